"""Base class of the planners: a queue in which moves wait until their speeds are final."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from stillpath.gcode.errors import GcodeError
from stillpath.gcode.firmware.planning import between_stops, empty_phases, join_phases
from stillpath.gcode.types import Limits, Moves, Phases, ProgramBlock

__all__ = ["QueuePlanner", "with_motion"]

_ROWS = 1024
_LARGE_TABLE = 64
"""Size of a table of limits above which only the rows in use are read."""


class QueuePlanner(ABC):
    """Base of the planners; see `gcode.firmware.base.Planner`.

    Parameters
    ----------
    columns : int
        Numbers per waiting move in the firmware's kernels.
    """

    def __init__(self, columns: int) -> None:
        self._queue = np.empty((_ROWS, columns))
        self._count = 0
        """Rows of the queue in use."""
        self._next_move = 0
        """Index of the next move in the whole file."""
        self._begun = False
        self._time_s = 0.0
        self._limits = np.empty((0, 0))
        self._table: Sequence[Limits] = ()
        """What `_limits` holds as an array."""

    @property
    def time_s(self) -> float:
        """When the last planned move or dwell ends."""
        return self._time_s

    def push(self, block: ProgramBlock) -> Phases:
        """Plan the moves of a block, with the stops that its events cause.

        Raises
        ------
        GcodeError
            For a move that the firmware refuses.
        """
        self._next_move = block.first_move
        parts = []
        for begun, end, dwell_s in between_stops(block):
            parts.append(self._plan(block.moves, begun, end, block.limits))
            if dwell_s is not None:
                parts.append(self.stop(dwell_s))
        return join_phases(parts)

    def push_moves(self, moves: Moves, limits: Sequence[Limits]) -> Phases:
        """Plan moves that follow the last ones without a stop; return those that are final.

        Parameters
        ----------
        limits : sequence of Limits
            The table of `Moves.limits_id`: the one of the last moves, which may have grown, or
            another.
        """
        return self._plan(moves, 0, len(moves), limits)

    def plan_whole(self, moves: Moves, limits: Sequence[Limits]) -> Phases:
        """Plan moves that follow the last ones, all at once, and come to rest."""
        self._enter(moves, 0, len(moves), limits)
        return self.stop()

    def stop(self, dwell_s: float = 0.0) -> Phases:
        """Come to rest after the last move and stand for `dwell_s`."""
        phases = self._take(final=True)
        if self._begun:
            self._time_s += dwell_s
        return phases

    def flush(self) -> Phases:
        """Come to rest; return all that is left."""
        return self.stop()

    def _plan(self, moves: Moves, begun: int, end: int, limits: Sequence[Limits]) -> Phases:
        self._enter(moves, begun, end, limits)
        return self._take(final=False) if end > begun and self._due() else empty_phases()

    def _enter(self, moves: Moves, begun: int, end: int, limits: Sequence[Limits]) -> None:
        n = end - begun
        if n == 0:
            return
        if limits is not self._table or len(limits) != len(self._limits):
            self._table = limits if len(limits) <= _LARGE_TABLE else ()
            self._limits = _rows_of(limits, moves.limits_id[begun:end])
        if self._count + n > len(self._queue):
            larger = np.empty((2 * (self._count + n), self._queue.shape[1]))
            larger[: self._count] = self._queue[: self._count]
            self._queue = larger
        problem, bad = self._append(moves, slice(begun, end))
        if problem >= 0:
            raise self._error(problem, moves, begun + bad)
        self._next_move += n
        self._begun = self._begun or self._count > 0

    def _due(self) -> bool:
        """Return whether it is worthwhile to look for settled moves."""
        return True

    def _drop(self, settled: int) -> None:
        """Move the unsettled rows to the front."""
        self._queue[: self._count - settled] = self._queue[settled : self._count]
        self._count -= settled

    @abstractmethod
    def _append(self, moves: Moves, rows: slice) -> tuple[int, int]:
        """Enter moves after the rows in use; return a problem (or -1) and its row of `rows`."""

    @abstractmethod
    def _take(self, *, final: bool) -> Phases:
        """Remove final moves from the queue; with `final` all moves."""

    @abstractmethod
    def _error(self, problem: int, moves: Moves, row: int) -> GcodeError:
        """Return the error that describes an invalid move."""


def with_motion(
    phases: Phases, times_s: NDArray[np.float64], speeds: NDArray[np.float64]
) -> Phases:
    """Return phases with times and speeds as kernels write them, (4, n) each, in their order."""
    columns = (
        *times_s,
        phases.start_mm,
        phases.direction,
        *speeds,
        phases.move_index,
        phases.s_curve,
    )
    return Phases(*columns)


def _rows_of(limits: Sequence[Limits], used: NDArray[np.int32]) -> NDArray[np.float64]:
    """Return a table as an array; of a large one only the rows in use, all others are nan."""
    if len(limits) <= _LARGE_TABLE:
        return np.array([limit.as_row() for limit in limits])
    rows = np.full((len(limits), len(limits[0].as_row())), np.nan)
    for k in np.unique(used).tolist():
        rows[k] = limits[k].as_row()
    return rows
