"""Routes of jobs: upload, ask, fetch, delete."""

from __future__ import annotations

import time
import uuid
from pathlib import Path
from typing import Annotated, Literal

from fastapi import APIRouter, Query, Request, Response
from starlette.concurrency import run_in_threadpool
from starlette.responses import FileResponse

from gcode.containers.sniff import Kind, sniff
from models.errors import ModelError
from service.api.problems import Problem, responses
from service.api.schemas import JobView
from service.api.uploads import receive_upload
from service.jobs.state import Job, JobState
from service.jobs.store import JobStore
from service.jobs.supervisor import Supervisor
from service.machines.resolve import PinnedMachine, Resolver
from service.machines.revision import NotApproved, UnknownMachine
from service.pipeline.options import DEFAULT_TOLERANCE_UM, BasisName, Options, RobustMode
from service.pipeline.reading import DialectName
from service.settings import Settings

__all__ = ["router"]

# The methods are written down once, in the options.
_METHOD = Options.model_json_schema()["properties"]["method"]["pattern"]
_BODY = {
    "requestBody": {
        "required": True,
        "description": "The G-code, plain, binary (.bgcode) or in a sliced 3MF package: as the "
        "body itself, or as the file of a form.",
        "content": {
            "application/octet-stream": {"schema": {"type": "string", "format": "binary"}},
            **{
                kind.value: {"schema": {"type": "string", "format": "binary"}}
                for kind in (Kind.BGCODE, Kind.THREEMF)
            },
            Kind.TEXT.value: {
                "schema": {"type": "string"},
                "example": "G28\nG1 X10 Y10 F6000\nG1 X60 Y10 E2\n",
            },
            "multipart/form-data": {
                "schema": {
                    "type": "object",
                    "required": ["file"],
                    "properties": {"file": {"type": "string", "format": "binary"}},
                }
            },
        },
    }
}

router = APIRouter(prefix="/v1/jobs", tags=["jobs"])


@router.post(
    "",
    status_code=202,
    response_model=JobView,
    responses=responses(403, 413, 422),
    openapi_extra=_BODY,
    summary="Hand in a G-code file",
)
async def create_job(
    request: Request,
    response: Response,
    machine: Annotated[str, Query(description="A name from /v1/machines.", examples=["ender3"])],
    method: Annotated[
        str,
        Query(
            pattern=_METHOD,
            description="`fbf` (limited-preview filtered basis functions), `npz-ignore`, "
            "`zmetc`, `zpetc`, `ebzpetc`, `ts` (approximate inverses), "
            "`shaper:NAME` (zv, mzv, ei, 2hump_ei, 3hump_ei) or `none`.",
        ),
    ] = "fbf",
    basis: Annotated[BasisName, Query(description="Basis functions of `fbf`.")] = "ce-opt",
    robust: Annotated[
        RobustMode,
        Query(
            description="What `fbf` is designed for: the nominal plant (`off`), or the machine's "
            "plant set by least squares (`ensemble`) or for its worst member (`minimax`)."
        ),
    ] = "off",
    along: Annotated[
        float | None,
        Query(
            ge=0.01,
            le=1,
            allow_inf_nan=False,
            description="Weight of errors along the path against those across it, for `fbf`; "
            "less than 1 takes longer. By default .09 with a set, else 1.",
        ),
    ] = None,
    tolerance_um: Annotated[
        float,
        Query(
            ge=0.5,
            le=50,
            allow_inf_nan=False,
            description="How far the written path may be from the computed one.",
        ),
    ] = DEFAULT_TOLERANCE_UM,
    plate: Annotated[
        int | None, Query(ge=1, description="Which plate of a 3MF package with several.")
    ] = None,
    times: Annotated[
        Literal["new", "kept"],
        Query(description="Whether the slicer's times in the file follow the new motion."),
    ] = "new",
    dialect: Annotated[
        DialectName | None,
        Query(description="How the file is read; by default as the machine's firmware reads it."),
    ] = None,
    name: Annotated[
        str, Query(max_length=255, description="File name, for a raw body.")
    ] = "upload.gcode",
) -> JobView:
    """Store the file and put a job in the queue. The answer's `Location` is where to ask.

    The parameters are checked before the body is read; whether the G-code can be processed is
    found out by the job.
    """
    del name  # read by receive_upload
    settings: Settings = request.app.state.settings
    store: JobStore = request.app.state.store
    pinned = await run_in_threadpool(_pinned, request.app.state.machines, machine)
    options = Options(
        method=method,
        basis=basis,
        robust=robust,
        along=along,
        tolerance_um=tolerance_um,
        plate=plate,
        dialect=dialect,
        times=times,
    )
    job_id = uuid.uuid4().hex
    incoming = store.incoming_dir / job_id
    try:
        upload = await receive_upload(request, incoming, max_bytes=settings.max_upload_bytes)
        job = Job(
            id=job_id,
            machine=machine,
            options=options.model_dump(),
            source_name=upload.name,
            result_name=_result_name(upload.name),
            source_bytes=upload.size,
            created_at=time.time(),
        )
        await run_in_threadpool(_enqueue, store, job, incoming, pinned)
    finally:
        incoming.unlink(missing_ok=True)
    supervisor: Supervisor = request.app.state.supervisor
    supervisor.notify()
    response.headers["Location"] = f"/v1/jobs/{job_id}"
    return _view(store, job)


