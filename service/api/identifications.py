"""Routes of measurements: files in, a new revision of a machine and its figures out."""

from __future__ import annotations

import asyncio
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Query, Request, Response
from pydantic import BaseModel, ValidationError
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import UploadFile
from starlette.formparsers import MultiPartException, MultiPartParser
from starlette.responses import HTMLResponse

from models.errors import ModelError
from models.identification.readers.settings import ReadSettings
from models.machine import Machine
from models.store import explain
from service.api.access import Reader, Submitter
from service.api.machine_views import RevisionView
from service.api.machines import Author, Message, Name, as_problems, look_up
from service.api.problems import Problem, responses
from service.api.uploads import limited_body, safe_name
from service.identification.archive import Archive
from service.identification.figures import IdentificationReport
from service.machines.resolve import Resolver
from service.machines.revision import Revision
from service.security.audit import record
from service.security.callers import Scope

__all__ = ["Identifications", "router"]

router = APIRouter(prefix="/v1/machines/{name}", tags=["machines"])

_LARGEST_BYTES = 200_000_000
_MOST_FILES = 40
_BODY = {
    "requestBody": {
        "required": True,
        "description": "Measurement files, each a part with a file name. A condition may follow "
        "the name: `raw_data_y.csv@+0.5kg` (a weight on the bed), `@z=150` (a place), `@label`.",
        "content": {
            "multipart/form-data": {
                "schema": {
                    "type": "object",
                    "properties": {
                        "file": {"type": "array", "items": {"type": "string", "format": "binary"}}
                    },
                }
            }
        },
    }
}


class IdentificationView(BaseModel):
    """What came of measurements; `revision` is null for a trial, which stores nothing."""

    revision: RevisionView | None
    report: IdentificationReport


class Identifications:
    """Identifies one machine at a time, in a thread, while the service goes on answering."""

    def __init__(self, archive: Archive) -> None:
        self.archive = archive
        self._turn = asyncio.Lock()

    async def run(self, work: Any, *arguments: Any) -> Any:
        """Return what `work` returns, when its turn has come."""
        async with self._turn:
            return await run_in_threadpool(work, *arguments)


def _settings(
    axis: str | None = None,
    accel_per_hz: Annotated[float | None, Query(gt=0)] = None,
    min_freq: Annotated[float | None, Query(gt=0)] = None,
    max_freq: Annotated[float | None, Query(gt=0)] = None,
    hz_per_sec: Annotated[float | None, Query(gt=0)] = None,
    sweeping_accel: Annotated[float | None, Query(ge=0)] = None,
    firmware_date: Annotated[str | None, Query(description="Of the Klipper version.")] = None,
    sensor_axis: Annotated[str | None, Query(description="x, y or z")] = None,
    sensor_turned: bool = False,
    frame_firm: bool = False,
    repair_rounding: bool = False,
    dc_gain: Annotated[float | None, Query(gt=0, description="That a model may have.")] = None,
    sampling_s: Annotated[float | None, Query(gt=0, description="Of a discrete model.")] = None,
) -> ReadSettings:
    given = {
        "axis": axis,
        "accel_per_hz_mm_s": accel_per_hz,
        "f_start_hz": min_freq,
        "f_end_hz": max_freq,
        "hz_per_s": hz_per_sec,
        "sweeping_accel_mm_s2": sweeping_accel,
        "firmware_date": firmware_date,
        "sensor_axis": sensor_axis,
        "sensor_turned": sensor_turned,
        "frame_firm": frame_firm,
        "repair_rounding": repair_rounding,
        "dc_gain": dc_gain,
        "sampling_s": sampling_s,
    }
    try:
        return ReadSettings.model_validate({k: v for k, v in given.items() if v is not None})
    except ValidationError as error:
        raise Problem(422, "Bad parameter", explain(error)) from None


