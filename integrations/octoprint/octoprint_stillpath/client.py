"""A client of the service that needs the standard library only."""

from __future__ import annotations

import contextlib
import http.client
import json
import time
import urllib.request
import uuid
from typing import TYPE_CHECKING, Any
from urllib.error import HTTPError, URLError
from urllib.parse import quote, urlencode, urlsplit

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path
    from typing import BinaryIO

__all__ = ["Failure", "Service"]

# Client of the service: the same in slicers/, cura/ and octoprint/.


class Failure(Exception):
    """It was not done: one line for the user; code 1: another try may help, 2: it will not."""

    def __init__(self, message: object, code: int = 2) -> None:
        super().__init__(" ".join(str(message).split()))
        self.code = code


class Service:
    """A Stillpath server.

    Parameters
    ----------
    address : str
        As in a browser: ``http://127.0.0.1:8000``.
    key : str
        Sent as a bearer token; empty for none.
    timeout_s : float
        How long the server may be silent, or away while a job is there, before it is given up.
    tell : callable
        Is told the stage, and the share that is done or None; may raise to stop the work.
    no_report : callable
        Is told why there is no report, if it cannot be fetched: the print is right all the same.
    """

    _FIRST_PATIENCE_S = 3.0
    _BUSY = (408, 429, 502, 503, 504)
    _LONGEST_PAUSE_S = 2.0
    _MAX_RESTARTS = 3
    """How many times a transfer that broke off midway gets its full patience again."""

    def __init__(
        self,
        address: str,
        key: str = "",
        timeout_s: float = 60.0,
        tell: Callable[[str, float | None], object] = lambda _stage, _share: None,
        no_report: Callable[[str], object] = lambda _reason: None,
    ) -> None:
        address, key = address.strip().rstrip("/"), key.strip()
        host = _host_of(address)
        if not host:
            raise Failure(f"{address!r} is not the address of a server, like http://127.0.0.1:8000")
        if not (key.isascii() and key.isprintable()):
            raise Failure("the key holds characters that no key has; copy it again")
        self._address = address
        self._headers = {"Authorization": f"Bearer {key}"} if key else {}
        self._timeout_s = timeout_s
        self._tell, self._no_report = tell, no_report
        # A key must not follow a redirection to somewhere else, and no proxy leads to ourselves.
        handlers: list[Any] = [_Web()]
        if host in ("localhost", "127.0.0.1", "::1"):
            handlers.append(urllib.request.ProxyHandler({}))
        self._opener = urllib.request.build_opener(*handlers)

    def compensate(
        self,
        source: Path,
        target: Path,
        options: Mapping[str, Any],
        wait_s: float | None = None,
        with_report: bool = True,
    ) -> bytes:
        """Send a file, wait, fetch the result and return the page of the report, if there is one.

        Parameters
        ----------
        source, target : Path
            The target is written in place: guard it.
        options : dict
            `machine`, `name` (of the file, in the report) and other parameters of a job.
        wait_s : float, optional
            Give up after this time.

        Raises
        ------
        Failure
        """
        self._tell("asking the server", None)
        machine = quote(options["machine"], safe="")
        # Whether address, key and machine are right is known before a long upload.
        self._ask("GET", f"/v1/machines/{machine}", min(self._FIRST_PATIENCE_S, self._timeout_s))
        path = f"/v1/jobs/{quote(self._send(source, options), safe='')}"
        try:
            self._fetch(path, self._wait(path, wait_s), target)
            return self._report(f"{path}/report") if with_report else b""
        finally:
            self._forget(path)

    def _send(self, source: Path, options: Mapping[str, Any]) -> str:
        # A job of our own: it is deleted afterwards, also if others send the same file.
        options = {**options, "fresh": "true"}
        job, _ = self._upload(source, options, uuid.uuid4().hex)
        size = source.stat().st_size
        if job.get("source_bytes") != size:
            self._forget(f"/v1/jobs/{quote(job['id'], safe='')}")
            raise Failure(f"sent {size} bytes, but {job.get('source_bytes')} arrived", 1)
        return job["id"]

    def _upload(
        self, source: Path, options: Mapping[str, Any], key: str
    ) -> tuple[dict[str, Any], bool]:
        """Return the job that the server makes of a file, and whether it is a new one.

        Sent again with the same key, it is one job all the same.
        """
        query = urlencode({**options, "name": options["name"][-255:]}, errors="replace")
        is_new = False

        def take(answer: Any) -> bytes:
            nonlocal is_new
            is_new = answer.status == 202
            return _read(answer)

        with source.open("rb") as file:
            size = source.stat().st_size
            body = _CountedFile(file, size, lambda share: self._tell("sending", share), key)
            answer = self._ask("POST", f"/v1/jobs?{query}", self._timeout_s, body, take)
        return self._document(answer), is_new

    def _wait(self, path: str, wait_s: float | None) -> dict[str, Any]:
        """Return the job when it is done."""
        began, pause_s = time.monotonic(), 0.1
        while True:
            job = self._document(self._ask("GET", path, self._timeout_s))
            state = job.get("state")
            if state == "done":
                return job
            if state in ("failed", "cancelled"):
                problem = job.get("error") or {}
                reason = problem.get("detail") or f"the job was {state} on the server"
                raise Failure(reason, 1 if str(problem.get("status")).startswith("5") else 2)
            if wait_s is not None and time.monotonic() - began > wait_s:
                raise Failure(f"not done within {wait_s:.0f} s; given up", 1)
            waiting = job.get("queue_position")
            stage = f"waiting behind {waiting} jobs" if waiting else job.get("stage") or "waiting"
            self._tell(stage, job.get("progress"))
            time.sleep(pause_s)
            pause_s = min(1.5 * pause_s, self._LONGEST_PAUSE_S)

    def _fetch(self, path: str, job: Mapping[str, Any], target: Path) -> None:
        """Write the result of a job to a file, all of it and nothing else.

        A transfer that breaks off goes on where it did: results may have gigabytes.
        """
        expected, tag = job.get("result_bytes") or 0, ""

        def missing() -> dict[str, str]:
            begun = tag and 0 < file.tell() < expected
            return {"Range": f"bytes={file.tell()}-", "If-Range": tag} if begun else {}

        def save(answer: Any) -> bytes:
            nonlocal tag
            if answer.status != 206:
                file.seek(0)
                file.truncate()
                tag = answer.headers.get("ETag") or ""
            while chunk := _read(answer, 1 << 18):
                file.write(chunk)
                self._tell("fetching", min(file.tell() / max(expected, 1), 1.0))
            # What a proxy answers instead may well be whole: only the job knows the size.
            if not expected or file.tell() != expected:
                raise _Broken(f"{file.tell()} of {expected} bytes came", midway=bool(tag))
            return b""

        try:
            with target.open("wb") as file:
                self._ask("GET", f"{path}/result", self._timeout_s, take=save, more=missing)
        except OSError as error:  # of a full disk, which does not say where
            error.filename = str(target)
            raise

    def _report(self, path: str) -> bytes:
        """Return a report; empty, once `no_report` was told why, if there is none."""
        try:
            return self._ask("GET", path, self._timeout_s)
        except Failure as failure:
            self._no_report(str(failure))
            return b""

    def _forget(self, path: str) -> None:
        """Delete the job, unless it is gone, or the server: nobody wants it any more."""
        with contextlib.suppress(Failure, _Broken):
            self._open("DELETE", path, timeout_s=min(5.0, self._timeout_s)).close()

    def _ask(
        self,
        method: str,
        path: str,
        patience_s: float,
        body: _CountedFile | None = None,
        take: Callable[[Any], bytes] = lambda answer: _read(answer),
        more: Callable[[], Mapping[str, str]] = dict,
    ) -> bytes:
        """Return what is taken of the answer; what may pass by itself is tried for some time.

        `more` gives further headers of each try.
        """
        deadline, pause_s = time.monotonic() + patience_s, 0.2
        restarts_left = self._MAX_RESTARTS
        while True:
            began = time.monotonic()
            try:
                with self._open(method, path, body, more()) as answer:
                    return take(answer)
            except _Broken as error:
                broken = error
            # To send a large file may take all patience, before the server says that it is busy.
            is_long = broken.pause_s is not None and time.monotonic() - began > patience_s / 2
            if (broken.midway or is_long) and restarts_left:
                deadline = time.monotonic() + self._timeout_s
                restarts_left -= 1
            wait_s = max(pause_s, broken.pause_s or 0.0)
            if time.monotonic() + wait_s > deadline:
                raise Failure(self._given_up(broken), 1)
            state = "does not answer" if broken.pause_s is None else "is busy"
            self._tell(f"the server {state}; trying again", None)
            time.sleep(wait_s)
            pause_s = min(2 * pause_s, self._LONGEST_PAUSE_S)

    def _given_up(self, broken: _Broken) -> str:
        if broken.pause_s is not None:
            return f"{self._address} could not take the request: {broken}"
        return (
            f"no answer from {self._address}: {broken}; is the service running there "
            "(`stillpath serve`), and is the address right (--server)?"
        )

    def _open(
        self,
        method: str,
        path: str,
        body: _CountedFile | None = None,
        more: Mapping[str, str] = {},
        timeout_s: float | None = None,
    ) -> Any:
        """Return the open answer; raise `Failure` if it is no, `_Broken` if there is none."""
        headers = {**self._headers, **more}
        if body is not None:
            headers["Content-Type"] = "application/octet-stream"
            headers["Content-Length"] = str(body.size)
            headers["Idempotency-Key"] = body.key
            body.rewind()
        request = urllib.request.Request(
            self._address + path, data=body, headers=headers, method=method
        )
        try:
            return self._opener.open(request, timeout=timeout_s or self._timeout_s)
        except HTTPError as error:
            with error:
                problem = _problem(error)
                if error.code in self._BUSY:
                    reason = problem.get("detail") or f"{error.code} {error.reason}"
                    asked = error.headers.get("Retry-After") or ""
                    pause_s = float(asked) if asked.isascii() and asked.isdigit() else 0.0
                    raise _Broken(str(reason), pause_s=pause_s) from None
                raise self._refusal(error, problem) from None
        except (OSError, http.client.HTTPException) as error:
            # Not where all was sent, and the server only says nothing.
            broke_off = isinstance(error, (URLError, ConnectionError, http.client.HTTPException))
            midway = body is not None and body.is_begun and broke_off
            raise _Broken(str(getattr(error, "reason", "") or error), midway) from None

    def _document(self, answer: bytes) -> dict[str, Any]:
        """Return what a server says of a job; what is used of it must be of its kind."""
        document = _object(answer)
        said = {name: kind for name, kind in _JOB.items() if document.get(name) is not None}
        if "id" not in said or not all(isinstance(document[n], said[n]) for n in said):
            raise Failure(f"{self._address} answers, but not as a Stillpath server", 1)
        return document

    def _refusal(self, error: HTTPError, problem: Mapping[str, Any]) -> Failure:
        """Return the error for an answer of status 300 or above."""
        reason = problem.get("detail") or f"{self._address} answers {error.code} {error.reason}"
        if error.code == 401:
            reason = f"the server does not accept the key (401): {reason}"
        elif 300 <= error.code < 400:
            reason = f"{self._address} has moved to {error.headers.get('Location')}; name that"
        elif problem.get("title") == "No such job":
            reason = f"the job was cancelled on the server: {reason}"
        return Failure(reason, 2 if error.code < 500 else 1)


