"""Plan the moves of verbatim parts, whose lines are not changed."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from stillpath.gcode.firmware.planning import stops
from stillpath.gcode.pieces import Piece, VerbatimPart
from stillpath.gcode.plan import plan_moves
from stillpath.gcode.types import EventKind, Moves, Phases, ProgramBlock, joined, rows_of
from stillpath.models.machine import Machine

__all__ = ["Restarts", "flowing_s", "plan_verbatim", "stops_in", "switching_s", "takes_s"]

_LAST_S = 2.0
"""What a piece does earlier has no effect on how it ends."""


def plan_verbatim(verbatim: VerbatimPart, machine: Machine) -> Iterator[Phases | float | None]:
    """Plan the moves of a verbatim part between its stops.

    Yields
    ------
    Phases
        Motion from rest to rest, starting at time 0; `move_index` counts within the part.
    float
        A standstill [s].
    None
        The position becomes unknown here.
    """
    if isinstance(verbatim, Piece):
        yield verbatim.phases
        return
    events = verbatim.events
    done = 0
    for k in [*np.flatnonzero(stops(events)).tolist(), None]:
        end = len(verbatim.moves) if k is None else int(events.move_index[k])
        if end > done:
            rows = rows_of(verbatim.moves, slice(done, end))
            phases = plan_moves(rows, verbatim.limits, machine)
            if len(phases):
                numbers = phases.move_index - phases.move_index[0] + done
                yield replace(phases, move_index=numbers)
            done = end
        if k is not None and events.dwell_s[k] > 0.0:
            yield float(events.dwell_s[k])
        if k is not None and events.kind[k] == EventKind.UNKNOWN:
            yield None


def takes_s(part: Phases | float | None) -> float:
    """Return the duration of a part of a verbatim part."""
    return part.duration_s if isinstance(part, Phases) else part or 0.0


def flowing_s(
    before: VerbatimPart | None, after: VerbatimPart | ProgramBlock, machine: Machine
) -> float:
    """Return how much later moves end than those before them, if nothing stops in between.

    Parameters
    ----------
    before : VerbatimPart, optional
        Its last moves count: those behind its last stop, of a piece the last seconds.
    after : VerbatimPart or ProgramBlock
        Its moves up to its first stop, of a piece up to the first that does not move X or Y.
    """
    moves = _first_moves(after)
    tail = None if before is None else _last_moves(before)
    if before is None or tail is None or len(tail) == 0 or len(moves) == 0:
        return plan_moves(moves, after.limits, machine).duration_s
    moves = replace(moves, limits_id=moves.limits_id + len(before.limits))
    whole = plan_moves(joined([tail, moves]), [*before.limits, *after.limits], machine)
    return whole.duration_s - plan_moves(tail, before.limits, machine).duration_s


def _last_moves(before: VerbatimPart) -> Moves:
    if isinstance(before, Piece):
        late = before.phases.end_s > before.phases.end_s[-1] - _LAST_S
        return rows_of(before.moves, slice(int(np.argmax(late)), None))
    stop = np.append(0, before.events.move_index[stops(before.events)]).max()
    return rows_of(before.moves, slice(int(stop), None))


def _first_moves(after: VerbatimPart | ProgramBlock) -> Moves:
    if isinstance(after, Piece | ProgramBlock):
        ends = np.flatnonzero(~after.moves.moves_xy)
    else:
        ends = after.events.move_index[stops(after.events)]
    return rows_of(after.moves, slice(0, int(ends[0]) if len(ends) else None))


class Restarts:
    """Count how long a firmware waits after stops before it moves again."""

    def __init__(self, restart_s: float) -> None:
        self._restart_s = restart_s
        self._moved = self._stands = False

    def after(
        self, parts: Iterable[VerbatimPart | ProgramBlock], *, from_rest: bool = False
    ) -> float:
        """Return how long it waits in the lines that follow [s], which may begin `from_rest`."""
        count, self._stands = 0, self._stands or from_rest
        for part in parts:
            first = part.first_move if isinstance(part, ProgramBlock) else 0
            rests = set((part.events.move_index[stops(part.events)] - first).tolist())
            if self._stands:
                rests.add(0)
            end = len(part.moves)
            self._stands = end in rests
            count += len(rests) - (end in rests) - (0 in rests and end > 0 and not self._moved)
            self._moved = self._moved or end > 0
        return self._restart_s * count


def stops_in(parts: Iterable[VerbatimPart | ProgramBlock]) -> int:
    """Return at how many lines the machine comes to rest."""
    return sum(int(np.count_nonzero(stops(part.events))) for part in parts)


def switching_s(parts: Iterable[VerbatimPart | ProgramBlock]) -> float:
    """Return how long the machine stands still for switching its shaper."""
    return sum(float(np.sum(p.events.dwell_s[p.events.kind == EventKind.SHAPER])) for p in parts)
