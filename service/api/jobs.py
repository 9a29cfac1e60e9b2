"""Routes of jobs: submit, list, get, cancel, delete."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection
from contextlib import suppress
from typing import Annotated, TypeVar

from fastapi import APIRouter, Header, Query, Request, Response
from starlette.concurrency import run_in_threadpool

from stillpath.gcode.containers.sniff import Kind
from stillpath.service.api.access import Reader, Submitter, Uploader, Watcher
from stillpath.service.api.hub import Hub
from stillpath.service.api.intake import Intake
from stillpath.service.api.job_lookup import JobId, find, no_such_job
from stillpath.service.api.problems import Problem, responses
from stillpath.service.api.schemas import DeliveryView, JobPage, JobQuery, JobView
from stillpath.service.database.errors import DatabaseAway, DatabaseFull
from stillpath.service.deliveries.sender import Sender
from stillpath.service.jobs.state import Cancelled, Job, JobKind, JobState
from stillpath.service.jobs.store import BadCursor, JobStore
from stillpath.service.security.audit import record
from stillpath.service.security.callers import Caller, Scope
from stillpath.service.storage.base import Storage, StorageError
from stillpath.service.storage.disk import Disk

__all__ = ["router", "upload_body"]

_T = TypeVar("_T")


def upload_body(required_form: bool = False) -> dict[str, object]:
    """Return the OpenAPI entry for a body that is a file, or a form with one."""
    binary = {"schema": {"type": "string", "format": "binary"}}
    form = {
        "schema": {
            "type": "object",
            "required": ["file"],
            "properties": {
                "file": {"type": "string", "format": "binary"},
                "print": {"type": "string", "examples": ["true", "false"]},
            },
        }
    }
    raw = {
        "application/octet-stream": binary,
        Kind.BGCODE.value: binary,
        Kind.THREEMF.value: binary,
        Kind.TEXT.value: {
            "schema": {"type": "string"},
            "example": "G28\nG1 X10 Y10 F6000\nG1 X60 Y10 E2\n",
        },
    }
    return {
        "requestBody": {
            "required": True,
            "description": "The G-code, plain, binary (.bgcode) or in a sliced 3MF package: as "
            "the body itself, or as the file of a form.",
            "content": {**({} if required_form else raw), "multipart/form-data": form},
        }
    }


router = APIRouter(prefix="/v1/jobs", tags=["jobs"])


@router.get("", responses=responses(422), summary="List jobs")
async def list_jobs(
    request: Request,
    response: Response,
    caller: Reader,
    state: Annotated[
        list[JobState] | None, Query(description="Only jobs in these states.", max_length=8)
    ] = None,
    kind: Annotated[
        list[JobKind] | None,
        Query(description="Only jobs of these kinds; by default compensations.", max_length=8),
    ] = None,
    batch: Annotated[str | None, Query(max_length=64, description="Only jobs of a batch.")] = None,
    limit: Annotated[int, Query(ge=1, le=200)] = 50,
    cursor: Annotated[
        str | None, Query(max_length=200, description="`next` of the page before.")
    ] = None,
) -> JobPage:
    """Return jobs, newest first; an administrator sees those of all owners."""
    store: JobStore = request.app.state.store
    if batch is not None and "\x00" in batch:
        return JobPage(jobs=[], next=None)  # no job's batch holds one; databases refuse it
    try:
        page = await run_in_threadpool(
            store.page,
            caller.sees,
            kinds=kind or (JobKind.COMPENSATION,),
            states=state or (),
            batch=batch,
            limit=limit,
            cursor=cursor,
        )
    except BadCursor as error:
        raise Problem(422, "Invalid cursor", str(error)) from None
    if page.next_cursor is not None:
        address = request.url.include_query_params(cursor=page.next_cursor)
        response.headers["Link"] = f'<{address.path}?{address.query}>; rel="next"'
    return JobPage(jobs=await _views(store, page.jobs), next=page.next_cursor)


@router.post(
    "",
    status_code=202,
    response_model=JobView,
    responses={
        200: {"model": JobView, "description": "The same job exists already"},
        **responses(403, 408, 413, 422, 429, 507),
    },
    openapi_extra=upload_body(),
    summary="Submit a G-code file",
)
async def create_job(
    request: Request,
    response: Response,
    caller: Uploader,
    wanted: Annotated[JobQuery, Query()],
    idempotency_key: Annotated[
        str | None,
        Header(
            min_length=1,
            max_length=255,
            pattern=r"^[\x21-\x7e]+$",
            description="Chosen by the caller for one request, which can then be repeated "
            "without making a second job. With a different request the key is refused.",
            examples=["0f6a7f8e-2f0e-4d53-9f0e-5d4f2a1c9b7e"],
        ),
    ] = None,
) -> JobView:
    """Store the file and queue a job; `Location` is the job's address.

    Parameters are checked before the body is read; the job finds out whether the G-code can be
    processed. If the same file was done before, with the same machine, options and version, that
    job is returned (200), unless `fresh`, `webhook` or `printer` is given.
    """
    if wanted.priority > 0 and not caller.may(Scope.ADMIN):
        raise Problem(
            403, "Not allowed", "A priority of more than 0 needs a key with the scope admin."
        )
    intake: Intake = request.app.state.intake
    taken = await intake.take(request, wanted, caller, idempotency_key=idempotency_key)
    if not taken.is_new:
        response.status_code = 200
    response.headers["Location"] = f"/v1/jobs/{taken.job.id}"
    waits = taken.job.state is JobState.QUEUED
    return JobView.of(taken.job, taken.queue_position if waits else None)


@router.get("/{job_id}", responses=responses(404), summary="Get a job")
async def read_job(request: Request, job_id: JobId, caller: Watcher) -> JobView:
    """Return state, stage, progress and, once it is known, the time still needed."""
    job = await find(request, job_id, caller)
    (view,) = await _views(request.app.state.store, [job])
    if job.state.is_final and (job.webhook or job.printer):
        sender: Sender = request.app.state.deliveries
        view.deliveries = [
            DeliveryView.of(delivery)
            for delivery in await run_in_threadpool(sender.deliveries_of, job_id)
        ]
    return view


@router.post("/{job_id}/cancel", responses=responses(403, 404, 409), summary="Cancel a job")
async def cancel_job(request: Request, job_id: JobId, caller: Submitter) -> JobView:
    """Take the job out of the queue, or stop it; it stays in the list as cancelled."""
    store: JobStore = request.app.state.store
    await find(request, job_id, caller)
    job = await _written(request, lambda: store.apply(job_id, Cancelled(time.time())))
    if job is None:  # it was over before
        job = await find(request, job_id, caller)
        if job.state is not JobState.CANCELLED:
            raise Problem(
                409,
                "Job already finished",
                f"The job is {job.state.value}; there is nothing to cancel.",
            )
    await _changed(request, caller, "cancel", job_id)
    return JobView.of(job)


@router.delete(
    "/{job_id}", status_code=204, responses=responses(403, 404), summary="Cancel and delete a job"
)
async def delete_job(request: Request, job_id: JobId, caller: Submitter) -> Response:
    """Stop the job if it runs, and delete its files."""
    store: JobStore = request.app.state.store
    storage: Storage = request.app.state.storage
    job = await find(request, job_id, caller)
    if not await _written(request, lambda: store.forget(job_id)):
        raise no_such_job(job_id)
    # What a worker still puts there, or what cannot be deleted now, is swept up later. On a full
    # disk this makes the room to write down who did it.
    with suppress(StorageError):
        await run_in_threadpool(storage.delete, job.files)
    await _changed(request, caller, "delete", job_id)
    return Response(status_code=204)


async def _written(request: Request, write: Callable[[], _T]) -> _T:
    """Return what `write` returns; on a full disk what was held back for it makes room."""
    disk: Disk = request.app.state.disk
    try:
        return await run_in_threadpool(write)
    except DatabaseAway as error:
        if not (disk.is_full or isinstance(error, DatabaseFull)):
            raise
        await run_in_threadpool(disk.give_up)
        return await run_in_threadpool(write)


async def _changed(request: Request, caller: Caller, action: str, job_id: str) -> None:
    """Tell those who watch, and those who work; and write down who did it."""
    await run_in_threadpool(record, request, caller, action, job_id)
    hub: Hub = request.app.state.hub
    hub.nudge()
    request.app.state.workforce.notify()


async def _views(store: JobStore, jobs: Collection[Job]) -> list[JobView]:
    positions: dict[str, int] = {}
    waiting = [job for job in jobs if job.state is JobState.QUEUED]
    if len(waiting) == 1:
        positions[waiting[0].id] = await run_in_threadpool(store.queue_position, waiting[0])
    elif waiting:
        positions = await run_in_threadpool(store.queue_positions)
    return [JobView.of(job, positions.get(job.id)) for job in jobs]
