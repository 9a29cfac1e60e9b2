"""The route of trajectories: motion as samples, computed when somebody asks for it."""

from __future__ import annotations

import shutil
import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from fastapi import APIRouter, Query, Request
from starlette.background import BackgroundTask
from starlette.concurrency import run_in_threadpool
from starlette.responses import FileResponse

from service.api.access import Reader
from service.api.computing import computed
from service.api.finding import JobId, find_done
from service.api.problems import Problem, responses
from service.jobs.state import Job
from service.security.callers import Caller

if TYPE_CHECKING:
    from service.storage.base import Storage

__all__ = ["router"]

_LONGEST_S = 600.0
_MEDIA = {"csv": "text/csv", "npz": "application/octet-stream"}

router = APIRouter(prefix="/v1/jobs", tags=["results"])


@router.get(
    "/{job_id}/trajectories",
    response_class=FileResponse,
    responses={
        200: {
            "description": "One row for every millisecond",
            "content": {
                "text/csv": {"example": "t_s,x_mm,y_mm\n0.000,10.0,10.0\n"},
                "application/octet-stream": {"schema": {"type": "string", "format": "binary"}},
            },
        },
        **responses(404, 409, 422, 429),
    },
    summary="Fetch the trajectories",
)
async def read_trajectories(
    request: Request,
    job_id: JobId,
    caller: Reader,
    format: Annotated[Literal["csv", "npz"], Query()] = "csv",  # noqa: A002 - its name on the wire
    start_s: Annotated[
        float, Query(ge=0, le=1e7, allow_inf_nan=False, description="Of the print.")
    ] = 0.0,
    stop_s: Annotated[
        float | None,
        Query(gt=0, le=1e7, allow_inf_nan=False, description="By default 60 s behind `start_s`."),
    ] = None,
) -> FileResponse:
    """Return the motion before and after, planned and simulated, with the contour errors.

    It is computed anew, which takes as long as the job did up to `stop_s`; at most 600 s of the
    print at once.
    """
    stop_s = start_s + 60.0 if stop_s is None else stop_s
    if not 0 < stop_s - start_s <= _LONGEST_S:
        raise Problem(
            422,
            "Bad parameter",
            f"From start_s {start_s:g} to stop_s {stop_s:g} is no time of at most {_LONGEST_S:g} "
            "s; ask for a part after the other.",
        )
    job = await find_done(request, job_id, caller)
    folder = Path(await run_in_threadpool(tempfile.mkdtemp, prefix="stillpath-trajectories-"))
    target = folder / f"trajectories.{format}"
    chosen = {"format": format, "start_s": start_s, "stop_s": stop_s}
    try:
        await _write(request, caller, job, target, chosen)
    except BaseException:
        _remove(folder)
        raise
    return FileResponse(
        target,
        media_type=_MEDIA[format],
        filename=f"{Path(job.result_name).stem}.{format}",
        background=BackgroundTask(_remove, folder),
    )


async def _write(
    request: Request, caller: Caller, job: Job, target: Path, chosen: dict[str, Any]
) -> None:
    state = request.app.state
    storage: Storage = state.storage
    with ExitStack() as files:
        try:
            source, machine = [
                await run_in_threadpool(files.enter_context, storage.local(key))
                for key in (
                    f"jobs/{job.id}/source/{job.source_name}",
                    f"jobs/{job.id}/machine.json",
                )
            ]
        except FileNotFoundError:
            raise Problem(404, "The file is gone", "The job's upload is no longer there.") from None
        await computed(
            request,
            state.trajectory_room,
            caller,
            "trajectories",
            {
                "source": str(source),
                "machine_file": str(machine),
                "machine": job.machine,
                "options": job.options,
                "target": str(target),
                "cache": str(state.settings.data_dir / "cache"),
                "chosen": chosen,
            },
            refused="No trajectories",
            remedy="Ask for an earlier part of the print, or have the limit raised.",
        )


def _remove(folder: Path) -> None:
    shutil.rmtree(folder, ignore_errors=True)
