"""A client of the HTTP service: hand in, wait, fetch.

It streams, repeats what is safe to repeat, and leaves nothing half-written.

>>> with Client("http://127.0.0.1:8000") as client:          # doctest: +SKIP
...     job = client.wait(client.submit("part.gcode", machine="ender3").id)
...     client.fetch(job, "part.stillpath.gcode")
"""

from __future__ import annotations

import hashlib
import json
import time
import uuid
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import takewhile
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Self, TypeVar
from urllib.parse import quote, urlsplit

import httpx2
from pydantic import ValidationError

from stillpath.pipeline.files import replacing
from stillpath.service.api.schemas import JobPage, JobView
from stillpath.version import __version__

if TYPE_CHECKING:
    from stillpath.pipeline.options import Options

__all__ = ["Client", "ClientError", "Submission"]

Tell = Callable[[str, float | None], object]
"""Is told what is being done, and the share that is done if it is known; may raise to stop."""

Found = TypeVar("Found")

_CHUNK_BYTES = 1 << 18
_BUSY = (408, 429, 502, 503, 504)
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.2, 5.0
_SILENCE_S = 45.0
"""Watching is given up when nothing came for so long; the service sends something every 15 s."""
_FETCHES = 4


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


class _Broken(Exception):
    """There is no answer, or not all of it: another try may bring it."""

    def __init__(self, reason: str, pause_s: float | None = None) -> None:
        super().__init__(reason)
        self.pause_s = pause_s


@dataclass(frozen=True, slots=True)
class Submission:
    """A job, and whether this submission made it."""

    job: JobView
    is_new: bool

    @property
    def id(self) -> str:
        """Of the job."""
        return self.job.id