@router.get("/{job_id}", responses=responses(404), summary="Ask how a job stands")
def read_job(request: Request, job_id: str) -> JobView:
    """Return state, stage, progress and, once it is known, the time still needed."""
    store: JobStore = request.app.state.store
    return _view(store, _find(store, job_id))


@router.get(
    "/{job_id}/result",
    response_class=FileResponse,
    responses={200: {"content": {kind.value: {} for kind in Kind}}, **responses(404, 409)},
    summary="Fetch the compensated G-code",
)
def read_result(request: Request, job_id: str) -> FileResponse:
    """Stream the written file: of the kind that was handed in."""
    store: JobStore = request.app.state.store
    job = _done(store, job_id)
    path = _there(store.files(job_id).result(job.result_name))
    return FileResponse(path, media_type=sniff(path).value, filename=job.result_name)


@router.get(
    "/{job_id}/report",
    response_class=FileResponse,
    responses={200: {"content": {"text/html": {}}}, **responses(404, 409)},
    summary="Fetch the report as a page",
)
def read_report(request: Request, job_id: str) -> FileResponse:
    """Return one self-contained HTML page."""
    store: JobStore = request.app.state.store
    _done(store, job_id)
    return FileResponse(_there(store.files(job_id).report / "report.html"), media_type="text/html")


@router.get(
    "/{job_id}/report.json",
    response_class=FileResponse,
    responses={200: {"content": {"application/json": {}}}, **responses(404, 409)},
    summary="Fetch the report's figures",
)
def read_report_json(request: Request, job_id: str) -> FileResponse:
    """Return every figure of the report, measured on the written file."""
    store: JobStore = request.app.state.store
    _done(store, job_id)
    return FileResponse(
        _there(store.files(job_id).report / "report.json"), media_type="application/json"
    )


@router.delete("/{job_id}", status_code=204, responses=responses(404), summary="Cancel and delete")
def delete_job(request: Request, job_id: str) -> Response:
    """Stop the job if it runs, and delete its files."""
    store: JobStore = request.app.state.store
    job = _find(store, job_id)
    if not store.forget(job_id):
        raise _no_such_job(job_id)
    if job.state is JobState.RUNNING:
        supervisor: Supervisor = request.app.state.supervisor
        supervisor.notify()  # the files go once the worker has let go of them
    else:
        store.remove_files(job_id)
    return Response(status_code=204)


def _pinned(machines: Resolver, name: str) -> PinnedMachine:
    try:
        return machines.for_job(name)
    except UnknownMachine:
        known = ", ".join(machines.names())
        detail = f"No machine is called {name[:80]!r}. Known: {known}."
        raise Problem(422, "Unknown machine", detail) from None
    except NotApproved as error:
        raise Problem(422, "Machine not approved", str(error)) from None
    except ModelError as error:
        raise Problem(422, "The machine cannot be used", str(error)) from None


def _enqueue(store: JobStore, job: Job, incoming: Path, pinned: PinnedMachine) -> None:
    """Move the stored upload to its place, then make the job known: never the other way."""
    files = store.files(job.id)
    source = files.source(job.source_name)
    source.parent.mkdir(parents=True)
    pinned.write(files.machine)
    incoming.rename(source)
    store.add(job)


def _result_name(source_name: str) -> str:
    """Name the result; printers tell a sliced package by both of its suffixes."""
    source = Path(source_name)
    suffix = ".gcode.3mf" if source_name.lower().endswith(".gcode.3mf") else source.suffix
    return f"{source_name[: len(source_name) - len(suffix)]}.stillpath{suffix or '.gcode'}"


def _view(store: JobStore, job: Job) -> JobView:
    queued = job.state is JobState.QUEUED
    return JobView.of(job, store.queue_position(job) if queued else None)


def _find(store: JobStore, job_id: str) -> Job:
    job = store.get(job_id)
    if job is None:
        raise _no_such_job(job_id)
    return job


def _done(store: JobStore, job_id: str) -> Job:
    job = _find(store, job_id)
    match job.state:
        case JobState.DONE:
            return job
        case JobState.FAILED:
            why = (job.problem or {}).get("detail", "the reason is unknown")
            raise Problem(409, "The job failed", f"There is no result: {why}", error=job.problem)
        case _:
            raise Problem(
                409,
                "Not done yet",
                f"The job is {job.state.value}. Ask /v1/jobs/{job_id} until its state is done.",
            )


def _there(path: Path) -> Path:
    if not path.is_file():
        raise Problem(404, "The file is gone", f"{path.name} is no longer in the data directory.")
    return path


def _no_such_job(job_id: str) -> Problem:
    return Problem(
        404, "No such job", f"There is no job {job_id[:64]}. Jobs are gone once they are deleted."
    )
