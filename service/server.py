"""Runs the HTTP application in this process."""

from __future__ import annotations

import socket
import sys

import uvicorn

from service.api import create_app
from service.exclusive import exclusive
from service.logs import configure_logging
from service.settings import Settings

__all__ = ["serve_forever"]

_BACKLOG = 128


def serve_forever(settings: Settings, host: str, port: int) -> None:
    """Serve until interrupted.

    Parameters
    ----------
    settings : Settings
    host : str
        Address to bind; the caller has checked that it may be reached.
    port : int
        0 takes any free port; the first line on stdout names it.

    Raises
    ------
    OSError
        If the address cannot be bound, or another service works with the data directory.
    """
    configure_logging()
    app = create_app(settings)
    config = uvicorn.Config(
        app, host=host, port=port, log_level="warning", access_log=False, server_header=False
    )
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with (
        exclusive(settings.data_dir),
        socket.create_server((host, port), family=family, backlog=_BACKLOG) as listener,
    ):
        shown = f"[{host}]" if family == socket.AF_INET6 else host
        sys.stdout.write(f"stillpath: http://{shown}:{listener.getsockname()[1]}/\n")
        sys.stdout.flush()
        uvicorn.Server(config).run(sockets=[listener])
