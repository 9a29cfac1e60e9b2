"""Compare a printer with its machine document before a result is sent to it.

A file is made for a machine document. Where printer.cfg says something else, times and vibration
are not those that were computed; some of it makes a print unsafe, and then none is started. The
configuration at a printer's first check with a machine is remembered, so that later changes are
noticed that the document cannot tell: another pulley, another motor current.
"""

from __future__ import annotations

import json
from datetime import UTC, datetime
from typing import Any, Literal

from pydantic import AwareDatetime, BaseModel, Field, ValidationError
from pydantic_core import from_json

from stillpath.applications.machines.documents import Documents
from stillpath.compensation.defaults import DEFAULT_METHOD
from stillpath.models.document import Document
from stillpath.models.machine import Machine
from stillpath.service.deliveries.findings import Finding, changes, findings, relevant
from stillpath.service.deliveries.http_requests import Unanswered, Unreached
from stillpath.service.deliveries.moonraker import NotReady, PrinterState, ask, kind_there
from stillpath.service.deliveries.printers import Printer
from stillpath.service.deliveries.targets import TargetRefused

__all__ = ["Checker", "PrinterCheck", "PrinterUnknown"]


class PrinterUnknown(Exception):
    """A printer cannot be checked; the message says why."""


class PrinterCheck(BaseModel):
    """What was found when a printer was asked.

    Attributes
    ----------
    printer, machine : str
    machine_revision : str
        `models.machine.Machine.revision` of what it was compared with.
    software : str
        Klipper's version.
    remembered_at : datetime
        Of the configuration that later ones are compared with.
    findings : list of Finding
        Empty if the printer fits its machine.
    """

    printer: str
    machine: str
    machine_revision: str
    software: str
    remembered_at: AwareDatetime
    findings: list[Finding]

    @property
    def unsafe(self) -> list[Finding]:
        """Those that keep a print from being started."""
        return [finding for finding in self.findings if finding.unsafe]

    @property
    def lines(self) -> list[str]:
        """What to tell a person, one line each."""
        return [f"printer {self.printer}: {finding.text}" for finding in self.findings]


class _Remembered(Document):
    """A printer's configuration as it was when it was first checked with a machine."""

    schema_version: Literal[1] = 1
    printer: str
    machine: str
    machine_revision: str
    when: AwareDatetime
    sections: dict[str, dict[str, Any]] = Field(description="See `relevant`.")


class Checker:
    """Compares printers with machines, and remembers their configurations.

    Parameters
    ----------
    documents : Documents
        Where configurations are kept: ``PRINTER/REVISION.json``.
    """

    def __init__(self, documents: Documents) -> None:
        self._documents = documents

    def check(
        self,
        printer: Printer,
        machine: Machine,
        *,
        method: str | None = None,
        accept: bool = False,
    ) -> PrinterCheck:
        """Ask a printer and compare it with the machine that files for it are made with.

        Parameters
        ----------
        method : str, optional
            Of the file, otherwise the printer's; those without a stream need no raised limits.
        accept : bool
            Remember the configuration as it is now, whatever it was before.

        Raises
        ------
        PrinterUnknown
            If it cannot be asked; nothing is known of it then.
        """
        asked = _asked(printer)
        found = findings(machine, asked, method=method or printer.method or DEFAULT_METHOD)
        now = _Remembered(
            printer=printer.name,
            machine=machine.name,
            machine_revision=machine.revision,
            when=datetime.now(UTC),
            sections=relevant(asked),
        )
        try:
            known = self._remember(now, accept=accept)
        except OSError as error:
            why = error.strerror or error
            text = f"the configuration of {printer.name} cannot be remembered: {why}"
            if accept:
                raise PrinterUnknown(text) from error
            known = now
            text += "; until that is mended nobody notices when it changes"
            found.append(Finding(place="memory", text=text))
        day = known.when.astimezone().strftime("%Y-%m-%d")
        found += changes(known.sections, day, printer.name, asked)
        return PrinterCheck(
            printer=printer.name,
            machine=machine.name,
            machine_revision=machine.revision,
            software=asked.software,
            remembered_at=known.when,
            findings=found,
        )

    def lines(self, printer: Printer, machine: Machine, *, method: str) -> list[str]:
        """Return warnings for a report, also if the printer cannot be queried."""
        if printer.kind != "moonraker":
            return []
        try:
            return self.check(printer, machine, method=method).lines
        except PrinterUnknown as error:
            return [f"printer {error}; its configuration was not compared with the machine"]

    def _remember(self, now: _Remembered, *, accept: bool) -> _Remembered:
        path = f"{now.printer}/{now.machine_revision}.json"
        text = json.dumps(now.model_dump(mode="json"), indent=1) + "\n"
        if accept:
            self._documents.replace(path, text)
            return now
        try:
            self._documents.create(path, text)
        except FileExistsError:
            return self._read(path)
        return now

    def _read(self, path: str) -> _Remembered:
        try:
            return _Remembered.model_validate(from_json(self._documents.read(path)))
        except (ValidationError, ValueError):
            raise OSError(
                f"{self._documents.place(path)} is damaged; delete it, and the printer's "
                "configuration as it is then counts"
            ) from None


def _asked(printer: Printer) -> PrinterState:
    """Return what a printer says; raise PrinterUnknown if it cannot be asked."""
    if printer.kind != "moonraker":
        _check_kind(printer)
        raise PrinterUnknown(
            f"{printer.name} is an OctoPrint, which cannot tell what Klipper's configuration "
            "says; check by hand (`stillpath machines check NAME --printer-cfg FILE`)"
        )
    try:
        return ask(printer)
    except (Unreached, Unanswered, TargetRefused, NotReady) as error:
        _check_kind(printer, answers=not isinstance(error, Unreached))
        raise PrinterUnknown(f"{printer.name} cannot be asked: {error}") from error


def _check_kind(printer: Printer, *, answers: bool = True) -> None:
    """Raise PrinterUnknown if what answers at a printer's address is of the other kind."""
    there = kind_there(printer) if answers else None
    if there not in (None, printer.kind):
        raise PrinterUnknown(
            f"{printer.name} has kind {printer.kind}, but at {printer.url} answers "
            f'{"a Moonraker" if there == "moonraker" else "an OctoPrint"}: set kind = "{there}" '
            f"in [printer.{printer.name}]"
        )