_JOB: dict[str, Any] = {
    "id": str,
    "state": str,
    "stage": str,
    "error": dict,
    "progress": (int, float),
    "source_bytes": int,
    "result_bytes": int,
    "queue_position": int,
}
"""What is used of a job, and its kinds."""


class _Broken(Exception):
    """There is no good answer, or not all of it: another try may bring it.

    `midway`: it broke off; `pause_s`: how long the server wants to be left alone, if it answered.
    """

    def __init__(self, reason: str, midway: bool = False, pause_s: float | None = None) -> None:
        super().__init__(reason)
        self.midway, self.pause_s = midway, pause_s


def _host_of(address: str) -> str:
    """Return the host of an address that a server may have, or an empty text."""
    try:
        parts = urlsplit(address)
        fits = parts.scheme in ("http", "https") and parts.port != 0 and parts.path.isascii()
    except ValueError:  # a port that is not a number, half an IPv6 address
        return ""
    return (parts.hostname or "") if fits and address.isprintable() and " " not in address else ""


def _read(answer: Any, size: int | None = None) -> bytes:
    try:
        return bytes(answer.read(size))
    except (OSError, http.client.HTTPException) as error:
        raise _Broken(str(error) or type(error).__name__, midway=True) from None


def _problem(error: HTTPError) -> dict[str, Any]:
    """Return the problem document (RFC 9457) of an answer, empty if there is none."""
    try:
        return _object(_read(error, 1 << 16))
    except _Broken:
        return {}


