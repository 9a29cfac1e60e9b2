"""Routes of designs: the report of `stillpath design`, computed by a job and kept with it."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter, Depends, Header, Request
from starlette.concurrency import run_in_threadpool
from starlette.responses import HTMLResponse, Response

from stillpath.applications.design.figures import DesignReport
from stillpath.compensation.defaults import DEFAULT_BASIS
from stillpath.pipeline.options import BasisName, RobustMode
from stillpath.service.api.access import Reader
from stillpath.service.api.computing import (
    WAITING,
    ComputeRequest,
    prefers_page,
    read_result,
    run_and_wait,
)
from stillpath.service.api.documentation import linked
from stillpath.service.api.machines import Name, look_up
from stillpath.service.api.problems import responses
from stillpath.service.jobs.state import JobKind

__all__ = ["router"]

router = APIRouter(prefix="/v1/machines/{name}", tags=["machines"])


async def _asked(
    request: Request,
    name: Name,
    caller: Reader,
    axis: Literal["x", "y"],
    basis: BasisName = DEFAULT_BASIS,
    robust: RobustMode = "auto",
) -> DesignReport:
    machine = await run_in_threadpool(look_up, request, name)
    job = await run_and_wait(
        request,
        caller,
        ComputeRequest(
            kind=JobKind.DESIGN,
            machine=name,
            document=machine,
            revision=machine.revision,
            options={"axis": axis, "basis": basis, "robust": robust},
            result_name=f"design-{axis}.json",
        ),
    )
    return DesignReport.model_validate(await read_result(request, job))


FoundDesign = Annotated[DesignReport, Depends(_asked)]


@router.get(
    "/design",
    response_model=DesignReport,
    responses={200: {"content": {"text/html": {}}}, **WAITING, **responses(404, 422)},
    summary="Get the design for an axis",
)
async def read_design(found: FoundDesign, accept: Annotated[str, Header()] = "*/*") -> Response:
    """Return the figures as JSON, or as a page if that is what `Accept` names first.

    The first request for a machine, axis, basis and robust mode takes some ten seconds.
    """
    vary = {"Vary": "Accept"}
    if prefers_page(accept):
        return await run_in_threadpool(_page, found, vary)
    return Response(found.model_dump_json(), media_type="application/json", headers=vary)


@router.get(
    "/design.html",
    response_class=HTMLResponse,
    responses={**WAITING, **responses(404, 422)},
    summary="Get the design for an axis, as a page",
)
async def read_design_page(found: FoundDesign) -> HTMLResponse:
    """Return one self-contained HTML page."""
    return await run_in_threadpool(_page, found)


# What is imported here takes a second, which the service's start need not wait for.


def _page(found: DesignReport, headers: dict[str, str] | None = None) -> HTMLResponse:
    from stillpath.applications.design.page import render_design

    return HTMLResponse(linked(render_design(found)), headers=headers)