class Client:
    """A service.

    Parameters
    ----------
    server : str
        As in a browser: ``http://127.0.0.1:8000``.
    key : str, optional
        An API key.
    timeout_s : float
        How long one answer may take to begin.
    patience_s : float
        For how long a service that does not answer, or is busy, is asked again.

    Raises
    ------
    ClientError
        If `server` is no address. Every method raises it; see there.
    """

    def __init__(
        self,
        server: str,
        key: str | None = None,
        *,
        timeout_s: float = 60.0,
        patience_s: float = 30.0,
    ) -> None:
        parts = urlsplit(server)
        if parts.scheme not in ("http", "https") or not parts.hostname:
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
        self._http = httpx2.Client(
            base_url=self.server,
            headers=headers,
            timeout=timeout_s,
            follow_redirects=False,
            trust_env=parts.hostname not in ("localhost", "127.0.0.1", "::1"),
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def submit(
        self,
        source: Path | str,
        *,
        machine: str,
        options: Options | None = None,
        name: str | None = None,
        tell: Tell | None = None,
        **more: Any,
    ) -> Submission:
        """Hand a file in. Repeated if the connection breaks; that makes one job all the same.

        Parameters
        ----------
        source : Path
        machine : str
            As the service calls it.
        options : Options, optional
        name : str, optional
            What the file is called in the report; by default its own name.
        tell : callable, optional
        **more
            Further parameters of `POST /v1/jobs`: priority, batch, fresh, webhook, printer, print.
        """
        source = Path(source)
        chosen = {} if options is None else options.model_dump()
        given = {**chosen, **more, "machine": machine, "name": (name or source.name)[-255:]}
        parameters = {key: _wire(value) for key, value in given.items() if value is not None}
        idempotency_key = uuid.uuid4().hex

        def send() -> Submission:
            size_bytes = source.stat().st_size
            with source.open("rb") as file:
                answer = self._send(
                    "POST",
                    "/v1/jobs",
                    params=parameters,
                    content=_told(file, size_bytes, tell),
                    headers={
                        "Content-Type": "application/octet-stream",
                        "Content-Length": str(size_bytes),
                        "Idempotency-Key": idempotency_key,
                    },
                )
            return Submission(self._job(answer), is_new=answer.status_code == 202)

        return self._patiently(send, tell)

    def job(self, job_id: str) -> JobView:
        """Return how a job stands."""
        return self._job(self._ask("GET", _path(job_id)))

    def jobs(self, **filters: Any) -> Iterator[JobView]:
        """Yield jobs, newest first; `filters` are parameters of `GET /v1/jobs`."""
        cursor = None
        while True:
            given = {**filters, "cursor": cursor}
            given = {key: value for key, value in given.items() if value is not None}
            answer = self._ask("GET", "/v1/jobs", params=given)
            try:
                page = JobPage.model_validate_json(answer.content)
            except ValidationError:
                raise self._stranger() from None
            yield from page.jobs
            cursor = page.next
            if cursor is None:
                return

    def wait(
        self,
        job_id: str,
        *,
        tell: Callable[[JobView], object] | None = None,
        timeout_s: float | None = None,
    ) -> JobView:
        """Return a job when it is over, in whatever way.

        It is watched by server-sent events, and asked for where these do not come through, and
        shortly before `timeout_s` is over.

        Parameters
        ----------
        job_id : str
        tell : callable, optional
            Is told of every change; may raise to stop the waiting.
        timeout_s : float, optional
            Then `ClientError` is raised; the job goes on.
        """
        deadline = None if timeout_s is None else time.monotonic() + timeout_s
        streams, pause_s = True, _FIRST_PAUSE_S
        seen: str | None = None
        while True:
            if streams and _may_be_silent(deadline):
                try:
                    for event_id, job in self._events(job_id, seen, deadline):
                        seen = event_id
                        pause_s = _FIRST_PAUSE_S
                        if tell is not None:
                            tell(job)
                        if job.state.is_final:
                            return job
                        _check_time(deadline, job)
                except _Broken:
                    pass
                except _NoEvents:
                    streams = False
            job = self.job(job_id)
            if tell is not None:
                tell(job)
            if job.state.is_final:
                return job
            _check_time(deadline, job)
            time.sleep(pause_s)
            pause_s = min(1.5 * pause_s, 2.0)

    def result_of(self, submission: Submission, **waiting: Any) -> JobView:
        """Return the job when it is done; a job that failed or was cancelled is an error.

        If the waiting is interrupted, a job that the submission made is cancelled.
        """
        try:
            job = self.wait(submission.id, **waiting)
        except BaseException:
            if submission.is_new:
                self._cancel_quietly(submission.id)
            raise
        if job.state.value == "done":
            return job
        problem = job.error or {}
        detail = problem.get("detail") or f"the job was {job.state.value} on the server"
        raise ClientError(str(detail), int(problem.get("status", 409)), problem)

    def fetch(self, job: JobView | str, target: Path | str, *, tell: Tell | None = None) -> Path:
        """Write the result to a file, whole or not at all; what broke off is taken up again.

        Parameters
        ----------
        job : JobView or str
            The job or its id.
        target : Path
        tell : callable, optional

        Raises
        ------
        ClientError
        OSError
            If the file cannot be written.
        """
        job_id = job if isinstance(job, str) else job.id
        target = Path(target)
        with replacing(target) as temporary:
            self._download(_path(job_id, "result"), temporary, tell)
        return target

    def report(self, job_id: str) -> dict[str, Any]:
        """Return the figures of the report."""
        return self._document(self._ask("GET", _path(job_id, "report.json")))

    def save_report(self, job_id: str, folder: Path | str) -> Path:
        """Write report.html and report.json into a folder, made if need be."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        for name, path in (("report.html", "report"), ("report.json", "report.json")):
            with replacing(folder / name) as temporary:
                self._download(_path(job_id, path), temporary, None)
        return folder

    def machines(self) -> list[dict[str, Any]]:
        """Return the machines that jobs can name."""
        found = self._json(self._ask("GET", "/v1/machines"))
        if not isinstance(found, list):
            raise self._stranger()
        return found

    def machine(self, name: str) -> dict[str, Any]:
        """Return the document of a machine."""
        return self._document(self._ask("GET", f"/v1/machines/{quote(name, safe='')}"))

    def check_printer(self, name: str, *, accept: bool = False) -> dict[str, Any]:
        """Return how a printer compares with its machine (`service.deliveries.checking`).

        With `accept` its configuration is remembered as it is now.
        """
        method, last = ("POST", "accept") if accept else ("GET", "check")
        return self._document(self._ask(method, f"/v1/printers/{quote(name, safe='')}/{last}"))

    def version(self) -> str:
        """Return the version of the service."""
        return str(self._document(self._ask("GET", "/healthz")).get("version", ""))

    def cancel(self, job_id: str) -> JobView:
        """Stop a job; it stays in the list."""
        return self._job(self._ask("POST", _path(job_id, "cancel")))

    def delete(self, job_id: str) -> None:
        """Stop a job if it runs, and delete its files. One that is gone already is no error."""
        try:
            self._ask("DELETE", _path(job_id))
        except ClientError as error:
            if error.status != 404:
                raise

    # What goes over the wire

    def _ask(self, method: str, path: str, **request: Any) -> httpx2.Response:
        return self._patiently(lambda: self._send(method, path, **request), None)

    def _send(self, method: str, path: str, **request: Any) -> httpx2.Response:
        try:
            answer = self._http.request(method, path, **request)
        except httpx2.TransportError as error:
            raise _Broken(_reason(error)) from None
        self._check(answer)
        return answer

    def _patiently(self, ask: Callable[[], Found], tell: Tell | None) -> Found:
        """Return what `ask` returns; what may pass by itself is tried again for some time."""
        deadline, pause_s = time.monotonic() + self._patience_s, _FIRST_PAUSE_S
        while True:
            try:
                return ask()
            except _Broken as error:
                wait_s = max(pause_s, error.pause_s or 0.0)
                if time.monotonic() + wait_s > deadline:
                    raise ClientError(f"no answer from {self.server}: {error}") from None
            if tell is not None:
                tell("the server does not answer; trying again", None)
            time.sleep(wait_s)
            pause_s = min(2 * pause_s, _LONGEST_PAUSE_S)

    def _check(self, answer: httpx2.Response) -> None:
        """Raise unless the answer is a good one; its body must be read."""
        status = answer.status_code
        if status < 300:
            return
        try:
            problem = json.loads(answer.content)
        except ValueError:
            problem = {}
        problem = problem if isinstance(problem, dict) else {}
        reason = problem.get("detail") or f"{self.server} answers {status} {answer.reason_phrase}"
        if status in _BUSY and not (status == 503 and problem.get("title") == "Not ready"):
            raise _Broken(str(reason), _seconds(answer.headers.get("retry-after")))
        if 300 <= status < 400:
            reason = f"{self.server} has moved to {answer.headers.get('location')}; name that"
        elif status == 401:
            reason = f"the server does not accept the key (401): {reason}"
        raise ClientError(str(reason), status, problem)

    def _events(
        self, job_id: str, seen: str | None, deadline: float | None
    ) -> Iterator[tuple[str, JobView]]:
        """Yield id and job of every event; return when the stream ends or the deadline is near."""
        headers = {"Accept": "text/event-stream"}
        if seen is not None:
            headers["Last-Event-ID"] = seen
        timeout = httpx2.Timeout(_SILENCE_S, connect=10.0)
        try:
            with self._http.stream(
                "GET", _path(job_id, "events"), headers=headers, timeout=timeout
            ) as answer:
                kind = answer.headers.get("content-type", "")
                if answer.status_code in _BUSY:
                    raise _Broken(answer.reason_phrase)
                if answer.status_code != 200 or not kind.startswith("text/event-stream"):
                    raise _NoEvents
                lines = takewhile(lambda _: _may_be_silent(deadline), answer.iter_lines())
                for event in _parsed(lines):
                    if event.get("event") == "job":
                        yield event.get("id", ""), JobView.model_validate_json(event["data"])
        except httpx2.TransportError as error:
            raise _Broken(_reason(error)) from None
        except (ValidationError, KeyError):
            raise self._stranger() from None

    def _download(self, path: str, target: Path, tell: Tell | None) -> None:
        """Write an answer to a file, in several goes if need be."""
        with target.open("wb") as file:
            download = _Download(path, file)
            for attempts_left in reversed(range(_FETCHES)):
                try:
                    self._patiently(lambda: self._part(download, tell), tell)
                    break
                except _Cut as cut:
                    if not attempts_left:
                        reason = f"{path} cannot be fetched from {self.server}: {cut}"
                        raise ClientError(reason) from None
                    time.sleep(_FIRST_PAUSE_S)
        named = (download.tag or "").strip('"')
        if len(named) == 64 and named != download.digest.hexdigest():
            raise ClientError(f"{path} came damaged from {self.server}; fetch it again")

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
                except httpx2.TransportError as error:
                    raise _Cut(_reason(error)) from None
        except httpx2.TransportError as error:
            raise _Broken(_reason(error)) from None
        if file.tell() != expected >= 0:
            raise _Cut(f"{file.tell()} of {expected} bytes came")

    def _cancel_quietly(self, job_id: str) -> None:
        # Over already, or the server is: either way there is nothing left to stop.
        try:
            self._http.request("POST", _path(job_id, "cancel"), timeout=5.0)
        except httpx2.HTTPError:
            return

    def _job(self, answer: httpx2.Response) -> JobView:
        try:
            return JobView.model_validate_json(answer.content)
        except ValidationError:
            raise self._stranger() from None

    def _document(self, answer: httpx2.Response) -> dict[str, Any]:
        found = self._json(answer)
        if not isinstance(found, dict):
            raise self._stranger()
        return found

    def _json(self, answer: httpx2.Response) -> Any:
        try:
            return json.loads(answer.content)
        except ValueError:
            raise self._stranger() from None

    def _stranger(self) -> ClientError:
        return ClientError(
            f"{self.server} answers, but not as a Stillpath server of version {__version__}"
        )


class _NoEvents(Exception):
    """The server, or a proxy before it, sends no events."""


class _Cut(Exception):
    """A download broke off."""


@dataclass(slots=True)
class _Download:
    """How far a download is, and what it is of."""

    path: str
    file: IO[bytes]
    digest: hashlib._Hash = field(default_factory=hashlib.sha256)
    tag: str | None = None


def _path(job_id: str, *more: str) -> str:
    return "/".join(("/v1/jobs", quote(job_id, safe=""), *more))


def _wire(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    return str(value)


def _told(file: IO[bytes], size_bytes: int, tell: Tell | None) -> Iterator[bytes]:
    """Yield a file in chunks, as long as it was said to be."""
    left = size_bytes
    while left:
        chunk = file.read(min(_CHUNK_BYTES, left))
        if not chunk:
            raise ClientError(f"{file.name} became shorter while it was sent", 400)
        left -= len(chunk)
        if tell is not None:
            tell("sending", 1 - left / size_bytes)
        yield chunk


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


def _may_be_silent(deadline: float | None) -> bool:
    """Whether a stream that falls silent now is given up before the deadline."""
    return deadline is None or time.monotonic() + _SILENCE_S < deadline


def _check_time(deadline: float | None, job: JobView) -> None:
    if deadline is not None and time.monotonic() > deadline:
        raise ClientError(f"job {job.id} is still {job.state.value}; given up waiting")


def _seconds(header: str | None) -> float | None:
    return float(header) if header is not None and header.isdecimal() else None


def _reason(error: Exception) -> str:
    return str(error) or type(error).__name__
