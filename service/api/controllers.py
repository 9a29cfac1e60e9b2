"""Routes of closed-loop machines: their list, and add-on controllers for them."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from fastapi import APIRouter, Body, Header, Path, Query, Request
from starlette.responses import HTMLResponse, PlainTextResponse, Response

from stillpath.applications.controllers.figures import ControllerReport, LoopFigures
from stillpath.applications.controllers.options import ControllerOptions
from stillpath.models.loops import builtin_loops
from stillpath.service.api.access import Reader
from stillpath.service.api.computing import (
    WAITING,
    ComputeRequest,
    prefers_page,
    read_result,
    run_and_wait,
)
from stillpath.service.api.documentation import linked
from stillpath.service.api.problems import Problem, responses
from stillpath.service.jobs.state import JobKind

__all__ = ["router"]

router = APIRouter(prefix="/v1", tags=["controllers"])


@router.get(
    "/loops",
    response_model=list[LoopFigures],
    responses=WAITING,
    summary="List closed-loop machines",
)
async def list_loops(request: Request, caller: Reader) -> Any:
    """Return the built-in closed-loop machines and the methods that fit each."""
    asked = ComputeRequest(kind=JobKind.LOOPS, machine="", options={}, result_name="loops.json")
    return await read_result(request, await run_and_wait(request, caller, asked))


@router.post(
    "/machines/{name}/controllers",
    response_model=ControllerReport,
    responses={
        200: {"content": {"text/html": {}, "text/plain": {}}},
        **WAITING,
        **responses(404, 422),
    },
    summary="Design an add-on controller",
)
async def design_controller(
    request: Request,
    name: Annotated[
        str, Path(max_length=255, description="A name from `/v1/loops`.", examples=["galvo-40khz"])
    ],
    options: Annotated[
        ControllerOptions,
        Body(openapi_examples={"fmsdob": {"value": {"method": "fmsdob", "targets_hz": [2000.0]}}}),
    ],
    caller: Reader,
    format: Annotated[  # noqa: A002 - the parameter's name on the wire
        Literal["json", "html", "c"] | None, Query(description="Overrides `Accept`.")
    ] = None,
    accept: Annotated[str, Header()] = "*/*",
) -> Response:
    """Return figures and coefficients as JSON, as a page (`Accept: text/html`), or as a C header.

    The machine is a built-in one of `GET /v1/loops`, or the document `loop` of the body, which
    then has the name of the path. A design that must not be loaded is refused with the reason.
    """
    if options.loop is None and name not in builtin_loops():
        raise Problem(
            404,
            "No such machine",
            f"No closed-loop machine is called {name!r}. GET /v1/loops lists them; your own goes "
            "into the body as `loop`.",
        )
    asked = ComputeRequest(
        kind=JobKind.CONTROLLER,
        machine=name,
        options=options.model_dump(mode="json", exclude_unset=True),
        result_name="controller.json",
    )
    made = await read_result(request, await run_and_wait(request, caller, asked))
    vary = {"Vary": "Accept"}
    wanted = format or ("html" if prefers_page(accept) else "json")
    if wanted == "html":
        return HTMLResponse(linked(made["page"]), headers=vary)
    if wanted == "c":
        return PlainTextResponse(made["c"], headers=vary)
    return Response(made["report"], media_type="application/json", headers=vary)
