"""What all planners share, and the plan of moves from rest to rest for any firmware."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from gcode.errors import GcodeError
from gcode.firmware.registry import kit
from gcode.types import EventKind, Events, Limits, Moves, Phases, ProgramBlock
from models.machine import Machine

__all__ = [
    "STOPPING",
    "between_stops",
    "check_moves_end",
    "check_print_ends",
    "empty_phases",
    "join_phases",
    "plan_moves",
    "stops",
]

STOPPING = frozenset({EventKind.STOP, EventKind.UNKNOWN, EventKind.SHAPER})
"""Events at which the motion comes to rest."""

LONGEST_MOVE_S = 1200.0
"""A single move that takes longer is taken for a mistake; a bed that is lowered takes minutes."""
LONGEST_PRINT_S = 3.6e6
"""So is a print that takes longer: a small file must not keep a computer busy for days."""

_STOPS = np.array([kind in STOPPING for kind in EventKind])
"""By the number of an event's kind."""


def stops(events: Events) -> NDArray[np.bool_]:
    """Mark events at which the motion comes to rest."""
    return np.asarray(_STOPS[events.kind])


def plan_moves(
    moves: Moves, limits: Sequence[Limits], machine: Machine, *, rests_apart: bool = False
) -> Phases:
    """Plan moves from rest to rest.

    Parameters
    ----------
    moves : Moves
    limits : sequence of Limits
        The table of `Moves.limits_id`.
    machine : Machine
    rests_apart : bool
        See `FirmwareKit.planner`.

    Raises
    ------
    GcodeError
        For a move that the firmware refuses, or that takes more than 20 minutes.
    """
    planner = kit(machine).planner(rests_apart=rests_apart)
    planner.queue_moves(moves, limits)
    phases = planner.flush()
    check_moves_end(phases, lambda index: int(moves.line[index]))
    return phases


def check_moves_end(phases: Phases, line: Callable[[int], int]) -> None:
    """Refuse moves that take long under the limits in force, whatever their F says.

    Parameters
    ----------
    phases : Phases
    line : callable
        Gives the source line of a `Phases.move_index`.

    Raises
    ------
    GcodeError
        For the slowest of them.
    """
    lasts_s = phases.accel_s + phases.cruise_s + phases.decel_s
    if np.all(lasts_s <= LONGEST_MOVE_S):
        return
    row = int(np.argmax(lasts_s))
    raise GcodeError(
        f"the move takes {_told(float(lasts_s[row]))} at {phases.cruise_mm_s[row]:.3g} mm/s, more "
        f"than {_told(LONGEST_MOVE_S)}; correct its F, M220 or the limits in force",
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
            f"up to here the print takes {_told(time_s)}, more than {_told(LONGEST_PRINT_S)}; "
            "correct F, M220, dwells or the limits in force, or print it in parts",
            line=line,
        )


def between_stops(block: ProgramBlock) -> Iterator[tuple[int, int, float | None]]:
    """Yield the rows [first, end) of moves between stops, and for how long it then stands.

    None: the block ends there and the motion goes on.
    """
    events = block.events
    begun = 0
    for row in np.flatnonzero(stops(events)).tolist():
        end = int(events.move_index[row]) - block.first_move
        yield begun, end, float(events.dwell_s[row])
        begun = end
    yield begun, len(block.moves), None


def join_phases(parts: Sequence[Phases]) -> Phases:
    """Put phases one behind the other."""
    parts = [part for part in parts if len(part)]
    if len(parts) == 1:
        return parts[0]
    if not parts:
        return empty_phases()
    return Phases(
        *(
            np.concatenate([getattr(part, name) for part in parts])
            for name in Phases.__dataclass_fields__
        )
    )


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


def _told(time_s: float) -> str:
    minutes = time_s / 60.0
    return f"{minutes:.3g} min" if minutes < 120.0 else f"{minutes / 60.0:.6g} h"
