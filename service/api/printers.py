"""Routes of printers that results can be sent to."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

from fastapi import APIRouter, Request
from pydantic import BaseModel, Field

from service.api.access import Reader
from service.api.problems import responses
from service.deliveries.printers import Printer

__all__ = ["router"]

router = APIRouter(prefix="/v1/printers", tags=["printers"])


class PrinterView(BaseModel):
    """A printer as callers see it; its address and key stay here."""

    name: str
    kind: Literal["moonraker", "octoprint"]
    machine: str = Field(description="That files for it are made with.")
    method: str | None
    tolerance_um: float | None
    start: bool = Field(description="Whether `print=true` may be asked for.")


@router.get("", responses=responses(401, 403, 429), summary="List the printers")
def list_printers(request: Request, caller: Reader) -> list[PrinterView]:
    """Return the printers that a job can name."""
    del caller
    printers: Mapping[str, Printer] = request.app.state.printers
    return [
        PrinterView(
            name=printer.name,
            kind=printer.kind,
            machine=printer.machine,
            method=printer.method,
            tolerance_um=printer.tolerance_um,
            start=printer.start,
        )
        for printer in printers.values()
    ]
