"""Routes of measurements: files in, a new revision of a machine and its figures out."""

from __future__ import annotations

import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Query, Request, Response
from pydantic import BaseModel, ValidationError
from starlette.concurrency import run_in_threadpool
from starlette.responses import HTMLResponse

from stillpath.applications.identification.archive import Archive
from stillpath.applications.identification.figures import IdentificationReport
from stillpath.applications.machines.resolve import Resolver
from stillpath.applications.machines.revision import Revision, identified_from
from stillpath.models.complaints import explain
from stillpath.models.identification.readers import LARGEST_BYTES, ReadSettings
from stillpath.models.machine import Machine
from stillpath.service.api.access import Reader, Uploader
from stillpath.service.api.computing import WAITING, ComputeRequest, read_result, run_and_wait
from stillpath.service.api.documentation import linked
from stillpath.service.api.forms import is_form
from stillpath.service.api.machine_views import RevisionView
from stillpath.service.api.machines import Author, Message, Name, as_problems, look_up
from stillpath.service.api.problems import Problem, responses
from stillpath.service.api.uploads import Received, receive_files, safe_name
from stillpath.service.jobs.state import JobKind
from stillpath.service.security.audit import record
from stillpath.service.security.callers import Caller, Scope
from stillpath.service.storage.disk import Disk

__all__ = ["router"]

router = APIRouter(prefix="/v1/machines/{name}", tags=["machines"])

_MOST_FILES = 40
_OF_DIRECTIONS = "=,"
"""In names of Klipper's tests of belts: resonances_axis=1.000,-1.000_a.csv."""
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
    """Result of an identification; `revision` is null for a trial, which stores nothing."""

    revision: RevisionView | None
    report: IdentificationReport


@dataclass(frozen=True, slots=True)
class _Reading:
    """What files of measurements do not say of themselves."""

    axis: str | None = None
    accel_per_hz: Annotated[float | None, Query(gt=0)] = None
    min_freq: Annotated[float | None, Query(gt=0)] = None
    max_freq: Annotated[float | None, Query(gt=0)] = None
    hz_per_sec: Annotated[float | None, Query(gt=0)] = None
    sweeping_accel: Annotated[float | None, Query(ge=0)] = None
    firmware_date: Annotated[str | None, Query(description="Date of the Klipper version.")] = None
    sensor_axis: Annotated[
        str | None, Query(description="Sensor axis along the tested axis: x, y or z.")
    ] = None
    sensor_turned: bool = False
    frame_firm: bool = False
    guides: Annotated[str | None, Query(description="Of the axes: wheels or rails.")] = None
    repair_rounding: bool = False
    dc_gain: Annotated[float | None, Query(gt=0, description="DC gain that a model may have.")] = (
        None
    )
    sampling_s: Annotated[
        float | None, Query(gt=0, description="Sampling time of a discrete model.")
    ] = None


_FIELDS = {
    "accel_per_hz": "accel_per_hz_mm_s",
    "min_freq": "f_start_hz",
    "max_freq": "f_end_hz",
    "hz_per_sec": "hz_per_s",
    "sweeping_accel": "sweeping_accel_mm_s2",
}
"""Of `ReadSettings`, where the parameter is called as in Klipper."""


def _settings(given: Annotated[_Reading, Depends()]) -> ReadSettings:
    known = {_FIELDS.get(k, k): v for k, v in asdict(given).items() if v is not None}
    try:
        return ReadSettings.model_validate(known)
    except ValidationError as error:
        raise Problem(422, "Invalid parameter", explain(error)) from None


