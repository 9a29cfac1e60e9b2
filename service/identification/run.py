"""From files to a machine with new plants; nothing is stored here."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from models.errors import ModelError
from models.identification.conditions import Condition
from models.identification.identify import Measured, Progress, identify
from models.identification.readers import ReadSettings, read_content
from models.identification.types import AxisIdentification
from models.machine import Machine
from models.provenance import SourceFile
from models.schedule import MassSchedule
from service.identification.figures import IdentificationReport
from service.identification.report import identification_report

__all__ = ["Identified", "InputFile", "identify_files", "read_inputs"]

LARGEST_BYTES = 200_000_000


@dataclass(frozen=True, slots=True)
class InputFile:
    """A file to identify from.

    Attributes
    ----------
    name : str
        Without folder; tells axis and date.
    condition : Condition
        What was different when it was measured.
    """

    name: str
    content: bytes
    condition: Condition = field(default_factory=Condition)

    @property
    def source(self) -> SourceFile:
        """Name and hash, for the record."""
        return SourceFile(name=self.name, sha256=hashlib.sha256(self.content).hexdigest())


@dataclass(frozen=True, slots=True)
class Identified:
    """A machine with new plants, and how they were found."""

    machine: Machine
    report: IdentificationReport


def read_inputs(arguments: Sequence[str]) -> list[InputFile]:
    """Read files given as `PATH` or `PATH@CONDITION` (see `Condition.parse`).

    Raises
    ------
    ModelError
        If a file cannot be read, is too large, or a condition is not understood.
    """
    return [_read_input(argument) for argument in arguments]


def identify_files(
    files: Sequence[InputFile],
    base: Machine,
    settings: ReadSettings | None = None,
    *,
    name: str | None = None,
    title: str | None = None,
    max_order: int = 4,
    progress: Progress | None = None,
) -> Identified:
    """Identify the axes that were measured and put them into a machine.

    Parameters
    ----------
    files : sequence of InputFile
    base : Machine
        Everything else comes from it.
    settings : ReadSettings, optional
    name, title : str, optional
        Of the machine, if it is a new one.
    max_order : int
        Most pole pairs to try.

    Raises
    ------
    ModelError
        If a file cannot be used; the message names it.
    """
    settings = settings or ReadSettings()
    measured = [
        Measured(measurement, file.condition)
        for file in files
        for measurement in read_content(file.content, file.name, settings=settings)
    ]
    sources = [file.source for file in files]
    found = identify(measured, settings, sources=sources, max_order=max_order, progress=progress)
    machine = _with_plants(base, found, name, title)
    report = identification_report(machine, base, found, settings, sources)
    return Identified(machine, report)


def _read_input(argument: str) -> InputFile:
    path, condition = Path(argument), Condition()
    if not path.exists() and "@" in argument:
        before, _, after = argument.rpartition("@")
        path, condition = Path(before), Condition.parse(after)
    try:
        if path.stat().st_size > LARGEST_BYTES:
            raise ModelError(f"{path}: over {LARGEST_BYTES} bytes, no measurement is that large")
        return InputFile(path.name, path.read_bytes(), condition)
    except OSError as error:
        raise ModelError(f"cannot read {path}: {error.strerror}") from None


def _with_plants(
    base: Machine,
    found: Mapping[Literal["x", "y"], AxisIdentification],
    name: str | None,
    title: str | None,
) -> Machine:
    document = base.model_dump()
    for axis, one in found.items():
        document["axes"][axis] = one.plants.model_dump()
        schedule = _schedule(base, axis, one)
        document["schedules"].pop(axis, None)
        if schedule:
            document["schedules"][axis] = schedule
    if name is not None and name != base.name:
        document.update(name=name, title=title or f"{base.title}, measured")
    elif title is not None:
        document["title"] = title
    return Machine.model_validate(document)


def _schedule(base: Machine, axis: Literal["x", "y"], found: AxisIdentification) -> dict[str, Any]:
    """Return the schedule of an axis: what was measured now, else the mass that was known before.

    A grid that was known before is dropped: its plants would hide the new one.
    """
    now = found.schedule
    before = base.schedules.get(axis)
    mass = now.mass if now else None
    if mass is None and before is not None and _fits(before.mass, found):
        mass = before.mass
    grid = now.grid if now else None
    parts = {"mass": mass, "grid": grid}
    return {key: part.model_dump() for key, part in parts.items() if part is not None}


def _fits(mass: MassSchedule | None, found: AxisIdentification) -> bool:
    if mass is None:
        return False
    try:
        mass.check(found.plants.nominal)
    except ModelError:
        return False
    return True
