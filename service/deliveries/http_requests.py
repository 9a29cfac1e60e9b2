"""Send one request to a checked address, without redirects and proxies."""

from __future__ import annotations

import contextlib
import socket
import ssl
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, BinaryIO

from stillpath.service.deliveries.targets import Target, Unresolved, addresses_of
from stillpath.version import __version__

if TYPE_CHECKING:
    import httpx2

__all__ = ["Reply", "Unanswered", "Unreached", "get", "post"]

_CONNECT_S = 10.0
_LONGEST_REPLY_BYTES = 4096
_SLOWEST = 3.0
"""Multiple of ``timeout_s`` allowed for the headers of a slow reply, and again for its body."""


class Unreached(Exception):
    """Nothing was sent: the connection failed, or the name is unknown."""


class Unanswered(Exception):
    """A request was sent, but its outcome is unknown."""


@dataclass(frozen=True, slots=True)
class Reply:
    """What came back; of the body only the beginning."""

    status: int
    text: str


def post(
    target: Target,
    *,
    headers: Mapping[str, str],
    content: bytes | None = None,
    fields: Mapping[str, str] | None = None,
    file: tuple[str, BinaryIO] | None = None,
    loopback: bool = False,
    timeout_s: float = 10.0,
) -> Reply:
    """Send one request.

    Parameters
    ----------
    headers : mapping
    content : bytes, optional
        The body, unless a form is sent.
    fields : mapping, optional
        Text fields of the form; used only with `file`.
    file : tuple of (name, open file), optional
        Name and open file of the form's file part; streamed.
    loopback : bool
        Whether the target may be this computer though its name does not say so.
    timeout_s : float
        How long the other side may be silent.

    Raises
    ------
    TargetRefused
        If the address is one that nothing is sent to.
    Unreached, Unanswered
    """
    body: dict[str, Any] = {"content": content}
    if file is not None:
        name, stream = file
        body = {
            "data": dict(fields or {}),
            "files": {"file": (name, stream, "application/octet-stream")},
        }
    again = None if file is None else file[1]
    return _exchange(
        "POST",
        target,
        headers=headers,
        body=body,
        stream=again,
        loopback=loopback,
        timeout_s=timeout_s,
        longest_bytes=_LONGEST_REPLY_BYTES,
    )


def get(
    target: Target,
    *,
    headers: Mapping[str, str],
    longest_bytes: int,
    loopback: bool = False,
    timeout_s: float = 10.0,
) -> Reply:
    """Ask for something; see `post`.

    Parameters
    ----------
    longest_bytes : int
        What comes after that is not read.
    """
    return _exchange(
        "GET",
        target,
        headers=headers,
        body={},
        stream=None,
        loopback=loopback,
        timeout_s=timeout_s,
        longest_bytes=longest_bytes,
    )


def _exchange(
    method: str,
    target: Target,
    *,
    headers: Mapping[str, str],
    body: Mapping[str, Any],
    stream: BinaryIO | None,
    loopback: bool,
    timeout_s: float,
    longest_bytes: int,
) -> Reply:
    import httpx2

    try:
        addresses = addresses_of(target, loopback=loopback)
    except Unresolved as error:
        raise Unreached(str(error)) from None
    # The environment's proxies would connect to where the name leads them.
    with httpx2.Client(
        trust_env=False,
        follow_redirects=False,
        verify=ssl.create_default_context() if target.scheme == "https" else False,
        timeout=httpx2.Timeout(timeout_s, connect=min(timeout_s, _CONNECT_S)),
        headers={"User-Agent": f"stillpath/{__version__}", "Accept-Encoding": "identity"},
    ) as client:
        for address in addresses:
            if stream is not None:
                stream.seek(0)
            # To the address that was checked; the name goes into Host, and TLS asks for it.
            request = client.build_request(
                method,
                httpx2.URL(
                    scheme=target.scheme,
                    host=address,
                    port=target.port,
                    raw_path=target.path.encode(),
                ),
                headers={**headers, "Host": target.authority},
                extensions={"sni_hostname": target.host},
                **body,
            )
            try:
                return _sent(client, request, longest_bytes, most_s=_SLOWEST * timeout_s)
            except (httpx2.ConnectError, httpx2.ConnectTimeout, httpx2.PoolTimeout) as error:
                reason = f"{target} cannot be reached: {error or type(error).__name__}"
            except httpx2.HTTPError as error:
                raise Unanswered(
                    f"{target} did not answer: {error or type(error).__name__}"
                ) from error
    raise Unreached(reason)


def _sent(
    client: httpx2.Client, request: httpx2.Request, longest_bytes: int, *, most_s: float
) -> Reply:
    import httpx2

    late = f"its reply was not whole after {most_s:g} s"
    limit = _HeaderLimit(most_s)
    request.extensions["trace"] = limit
    try:
        response = client.send(request, stream=True)
    except httpx2.HTTPError:
        if limit.reached:
            raise httpx2.ReadTimeout(late) from None
        raise
    finally:
        limit.end()
    deadline = time.monotonic() + most_s
    try:
        start = b""
        for chunk in response.iter_raw():
            start += chunk
            if len(start) >= longest_bytes:
                break
            if time.monotonic() > deadline:
                raise httpx2.ReadTimeout(late)
    finally:
        response.close()
    return Reply(response.status_code, start[:longest_bytes].decode("utf-8", "replace"))


class _HeaderLimit:
    """Disconnects if the headers of a reply are not complete in time.

    The client's own timeout restarts with every byte. Connection and start of waiting are taken
    from httpcore's extension ``trace``.
    """

    def __init__(self, most_s: float) -> None:
        self.reached = False
        self._most_s = most_s
        self._connection: socket.socket | None = None
        self._timer: threading.Timer | None = None

    def __call__(self, event: str, info: Mapping[str, Any]) -> None:
        if event in ("connection.connect_tcp.complete", "connection.start_tls.complete"):
            self._connection = info["return_value"].get_extra_info("socket")
        elif event == "http11.receive_response_headers.started":
            self._timer = threading.Timer(self._most_s, self._hang_up)
            self._timer.daemon = True
            self._timer.start()

    def end(self) -> None:
        """Stop waiting: the headers are there, or will never be."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer.join()

    def _hang_up(self) -> None:
        self.reached = True
        if self._connection is not None:
            with contextlib.suppress(OSError):
                self._connection.shutdown(socket.SHUT_RDWR)