@router.post(
    "/measurements",
    status_code=201,
    response_model=IdentificationView,
    responses={
        200: {"model": IdentificationView},
        **WAITING,
        **responses(403, 404, 408, 409, 412, 413, 422, 507),
    },
    openapi_extra=_BODY,
    summary="Identify a machine from measurements",
)
async def post_measurements(
    request: Request,
    response: Response,
    name: Name,
    caller: Uploader,
    settings: Annotated[ReadSettings, Depends(_settings)],
    base: Annotated[str | None, Query(description="Machine that a new one is based on.")] = None,
    title: Annotated[
        str | None, Query(description="Display name of the machine.", max_length=200)
    ] = None,
    trial: Annotated[bool, Query(description="Store nothing.")] = False,
    max_order: Annotated[int, Query(ge=1, le=8, description="Largest number of modes to try.")] = 4,
    author: Author = None,
    message: Message = "",
) -> Any:
    """Identify the plants of the measured axes, and store them as a new revision of the machine.

    Accepts resonance tests (raw or spectra), ring tests (the G-code and its logs), recorded drives,
    frequency responses and models. If a file cannot be used, the answer names it and the reason,
    and nothing is stored.
    """
    machines: Resolver = request.app.state.machines
    if not trial:
        _check_may_store(caller)
    with as_problems():
        start, expected = await run_in_threadpool(_start, machines, name, base)
    given = {
        "settings": settings.model_dump(mode="json", exclude_unset=True),
        "name": name,
        "title": title,
        "order": max_order,
    }
    machine, report = await _identified(request, caller, start, given)
    if trial:
        response.status_code = 200
        return IdentificationView(revision=None, report=report)
    with as_problems():
        made: Revision = await run_in_threadpool(
            _stored,
            machines,
            request.app.state.identifications,
            name,
            machine,
            report,
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
    return IdentificationView(revision=RevisionView.of(made, None), report=report)


@router.get(
    "/identification", responses=responses(404, 422), summary="Get the identification of a machine"
)
def read_identification(request: Request, name: Name, _: Reader) -> IdentificationReport:
    """Return the figures of the identification that led to the machine as it stands."""
    return _kept(request, name)


@router.get(
    "/identification.html",
    response_class=HTMLResponse,
    responses=responses(404, 422),
    summary="Get the identification of a machine, as a page",
)
def read_identification_page(request: Request, name: Name, _: Reader) -> HTMLResponse:
    """Return one self-contained HTML page: measured and model, modes, shapers."""
    from stillpath.applications.identification.page import render_identification

    return HTMLResponse(linked(render_identification(_kept(request, name))))


def _kept(request: Request, name: str) -> IdentificationReport:
    machine = look_up(request, name)
    archive: Archive = request.app.state.identifications
    with as_problems():
        found = archive.find(machine.revision)
    if found is None:
        raise Problem(
            404,
            "No identification",
            f"Machine {name!r} as it stands ({machine.revision}) was not identified here; POST "
            f"measurements to /v1/machines/{name}/measurements.",
        )
    return found


def _check_may_store(caller: Caller) -> None:
    if not caller.may(Scope.ADMIN):
        raise Problem(
            403,
            "Not allowed",
            "Changing a machine requires a key with the `admin` scope; a trial does not.",
        )


async def _identified(
    request: Request, caller: Caller, start: Machine, given: dict[str, Any]
) -> tuple[Machine, IdentificationReport]:
    """Take the files in, on the disk, and have the machine `start` identified from them."""
    state = request.app.state
    with tempfile.TemporaryDirectory(dir=state.intake.folder, prefix="measurements-") as folder:
        received = await _received(request, Path(folder), state.disk)
        named = [file.label.partition("@") for file in received]
        files = [
            [safe_name(before, also=_OF_DIRECTIONS), condition] for before, _, condition in named
        ]
        asked = ComputeRequest(
            kind=JobKind.IDENTIFICATION,
            machine=given["name"],
            document=start,
            revision=start.revision,
            options=given | {"files": files},
            result_name="identification.json",
            source_name=files[0][0],
            source_bytes=sum(file.size_bytes for file in received),
            files=tuple((file.path, file.sha256) for file in received),
        )
        job = await run_and_wait(request, caller, asked)
    found = await read_result(request, job)
    # In a thread: a report has some ten thousand numbers.
    return await run_in_threadpool(
        lambda: (
            Machine.model_validate(found["machine"]),
            IdentificationReport.model_validate(found["report"]),
        )
    )


async def _received(request: Request, folder: Path, disk: Disk) -> list[Received]:
    if not is_form(request):
        raise Problem(
            422,
            "Multipart form required",
            "Send the files as multipart/form-data (curl -F file=@raw_data_x.csv).",
        )
    files = await receive_files(
        request, folder, max_bytes=LARGEST_BYTES, max_files=_MOST_FILES, disk=disk
    )
    if not files:
        raise Problem(
            422,
            "Identification not possible",
            "the form holds no file; send at least one measurement",
        )
    return files


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


def _stored(
    machines: Resolver,
    archive: Archive,
    name: str,
    machine: Machine,
    report: IdentificationReport,
    author: str,
    message: str,
    expected: int,
) -> Revision:
    # First what may lie unused, then what refers to it.
    archive.keep(report)
    return machines.store.add_revision(
        name,
        machine,
        author=author,
        message=message or identified_from(report.sources),
        sources=report.sources,
        expected=expected,
    )
