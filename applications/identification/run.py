"""Identify a machine with new plants from files; nothing is stored here."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import date
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np
from pydantic import ValidationError

from stillpath.applications.identification.figures import IdentificationReport
from stillpath.applications.identification.report import identification_report
from stillpath.applications.proof.ring_identification import stops_of
from stillpath.applications.proof.ring_motion import begins_ring_test
from stillpath.compensation.defaults import DT_S
from stillpath.gcode.errors import GcodeError
from stillpath.models.complaints import explain
from stillpath.models.errors import ModelError
from stillpath.models.friction import usual_guides
from stillpath.models.identification.conditioned import schedulable
from stillpath.models.identification.conditions import Condition
from stillpath.models.identification.identify import Measured, Progress, identify
from stillpath.models.identification.readers import LARGEST_BYTES, ReadSettings, read_content
from stillpath.models.identification.types import AccelerationLog, AxisIdentification, Spectrum
from stillpath.models.machine import Machine
from stillpath.models.plants import PlantSpec, discretise
from stillpath.models.provenance import SourceFile
from stillpath.models.schedule import AxisSchedule, MassSchedule, resonances_hz
from stillpath.models.user_files import read_bytes

__all__ = ["Identified", "InputFile", "identify_files", "read_inputs"]

Axis: TypeAlias = Literal["x", "y"]


@dataclass(frozen=True, slots=True)
class InputFile:
    """A file to identify from.

    Attributes
    ----------
    name : str
        Without folder; tells axis and date.
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
        Measurements. With the G-code of a ring test among them, raw accelerations are its logs.
    base : Machine
        Source of everything that was not measured.
    name, title : str, optional
        Of the machine, if it is a new one.
    max_order : int
        Most pole pairs to try.

    Raises
    ------
    ModelError
        If a file cannot be used (the message names it), or its plants do not fit the machine.
    """
    settings = settings or ReadSettings()
    if settings.guides is None:
        settings = settings.model_copy(update={"guides": usual_guides(base.kinematics)})
    tests = [file for file in files if begins_ring_test(file.content)]
    measured = _read([file for file in files if file not in tests], settings, progress)
    if tests:
        measured = _with_stops(tests, measured, base)
    sources = [file.source for file in files]
    identified = identify(
        measured, settings, sources=sources, max_order=max_order, progress=progress
    )
    found = {axis: _with_what_is_known(base, axis, one) for axis, one in identified.items()}
    found = {axis: _dated(one) for axis, one in found.items()}
    for axis, one in found.items():
        _check_sampled(axis, one.plants.nominal)
    machine = _with_plants(base, found, name, title)
    report = identification_report(machine, base, found, settings, sources)
    return Identified(machine, report)


def _read(
    files: Sequence[InputFile], settings: ReadSettings, progress: Progress | None
) -> list[Measured]:
    """Read all files; refuse a copy, which would be taken for a repeat that scatters by nothing."""
    measured: list[Measured] = []
    known: dict[tuple[str | None, Condition, bytes], InputFile] = {}
    recorded: dict[bytes, InputFile] = {}
    for file in files:
        if progress is not None:
            progress(f"reading {file.name}", 0.0)
        for measurement in read_content(file.content, file.name, settings=settings):
            first = known.setdefault((measurement.axis, file.condition, file.content), file)
            if first is not file:
                raise ModelError(
                    f"{file.name} is a copy of {first.name}, and a copy is no repeat: give each "
                    "recording once"
                )
            if isinstance(measurement, AccelerationLog | Spectrum):
                _check_recorded_once(recorded.setdefault(file.content, file), file)
            measured.append(Measured(measurement, file.condition))
    return measured


def _with_stops(
    tests: Sequence[InputFile], measured: Sequence[Measured], base: Machine
) -> list[Measured]:
    """Put the stops of a ring test in the place of the raw accelerations, which are its logs."""
    if len(tests) > 1:
        names = ", ".join(test.name for test in tests)
        raise ModelError(f"{names}: give one ring test with its logs at a time")
    (test,) = tests
    logs = [one.measurement for one in measured if isinstance(one.measurement, AccelerationLog)]
    if not logs:
        raise ModelError(f"{test.name} is a ring test: give what was logged while it ran, too")
    try:
        stops = iter(stops_of(test.content, test.name, logs, base))
    except GcodeError as error:
        raise ModelError(f"{test.name}: {error}") from None
    found: list[Measured] = []
    for one in measured:
        if isinstance(one.measurement, AccelerationLog):
            found += [Measured(each, one.condition) for each in next(stops)]
        else:
            found.append(one)
    return found


def _check_recorded_once(first: InputFile, file: InputFile) -> None:
    """Refuse the recording of a test that is given as one of another axis or condition, too."""
    if first is not file:
        raise ModelError(
            f"{file.name} is a copy of {first.name}, but a test is of one axis and one condition: "
            "leave out the one with the wrong name, and measure what is missing. (Creality's K1 "
            "writes the table of Y as that of X, too, after SHAPER_CALIBRATE AXIS=Y: run "
            "TEST_RESONANCES AXIS=X, then AXIS=Y)"
        )


def _dated(found: AxisIdentification) -> AxisIdentification:
    """Date a ring test whose logs do not say when they were taken: today."""
    about = found.plants.provenance
    if about is None or about.kind != "ring test" or about.measured_on is not None:
        return found
    about = about.model_copy(update={"measured_on": date.today()})
    note = "no date in the names of its logs: taken as measured today"
    plants = found.plants.model_copy(update={"provenance": about})
    return replace(found, plants=plants, notes=(*found.notes, note))


def _check_sampled(axis: Axis, plant: PlantSpec) -> None:
    """Refuse a model that no command can be designed for, before it is stored."""
    try:
        discretise(plant, DT_S)
    except ModelError as error:
        raise ModelError(
            f"axis {axis.upper()}: commands have a sample every {DT_S * 1e3:g} ms, and {error}"
        ) from None


def _read_input(argument: str) -> InputFile:
    path, condition = Path(argument), Condition()
    before, _, after = argument.rpartition("@")
    # An @ may be the file's own, or its folder's.
    if not path.exists() and Path(before).exists() and not Path(before).is_dir():
        path, condition = Path(before), Condition.parse(after)
    content = read_bytes(path, LARGEST_BYTES, "no measurement is that large")
    return InputFile(path.name, content, condition)


def _with_what_is_known(base: Machine, axis: Axis, found: AxisIdentification) -> AxisIdentification:
    """Keep a known moving mass if no weight was put on the bed this time."""
    before, now = base.schedules.get(axis), found.schedule
    mass, grid = (now.mass, now.grid) if now else (None, None)
    notes, warnings = list(found.notes), list(found.warnings)
    if mass is not None:
        mass = _same_filament(mass, base)
    elif before is not None and before.mass is not None:
        mass = _same_modes(before.mass, base.axes[axis].nominal, found.plants.nominal)
        known = f"the {before.mass.moving_mass_kg:g} kg that axis {axis} moves"
        if mass is None:
            warnings.append(f"{known} are left out: the new plant is not given by its resonances")
        else:
            notes.append(f"{known} stay: no weight was put on the bed")
    if grid is None and before is not None and before.grid is not None:
        # Its plants would override the new one.
        warnings.append(
            f"the plants of {len(before.grid.nodes)} places that the machine had for axis {axis} "
            "were dropped: they belong to the earlier measurement; measure there again (FILE@z=150)"
        )
    schedule = AxisSchedule(mass=mass, grid=grid) if mass or grid else None
    about = found.plants.provenance
    if schedule is not None and about is not None:
        plants, varied = schedulable(found.plants, about.kind)
        found, notes = replace(found, plants=plants), [*notes, *varied]
    return replace(found, schedule=schedule, notes=tuple(notes), warnings=tuple(warnings))


def _same_filament(mass: MassSchedule, base: Machine) -> MassSchedule:
    """Return the mass with the density of the machine's filament, if known."""
    known = [s.mass.filament_density_g_cm3 for s in base.schedules.values() if s.mass]
    return mass.model_copy(update={"filament_density_g_cm3": known[0]}) if known else mass


