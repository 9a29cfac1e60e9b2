"""Routes of designs: what `stillpath design` shows, computed once and kept."""

from __future__ import annotations

import asyncio
from collections import OrderedDict
from collections.abc import Awaitable, Callable
from typing import Annotated, Literal
from weakref import WeakValueDictionary

from fastapi import APIRouter, Depends, Header, Request
from starlette.concurrency import run_in_threadpool
from starlette.responses import HTMLResponse, Response

from models.machine import Machine
from service.api.access import Reader
from service.api.computing import computed
from service.api.machines import Name, look_up
from service.api.problems import responses
from service.design.figures import DesignReport
from service.pipeline.options import BasisName, RobustMode

__all__ = ["Designs", "router"]

router = APIRouter(prefix="/v1/machines/{name}", tags=["machines"])

_Settings = tuple[Literal["x", "y"], BasisName, RobustMode]
_KEPT = 64


class Designs:
    """The last designs that were made; whoever asks for one that is being made waits for it."""

    def __init__(self) -> None:
        self._kept: OrderedDict[tuple[str, _Settings], DesignReport] = OrderedDict()
        self._making: WeakValueDictionary[tuple[str, _Settings], asyncio.Lock] = (
            WeakValueDictionary()
        )

    async def get(
        self,
        machine: Machine,
        settings: _Settings,
        make: Callable[[], Awaitable[DesignReport]],
    ) -> DesignReport:
        """Return the design of a machine's axis, made if nobody asked for it before."""
        key = (machine.revision, settings)
        if key not in self._kept:
            making = self._making.setdefault(key, asyncio.Lock())
            async with making:
                if key not in self._kept:
                    self._kept[key] = await make()
                    if len(self._kept) > _KEPT:
                        self._kept.popitem(last=False)
        self._kept.move_to_end(key)
        return self._kept[key]


async def _asked(
    request: Request,
    name: Name,
    caller: Reader,
    axis: Literal["x", "y"],
    basis: BasisName = "ce-opt",
    robust: RobustMode = "off",
) -> DesignReport:
    machine = await run_in_threadpool(look_up, request, name)

    async def make() -> DesignReport:
        found = await computed(
            request,
            request.app.state.room,
            caller,
            "design",
            {
                "machine": machine.model_dump(mode="json"),
                "axis": axis,
                "basis": basis,
                "robust": robust,
            },
            refused="No such design",
            remedy="Give the machine fewer members or places, or have the limit raised.",
        )
        return DesignReport.model_validate(found)

    designs: Designs = request.app.state.designs
    return await designs.get(machine, (axis, basis, robust), make)


Asked = Annotated[DesignReport, Depends(_asked)]


@router.get(
    "/design",
    response_model=DesignReport,
    responses={200: {"content": {"text/html": {}}}, **responses(404, 422)},
    summary="Look at the design for an axis",
)
async def read_design(found: Asked, accept: Annotated[str, Header()] = "*/*") -> Response:
    """Return the figures as JSON, or as a page if that is what `Accept` names first.

    The first request for a machine, axis, basis and robust mode takes some ten seconds.
    """
    kinds = [part.split(";")[0].strip() for part in accept.split(",")]
    first = next((k for k in kinds if k in ("text/html", "application/json", "*/*")), "*/*")
    vary = {"Vary": "Accept"}
    if first == "text/html":
        return await run_in_threadpool(_page, found, vary)
    return Response(found.model_dump_json(), media_type="application/json", headers=vary)


@router.get(
    "/design.html",
    response_class=HTMLResponse,
    responses=responses(404, 422),
    summary="Look at the design for an axis, as a page",
)
async def read_design_page(found: Asked) -> HTMLResponse:
    """Return one self-contained HTML page."""
    return await run_in_threadpool(_page, found)


# What is imported here takes a second, which the service's start need not wait for.


def _page(found: DesignReport, headers: dict[str, str] | None = None) -> HTMLResponse:
    from service.design.page import render_design

    return HTMLResponse(render_design(found), headers=headers)
