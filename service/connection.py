"""The connection of a client to the service, with retries of what may fail temporarily."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import takewhile
from pathlib import Path
from typing import IO, Any, TypeVar
from urllib.parse import urlsplit

import httpx2

from stillpath.version import __version__

__all__ = [
    "FIRST_PAUSE_S",
    "Broken",
    "ClientError",
    "Connection",
    "NoEvents",
    "Tell",
    "may_be_silent",
]

Tell = Callable[[str, float | None], object]
"""Is told what is being done, and the share that is done if it is known; may raise to stop."""

Found = TypeVar("Found")

FIRST_PAUSE_S = 0.2
_BUSY = (408, 429, 502, 503, 504)
_LONGEST_PAUSE_S = 5.0
_ANSWER_S = 60.0
"""How long one answer may take to begin."""
_SILENCE_S = 45.0
"""Watching is given up when nothing came for so long; the service sends something every 15 s."""
_MAX_RESTARTS, _MAX_DOWNLOAD_ATTEMPTS = 3, 4


class ClientError(Exception):
    """The service did not do it; the message says why.

    Attributes
    ----------
    status : int or None
        Of the answer; None: there was none.
    problem : dict
        The problem document (RFC 9457), if one came.
    is_refused : bool
        Another try with the same request would not help.
    exit_code : int
        For the command line.
    """

    def __init__(
        self, message: str, status: int | None = None, problem: Mapping[str, Any] | None = None
    ) -> None:
        super().__init__(" ".join(message.split()))
        self.status = status
        self.problem = dict(problem or {})
        self.is_refused = status is not None and status < 500 and status not in _BUSY
        self.exit_code = 2 if self.is_refused else 1


class Broken(Exception):
    """There is no answer, or not all of it: another try may bring it."""

    def __init__(
        self,
        reason: str,
        pause_s: float | None = None,
        *,
        midway: bool = False,
        answered: bool = False,
    ) -> None:
        super().__init__(reason)
        self.pause_s = pause_s
        self.midway = midway
        """It broke off in an upload, perhaps after minutes."""
        self.answered = answered
        """The service said why it cannot now."""


class NoEvents(Exception):
    """The server, or a proxy before it, sends no events."""


class Connection:
    """Requests to a service; parameters as `service.client.Client` has them.

    Raises
    ------
    ClientError
        If `server` is no address, or `key` no key.
    """

    def __init__(self, server: str, key: str | None, *, patience_s: float) -> None:
        host = _host_of(server)
        if host is None:
            raise ClientError(
                f"{server!r} is not the address of a server; one looks like http://127.0.0.1:8000",
                400,
            )
        if key is not None and not (key.isascii() and key.isprintable() and key.strip() == key):
            raise ClientError("the key holds characters that no key has", 400)
        self.server = server.rstrip("/")
        self._patience_s = patience_s
        headers = {"User-Agent": f"stillpath/{__version__}"}
        if key:
            headers["Authorization"] = f"Bearer {key}"
        # A key must not follow a redirection to somewhere else, and no proxy leads to ourselves.
        try:
            self._http = httpx2.Client(
                base_url=self.server,
                headers=headers,
                timeout=_ANSWER_S,
                follow_redirects=False,
                trust_env=host not in ("localhost", "127.0.0.1", "::1"),
            )
        except (httpx2.InvalidURL, ValueError, ImportError, OSError) as error:
            raise ClientError(
                f"{server} cannot be asked: {error}; look at the address, and at HTTP_PROXY, "
                "HTTPS_PROXY, ALL_PROXY, NO_PROXY and SSL_CERT_FILE in the environment",
                400,
            ) from None

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def ask(self, method: str, path: str, **request: Any) -> httpx2.Response:
        """Return the answer to a request that may be repeated."""
        return self.patiently(lambda: self.send(method, path, **request), None)

    def send(self, method: str, path: str, **request: Any) -> httpx2.Response:
        """Return the answer to a request; `Broken` if another try may bring it."""
        try:
            answer = self._http.request(method, path, **request)
        except httpx2.RequestError as error:
            # Not where it did not begin, or all was sent and the service only says nothing.
            whole = httpx2.ConnectError | httpx2.ConnectTimeout | httpx2.ReadTimeout
            midway = "content" in request and not isinstance(error, whole)
            raise Broken(_reason(error), midway=midway) from None
        self._check(answer)
        return answer

    def patiently(self, ask: Callable[[], Found], tell: Tell | None) -> Found:
        """Return what `ask` returns; what may pass by itself is tried again for some time."""
        deadline, pause_s = time.monotonic() + self._patience_s, FIRST_PAUSE_S
        restarts_left = _MAX_RESTARTS
        while True:
            began = time.monotonic()
            try:
                return ask()
            except Broken as error:
                # To send a large file may take all patience, before the service says it is busy.
                is_long = error.answered and time.monotonic() - began > self._patience_s / 2
                if (error.midway or is_long) and restarts_left:
                    deadline = time.monotonic() + self._patience_s
                    restarts_left -= 1
                wait_s = max(pause_s, error.pause_s or 0.0)
                if time.monotonic() + wait_s > deadline:
                    raise ClientError(self._given_up(error)) from None
                state = "is busy" if error.answered else "does not answer"
            if tell is not None:
                tell(f"the server {state}; trying again", None)
            time.sleep(wait_s)
            pause_s = min(2 * pause_s, _LONGEST_PAUSE_S)

    def _given_up(self, error: Broken) -> str:
        if error.answered:
            return f"{self.server} could not take the request: {error}"
        return f"no answer from {self.server}: {error}"

    def post_quietly(self, path: str) -> None:
        """Post once, whatever becomes of it."""
        try:
            self._http.request("POST", path, timeout=5.0)
        except httpx2.HTTPError:
            return

    def events(
        self, path: str, last_id: str | None, deadline: float | None
    ) -> Iterator[dict[str, str]]:
        """Yield the fields of every event after `last_id`.

        The stream is left when it ends, or when a silence could outlast the deadline.

        Raises
        ------
        Broken
        NoEvents
        """
        headers = {"Accept": "text/event-stream"}
        if last_id is not None:
            headers["Last-Event-ID"] = last_id
        timeout = httpx2.Timeout(_SILENCE_S, connect=10.0)
        try:
            with self._http.stream("GET", path, headers=headers, timeout=timeout) as answer:
                kind = answer.headers.get("content-type", "")
                if answer.status_code in _BUSY:
                    raise Broken(answer.reason_phrase)
                if answer.status_code != 200 or not kind.startswith("text/event-stream"):
                    raise NoEvents
                lines = takewhile(lambda _: may_be_silent(deadline), answer.iter_lines())
                yield from _parsed(lines)
        except httpx2.RequestError as error:
            raise Broken(_reason(error)) from None

    def download(
        self, path: str, target: Path, tell: Tell | None, size_bytes: int | None = None
    ) -> None:
        """Write an answer to a file, in several goes if need be; its size may be known."""
        with target.open("wb") as file:
            download = _Download(path, file)
            for attempts_left in reversed(range(_MAX_DOWNLOAD_ATTEMPTS)):
                try:
                    self.patiently(lambda: self._part(download, tell), tell)
                    break
                except _Cut as cut:
                    if not attempts_left:
                        reason = f"{path} cannot be fetched from {self.server}: {cut}"
                        raise ClientError(reason) from None
                    time.sleep(FIRST_PAUSE_S)
            came_bytes = file.tell()
        if size_bytes is not None and came_bytes != size_bytes:
            raise ClientError(
                f"{path} came with {came_bytes} instead of {size_bytes} bytes from {self.server}: "
                "something in between answered instead, such as the login page of a proxy"
            )
        named = (download.tag or "").strip('"')
        if len(named) == 64 and named != download.digest.hexdigest():
            raise ClientError(f"{path} came damaged from {self.server}; fetch it again")

    def not_stillpath(self) -> ClientError:
        """Return the error of an answer that makes no sense."""
        return ClientError(
            f"{self.server} answers, but not as a Stillpath server of version {__version__}"
        )

    def _check(self, answer: httpx2.Response) -> None:
        """Raise unless the answer is a good one; its body must be read."""
        status = answer.status_code
        if status < 300:
            return
        try:
            problem = json.loads(answer.content)
        except (ValueError, RecursionError):
            problem = {}
        problem = problem if isinstance(problem, dict) else {}
        reason = problem.get("detail") or f"{self.server} answers {status} {answer.reason_phrase}"
        if status in _BUSY and not (status == 503 and problem.get("title") == "Not ready"):
            pause_s = _seconds(answer.headers.get("retry-after"))
            raise Broken(str(reason), pause_s, answered=True)
        if 300 <= status < 400:
            reason = f"{self.server} has moved to {answer.headers.get('location')}; name that"
        elif status == 401:
            reason = f"the server does not accept the key (401): {reason}"
        raise ClientError(str(reason), status, problem)

    def _part(self, download: _Download, tell: Tell | None) -> None:
        """Append what is missing."""
        path, file = download.path, download.file
        headers = {"Accept-Encoding": "identity"}
        have = file.tell()
        if have and download.tag is not None:
            headers |= {"Range": f"bytes={have}-", "If-Range": download.tag}
        try:
            with self._http.stream("GET", path, headers=headers) as answer:
                if answer.status_code >= 300:
                    answer.read()
                    self._check(answer)
                if answer.status_code != 206 and have:
                    raise ClientError(f"{path} has changed while it was fetched; try again")
                download.tag = answer.headers.get("etag")
                expected = have + int(answer.headers.get("content-length", -1 - have))
                try:
                    for chunk in answer.iter_raw():  # as it comes: what came is kept
                        file.write(chunk)
                        download.digest.update(chunk)
                        if tell is not None:
                            share = file.tell() / expected if expected > 0 else None
                            tell("fetching", share)
                except httpx2.RequestError as error:
                    raise _Cut(_reason(error)) from None
        except httpx2.RequestError as error:
            raise Broken(_reason(error)) from None
        if file.tell() != expected >= 0:
            raise _Cut(f"{file.tell()} of {expected} bytes came")


class _Cut(Exception):
    """A download broke off."""


@dataclass(slots=True)
class _Download:
    """How far a download is, and what it is of."""

    path: str
    file: IO[bytes]
    digest: hashlib._Hash = field(default_factory=hashlib.sha256)
    tag: str | None = None


def _host_of(server: str) -> str | None:
    try:
        parts = urlsplit(server)
        fits = parts.scheme in ("http", "https") and parts.port != 0
    except ValueError:  # a port that is not a number, half an IPv6 address
        return None
    return parts.hostname or None if fits else None


def _parsed(lines: Iterator[str]) -> Iterator[dict[str, str]]:
    """Yield the fields of every event of a stream (HTML standard, 9.2.6)."""
    event: dict[str, str] = {}
    for line in lines:
        if not line:
            if event:
                yield event
            event = {}
        elif not line.startswith(":"):
            name, _, value = line.partition(":")
            value = value.removeprefix(" ")
            event[name] = f"{event[name]}\n{value}" if name in event and name == "data" else value


def may_be_silent(deadline: float | None) -> bool:
    """Whether a stream that falls silent now is given up before the deadline."""
    return deadline is None or time.monotonic() + _SILENCE_S < deadline


def _seconds(header: str | None) -> float | None:
    return float(header) if header is not None and header.isdecimal() else None


def _reason(error: Exception) -> str:
    return str(error) or type(error).__name__
