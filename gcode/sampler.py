"""Positions along planned moves, at given times or on a uniform grid.

`sample_phases` samples a complete set of phases; `Sampler` takes them as they come and returns one
continuous uniform grid, standing still during dwells and stops.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillpath.gcode import _sample_kernels as kernels
from stillpath.gcode.types import Phases, joined, rows_of

__all__ = ["Sampler", "Samples", "distances", "sample_phases", "sample_until"]

_MOST = 1 << 17  # samples at once: a dwell may last for hours
_NO_TIMES, _NO_MARKS = np.empty(0), np.empty(0, np.bool_)


@dataclass(frozen=True, slots=True)
class Samples:
    """A piece of a uniformly sampled motion.

    Attributes
    ----------
    t_s : ndarray, shape (n,)
        Integer multiples of the sampler's step.
    xyz_mm : ndarray, shape (3, n)
    e_mm : ndarray, shape (n,)
    move_index : ndarray of int64, shape (n,)
        The move in force, or the last one before a stand.
    moving : ndarray of bool, shape (n,)
        That move has not ended.
    """

    t_s: NDArray[np.float64]
    xyz_mm: NDArray[np.float64]
    e_mm: NDArray[np.float64]
    move_index: NDArray[np.int64]
    moving: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.t_s)

    def part(self, start: int, stop: int) -> Samples:
        """Return the samples start..stop - 1."""
        rows = slice(start, stop)
        return Samples(
            self.t_s[rows],
            self.xyz_mm[:, rows],
            self.e_mm[rows],
            self.move_index[rows],
            self.moving[rows],
        )


def sample_phases(
    phases: Phases, t_s: NDArray[np.float64] | tuple[float, float, int], *, flat: bool = False
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Sample planned moves.

    Parameters
    ----------
    phases : Phases
        At least one, in order of time.
    t_s : ndarray, shape (n,), or tuple (t0, dt, n)
        Ascending times, or the grid ``t0 + k dt``.
    flat : bool
        Only x and y are wanted.

    Returns
    -------
    position_mm : ndarray, shape (4, n) or (2, n)
        x y z e, or x y. Before the first phase its start, after a phase its end.
    row : ndarray of int64, shape (n,)
        Row of `phases` in force.

    Raises
    ------
    ValueError
        If there are no phases, or the times descend or are not finite.
    """
    _check(phases)
    axes = 2 if flat else 4
    if isinstance(t_s, tuple):
        t0_s, dt_s, n = _grid(t_s)
        return _sweep(phases, t0_s, dt_s, 0, np.empty((axes, n)))
    times = np.ascontiguousarray(t_s, np.float64)
    if times.ndim != 1 or not np.all(np.isfinite(times)) or np.any(np.diff(times) < 0):
        raise ValueError("the sampling times must be finite and ascending")
    position, row = np.empty((axes, len(times))), np.empty(len(times), np.int64)
    kernels.visit(times, position, row, _plan(phases))
    return position, row


def sample_until(
    phases: Phases,
    grid: tuple[float, float, int],
    until_s: NDArray[np.float64],
    *,
    axes: int = 4,
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.bool_]]:
    """Sample planned moves on a grid, and return which samples are in time.

    Parameters
    ----------
    phases, grid
        As `sample_phases` has them.
    until_s : ndarray, shape (len(phases),)
    axes : int
        2 to 4: how many of x y z e are wanted.

    Returns
    -------
    position_mm : ndarray, shape (axes, n)
    row : ndarray of int64, shape (n,)
    inside : ndarray of bool, shape (n,)
        The sample is not later than `until_s` of its phase.
    """
    _check(phases)
    t0_s, dt_s, n = _grid(grid)
    inside = np.empty(n, np.bool_)
    position, row = _sweep(phases, t0_s, dt_s, 0, np.empty((axes, n)), until_s, inside)
    return position, row, inside


def distances(
    phases: Phases,
    points_mm: NDArray[np.float64],
    dt_s: float,
    first: NDArray[np.int64],
    late_s: NDArray[np.float64],
    until_s: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the distance in X Y between points and the tool on planned moves, shape (n,).

    Parameters
    ----------
    phases : Phases
        At least one, in order of time.
    points_mm : ndarray, shape (2 or more, n)
        x y first; of the times ``k dt``, but for what follows.
    first : ndarray of int64, shape (stretches,)
        Point that each stretch begins with, rising from 0.
    late_s, until_s : ndarray, shape (stretches,)
        Delay of the points of a stretch, and their latest time. Time never decreases: a point
        before an earlier one has the time of that.
    """
    _check(phases)
    out = np.empty(points_mm.shape[1])
    kernels.distances(dt_s, first, late_s, until_s, points_mm, out, _plan(phases))
    return out


class Sampler:
    """Sample a stream of phases on the grid ``t = k dt``, k = 0, 1, ..."""

    def __init__(self, dt_s: float) -> None:
        if not (dt_s > 0 and math.isfinite(dt_s)):
            raise ValueError(f"the sampling step {dt_s} s must be above 0")
        self.dt_s = dt_s
        self._next = 0
        self._last: Phases | None = None

    def push(self, phases: Phases) -> Iterator[Samples]:
        """Take the next phases; yield the samples up to the end of the last of them."""
        if len(phases):
            known = phases if self._last is None else joined([self._last, phases])
            self._last = rows_of(phases, [-1])  # a copy: a view would keep all of them
            # A sample that falls on the end belongs to what comes next.
            yield from self._sample(known, math.ceil(phases.end_s[-1] / self.dt_s))

    def flush(self) -> Iterator[Samples]:
        """Yield the rest: the last sample stands at the end of the last phase."""
        if self._last is not None:
            yield from self._sample(self._last, math.ceil(self._last.end_s[-1] / self.dt_s) + 1)

    def _sample(self, phases: Phases, stop: int) -> Iterator[Samples]:
        end_s = phases.end_s
        while self._next < stop:
            n = min(stop - self._next, _MOST)
            position, moving = np.empty((4, n)), np.empty(n, np.bool_)
            _, row = _sweep(phases, 0.0, self.dt_s, self._next, position, end_s, moving)
            t_s = np.arange(self._next, self._next + n, dtype=np.float64) * self.dt_s
            self._next += n
            yield Samples(t_s, position[:3], position[3], phases.move_index[row], moving)


def _grid(grid: tuple[float, float, int]) -> tuple[float, float, int]:
    t0_s, dt_s, n = grid
    if not (math.isfinite(t0_s) and dt_s > 0 and math.isfinite(dt_s) and n >= 0):
        raise ValueError(f"the grid (t0 {t0_s}, dt {dt_s}, n {n}) needs dt > 0 and n >= 0")
    return grid


def _sweep(
    phases: Phases,
    t0_s: float,
    dt_s: float,
    first: int,
    position: NDArray[np.float64],
    until_s: NDArray[np.float64] = _NO_TIMES,
    inside: NDArray[np.bool_] = _NO_MARKS,
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    row = np.empty(position.shape[1], np.int64)
    kernels.sweep(t0_s, dt_s, first, position, row, until_s, inside, _plan(phases))
    return position, row


def _plan(phases: Phases) -> kernels.Plan:
    return kernels.Plan(*(getattr(phases, name) for name in kernels.Plan._fields))


def _check(phases: Phases) -> None:
    if len(phases) == 0:
        raise ValueError("nothing to sample: there are no phases")
