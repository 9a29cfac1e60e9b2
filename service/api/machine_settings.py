"""Machines from a printer's own settings: printer.cfg, config.g, Marlin's answer to M503."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

from fastapi import APIRouter, Depends, Query, Request, Response
from starlette.concurrency import run_in_threadpool

from stillpath.applications.machines import marlin_settings
from stillpath.applications.machines.klipper_config import parse_printer_config
from stillpath.applications.machines.klipper_settings import machine_from_config, with_config
from stillpath.applications.machines.reprapfirmware_config import (
    looks_like_config_g,
    parse_config_g,
)
from stillpath.applications.machines.reprapfirmware_settings import (
    machine_from_config_g,
    with_config_g,
)
from stillpath.applications.machines.revision import source_file
from stillpath.applications.machines.stated import StatedMachine
from stillpath.models.machine import Machine
from stillpath.service.api.access import Admin
from stillpath.service.api.machine_views import RevisionView
from stillpath.service.api.machines import (
    Edit,
    Name,
    as_problems,
    store_revision,
)
from stillpath.service.api.problems import Problem, responses
from stillpath.service.api.uploads import receive_document, safe_name

__all__ = ["router"]

_LARGEST_BYTES = 4_000_000
_LONGEST_UNREAD = 500
_WANTED = "Klipper's printer.cfg, RepRapFirmware's config.g, or Marlin's answer to M503"
_BODY = {
    "requestBody": {
        "required": True,
        "description": f"{_WANTED}.",
        "content": {"text/plain": {"schema": {"type": "string"}}},
    }
}

Hertz = Annotated[float | None, Query(ge=1, le=500, allow_inf_nan=False)]

router = APIRouter(prefix="/v1/machines", tags=["machines"])


@dataclass(frozen=True, slots=True)
class _Given:
    """What goes along with the text; of a machine that is there only `file` counts."""

    file: Annotated[
        str, Query(max_length=255, description="Name of the file, for messages and the record.")
    ] = "settings.txt"
    travel: Annotated[
        str,
        Query(
            max_length=60,
            description="Travel of the axes in mm, which is not in M503's output: where each "
            "ends, or begins and ends.",
            examples=["235x235x250", "-4:220x-17:227x0:250"],
        ),
    ] = ""
    kinematics: Annotated[
        str,
        Query(
            max_length=20, description="Kinematics of a Marlin printer: `cartesian` or `corexy`."
        ),
    ] = "cartesian"
    title: Annotated[str, Query(max_length=200, description="Display name.")] = ""
    fx: Hertz = None
    fy: Hertz = None


@router.post(
    "/{name}/settings",
    response_model=RevisionView,
    responses={
        200: {"description": "The next revision, with the printer's values"},
        201: {"description": "The first revision of a new machine", "model": RevisionView},
        **responses(403, 409, 412, 413, 422, 428),
    },
    openapi_extra=_BODY,
    summary="Create or update a machine from printer settings",
)
async def put_settings(
    request: Request,
    response: Response,
    name: Name,
    caller: Admin,
    given: Annotated[_Given, Depends()],
    edit: Annotated[Edit, Depends()],
) -> RevisionView:
    """Create a machine from its printer's settings; its plants are yet to be measured.

    The settings are Klipper's printer.cfg, RepRapFirmware's config.g or Marlin's answer to M503.

    An existing machine is updated from it (with `If-Match`, as for PUT); what is not in it stays,
    and so do measured plants.
    """
    content = await receive_document(request, max_bytes=_LARGEST_BYTES)
    file = safe_name(given.file)
    text = content.decode(errors="replace")

    def made(before: Machine | None) -> Machine:
        if before is None:
            return _new(text, file, name, given)
        if looks_like_config_g(text):
            return with_config_g(before, parse_config_g(text, file))
        if marlin_settings.looks_like_m503(text):
            return marlin_settings.with_m503(before, text, file)
        return with_config(before, parse_printer_config(text, file, _WANTED))

    def stored() -> RevisionView:
        message = edit.message or _message(text, file)
        sources = [source_file(file, content)]
        told = replace(edit, message=message)
        return store_revision(request, response, name, caller, told, made, sources=sources)

    with as_problems():
        return await run_in_threadpool(stored)


def _message(text: str, file: str) -> str:
    """Return what a revision is made from, and which files of a configuration were not read."""
    if looks_like_config_g(text):
        names = ", ".join(parse_config_g(text, file).unread)
    elif marlin_settings.looks_like_m503(text):
        names = ""
    else:
        names = ", ".join(parse_printer_config(text, file, _WANTED).includes)
    unread = "".join(filter(str.isprintable, names))[:_LONGEST_UNREAD]
    return f"from {file}; not read, so unknown: {unread}" if unread else f"from {file}"


def _new(text: str, file: str, name: str, given: _Given) -> Machine:
    stated = StatedMachine(name, given.title, (given.fx, given.fy))
    if looks_like_config_g(text):
        return machine_from_config_g(parse_config_g(text, file), stated)
    if not marlin_settings.looks_like_m503(text):
        config = parse_printer_config(text, file, _WANTED)
        return machine_from_config(config, stated)
    if not given.travel:
        raise Problem(
            422,
            "Travel required",
            "M503 does not say how far the axes reach: say travel=XxYxZ in mm, like 235x235x250.",
        )
    return marlin_settings.machine_from_m503(
        text,
        file,
        stated,
        travel_mm=marlin_settings.read_travel(given.travel),
        kinematics=given.kinematics,
    )
