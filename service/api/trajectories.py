"""The route of trajectories: motion as samples, computed when somebody asks for it."""

from __future__ import annotations

import shutil
import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import anyio
from anyio import to_process
from fastapi import APIRouter, Query, Request
from starlette.background import BackgroundTask
from starlette.concurrency import run_in_threadpool
from starlette.responses import FileResponse

from gcode.errors import GcodeError
from service.api.access import Reader
from service.api.finding import JobId, find_done
from service.api.problems import Problem, responses
from service.jobs.state import Job

if TYPE_CHECKING:
    from service.settings import Settings
    from service.storage.base import Storage

__all__ = ["Trajectories", "router"]

_LONGEST_S = 600.0
_WAITING = 4
"""How many may wait for their turn."""
_MEDIA = {"csv": "text/csv", "npz": "application/octet-stream"}

router = APIRouter(prefix="/v1/jobs", tags=["results"])


class Trajectories:
    """Computes one at a time, in a process of its own: the road takes memory and CPU.

    Parameters
    ----------
    settings : Settings
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._turn = anyio.CapacityLimiter(1)

    async def write(self, storage: Storage, job: Job, target: Path, **chosen: Any) -> None:
        """Write the trajectories of a job to a file.

        Raises
        ------
        GcodeError
        FileNotFoundError
            If the job's files are gone.
        Problem
            429 if too many wait already.
        """
        if self._turn.statistics().tasks_waiting >= _WAITING:
            raise Problem(
                429,
                "Too many wait",
                f"{_WAITING} others wait for trajectories; ask again later.",
                headers={"Retry-After": "60"},
            )
        async with self._turn:
            with ExitStack() as files:
                source, machine = [
                    await run_in_threadpool(files.enter_context, storage.local(key))
                    for key in (
                        f"jobs/{job.id}/source/{job.source_name}",
                        f"jobs/{job.id}/machine.json",
                    )
                ]
                await to_process.run_sync(
                    _write,
                    source,
                    machine,
                    job.machine,
                    job.options,
                    target,
                    self._settings.data_dir / "cache",
                    chosen,
                    cancellable=True,
                )


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
    try:
        await request.app.state.trajectories.write(
            request.app.state.storage, job, target, format=format, start_s=start_s, stop_s=stop_s
        )
    except GcodeError as error:
        await run_in_threadpool(_remove, folder)
        raise Problem(422, "No trajectories", str(error)) from None
    except FileNotFoundError:
        await run_in_threadpool(_remove, folder)
        raise Problem(404, "The file is gone", "The job's upload is no longer there.") from None
    except BaseException:
        _remove(folder)
        raise
    return FileResponse(
        target,
        media_type=_MEDIA[format],
        filename=f"{Path(job.result_name).stem}.{format}",
        background=BackgroundTask(_remove, folder),
    )


def _write(
    source: Path,
    machine_file: Path,
    machine: str,
    options: dict[str, Any],
    target: Path,
    cache_dir: Path,
    chosen: dict[str, Any],
) -> None:
    """Do the work, in the process for it."""
    from service.environment import prepare_environment

    prepare_environment()

    from service.machines.resolve import PinnedMachine
    from service.pipeline.options import Options
    from service.pipeline.trajectories import write_trajectories

    settings = Options.model_validate(options)
    write_trajectories(
        source,
        target,
        PinnedMachine.read(machine_file, machine).machine,
        settings,
        dialect=settings.dialect,
        plate=settings.plate,
        cache_dir=cache_dir,
        **chosen,
    )


def _remove(folder: Path) -> None:
    shutil.rmtree(folder, ignore_errors=True)
