"""The route of a machine's frequency responses, as plots need them."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query, Request

from stillpath.applications.machines.frequency import AxisResponse, axis_responses
from stillpath.applications.machines.resolve import Resolver
from stillpath.models.machine import Machine
from stillpath.service.api.access import Reader
from stillpath.service.api.machines import as_problems, look_up
from stillpath.service.api.problems import responses

__all__ = ["router"]

router = APIRouter(prefix="/v1/machines/{name}", tags=["machines"])


@router.get(
    "/response", responses=responses(404, 422), summary="Get the frequency response of a machine"
)
def show_response(
    request: Request,
    name: str,
    _: Reader,
    revision: Annotated[
        int | None,
        Query(ge=1, le=999_999, description="Revision of your own machine; by default the newest."),
    ] = None,
) -> list[AxisResponse]:
    """Return modulus and phase of both axes: the nominal plant and the members of its set."""
    with as_problems():
        return axis_responses(_machine(request, name, revision))


def _machine(request: Request, name: str, revision: int | None) -> Machine:
    if revision is None:
        return look_up(request, name)
    machines: Resolver = request.app.state.machines
    return machines.store.revision(name, revision).machine
