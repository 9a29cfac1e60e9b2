"""A client of the HTTP service: hand in, wait, fetch.

It streams, repeats what is safe to repeat, and leaves nothing half-written.

>>> with Client("http://127.0.0.1:8000") as client:          # doctest: +SKIP
...     job = client.wait(client.submit("part.gcode", machine="ender3").id)
...     client.fetch(job, "part.stillpath.gcode")
"""

from __future__ import annotations

import json
import time
import uuid
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Self
from urllib.parse import quote

import httpx2
from pydantic import ValidationError

from stillpath.pipeline.files import replacing
from stillpath.service.api.schemas import JobPage, JobView
from stillpath.service.connection import (
    FIRST_PAUSE_S,
    Broken,
    ClientError,
    Connection,
    NoEvents,
    Tell,
    may_be_silent,
)

if TYPE_CHECKING:
    from stillpath.pipeline.options import Options

__all__ = ["Client", "ClientError", "Submission"]

_CHUNK_BYTES = 1 << 18


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
    patience_s : float
        For how long a service that does not answer, or is busy, is asked again.

    Raises
    ------
    ClientError
        If `server` is no address. Every method raises it; see there.
    """

    def __init__(self, server: str, key: str | None = None, *, patience_s: float = 30.0) -> None:
        self._connection = Connection(server, key, patience_s=patience_s)
        self.server = self._connection.server

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections."""
        self._connection.close()

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
                answer = self._connection.send(
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

        return self._connection.patiently(send, tell)

    def job(self, job_id: str) -> JobView:
        """Return how a job stands."""
        return self._job(self._connection.ask("GET", _path(job_id)))

    def jobs(self, **filters: Any) -> Iterator[JobView]:
        """Yield jobs, newest first; `filters` are parameters of `GET /v1/jobs`."""
        cursor = None
        while True:
            given = {**filters, "cursor": cursor}
            given = {key: value for key, value in given.items() if value is not None}
            answer = self._connection.ask("GET", "/v1/jobs", params=given)
            try:
                page = JobPage.model_validate_json(answer.content)
            except ValidationError:
                raise self._connection.not_stillpath() from None
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
        tell : callable, optional
            Is told of every change; may raise to stop the waiting.
        timeout_s : float, optional
            Then `ClientError` is raised; the job goes on.
        """
        deadline = None if timeout_s is None else time.monotonic() + timeout_s
        streams, pause_s = True, FIRST_PAUSE_S
        seen: str | None = None
        while True:
            if streams and may_be_silent(deadline):
                try:
                    for event_id, job in self._events(job_id, seen, deadline):
                        seen = event_id
                        pause_s = FIRST_PAUSE_S
                        if tell is not None:
                            tell(job)
                        if job.state.is_final:
                            return job
                        _check_time(deadline, job)
                except Broken:
                    pass
                except NoEvents:
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
                self._connection.post_quietly(_path(submission.id, "cancel"))
            raise
        if job.state.value == "done":
            return job
        problem = job.error or {}
        detail = problem.get("detail") or f"the job was {job.state.value} on the server"
        raise ClientError(str(detail), int(problem.get("status", 409)), problem)

    def fetch(
        self,
        job: JobView | str,
        target: Path | str,
        *,
        tell: Tell | None = None,
        check: Callable[[], object] = lambda: None,
    ) -> Path:
        """Write the result to a file, whole or not at all; what broke off is taken up again.

        Parameters
        ----------
        job : JobView or str
            The job or its id.
        target : Path
        tell : callable, optional
        check : callable, optional
            Called when all is here, before the file takes its place; may raise to leave that as
            it is.

        Raises
        ------
        ClientError
        OSError
            If the file cannot be written.
        """
        if isinstance(job, str):
            job = self.job(job)
        target = Path(target)
        with replacing(target) as temporary:
            path = _path(job.id, "result")
            self._connection.download(path, temporary, tell, size_bytes=job.result_bytes)
            check()
        return target

    def report(self, job_id: str) -> dict[str, Any]:
        """Return the figures of the report."""
        return self._document(self._connection.ask("GET", _path(job_id, "report.json")))

    def save_report(self, job_id: str, folder: Path | str) -> Path:
        """Write report.html and report.json into a folder, made if need be."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        for name, path in (("report.html", "report"), ("report.json", "report.json")):
            with replacing(folder / name) as temporary:
                self._connection.download(_path(job_id, path), temporary, None)
        return folder

    def machines(self) -> list[dict[str, Any]]:
        """Return the machines that jobs can name."""
        found = self._json(self._connection.ask("GET", "/v1/machines"))
        if not isinstance(found, list):
            raise self._connection.not_stillpath()
        return found

    def machine(self, name: str) -> dict[str, Any]:
        """Return the document of a machine."""
        return self._document(self._connection.ask("GET", f"/v1/machines/{quote(name, safe='')}"))

    def check_printer(self, name: str, *, accept: bool = False) -> dict[str, Any]:
        """Return how a printer compares with its machine (`service.deliveries.checking`).

        With `accept` its configuration is remembered as it is now.
        """
        method, last = ("POST", "accept") if accept else ("GET", "check")
        return self._document(
            self._connection.ask(method, f"/v1/printers/{quote(name, safe='')}/{last}")
        )

    def version(self) -> str:
        """Return the version of the service."""
        return str(self._health().get("version", ""))

    def build(self) -> str:
        """Return its version with a digest of its code; see `stillpath.version.build`."""
        health = self._health()
        return str(health.get("build") or health.get("version", ""))

    def cancel(self, job_id: str) -> JobView:
        """Stop a job; it stays in the list."""
        return self._job(self._connection.ask("POST", _path(job_id, "cancel")))

    def delete(self, job_id: str) -> None:
        """Stop a job if it runs, and delete its files. One that is gone already is no error."""
        try:
            self._connection.ask("DELETE", _path(job_id))
        except ClientError as error:
            if error.status != 404:
                raise

    def _events(
        self, job_id: str, seen: str | None, deadline: float | None
    ) -> Iterator[tuple[str, JobView]]:
        """Yield id and job of every event; return when the stream ends or the deadline is near."""
        try:
            for event in self._connection.events(_path(job_id, "events"), seen, deadline):
                if event.get("event") == "job":
                    yield event.get("id", ""), JobView.model_validate_json(event["data"])
        except (ValidationError, KeyError):
            raise self._connection.not_stillpath() from None

    def _job(self, answer: httpx2.Response) -> JobView:
        try:
            return JobView.model_validate_json(answer.content)
        except ValidationError:
            raise self._connection.not_stillpath() from None

    def _health(self) -> dict[str, Any]:
        return self._document(self._connection.ask("GET", "/healthz"))

    def _document(self, answer: httpx2.Response) -> dict[str, Any]:
        found = self._json(answer)
        if not isinstance(found, dict):
            raise self._connection.not_stillpath()
        return found

    def _json(self, answer: httpx2.Response) -> Any:
        try:
            return json.loads(answer.content)
        except (ValueError, RecursionError):
            raise self._connection.not_stillpath() from None


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


def _check_time(deadline: float | None, job: JobView) -> None:
    if deadline is not None and time.monotonic() > deadline:
        raise ClientError(f"job {job.id} is still {job.state.value}; given up waiting")
