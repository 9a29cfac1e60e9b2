"""Routes of closed-loop machines: which there are, and add-on controllers for them."""

from __future__ import annotations

import asyncio
from functools import cache
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Body, Header, Path, Query, Request
from starlette.concurrency import run_in_threadpool
from starlette.responses import HTMLResponse, PlainTextResponse, Response

from compensation.base import DesignError
from models.errors import ModelError
from models.loops import builtin_loops
from service.api.access import Reader
from service.api.problems import Problem, responses
from service.controllers.figures import ControllerReport, LoopFigures
from service.controllers.options import ControllerOptions, resolved

__all__ = ["Controllers", "router"]

router = APIRouter(prefix="/v1", tags=["controllers"])


class Controllers:
    """Designs one controller at a time, in a thread, while the service goes on answering."""

    def __init__(self) -> None:
        self._turn = asyncio.Lock()

    async def design(self, name: str, options: ControllerOptions) -> Any:
        """Return what `service.controllers.design.design_controller` makes.

        Raises
        ------
        DesignError, ModelError
        """
        async with self._turn:
            return await run_in_threadpool(_made, name, options)


@router.get("/loops", response_model=list[LoopFigures], summary="List the closed-loop machines")
async def list_loops(_: Reader) -> Any:
    """Return the built-in closed-loop machines and the methods that fit each."""
    return await run_in_threadpool(_loops)


@router.post(
    "/machines/{name}/controllers",
    response_model=ControllerReport,
    responses={200: {"content": {"text/html": {}, "text/plain": {}}}, **responses(404, 422)},
    summary="Design an add-on controller",
)
async def design_controller(
    request: Request,
    name: Annotated[
        str, Path(max_length=255, description="Of `/v1/loops`.", examples=["galvo-40khz"])
    ],
    options: Annotated[
        ControllerOptions,
        Body(openapi_examples={"fmsdob": {"value": {"method": "fmsdob", "targets_hz": [2000.0]}}}),
    ],
    _: Reader,
    format: Annotated[  # noqa: A002 - the parameter's name on the wire
        Literal["json", "html", "c"] | None, Query(description="Goes before `Accept`.")
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
    controllers: Controllers = request.app.state.controllers
    try:
        made = await controllers.design(name, options)
    except (DesignError, ModelError) as error:
        reason = getattr(error, "reason", None)
        extra = {} if reason is None else {"reason": reason}
        raise Problem(422, "No such controller", str(error), **extra) from error
    vary = {"Vary": "Accept"}
    wanted = format or ("html" if _first(accept) == "text/html" else "json")
    if wanted == "html":
        return HTMLResponse(await run_in_threadpool(_page, made.report), headers=vary)
    if wanted == "c":
        return PlainTextResponse(made.controller.to_c_header(), headers=vary)
    return Response(made.report.model_dump_json(), media_type="application/json", headers=vary)


def _first(accept: str) -> str:
    """Return the kind that `Accept` names first of those there are."""
    kinds = (part.split(";")[0].strip() for part in accept.split(","))
    return next((k for k in kinds if k in ("text/html", "application/json", "*/*")), "*/*")


# What is imported here takes a second, which the service's start need not wait for.


@cache
def _loops() -> list[LoopFigures]:
    from service.controllers.design import loop_figures

    return loop_figures()


def _made(name: str, options: ControllerOptions) -> Any:
    from service.controllers.design import design_controller as design

    return design(resolved(name, options), options)


def _page(report: ControllerReport) -> str:
    from service.controllers.page import render_controller

    return render_controller(report)
