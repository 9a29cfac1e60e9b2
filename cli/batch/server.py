"""Runs the files of a batch on a Stillpath server."""

from __future__ import annotations

import hashlib
import json
import threading
from pathlib import Path
from typing import TYPE_CHECKING

from stillpath.cli.batch.local_workers import Failure, FileResult, Stopped
from stillpath.cli.batch.output import Figures, Scratch, Trouble
from stillpath.cli.batch.worker_pool import Found
from stillpath.service.client import Client, ClientError
from stillpath.service.jobs.problems import FILE_TITLES, LIMIT_TITLES

if TYPE_CHECKING:
    from stillpath.pipeline.options import Options
    from stillpath.service.api.schemas import JobView

__all__ = ["ServerBackend", "batch_name"]

_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.3, 2.0
_OF_REQUEST = (400, 401, 403, 422)


class ServerBackend:
    """Compensates on a server. A job that was begun goes on there when we are interrupted.

    Parameters
    ----------
    client : Client
        Closed by `close`.
    batch : str
        What the jobs have in common; the same one finds them again.
    """

    def __init__(self, client: Client, options: Options, batch: str) -> None:
        self._client = client
        self._options = options
        self._batch = batch
        try:
            self.version = client.build()
        except BaseException:
            client.close()
            raise

    def machine(self, name: str) -> Found:
        """See `Backend`. What the server would use depends on approvals; they count as well."""
        try:
            machines = self._client.machines()
        except ClientError as error:
            raise _failure_of(error) from None
        for found in machines:
            if found["name"] == name:
                stand = (found["revision"], found.get("number"), found.get("approved"))
                return Found(name, "/".join(str(part) for part in stand if part is not None))
        raise Failure(f"{self._client.server} has no machine {name}", "machine")

    def do(
        self, source: Path, scratch: Scratch, machine: Found, stopping: threading.Event
    ) -> FileResult:
        """See `Backend`."""

        def tell(*_: object) -> None:
            if stopping.is_set():
                raise Stopped

        try:
            job = self._client.submit(
                source, machine=machine.name, options=self._options, batch=self._batch, tell=tell
            ).job
            pause_s = _FIRST_PAUSE_S
            while not job.state.is_final:
                if stopping.wait(pause_s):
                    raise Stopped
                pause_s = min(1.3 * pause_s, _LONGEST_PAUSE_S)
                job = self._client.job(job.id)
            _check_done(job)
            self._client.fetch(job, scratch.result, tell=tell)
            self._client.save_report(job.id, scratch.report)
        except ClientError as error:
            raise _failure_of(error) from None
        report = json.loads((scratch.report / "report.json").read_bytes())
        figures = {**(job.summary or {}), "warnings": report.get("warnings", [])}
        return FileResult(Figures.model_validate(figures), 0.0)

    def close(self) -> None:
        """See `Backend`."""
        self._client.close()


def batch_name(output: Path) -> str:
    """Return a name for the jobs of an output folder, the same each time."""
    place = str(output.resolve()).encode("utf-8", "surrogateescape")
    return f"farm-{hashlib.sha256(place).hexdigest()[:20]}"


def _check_done(job: JobView) -> None:
    if job.state.value != "done":
        problem = job.error or {}
        detail = problem.get("detail") or f"the job was {job.state.value} on the server"
        raise ClientError(str(detail), int(problem.get("status", 409)), problem)


def _failure_of(error: ClientError) -> Failure:
    """Tell whose fault a refusal is."""
    trouble: Trouble = "computer"
    if error.is_refused and error.problem.get("title") in FILE_TITLES:
        trouble = "file"
    elif error.status == 500 or error.problem.get("title") in LIMIT_TITLES:
        trouble = "work"
    elif error.status in _OF_REQUEST:
        trouble = "machine"
    return Failure(str(error), trouble)
