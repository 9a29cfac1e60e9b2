"""The two requests of OctoPrint's API with which slicers send a file to a printer.

A slicer is given the address of this service as that of an OctoPrint. With
``http://host:8000/printers/NAME`` the file is for the printer NAME of the printers' file, to which
the result is sent on, or, if there is none, for the machine NAME.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Any

from fastapi import APIRouter, Path, Request, Response
from pydantic import BaseModel, ConfigDict, ValidationError
from starlette.concurrency import run_in_threadpool

from stillpath.models.complaints import complaint
from stillpath.service.api.access import Reader, Uploader
from stillpath.service.api.intake import Intake
from stillpath.service.api.jobs import upload_body
from stillpath.service.api.problems import Problem, responses
from stillpath.service.api.schemas import JobQuery
from stillpath.version import __version__

__all__ = ["router"]

# Slicers look for the word in front.
_TEXT = f"OctoPrint (Stillpath {__version__})"

PrinterName = Annotated[
    str, Path(description="A printer of `/v1/printers`, or a machine.", examples=["ender3"])
]

router = APIRouter(tags=["printers"])


class ApiVersion(BaseModel):
    """OctoPrint's version information."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"api": "0.1", "server": "1.10.0", "text": _TEXT}]}
    )

    api: str = "0.1"
    server: str = "1.10.0"
    text: str = _TEXT


class LocalFile(BaseModel):
    """A file in OctoPrint's format."""

    name: str
    path: str
    display: str
    origin: str = "local"
    refs: dict[str, str]


class Stored(BaseModel):
    """OctoPrint's answer to an upload; `job` is ours."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "files": {
                        "local": {
                            "name": "gear.gcode",
                            "path": "gear.gcode",
                            "display": "gear.gcode",
                            "origin": "local",
                            "refs": {"resource": "http://localhost:8000/v1/jobs/5f2c8e0e"},
                        }
                    },
                    "done": True,
                    "effectiveSelect": False,
                    "effectivePrint": False,
                    "job": "/v1/jobs/5f2c8e0e",
                }
            ]
        }
    )

    files: dict[str, LocalFile]
    done: bool = True
    effectiveSelect: bool = False
    effectivePrint: bool
    job: str


@router.get(
    "/api/version", responses=responses(401, 403, 429), summary="OctoPrint-compatible version"
)
async def version(_: Reader) -> ApiVersion:
    """Answer a slicer's connection test."""
    return ApiVersion()


@router.get(
    "/printers/{name}/api/version",
    responses=responses(401, 403, 404, 429),
    summary="OctoPrint-compatible version",
)
async def version_of(request: Request, name: PrinterName, _: Reader) -> ApiVersion:
    """Answer a slicer's connection test."""
    if name not in request.app.state.printers:
        await run_in_threadpool(_check_machine, request, name)
    return ApiVersion()


@router.get("/printers/{name}", include_in_schema=False)
@router.get("/printers/{name}/", include_in_schema=False)
async def page_of(request: Request, name: PrinterName) -> Response:  # noqa: ARG001
    """Lead to the page: OrcaSlicer shows what is at the address that it sends files to."""
    # From here, because a proxy may have the service below a path.
    up = "../../" if request.url.path.endswith("/") else "../"
    return Response(status_code=307, headers={"Location": up})


_UPLOAD: dict[str, Any] = {
    "status_code": 201,
    "openapi_extra": upload_body(required_form=True),
    "summary": "OctoPrint-compatible upload",
}
_REFUSALS = 401, 403, 408, 413, 422, 429, 507


@router.post("/api/files/local", responses=responses(*_REFUSALS), **_UPLOAD)
async def upload(request: Request, response: Response, caller: Uploader) -> Stored:
    """Queue a job for the file; there must be exactly one printer."""
    printers = request.app.state.printers
    if len(printers) != 1:
        raise Problem(
            422,
            "Printer required",
            f"There are {len(printers)} printers. Give the slicer an address that names one: "
            f"{request.base_url}printers/NAME, with a name of /v1/printers or of /v1/machines.",
        )
    return await _taken(request, response, next(iter(printers)), caller)


@router.post("/printers/{name}/api/files/local", responses=responses(404, *_REFUSALS), **_UPLOAD)
async def upload_for(
    request: Request, response: Response, name: PrinterName, caller: Uploader
) -> Stored:
    """Queue a job for the file. A printer gets the result, and prints it if `print` is true."""
    return await _taken(request, response, name, caller)


async def _taken(request: Request, response: Response, name: str, caller: Uploader) -> Stored:
    intake: Intake = request.app.state.intake
    wanted = await run_in_threadpool(_wanted, request, name)
    taken = await intake.take(request, wanted, caller)
    here = f"/v1/jobs/{taken.job.id}"
    response.headers["Location"] = f"{str(request.base_url).rstrip('/')}{here}"
    file = LocalFile(
        name=taken.job.source_name,
        path=taken.job.source_name,
        display=taken.job.source_name,
        refs={"resource": response.headers["Location"]},
    )
    return Stored(files={"local": file}, effectivePrint=taken.job.print_after, job=here)


def _wanted(request: Request, name: str) -> JobQuery:
    printer = request.app.state.printers.get(name)
    if printer is None:
        _check_machine(request, name)
    given: dict[str, Any] = {"machine": name, "fresh": True}
    if printer is not None:
        chosen = printer.model_dump(include={"method", "tolerance_um", "budget_um"})
        given |= {"machine": printer.machine, "printer": name}
        given |= {key: value for key, value in chosen.items() if value is not None}
    try:
        return JobQuery.model_validate(given)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        place = ".".join(str(part) for part in first["loc"]) or "options"
        raise Problem(
            422,
            "Printer not usable",
            f"The settings of {name!r:.80} are not valid, {place}: "
            f"{complaint(first, repeat=False)}. Change them in the printers' "
            "file (STILLPATH_PRINTERS).",
        ) from None


def _check_machine(request: Request, name: str) -> None:
    """Raise unless there is a machine of that name; jobs ask for more."""
    names = request.app.state.machines.names()
    if name not in names:
        raise _no_such_printer(request, name, names)


def _no_such_printer(request: Request, name: str, machines: Iterable[str]) -> Problem:
    known = ", ".join([*request.app.state.printers, *machines])
    return Problem(404, "No such printer", f"No printer is called {name!r:.80}. Known: {known}.")