def _same_modes(mass: MassSchedule, before: PlantSpec, now: PlantSpec) -> MassSchedule | None:
    """Return the mass schedule for the resonances nearest to those it lowered before."""
    were, are = resonances_hz(before), resonances_hz(now)
    if not len(are):
        return None
    modes = {int(np.argmin(np.abs(np.log(are / were[k])))) for k in mass.modes}
    return mass.model_copy(update={"modes": tuple(sorted(modes))})


def _with_plants(
    base: Machine, found: Mapping[Axis, AxisIdentification], name: str | None, title: str | None
) -> Machine:
    document = base.model_dump()
    for axis, one in found.items():
        document["axes"][axis] = one.plants.model_dump()
        document["schedules"].pop(axis, None)
        if one.schedule is not None:
            document["schedules"][axis] = one.schedule.model_dump()
    if name is not None and name != base.name:
        kept = ", ".join(
            [f"axis {axis.upper()}" for axis in sorted(base.axes.keys() - found.keys())]
            + [f"ripple of {axis.upper()}" for axis in sorted(base.ripple)]
        )
        document.update(
            name=name,
            title=title or f"{base.title}, measured",
            source=f"travel, limits{kept and f', {kept}'} of {base.title} ({base.name})",
        )
    elif title is not None:
        document["title"] = title
    try:
        return Machine.model_validate(document)
    except ValidationError as error:
        raise ModelError(f"machine {document['name']!r:.80}: {explain(error)}") from None
