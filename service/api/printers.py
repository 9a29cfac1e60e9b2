"""Routes of printers that results can be sent to, and of how they compare with their machines."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Literal

from anyio import CapacityLimiter, to_thread
from fastapi import APIRouter, Path, Request
from pydantic import BaseModel, Field
from starlette.concurrency import run_in_threadpool

from stillpath.applications.machines.resolve import Resolver
from stillpath.models.errors import ModelError
from stillpath.models.machine import Machine
from stillpath.service.api.access import Admin, Reader
from stillpath.service.api.problems import Problem, responses
from stillpath.service.deliveries.checking import Checker, PrinterCheck, PrinterUnknown
from stillpath.service.deliveries.printers import Printer
from stillpath.service.security.audit import record

__all__ = ["CHECKED_AT_ONCE", "router"]

CHECKED_AT_ONCE = 8
"""Checks that wait for printers in parallel: all other requests share the remaining threads."""

router = APIRouter(prefix="/v1/printers", tags=["printers"])

Name = Annotated[str, Path(description="A printer of `/v1/printers`.", examples=["voron"])]


class PrinterView(BaseModel):
    """A printer as callers see it; its address and key stay here."""

    name: str
    kind: Literal["moonraker", "octoprint"]
    machine: str = Field(description="Machine that files for it are made with.")
    method: str | None
    tolerance_um: float | None
    budget_um: float | None
    start: bool = Field(description="Whether `print=true` is allowed.")


@router.get("", responses=responses(401, 403, 429), summary="List the printers")
def list_printers(request: Request, _: Reader) -> list[PrinterView]:
    """Return the printers that a job can name."""
    printers: Mapping[str, Printer] = request.app.state.printers
    return [
        PrinterView(
            name=printer.name,
            kind=printer.kind,
            machine=printer.machine,
            method=printer.method,
            tolerance_um=printer.tolerance_um,
            budget_um=printer.budget_um,
            start=printer.start,
        )
        for printer in printers.values()
    ]


@router.get(
    "/{name}/check",
    responses=responses(401, 403, 404, 422, 424, 429),
    summary="Compare a printer with its machine",
)
async def check_printer(request: Request, name: Name, _: Reader) -> PrinterCheck:
    """Ask a Moonraker printer for its configuration and limits; say where the machine differs.

    The first check with a revision of the machine remembers the configuration; later ones tell what
    has changed since.
    """
    return await _checked(request, name, accept=False)


@router.post(
    "/{name}/accept",
    responses=responses(401, 403, 404, 422, 424, 429),
    summary="Accept the current printer configuration",
)
async def accept_printer(request: Request, name: Name, caller: Admin) -> PrinterCheck:
    """Remember the current configuration; later checks report changes since then."""
    found = await _checked(request, name, accept=True)
    await run_in_threadpool(record, request, caller, "printer.accept", name, machine=found.machine)
    return found


async def _checked(request: Request, name: str, *, accept: bool) -> PrinterCheck:
    limiter: CapacityLimiter = request.app.state.printer_checks
    return await to_thread.run_sync(
        lambda: _compared(request, name, accept=accept), limiter=limiter
    )


def _compared(request: Request, name: str, *, accept: bool) -> PrinterCheck:
    state = request.app.state
    printers: Mapping[str, Printer] = state.printers
    printer = printers.get(name)
    if printer is None:
        known = ", ".join(sorted(printers)) or "none; STILLPATH_PRINTERS names their file"
        raise Problem(404, "No such printer", f"No printer is called {name!r:.80}. Known: {known}.")
    if printer.kind != "moonraker":
        raise Problem(
            422,
            "Printer cannot be checked",
            f"{name} is an OctoPrint, which cannot tell Klipper's configuration. Only Moonraker "
            "printers can be checked.",
        )
    checker: Checker = state.checker
    try:
        return checker.check(printer, _machine(state.machines, printer), accept=accept)
    except PrinterUnknown as error:
        raise Problem(424, "Printer unavailable", str(error)) from None


def _machine(machines: Resolver, printer: Printer) -> Machine:
    try:
        return machines.for_job(printer.machine).machine
    except ModelError as error:
        raise Problem(
            422, "The printer's machine cannot be used", f"{printer.name}: {error}"
        ) from None
