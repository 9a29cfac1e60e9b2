"""Run a request as a job that computes the response while the caller waits.

A repeated request gets the same job, so a caller whose wait timed out simply repeats it.
"""

from __future__ import annotations

import asyncio
import hashlib
import json
import re
import tempfile
import time
import uuid
from collections.abc import Coroutine, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from fastapi import Request
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect
from starlette.responses import JSONResponse, Response

from stillpath.applications.machines.resolve import PinnedMachine
from stillpath.models.machine import Machine
from stillpath.service.api.job_lookup import no_such_job
from stillpath.service.api.problems import Problem
from stillpath.service.api.schemas import JobView
from stillpath.service.jobs.problems import problem
from stillpath.service.jobs.state import Cancelled, Job, JobKind, JobState
from stillpath.service.security.callers import Caller
from stillpath.service.storage.base import Storage
from stillpath.version import build

__all__ = [
    "WAITING",
    "ComputeRequest",
    "StillRunning",
    "lost_answer",
    "prefers_page",
    "read_result",
    "run_and_wait",
    "still_running",
]

_LONGEST_WAIT_S = 50.0
"""Proxies usually wait a minute for a response."""
_LARGEST_ANSWER_BYTES = 64 << 20
_ANSWERS = ("text/html", "application/json", "*/*")
_WAIT = re.compile(r"(?:^|[,;\s])wait=(\d{1,6})(?:$|[,;\s])")
_UNKNOWN = problem(500, "Job failed", "Its reason is unknown.")
_T = TypeVar("_T")

WAITING: dict[int | str, dict[str, Any]] = {
    202: {
        "model": JobView,
        "description": "Not done within `Prefer: wait=SECONDS` (at most 50). The job goes on; "
        "repeat the request: once the job is done, it is answered at once.",
    }
}
"""OpenAPI entry of routes whose answer is a job's."""


class StillRunning(Exception):
    """The response takes longer than the caller waits; `job` continues."""

    def __init__(self, job: Job) -> None:
        super().__init__(job.id)
        self.job = job


async def still_running(_: Request, error: Exception) -> Response:
    """Answer with the job."""
    assert isinstance(error, StillRunning)
    view = JobView.of(error.job)
    headers = {"Location": view.links.self, "Retry-After": "1"}
    return JSONResponse(view.model_dump(mode="json"), 202, headers)


@dataclass(frozen=True, slots=True, kw_only=True)
class ComputeRequest:
    """What is to be computed.

    Attributes
    ----------
    document : Machine, optional
        The machine, where the job needs it.
    revision : str
        What distinguishes machines of the same name.
    options : mapping
        What JSON can hold.
    result_name : str
        File name of the answer.
    source_sha256 : str
        Of an input that is in the storage already.
    files : tuple of (Path, str)
        Input and its SHA-256; moved into the storage.
    """

    kind: JobKind
    machine: str
    options: Mapping[str, Any]
    result_name: str
    document: Machine | None = None
    revision: str = ""
    source_name: str = ""
    source_bytes: int = 0
    source_sha256: str = ""
    files: tuple[tuple[Path, str], ...] = field(default=())

    def job(self, owner: str) -> Job:
        """Return the job that answers it."""
        hashes = [sha256 for _, sha256 in self.files]
        asked = [self.kind, self.machine, self.revision, self.options, hashes, build()]
        digest = hashlib.sha256(json.dumps(asked, sort_keys=True).encode()).hexdigest()
        return Job(
            id=uuid.uuid4().hex,
            kind=self.kind,
            owner=owner,
            machine=self.machine,
            machine_revision=self.revision,
            options=dict(self.options),
            dedupe_key=digest,
            source_name=self.source_name,
            source_bytes=self.source_bytes,
            source_sha256=hashes[0] if hashes else self.source_sha256,
            result_name=self.result_name,
            created_at=time.time(),
        )


