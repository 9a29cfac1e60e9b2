"""Functions shared by all planners: stops, limits on durations, intended motion."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillpath.gcode.errors import GcodeError
from stillpath.gcode.types import EventKind, Events, Phases, ProgramBlock, joined

__all__ = [
    "STOPPING",
    "between_stops",
    "check_moves_end",
    "check_print_ends",
    "empty_phases",
    "intended",
    "join_phases",
    "stops",
]

STOPPING = frozenset({EventKind.STOP, EventKind.UNKNOWN, EventKind.SHAPER})
"""Events at which the motion comes to rest."""

LONGEST_MOVE_S = 1200.0
"""Longer single moves are considered a mistake; lowering a bed takes minutes."""
LONGEST_PRINT_S = 3.6e6
"""Longer prints are refused: a small file must not keep a computer busy for days."""

_HALF = 0.501
"""Half a step, the largest rounding error, plus a tolerance."""

_STOPS = np.array([kind in STOPPING for kind in EventKind])
"""Whether the motion rests, indexed by the number of an event's kind."""


def stops(events: Events) -> NDArray[np.bool_]:
    """Mark events at which the motion comes to rest, shape (len(events),)."""
    return np.asarray(_STOPS[events.kind])


def intended(
    phases: Phases,
    start_mm: NDArray[np.float64],
    end_mm: NDArray[np.float64],
    step_mm: Sequence[float],
) -> Phases:
    """Return a plan whose moves end in X and Y at the file's positions instead of on motor steps.

    It is the firmware's plan with its timing, but without rounding to whole steps, which counts as
    an error like any other.

    Parameters
    ----------
    phases : Phases
        `move_index` counts the rows of the tables.
    start_mm, end_mm : ndarray, shape (moves, 4)
        Where the file says that moves begin and end.
    step_mm : sequence of float
        One step of X's and of Y's motor; 0 for firmware that keeps all digits.
    """
    if len(phases) == 0 or max(step_mm[:2]) == 0.0:
        return phases
    half_step_mm = _HALF * np.asarray(step_mm[:2])

    def rounded_by(told_mm: NDArray[np.float64], there_mm: NDArray[np.float64]) -> Any:
        # Larger differences are not rounding (a swallowed move, for example).
        by_mm = told_mm[..., :2] - there_mm[..., :2]
        return np.where(np.all(np.abs(by_mm) <= half_step_mm, axis=-1, keepdims=True), by_mm, 0.0)

    length_mm = phases.length_mm
    moves_xy = np.any(phases.direction[:, :2] != 0.0, axis=1) & (length_mm > 0.0)
    first = rounded_by(start_mm[phases.move_index[0]], phases.start_mm[0])
    by_mm = np.vstack([first, rounded_by(end_mm[phases.move_index], phases.end_mm)])
    # The others leave X and Y where they are.
    kept = np.maximum.accumulate(np.where(moves_xy, np.arange(1, len(phases) + 1), 0))
    begins, ends = by_mm[np.append(0, kept[:-1])], by_mm[kept]
    starts_mm, direction = phases.start_mm.copy(), phases.direction.copy()
    starts_mm[:, :2] += begins
    direction[moves_xy, :2] += ((ends - begins)[moves_xy].T / length_mm[moves_xy]).T
    return replace(phases, start_mm=starts_mm, direction=direction)


def check_moves_end(phases: Phases, line: Callable[[int], int]) -> None:
    """Refuse moves that take long under the limits in force, whatever their F says.

    Parameters
    ----------
    line : callable
        Gives the source line of a `Phases.move_index`.

    Raises
    ------
    GcodeError
        For the slowest of them.
    """
    lasts_s = phases.lasts_s
    if np.all(lasts_s <= LONGEST_MOVE_S):
        return
    row = int(np.argmax(lasts_s))
    raise GcodeError(
        f"the move takes {_in_words(float(lasts_s[row]))} at {phases.cruise_mm_s[row]:.3g} mm/s, "
        f"more than {_in_words(LONGEST_MOVE_S)}; correct its F, M220 or the limits in force",
        line=line(int(phases.move_index[row])),
    )


def check_print_ends(time_s: float, line: int) -> None:
    """Refuse a print that by the end of this line has taken more than 1000 hours.

    Raises
    ------
    GcodeError
    """
    if not time_s <= LONGEST_PRINT_S:
        raise GcodeError(
            f"up to here the print takes {_in_words(time_s)}, more than "
            f"{_in_words(LONGEST_PRINT_S)}; correct F, M220, dwells or the limits in force, or "
            "print it in parts",
            line=line,
        )


def between_stops(block: ProgramBlock) -> Iterator[tuple[int, int, float | None]]:
    """Yield the rows [first, end) of moves between stops, and the dwell after them.

    None: the block ends there without a stop.
    """
    events = block.events
    begun = 0
    for row in np.flatnonzero(stops(events)).tolist():
        end = int(events.move_index[row]) - block.first_move
        yield begun, end, float(events.dwell_s[row])
        begun = end
    yield begun, len(block.moves), None


def join_phases(parts: Sequence[Phases]) -> Phases:
    """Put phases one after the other."""
    parts = [part for part in parts if len(part)]
    return joined(parts) if parts else empty_phases()


def empty_phases(n: int = 0) -> Phases:
    """Return `n` rows to be filled."""
    return Phases(
        t_s=np.empty(n),
        accel_s=np.empty(n),
        cruise_s=np.empty(n),
        decel_s=np.empty(n),
        start_mm=np.empty((n, 4)),
        direction=np.empty((n, 4)),
        start_mm_s=np.empty(n),
        cruise_mm_s=np.empty(n),
        end_mm_s=np.empty(n),
        accel_mm_s2=np.empty(n),
        move_index=np.empty(n, np.int64),
        s_curve=np.zeros(n, np.bool_),
    )


def _in_words(time_s: float) -> str:
    minutes = time_s / 60.0
    return f"{minutes:.3g} min" if minutes < 120.0 else f"{minutes / 60.0:.6g} h"
