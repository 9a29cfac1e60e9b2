"""Changes of a machine since it was first measured."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import date
from itertools import pairwise

from pydantic import BaseModel, ConfigDict, Field

from stillpath.applications.machines.resonances import Resonance, leading, matched, resonances
from stillpath.applications.machines.revision import Revision
from stillpath.models.machine import Machine

__all__ = ["SAME_DAY", "WEEKS", "Drift", "drift"]

SAME_DAY = 0.007
WEEKS = 0.02
"""Scatter of the leading mode's frequency when nothing was done to a machine, as a fraction: within
a session, and over weeks (35 measurements each of X and Y of one Voron 2.4 in a year)."""


class Drift(BaseModel):
    """The leading mode of an axis moved further than measurements scatter."""

    model_config = ConfigDict(frozen=True)

    axis: str
    since: date
    until: date
    f_before_hz: float
    f_after_hz: float
    percent: float = Field(description="Change of the frequency.")
    text: str


def drift(history: Sequence[Revision], *, since: date | None = None) -> tuple[Drift, ...]:
    """Compare the newest measurement of each axis with the first one.

    Parameters
    ----------
    history : sequence of Revision
        Oldest first. A measurement is dated by `measured_on` of its provenance, otherwise by its
        revision; plants that were typed in are none.
    since : date, optional
        Ignore earlier measurements, for instance from before a rebuild.
    """
    found = (_of_axis(axis, history, since) for axis in ("x", "y"))
    return tuple(entry for entry in found if entry is not None)


def _of_axis(axis: str, history: Sequence[Revision], since: date | None) -> Drift | None:
    measured = [
        (day, revision.machine)
        for revision, day in _measurements(axis, history)
        if since is None or day >= since
    ]
    if len(measured) < 2:
        return None
    measured.sort(key=lambda entry: entry[0])
    (first_day, first), (last_day, last) = measured[0], measured[-1]
    before = leading(first.axes[axis].nominal)  # type: ignore[index]
    after = None if before is None else _counterpart(before, last, axis)
    if before is None or after is None:
        return None
    change = after[0] / before[0] - 1.0
    if abs(change) <= (SAME_DAY if first_day == last_day else WEEKS):
        return None
    moved = "fell" if change < 0 else "rose"
    text = (
        f"{axis.upper()} {moved} from {before[0]:.1f} to {after[0]:.1f} Hz ({100 * change:+.1f} %) "
        f"since {first_day}: {_causes(axis, change < 0, last)}"
    )
    return Drift(
        axis=axis,
        since=first_day,
        until=last_day,
        f_before_hz=before[0],
        f_after_hz=after[0],
        percent=100 * change,
        text=text,
    )


def _measurements(axis: str, history: Sequence[Revision]) -> list[tuple[Revision, date]]:
    """Return the revisions that brought a new measurement of the axis, with its day.

    Machines whose plant depends on position are skipped: their nominal plants are of some position
    in the middle.
    """
    found = []
    for earlier, revision in pairwise([None, *history]):
        assert revision is not None
        plants = revision.machine.axes[axis]  # type: ignore[index]
        known = plants.provenance
        same = earlier is not None and earlier.machine.axes[axis] == plants  # type: ignore[index]
        schedule = revision.machine.schedules.get(axis)  # type: ignore[call-overload]
        placed = schedule is not None and schedule.grid is not None
        if known is None or known.kind == "typed in" or same or placed or revision.restored:
            continue
        found.append((revision, known.measured_on or revision.when.date()))
    return found


def _counterpart(mode: Resonance, machine: Machine, axis: str) -> Resonance | None:
    """Return the mode that `mode` has become."""
    ((_, found), *_) = [
        pair
        for pair in matched([mode], resonances(machine.axes[axis].nominal))  # type: ignore[index]
        if pair[0] is not None
    ]
    return found


def _causes(axis: str, fell: bool, machine: Machine) -> str:
    part = "head or bed" if (axis, machine.kinematics) == ("y", "cartesian") else "head"
    return f"belts looser? heavier {part}?" if fell else f"belts tighter? lighter {part}?"