async def run_and_wait(request: Request, caller: Caller, asked: ComputeRequest) -> Job:
    """Return the job of a request when it is done.

    A disconnecting caller cancels it, unless somebody else was given it, too.

    Parameters
    ----------
    request : Request
        Its body must have been read.
    caller : Caller
        Owner of the job.

    Raises
    ------
    StillRunning
    Problem
        That of the job, if it failed; 429 or 507 if it was not taken.
    """
    state = request.app.state
    wanted = asked.job(caller.owner)
    if state.settings.scheduler is None:  # else another API may have given it to somebody
        state.unshared.add(wanted.id)
    try:
        job: Job = await run_in_threadpool(_submit, request, asked, wanted)
        if job.id == wanted.id:
            state.workforce.notify()
        else:
            state.unshared.discard(job.id)
        if not job.state.is_final:
            await _wait(request, job)
            found = await run_in_threadpool(state.store.get, job.id)
            if found is None:
                raise no_such_job(job.id)
            job = found
    finally:
        state.unshared.discard(wanted.id)
    match job.state:
        case JobState.DONE:
            return job
        case JobState.FAILED:
            raise Problem.of(job.problem or _UNKNOWN)
        case JobState.CANCELLED:
            raise Problem(409, "Job cancelled", "The job was cancelled; ask again.")
        case _:
            raise StillRunning(job)


def prefers_page(accept: str) -> bool:
    """Return whether the header `Accept` names a page before JSON."""
    kinds = [part.split(";")[0].strip() for part in accept.split(",")]
    return next((k == "text/html" for k in kinds if k in _ANSWERS), False)


async def read_result(request: Request, job: Job) -> Any:
    """Return the answer of a job, which is JSON."""
    state = request.app.state
    size = job.result_bytes or 0
    if size > _LARGEST_ANSWER_BYTES:
        raise Problem(
            422,
            "Result too large",
            f"It has {size} bytes; fetch /v1/jobs/{job.id}/result.",
        )
    content = await run_in_threadpool(_content, state.storage, job)
    if content is None:
        raise await lost_answer(request, job)
    return json.loads(content)


async def lost_answer(request: Request, job: Job) -> Problem:
    """Forget a job, so that the same question does not lead to it again; return the problem."""
    await run_in_threadpool(request.app.state.store.forget, job.id)
    return Problem(
        503,
        "Answer lost",
        f"The answer of job {job.id} is gone from the storage or damaged, and was deleted: ask "
        "again, and it is computed anew. Check the storage's disk.",
        headers={"Retry-After": "1"},
    )


def _content(storage: Storage, job: Job) -> bytes | None:
    """Return an answer as the worker stored it; None if it is gone or damaged."""
    try:
        content = b"".join(storage.read(job.result, 0, job.result_bytes or 0))
    except FileNotFoundError:
        return None
    return content if hashlib.sha256(content).hexdigest() == job.result_sha256 else None


def _submit(request: Request, asked: ComputeRequest, job: Job) -> Job:
    intake = request.app.state.intake
    with tempfile.TemporaryDirectory(dir=intake.folder, prefix="question-") as folder:
        files = dict(zip(job.sources, (path for path, _ in asked.files), strict=False))
        if asked.document is not None:
            machine = Path(folder, "machine.json")
            PinnedMachine(machine=asked.document).write(machine)
            files[job.machine_file] = machine
        found: Job = intake.ask(job, files)
        return found


async def _wait(request: Request, job: Job) -> None:
    """Wait until the job has ended, or for as long as the caller waits."""
    state = request.app.state
    try:
        await _while_there(request, _wait_until_final(request, job.id))
    except ClientDisconnect:
        if job.id in state.unshared:
            await run_in_threadpool(state.store.apply, job.id, Cancelled(time.time()))
            state.workforce.notify()
        raise


async def _wait_until_final(request: Request, job_id: str) -> None:
    try:
        async with asyncio.timeout(_patience_s(request)):
            async for snapshot in request.app.state.hub.watch(job_id):
                if snapshot.is_final:
                    return
    except TimeoutError:
        return


def _patience_s(request: Request) -> float:
    """Return how long the caller waits (RFC 7240)."""
    preferred = ",".join(request.headers.getlist("prefer")).lower()
    wait = _WAIT.search(preferred)
    if wait is not None:
        return min(float(wait[1]), _LONGEST_WAIT_S)
    return 0.0 if "respond-async" in preferred else _LONGEST_WAIT_S


async def _while_there(request: Request, work: Coroutine[Any, Any, _T]) -> _T:
    """Return the result of `work`; cancel it when the caller disconnects.

    Raises
    ------
    ClientDisconnect
    """
    working = asyncio.ensure_future(work)
    gone = asyncio.ensure_future(_gone(request))
    try:
        await asyncio.wait((working, gone), return_when=asyncio.FIRST_COMPLETED)
        if not working.done():
            raise ClientDisconnect
        return working.result()
    finally:
        for task in (working, gone):
            task.cancel()
        await asyncio.gather(working, gone, return_exceptions=True)


async def _gone(request: Request) -> None:
    while (await request.receive())["type"] != "http.disconnect":
        pass