@router.post(
    "/measurements",
    status_code=201,
    response_model=IdentificationView,
    responses={200: {"model": IdentificationView}, **responses(403, 404, 409, 412, 413, 422)},
    openapi_extra=_BODY,
    summary="Identify a machine from measurements",
)
async def post_measurements(
    request: Request,
    response: Response,
    name: Name,
    caller: Submitter,
    settings: Annotated[ReadSettings, Depends(_settings)],
    base: Annotated[
        str | None, Query(description="What a machine that does not exist yet starts from.")
    ] = None,
    title: Annotated[str | None, Query(description="Of the machine.", max_length=200)] = None,
    trial: Annotated[bool, Query(description="Store nothing.")] = False,
    max_order: Annotated[int, Query(ge=1, le=8, description="Most modes to try.")] = 4,
    author: Author = None,
    message: Message = "",
) -> Any:
    """Give the axes that were measured new plants, as a new revision of the machine.

    Accepts resonance tests (raw or spectra), recorded drives, frequency responses and models. A
    file that cannot be used is named with its reason, and nothing is stored.
    """
    machines: Resolver = request.app.state.machines
    if not trial and not caller.may(Scope.ADMIN):
        raise Problem(
            403, "Not allowed", "To change a machine needs a key with the scope admin; a trial not."
        )
    with as_problems():
        start, expected = await run_in_threadpool(_start, machines, name, base)
    files = await _received(request)
    identifications: Identifications = request.app.state.identifications
    with as_problems():
        found = await identifications.run(
            _identified, files, start, settings, name, title, max_order
        )
        if trial:
            response.status_code = 200
            return IdentificationView(revision=None, report=found.report)
        made: Revision = await run_in_threadpool(
            _stored,
            machines,
            identifications.archive,
            name,
            found,
            author or caller.owner,
            message,
            expected,
        )
    await run_in_threadpool(
        record,
        request,
        caller,
        "machine.change",
        name,
        revision=made.machine.revision,
        number=made.number,
    )
    response.headers["Location"] = f"/v1/machines/{name}/revisions/{made.number}"
    return IdentificationView(revision=RevisionView.of(made, None), report=found.report)


@router.get(
    "/identification", responses=responses(404, 422), summary="How the machine's plants were found"
)
def read_identification(request: Request, name: Name, _: Reader) -> IdentificationReport:
    """Return the figures of the identification that led to the machine as it stands."""
    return _kept(request, name)


@router.get(
    "/identification.html",
    response_class=HTMLResponse,
    responses=responses(404, 422),
    summary="How the machine's plants were found, as a page",
)
def read_identification_page(request: Request, name: Name, _: Reader) -> HTMLResponse:
    """Return one self-contained HTML page: measured and model, modes, shapers."""
    from service.identification.page import render_identification

    return HTMLResponse(render_identification(_kept(request, name)))


def _kept(request: Request, name: str) -> IdentificationReport:
    machine = look_up(request, name)
    identifications: Identifications = request.app.state.identifications
    with as_problems():
        found = identifications.archive.find(machine.revision)
    if found is None:
        raise Problem(
            404,
            "No identification",
            f"Machine {name!r} as it stands ({machine.revision}) was not identified here; POST "
            f"measurements to /v1/machines/{name}/measurements.",
        )
    return found


async def _received(request: Request) -> list[tuple[str, bytes]]:
    """Return names and contents of the files of a form."""
    if not request.headers.get("content-type", "").startswith("multipart/form-data"):
        raise Problem(
            422, "No form", "Send the files as multipart/form-data (curl -F file=@raw_data_x.csv)."
        )
    body = limited_body(request, _LARGEST_BYTES)
    try:
        form = await MultiPartParser(request.headers, body, max_files=_MOST_FILES).parse()
    except (MultiPartException, KeyError) as error:
        raise Problem(422, "Broken form", f"The form cannot be read: {error}.") from None
    try:
        uploads = [part for _, part in form.multi_items() if isinstance(part, UploadFile)]
        return [(part.filename or "", await part.read()) for part in uploads]
    finally:
        await form.close()


def _start(machines: Resolver, name: str, base: str | None) -> tuple[Machine, int]:
    if name in machines.store:
        current = machines.store.current(name)
        return current.machine, current.number
    if base is None:
        raise Problem(
            404,
            "Unknown machine",
            f"No machine of yours is called {name!r:.80}. Say by `base` which machine a new one "
            "starts from.",
        )
    return machines.to_look_at(base).machine, 0


# What is imported here takes a second, which the service's start need not wait for.


def _identified(
    files: list[tuple[str, bytes]],
    start: Machine,
    settings: ReadSettings,
    name: str,
    title: str | None,
    order: int,
) -> Any:
    from models.identification.conditions import Condition
    from service.identification.run import InputFile, identify_files

    if not files:
        raise ModelError("the form holds no file; send at least one measurement")
    inputs = []
    for label, content in files:
        before, _, condition = label.partition("@")
        inputs.append(InputFile(safe_name(before), content, Condition.parse(condition)))
    return identify_files(inputs, start, settings, name=name, title=title, max_order=order)


def _stored(
    machines: Resolver,
    archive: Archive,
    name: str,
    found: Any,
    author: str,
    message: str,
    expected: int,
) -> Revision:
    # First what may lie unused, then what refers to it.
    archive.keep(found.report)
    sources = found.report.sources
    return machines.store.add_revision(
        name,
        found.machine,
        author=author,
        message=message or f"identified from {', '.join(s.name for s in sources)}",
        sources=sources,
        expected=expected,
    )
