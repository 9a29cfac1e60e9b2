"""Plan the moves of verbatim parts, whose lines are not changed."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from stillpath.gcode.firmware.planning import stops
from stillpath.gcode.pieces import Piece, VerbatimPart
from stillpath.gcode.plan import plan_moves
from stillpath.gcode.types import EventKind, Phases, ProgramBlock, joined, rows_of
from stillpath.models.machine import Machine

__all__ = ["plan_verbatim", "stop_between_s", "switching_s", "takes_s"]


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


def stop_between_s(verbatim: VerbatimPart, piece: Piece, machine: Machine) -> float:
    """Return by how much sooner the sliced file would be there without a stop before a piece.

    Parameters
    ----------
    verbatim : VerbatimPart
        What stands in front of it.
    """
    if isinstance(verbatim, Piece) or len(verbatim.moves) == 0:
        return 0.0
    stop = np.append(0, verbatim.events.move_index[stops(verbatim.events)]).max()
    before = rows_of(verbatim.moves, slice(int(stop), None))
    if len(before) == 0:
        return 0.0
    rests = np.flatnonzero(~piece.phases.moves_xy)
    after = rows_of(piece.moves, slice(0, int(rests[0]) if len(rests) else None))
    shifted = replace(after, limits_id=after.limits_id + len(verbatim.limits))
    alone = [
        plan_moves(before, verbatim.limits, machine).duration_s,
        plan_moves(after, piece.limits, machine).duration_s,
    ]
    tables = [*verbatim.limits, *piece.limits]
    return sum(alone) - plan_moves(joined([before, shifted]), tables, machine).duration_s


def switching_s(parts: Iterable[VerbatimPart | ProgramBlock]) -> float:
    """Return how long the machine stands still for switching its shaper."""
    return sum(float(np.sum(p.events.dwell_s[p.events.kind == EventKind.SHAPER])) for p in parts)