def _object(answer: bytes) -> dict[str, Any]:
    """Return a JSON object, empty for anything else."""
    with contextlib.suppress(ValueError, RecursionError):
        if isinstance(found := json.loads(answer), dict):
            return found
    return {}


class _EarlyAnswer(http.client.HTTPConnection):
    """Reads the answer even if the server does not take the whole request."""

    def send(self, data: Any) -> None:
        if self.sock is None:
            self.connect()
        with contextlib.suppress(ConnectionError):
            super().send(data)


class _EarlyAnswerTls(_EarlyAnswer, http.client.HTTPSConnection):
    pass


class _Web(
    urllib.request.HTTPHandler, urllib.request.HTTPSHandler, urllib.request.HTTPRedirectHandler
):
    def http_open(self, request: Any) -> Any:
        return self.do_open(_EarlyAnswer, request)

    def https_open(self, request: Any) -> Any:
        return self.do_open(_EarlyAnswerTls, request)

    def redirect_request(self, *_: Any) -> None:
        """Go nowhere else."""


class _CountedFile:
    """A file that tells which share of it has been read, and the key of its job."""

    def __init__(
        self, file: BinaryIO, size: int, tell: Callable[[float], object], key: str
    ) -> None:
        self._file, self.size, self._tell, self.key = file, size, tell, key

    @property
    def is_begun(self) -> bool:
        return self._file.tell() > 0

    def rewind(self) -> None:
        self._file.seek(0)

    def read(self, size: int = -1) -> bytes:
        self._tell(min(self._file.tell() / max(self.size, 1), 1.0))
        return self._file.read(size)


# End of the client.
