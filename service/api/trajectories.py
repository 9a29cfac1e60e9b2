"""The route of trajectories: motion as samples, computed when somebody asks for it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from fastapi import APIRouter, Query, Request
from starlette.responses import Response

from stillpath.service.api.access import Reader
from stillpath.service.api.computing import WAITING, ComputeRequest, lost_answer, run_and_wait
from stillpath.service.api.file_responses import MEDIA, stored_result
from stillpath.service.api.job_lookup import JobId, find_done
from stillpath.service.api.problems import Problem, responses
from stillpath.service.jobs.state import JobKind

__all__ = ["router"]

_LONGEST_S = 600.0

router = APIRouter(prefix="/v1/jobs", tags=["results"])


@router.get(
    "/{job_id}/trajectories",
    response_class=Response,
    responses={
        200: {
            "description": "One row for every millisecond",
            "content": {
                "text/csv": {"example": "t_s,x_mm,y_mm\n0.000,10.0,10.0\n"},
                "application/octet-stream": {"schema": {"type": "string", "format": "binary"}},
            },
        },
        **WAITING,
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
        Query(gt=0, le=1e7, allow_inf_nan=False, description="By default 60 s after `start_s`."),
    ] = None,
) -> Response:
    """Return the motion before and after, planned and simulated, with the contour errors.

    A separate job computes it, which takes as long as the first one did up to `stop_s`. At most
    600 s of the print can be fetched at once.
    """
    stop_s = start_s + 60.0 if stop_s is None else stop_s
    if not 0 < stop_s - start_s <= _LONGEST_S:
        raise Problem(
            422,
            "Invalid parameter",
            f"start_s {start_s:g} to stop_s {stop_s:g} must be a period of at most {_LONGEST_S:g} "
            "s; ask for longer ones in parts.",
        )
    job = await find_done(request, job_id, caller)
    asked = ComputeRequest(
        kind=JobKind.TRAJECTORIES,
        machine=job.machine,
        revision=job.machine_revision,
        options={
            "of": job.id,
            "options": job.options,
            "format": format,
            "start_s": start_s,
            "stop_s": stop_s,
        },
        result_name=f"{Path(job.result_name).stem}.{format}",
        source_name=job.source_name,
        source_sha256=job.source_sha256,
    )
    made = await run_and_wait(request, caller, asked)
    try:
        return await stored_result(request, made, MEDIA[f".{format}"])
    except Problem as error:
        if error.document["status"] != 404:
            raise
        raise await lost_answer(request, made) from None
