"""Derive schedules over bed load and position from runs under such conditions."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

from pydantic import ValidationError

from stillpath.models.complaints import explain
from stillpath.models.errors import ModelError
from stillpath.models.identification.conditions import Condition
from stillpath.models.identification.prompt import prompt
from stillpath.models.identification.sets import parametric_members
from stillpath.models.identification.types import (
    AxisIdentification,
    Excitation,
    Fit,
    ModeEstimate,
    Spectrum,
)
from stillpath.models.plants import ParametricMembers, PlantSetSpec
from stillpath.models.provenance import Kind
from stillpath.models.schedule import (
    AxisSchedule,
    GridNode,
    GridSchedule,
    MassSchedule,
    moving_mass_from_two_runs,
)

__all__ = [
    "SpectrumRun",
    "check_labels",
    "of_one_test",
    "schedulable",
    "scheduled",
    "special",
    "usual",
]

_REPEATABLE = 0.0035
"""Relative standard deviation of a frequency from run to run: +-0.7 % within a session."""


class SpectrumRun(NamedTuple):
    """A spectrum, the test that made it, under what condition, and notes on what was assumed."""

    spectrum: Spectrum
    test: Excitation
    condition: Condition
    notes: tuple[str, ...] = ()


def usual(conditions: Sequence[Condition], axis: str) -> list[Condition]:
    """Return the conditions of the nominal plant: an empty bed, wherever that was measured.

    If all were measured at known places, the one in the middle.

    Raises
    ------
    ModelError
        If every run has a weight on the bed.
    """
    empty = [c for c in dict.fromkeys(conditions) if not c.added_kg]
    plain = [c for c in empty if not c.position_mm]
    if plain:
        return plain
    if not empty:
        raise ModelError(
            f"axis {axis}: every run has a weight on the bed: measure the empty bed too, it is "
            "what the machine starts a print with"
        )
    return [sorted(empty, key=lambda c: c.position_mm)[len(empty) // 2]]


def check_labels(common: Sequence[Condition], axis: str) -> None:
    """Refuse spectra with several labels: only of one label they have a mean.

    Raises
    ------
    ModelError
    """
    if len(common) > 1:
        labels = ", ".join(c.label or "none" for c in common)
        raise ModelError(
            f"axis {axis}: the spectra have different labels ({labels}), so they have no mean; "
            "identify from those of one label, or leave the labels out if they are repeats (labels "
            "keep raw logs apart)"
        )


def of_one_test(spectra: Sequence[SpectrumRun], axis: str) -> tuple[list[SpectrumRun], list[str]]:
    """Leave out usual spectra except those of the most frequent test and label; say which.

    As responses, logs of several tests or labels are members of one set; spectra have no mean.
    """
    common = usual([run.condition for run in spectra], axis)
    tests = [(run.test, run.condition) for run in spectra if run.condition in common]
    most = max(tests, key=tests.count)
    kept, notes = [], []
    for run in spectra:
        if run.condition not in common or (run.test, run.condition) == most:
            kept.append(run)
        else:
            notes.append(
                f"{run.spectrum.source}: not used, because spectra of different tests or labels "
                "have no mean"
            )
    return kept, notes


def special(conditions: Sequence[Condition]) -> list[Condition]:
    """Return the conditions that each get a plant of their own."""
    return [c for c in dict.fromkeys(conditions) if c.added_kg or c.position_mm]


def scheduled(
    found: AxisIdentification, nominal: Fit, fits: Mapping[Condition, Fit], kind: Kind
) -> AxisIdentification:
    """Return the axis with the schedule that its runs under special conditions make.

    Parameters
    ----------
    nominal : Fit
        Of the usual condition.
    fits : mapping of Condition to Fit
        With the structure of `nominal`.
    kind : Kind
        Of the measurements.

    Raises
    ------
    ModelError
        If a weight did not lower a resonance, or the places make no grid.
    """
    loaded = {c: f for c, f in fits.items() if c.added_kg}
    placed = {c: f for c, f in fits.items() if c.position_mm}
    if not loaded and not placed:
        return found
    try:
        mass, notes = _mass(nominal, loaded) if loaded else (None, ())
        grid = _grid(placed) if placed else None
    except ModelError as error:
        raise ModelError(f"axis {found.axis}: {error}") from None
    plants, varied = schedulable(found.plants, kind)
    if grid is not None:
        notes = (*notes, _grid_note(placed))
    notes = (*notes, *varied)
    schedule = AxisSchedule(mass=mass, grid=grid)
    schedule.check(plants)
    return replace(found, plants=plants, schedule=schedule, notes=(*found.notes, *notes))


def _mass(nominal: Fit, loaded: Mapping[Condition, Fit]) -> tuple[MassSchedule, tuple[str, ...]]:
    """Return the schedule of the mode that the heaviest weight lowers, and its predictions."""
    condition, fit = max(loaded.items(), key=lambda item: item[0].added_kg)
    before, after = _moved(nominal.modes, fit.modes)
    empty, heavy = nominal.modes[before], fit.modes[after]
    found = moving_mass_from_two_runs(
        empty.f_hz,
        heavy.f_hz,
        condition.added_kg,
        f0_sd_hz=_deviation_hz(empty),
        f1_sd_hz=_deviation_hz(heavy),
    )
    mass = MassSchedule(moving_mass_kg=round(found.mass_kg, 4), modes=(before,))
    note = (
        f"{condition.added_kg:g} kg on the bed lowered {empty.f_hz:.2f} Hz to {heavy.f_hz:.2f} Hz: "
        f"the axis moves {found.mass_kg:.3f} ± {1.96 * found.sd_kg:.3f} kg"
    )
    notes = [note]
    for lighter, other in loaded.items():
        if lighter != condition:
            seen = other.modes[_moved(nominal.modes, other.modes)[1]].f_hz
            expected = empty.f_hz * mass.factor(lighter.added_kg)
            notes.append(
                f"{lighter.added_kg:g} kg on the bed: {seen:.2f} Hz, by that mass {expected:.2f} Hz"
            )
    return mass, tuple(notes)


def _moved(before: Sequence[ModeEstimate], after: Sequence[ModeEstimate]) -> tuple[int, int]:
    """Return the index, in both lists, of the mode that moved: the others then agree best.

    Both rise in frequency, so a mode that falls below its neighbour changes its place.
    """

    def apart(pair: tuple[int, int]) -> float:
        i, j = pair
        rest = zip((*before[:i], *before[i + 1 :]), (*after[:j], *after[j + 1 :]), strict=True)
        return sum(a.peak * abs(math.log(b.f_hz / a.f_hz)) for a, b in rest)

    return min(itertools.product(range(len(before)), range(len(after))), key=apart)


def _deviation_hz(mode: ModeEstimate) -> float:
    """Return the uncertainty of the frequency between runs: a fit covers only its own run."""
    repeatable = _REPEATABLE * mode.f_hz
    return math.hypot(repeatable, mode.f_sd_hz) if math.isfinite(mode.f_sd_hz) else repeatable


def _grid(placed: Mapping[Condition, Fit]) -> GridSchedule:
    if len(placed) < 2:
        (only,) = placed
        raise ModelError(
            f"measured at one place only ({only.label}): measure at another one too, or leave the "
            "place out"
        )
    rising = sorted(placed.items(), key=lambda item: item[0].position_mm)
    try:
        return GridSchedule(nodes=tuple(_node(c, f) for c, f in rising))
    except ValidationError as error:
        raise ModelError(f"the places: {explain(error).partition(': ')[2]}") from None


def _grid_note(placed: Mapping[Condition, Fit]) -> str:
    rising = sorted(placed.items(), key=lambda item: item[0].position_mm)
    seen = "; ".join(f"{condition.label} {fit.modes[0].f_hz:.2f} Hz" for condition, fit in rising)
    return f"the plant follows the place; lowest resonance at {seen}"


def _node(condition: Condition, fit: Fit) -> GridNode:
    where = {f"{axis}_mm": value for axis, value in condition.position_mm}
    return GridNode.model_validate({**where, "plant": prompt(fit).model_dump()})


def schedulable(plants: PlantSetSpec, kind: Kind) -> tuple[PlantSetSpec, tuple[str, ...]]:
    """Return members that can follow a schedule: those that scale, not those that are listed."""
    if not plants.members or isinstance(plants.members, ParametricMembers):
        return plants, ()
    note = (
        "members are spread about the plant of each place and mass: it is unknown which resonance "
        "of each listed one the schedule moves"
    )
    return plants.model_copy(update={"members": parametric_members(kind)}), (note,)
