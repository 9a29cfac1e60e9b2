"""Finds the job named in a path, for callers who may see it."""

from __future__ import annotations

import re
from typing import Annotated

from fastapi import Path, Request
from starlette.concurrency import run_in_threadpool

from stillpath.service.api.problems import Problem
from stillpath.service.jobs.state import Job, JobKind, JobState
from stillpath.service.jobs.store import JobStore
from stillpath.service.security.callers import Caller

__all__ = ["JobId", "find", "find_done", "no_such_job"]

_ID = re.compile(r"[0-9a-f]{32}")

JobId = Annotated[
    str,
    Path(
        description="The `id` in the response to the upload.",
        examples=["5f2c8e0e6c0d4a3f9d1b7a52c4e86f10"],
    ),
]


async def find(request: Request, job_id: str, caller: Caller) -> Job:
    """Return a job; raise `Problem` 404 if there is none, or it is somebody else's."""
    job = None
    if _ID.fullmatch(job_id):
        store: JobStore = request.app.state.store
        job = await run_in_threadpool(store.get, job_id, caller.sees)
    if job is None:
        raise no_such_job(job_id)
    return job


async def find_done(
    request: Request, job_id: str, caller: Caller, *, of_any_kind: bool = False
) -> Job:
    """Return a job that has a result; raise `Problem` 409 if it has none (yet).

    By default a compensation, with a report.
    """
    job = await find(request, job_id, caller)
    if not of_any_kind and job.kind is not JobKind.COMPENSATION:
        raise Problem(
            404, "No such part", f"Job {job_id} is of the kind {job.kind}; it only has a result."
        )
    match job.state:
        case JobState.DONE:
            return job
        case JobState.FAILED:
            why = (job.problem or {}).get("detail", "the reason is unknown")
            raise Problem(409, "Job failed", f"There is no result: {why}", error=job.problem)
        case JobState.CANCELLED:
            raise Problem(
                409,
                "Job cancelled",
                "The job was cancelled, so there is no result; submit the file again.",
            )
        case _:
            raise Problem(
                409,
                "Job not finished",
                f"The job is {job.state.value}. Ask /v1/jobs/{job_id} until its state is done, or "
                f"watch /v1/jobs/{job_id}/events.",
            )


def no_such_job(job_id: str) -> Problem:
    """Return the problem of a job that is not there."""
    return Problem(
        404, "No such job", f"There is no job {job_id[:64]}. Jobs are gone once they are deleted."
    )
