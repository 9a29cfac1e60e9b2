"""The sampled path of a piece from its planned moves, with its rests on the sampling grid.

A *piece* is a row of planned moves that starts and ends at rest. Inside it, moves of X and Y form
*stretches*; between them lie *rests*, moves of the extruder or of Z alone, which are written
unchanged while X and Y stand still. The duration of a rest depends on the limits of the written
file, not on the original ones, so the rests' durations are an input here and stretches are shifted
in time. A rest starts on the sampling grid; a stretch starts where its rest ends.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from stillpath.gcode.sampler import sample_until
from stillpath.gcode.types import Phases

__all__ = ["Group", "Timeline", "build_timeline", "group_rows"]

_GRID_EPS = 1e-6
"""Tolerance, in samples, when comparing samples with times."""


@dataclass(frozen=True, slots=True)
class Group:
    """Consecutive rows of a piece, all moving X or Y (a stretch) or none of them (a rest)."""

    first: int
    last: int
    """One past the last row."""
    rest: bool
    before_z: bool = False
    """A stretch that is followed by a move of Z."""


@dataclass(frozen=True, slots=True)
class Timeline:
    """The sampled path of a piece.

    Attributes
    ----------
    position_mm : ndarray, shape (4, n)
        x y z e at the times ``k * dt_s``.
    row : ndarray of int64, shape (n,)
        Row of the piece's phases that each sample belongs to.
    moving : ndarray of bool, shape (n,)
        X or Y moves at the sample.
    rests : ndarray of int64, shape (k, 2)
        Ranges [a, b) of samples in which u(i) = u(i - 1) must hold; the path stands at a - 1.
    start_s, end_s : ndarray, shape (len(groups),)
        Start and end of each group [s]. A stretch includes the standing time lead_s and tail_s, in
        which the command may already move; its end is rounded up to the grid.
    group_start_mm : ndarray, shape (len(groups), 4)
        x y z e where each group starts.
    row_start_s : ndarray, shape (rows,)
        Start of each row on this timeline.
    """

    dt_s: float
    position_mm: NDArray[np.float64]
    row: NDArray[np.int64]
    moving: NDArray[np.bool_]
    rests: NDArray[np.int64]
    groups: list[Group]
    start_s: NDArray[np.float64]
    end_s: NDArray[np.float64]
    group_start_mm: NDArray[np.float64]
    row_start_s: NDArray[np.float64]

    def starts(self, rows: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Mark the samples at which rows begin, shape (n,)."""
        marks = np.zeros(len(self.row), np.bool_)
        at = np.rint(self.row_start_s[rows] / self.dt_s).astype(np.int64)
        marks[np.minimum(at, len(marks) - 1)] = True
        return marks


def group_rows(phases: Phases) -> list[Group]:
    """Split the rows of a piece into stretches and rests, in order."""
    moves_xy = phases.moves_xy
    edges = np.flatnonzero(np.diff(moves_xy)) + 1
    bounds = [0, *edges.tolist(), len(moves_xy)]
    return [
        Group(
            first,
            last,
            rest=not bool(moves_xy[first]),
            before_z=last < len(moves_xy)
            and bool(moves_xy[first])
            and phases.direction[last, 2] != 0.0,
        )
        for first, last in pairwise(bounds)
        if last > first
    ]


def build_timeline(
    phases: Phases,
    groups: list[Group],
    rest_s: NDArray[np.float64],
    dt_s: float,
    *,
    lead_s: NDArray[np.float64] | float = 0.0,
    tail_s: NDArray[np.float64] | float = 0.0,
) -> Timeline:
    """Lay a piece on the sampling grid.

    Parameters
    ----------
    phases : Phases
        The original plan of the piece.
    groups : list of Group
        As `group_rows` gives them.
    rest_s : ndarray, shape (len(groups),)
        Duration of each rest under the limits of the written file (ignored for stretches).
    lead_s, tail_s : float, or ndarray, shape (len(groups),)
        Standing time before and after every stretch, or each of them (ignored for rests).
    """
    duration = phases.lasts_s
    lead_s, tail_s = (np.broadcast_to(one, len(groups)) for one in (lead_s, tail_s))
    start, end, row_start, rests = _laid(groups, duration, rest_s, dt_s, lead_s, tail_s)
    samples = int(np.ceil(end[-1] / dt_s - _GRID_EPS)) + 1
    moved = replace(phases, t_s=row_start)
    until = np.where(phases.moves_xy, row_start + duration + _GRID_EPS * dt_s, -np.inf)
    position, row, moving = sample_until(moved, (0.0, dt_s, samples), until)
    return Timeline(
        dt_s=dt_s,
        position_mm=position,
        row=row,
        moving=moving,
        rests=np.array(rests, dtype=np.int64).reshape(-1, 2),
        groups=groups,
        start_s=start,
        end_s=end,
        group_start_mm=phases.start_mm[[group.first for group in groups]],
        row_start_s=row_start,
    )


def _laid(
    groups: list[Group],
    duration: NDArray[np.float64],
    rest_s: NDArray[np.float64],
    dt_s: float,
    lead_s: NDArray[np.float64],
    tail_s: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], list[tuple[int, int]]]:
    """Return start and end of the groups, the start of the rows, and the samples of the rests."""
    row_start = np.empty(len(duration))
    start, end = np.empty(len(groups)), np.empty(len(groups))
    rests: list[tuple[int, int]] = []
    now = 0.0
    for i, group in enumerate(groups):
        rows = slice(group.first, group.last)
        offset = np.concatenate([[0.0], np.cumsum(duration[rows])])
        if group.rest:
            scale = rest_s[i] / offset[-1] if offset[-1] > 0 else 1.0
            start[i], end[i] = now, now + rest_s[i]
            row_start[rows] = now + scale * offset[:-1]
            first = int(np.ceil(now / dt_s - _GRID_EPS)) + 1
            # The first move after the rest gets at least a whole sample, to avoid a jerk.
            last = int(np.ceil(end[i] / dt_s - _GRID_EPS)) + 1
            # At least one sample: the command must be on the path when the rest's own line comes.
            rests.append((first, max(last, first + 1)))
            now = end[i]
        else:
            start[i] = now
            row_start[rows] = now + lead_s[i] + offset[:-1]
            now = dt_s * np.ceil((now + lead_s[i] + offset[-1] + tail_s[i]) / dt_s - _GRID_EPS)
            # A stretch has at least one sample of its own after the rest.
            now = max(now, dt_s * (rests[-1][1] if rests else 1))
            end[i] = now
    return start, end, row_start, rests
