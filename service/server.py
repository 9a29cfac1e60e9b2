"""Run the HTTP application in this process."""

from __future__ import annotations

import contextlib
import errno
import socket
import sys
import time
from collections.abc import Iterator

import structlog
import uvicorn

from stillpath.service.api import create_app
from stillpath.service.database.engine import database_url, open_database
from stillpath.service.database.errors import DatabaseAway
from stillpath.service.instance_lock import exclusive
from stillpath.service.jobs.task import Runner
from stillpath.service.jobs.worker import run_compensation
from stillpath.service.logs import configure_logging
from stillpath.service.permissions import private_folder
from stillpath.service.processes import quiet_tracker
from stillpath.service.security.keys import keys_needed
from stillpath.service.settings import Settings

__all__ = ["serve_forever"]

_SWITCH_S = 0.001
"""Thread switch interval; the default of 5 ms would delay every step of an upload."""
_BACKLOG = 1024
_LONGEST_HEADERS_BYTES = 32 << 10
_FIRST_WAIT_S, _LONGEST_WAIT_S = 0.5, 5.0
_GOODBYE_S = 5
"""Time allowed to active requests when the service shuts down."""


def serve_forever(
    settings: Settings, host: str, port: int, *, runner: Runner = run_compensation
) -> None:
    """Serve until interrupted.

    Parameters
    ----------
    host : str
        Address to bind.
    port : int
        0 takes any free port; the first line on stdout names it.
    runner : Runner
        Does the work of a job; replaceable in tests.

    Raises
    ------
    OSError
        If the address cannot be bound, or another service works with the data directory.
    StoreError
        If the database cannot be opened; one on another computer that is away is waited for.
    UnsafeBinding
        If other computers can reach the address, and keys are switched off.
    """
    configure_logging()
    sys.setswitchinterval(_SWITCH_S)
    app = create_app(settings, keys_required=keys_needed(settings, host), runner=runner)
    config = uvicorn.Config(
        app,
        host=host,
        port=port,
        log_config=None,  # as all libraries': `service.logs`
        log_level="warning",
        access_log=False,
        server_header=False,
        # `service.api.proxies` knows which to trust.
        proxy_headers=False,
        h11_max_incomplete_event_size=_LONGEST_HEADERS_BYTES,
        timeout_graceful_shutdown=_GOODBYE_S,
    )
    quiet_tracker()
    with (
        _alone(settings),
        _database(settings),
        _listening(host, port) as listener,
    ):
        log = structlog.get_logger("serve")
        log.info("data directory", folder=str(settings.data_dir.resolve()))
        for address in _addresses(host, listener.getsockname()[1]):
            sys.stdout.write(f"stillpath: {address}\n")
        sys.stdout.flush()
        uvicorn.Server(config).run(sockets=[listener])


def _listening(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    both = _is_dual(host)
    try:
        return socket.create_server(
            (host, port), family=family, backlog=_BACKLOG, dualstack_ipv6=both
        )
    except OSError as error:
        if error.errno != errno.EADDRINUSE:
            raise
        taken = f"another program listens on {host}:{port}; stop it, or choose another --port"
        raise OSError(error.errno, f"{taken} (0: any)") from None


def _is_dual(host: str) -> bool:
    """Return whether IPv4 is answered, too, where an IPv6 address is bound."""
    return host == "::" and socket.has_dualstack_ipv6()


def _addresses(host: str, port: int) -> list[str]:
    """Return where a browser finds the service, on this computer first."""
    if host in ("0.0.0.0", "::", ""):
        name = socket.gethostname()
        here = "[::1]" if host == "::" and not _is_dual(host) else "127.0.0.1"
        others = [name, *_own_address()]
        return [
            f"http://{here}:{port}/",
            *(f"http://{other}:{port}/ (from other computers)" for other in others),
        ]
    shown = f"[{host}]" if ":" in host else host
    return [f"http://{shown}:{port}/"]


def _own_address() -> list[str]:
    """Return this computer's address in its network, if it has one: phones know no names."""
    with contextlib.suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect(("192.0.2.1", 9))  # sends nothing; an address for documentation (RFC 5737)
        return [probe.getsockname()[0]]
    return []


@contextlib.contextmanager
def _database(settings: Settings) -> Iterator[None]:
    """Wait until the database answers: where several computers start, in any order.

    The application opens it again, but errors there would be unreadable through uvicorn.
    """
    wait_s = _FIRST_WAIT_S
    while True:
        try:
            open_database(settings).dispose()
        except DatabaseAway as error:
            if database_url(settings).get_backend_name() == "sqlite":
                raise  # an unreadable file does not recover by itself
            structlog.get_logger("serve").warning(
                "waiting for the database", reason=str(error), again_in_s=wait_s
            )
        else:
            break
        time.sleep(wait_s)
        wait_s = min(2 * wait_s, _LONGEST_WAIT_S)
    yield


@contextlib.contextmanager
def _alone(settings: Settings) -> Iterator[None]:
    """Lock the data folder, unless workers are remote: then it has no permanent data."""
    if settings.scheduler is not None:
        private_folder(settings.data_dir)
        yield
        return
    with exclusive(settings.data_dir):
        yield
