"""The product's main compensator: filtered basis functions in limited preview.

Accuracy is set by the number of functions n, which is the command's bandwidth; the basis keeps the
effort small. Each axis of a piece therefore uses the first design of a ladder whose command is
smooth enough for the machine (two-step design, paper 003, remark 3.2). Windows in which the command
still exceeds the machine's bounds are solved again within them.

For a plant set the error along the path may count less than the error across it
(`compensation.sliding`).
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillpath.compensation._sliding_kernels import contour_square
from stillpath.compensation.base import DesignError
from stillpath.compensation.basis import BASES
from stillpath.compensation.defaults import DEFAULT_BASIS
from stillpath.compensation.ladder import (
    GENTLE_RUNG,
    LADDER,
    Rung,
    designs,
    functions_within,
)
from stillpath.compensation.minimax import guarded_weights
from stillpath.compensation.preview_axis import (
    WEIGHT_REST,
    WEIGHT_TRAVEL,
    AxisCommand,
    AxisTask,
    PreviewAxis,
)
from stillpath.compensation.sliding import balanced_weights, member_response, slide
from stillpath.compensation.window_problem import Bounds, Extremes
from stillpath.models.arrays import Array, Ints
from stillpath.models.machine import Machine, MotorLimits
from stillpath.models.plants import DiscretePlant, PlantSet, plant_set
from stillpath.models.schedule import OperatingPoint

__all__ = ["LADDER", "ROBUST", "UPDATE_S", "WINDOW_S", "PreviewFbf", "Rung"]

ROBUST = ("off", "ensemble", "minimax")
"""off: the nominal plant; ensemble: weighted least squares over the set; minimax: the same with
weights that balance the members' errors."""

WINDOW_S, UPDATE_S = 0.3, 0.15
"""Preview window, and the part of it committed before the next one starts."""
ACCEL_RATIO = 1.4
"""Largest ratio of the command's peak acceleration to the planned path's; X and Y together then
stay below twice the path's."""
RMS_RATIO = 1.5
"""The same for the rms acceleration, unless that would cost functions."""
_BOUNDED_SHARE = 0.2
"""Share of windows that may be solved again within bounds; above it a gentler design is used."""
_BOUNDED_ROUNDS = 4
_REACH_S, _STRIDE = 0.03, 7
"""The nearest point of the path is searched within this time, at every 7th sample."""


class _Solution(NamedTuple):
    """Command of an axis, its rung, and the windows that were solved within bounds."""

    command: AxisCommand
    rung: int
    bounded: frozenset[int]


class PreviewFbf:
    """Limited-preview FBF for the two axes of a machine.

    Parameters
    ----------
    machine : Machine
        Plants of X and Y and the limits of the command.
    dt_s : float
        Sampling time of the path.
    basis : str
        A key of `compensation.basis.BASES`.
    robust : str
        One of `ROBUST`.
    along : float, optional
        Weight of the error along the path relative to that across it, above 0. The default 1 is
        plain least squares. With .09 the error of a set across the path is somewhat smaller
        (docs/benchmarks.md), at about ten times the computing time.

    Attributes
    ----------
    lifted : tuple of LiftedWindow
        Plants and weights for which X and Y are designed.
    rungs : tuple of int
        Rungs of the ladders (`LADDER`, within the models' bands) used by the last command, X and Y.

    Raises
    ------
    DesignError
        For an unknown setting, or a design that fails its acceptance.

    Notes
    -----
    The machine's vibration carries over from one piece to the next: call `commit` if the last
    command was used, `observe` for motion that stays as sliced, `reset` when the position jumps.
    """

    name = "fbf"
    lead_s = 0.0
    tail_s = 0.0

    def __init__(
        self,
        machine: Machine,
        dt_s: float,
        *,
        basis: str = DEFAULT_BASIS,
        robust: str = "off",
        along: float | None = None,
    ) -> None:
        if basis not in BASES:
            raise DesignError(f"no basis is called {basis!r}; there are {', '.join(BASES)}")
        if robust not in ROBUST:
            raise DesignError(f"no robust mode is called {robust!r}; there are {', '.join(ROBUST)}")
        if basis == "robust" and robust == "off":
            raise DesignError(
                "the robust basis compares members of a set, but one plant is designed for (robust "
                "off): choose robust ensemble or minimax, or the basis ce-opt"
            )
        along = 1.0 if along is None else along
        if not 0.0 < along <= 1.0:
            raise DesignError(f"weight along the path is {along}; above 0 and at most 1 needed")
        window, update = round(WINDOW_S / dt_s), round(UPDATE_S / dt_s)
        self._dt_s = dt_s
        self.along = along
        self._limits = [machine.command.of("x"), machine.command.of("y")]
        self._accel_share = 1.0
        self._travel = [machine.travel[axis] for axis in ("x", "y")]
        motors = machine.command.motors or MotorLimits()
        self._motors = Bounds(
            accel=(motors.accel_mm_s2 or np.inf) * dt_s**2,
            speed=(motors.velocity_mm_s or np.inf) * dt_s,
            low_mm=-np.inf,
            high_mm=np.inf,
        )
        self._unused = [False, False]
        self._last: list[AxisCommand] = []
        self.rungs: tuple[int, ...] = ()
        # Delays are not vibration: leading the path by them would help only if they were exact.
        sets = [plant_set(machine.axes[axis].without_delay(), dt_s) for axis in ("x", "y")]
        most = tuple(functions_within(machine.axes[axis].band_hz, dt_s) for axis in ("x", "y"))
        weighted = _weighted(sets, robust, dt_s, window, update, basis, along, most)
        made = [
            designs(plants, weights, window, update, basis, functions)
            for (plants, weights), functions in zip(weighted, most, strict=True)
        ]
        for axis_designs in made:
            axis_designs.check()
        self.lifted = tuple(axis_designs.lifted for axis_designs in made)
        self._axes = [PreviewAxis(name, of) for name, of in zip(("x", "y"), made, strict=True)]

    def reset(self, position_mm: Array) -> None:
        """Assume that the machine stands still at `position_mm` (2,)."""
        for axis, position in zip(self._axes, position_mm, strict=True):
            axis.reset(float(position))

    def observe(self, command_mm: Array) -> None:
        """Account for a command (2, n) that did not come from `compensate`."""
        for axis, command in zip(self._axes, command_mm, strict=True):
            axis.observe(command)

    def commit(self) -> None:
        """Mark the last command as executed."""
        for axis, command in zip(self._axes, self._last, strict=True):
            axis.commit(command)

    def commit_as(self, command_mm: Array) -> None:
        """Mark a command (2, n) derived from the last one as executed."""
        for axis, command in zip(self._axes, command_mm, strict=True):
            axis.commit_as(command)

    def leave_out(self, unused: Sequence[bool]) -> None:
        """Do not let limits of X or Y refuse a piece where nobody uses that axis's command."""
        self._unused = list(unused)

    def operate_at(self, point: OperatingPoint) -> None:
        """Do nothing: the plants of this machine are constant."""

    def ease(self, accel_share: float) -> bool:
        """Use at most this share of the machine's acceleration from now on; 0 is refused."""
        self._accel_share = accel_share
        return accel_share > 0.0

    def compensate(self, y_d_mm: Array, extruding: NDArray[np.bool_], rests: Ints) -> Array:
        """Return the command of a piece that starts and ends at rest on the path.

        Parameters
        ----------
        y_d_mm : ndarray, shape (2, n)
            Planned X and Y.
        extruding : ndarray of bool, shape (n,)
        rests : ndarray of int64, shape (k, 2)
            Ranges [a, b) of samples in which u(i) = u(i - 1); the path stands still there, and
            the command stands exactly on it.

        Returns
        -------
        ndarray, shape (2, n)

        Raises
        ------
        DesignError
            If no rung of the ladder keeps the machine's limits.
        """
        tasks = self._tasks(y_d_mm, extruding, rests)
        solved = [self._ladder(axis, task) for axis, task in zip(self._axes, tasks, strict=True)]
        if np.isfinite([self._motors.accel, self._motors.speed]).any():
            solved, tasks = self._within_motors(solved, tasks)
        self._last = [one.command for one in solved]
        self.rungs = tuple(one.rung for one in solved)
        if self.along < 1.0:
            chosen = [(one.rung, one.bounded) for one in solved]
            self._last = slide(
                self._axes, self._last, tasks, chosen, extruding, self.along, self._dt_s
            )
        return np.stack([command.position_mm for command in self._last])

    def _tasks(self, y_d_mm: Array, extruding: NDArray[np.bool_], rests: Ints) -> list[AxisTask]:
        """Return the problems of X and Y for a piece: weights, stops and limits."""
        n = y_d_mm.shape[1]
        weight = np.where(extruding, 1.0, WEIGHT_TRAVEL)
        for a, b in rests:
            weight[a:b] = WEIGHT_REST
        around = np.array([[-1, 1], [n, n + self._axes[0].window]], dtype=np.int64)
        stops = _merged(np.concatenate([around, rests]))
        asked = [Extremes.of(path, path[0], path[0]) for path in y_d_mm]
        rms_limit = np.inf
        if n > 2:
            largest = max(one.mean_square for one in asked)
            rms_limit = RMS_RATIO * np.sqrt(largest) / self._dt_s**2
        rms_limits = np.where(self._unused, np.inf, rms_limit)
        accel_limits = self._accel_limits_mm_s2(asked)
        return [
            AxisTask(path, weight, stops, self._bounds(i, asked[i], accel_limits[i]), rms)
            for i, (path, rms) in enumerate(zip(y_d_mm, rms_limits, strict=True))
        ]

    def _within_motors(
        self, solved: list[_Solution], tasks: list[AxisTask]
    ) -> tuple[list[_Solution], list[AxisTask]]:
        """Solve windows again in which X and Y together ask too much of a motor (CoreXY).

        Each axis may use half of what the motor bears there. Where that does not help, the commands
        are returned as they were.
        """
        outside = self._over_limits(solved, tasks)
        if not outside:
            return solved, tasks
        accel, speed = 0.5 * self._motors.accel, 0.5 * self._motors.speed
        halves = [replace(task, bounds=task.bounds.at_most(accel, speed)) for task in tasks]
        tried = solved
        for _ in range(_BOUNDED_ROUNDS):
            tried = [
                _solved(axis, one.rung, task, one.bounded | outside)
                for axis, task, one in zip(self._axes, halves, tried, strict=True)
            ]
            outside = self._over_limits(tried, tasks)
            if not outside:
                return tried, halves
            if all(outside <= one.bounded for one in tried):
                break
        return solved, tasks

    def _over_limits(self, solved: list[_Solution], tasks: list[AxisTask]) -> frozenset[int]:
        """Return the windows in which an axis or a motor exceeds its limits, and those before."""
        axis, (x, y) = self._axes[0], (one.command.position_mm for one in solved)
        asked = [(x, tasks[0].bounds), (y, tasks[1].bounds)]
        asked += [(x + y, self._motors), (x - y, self._motors)]
        return frozenset().union(*(axis.windows_outside(bounds, row) for row, bounds in asked))

    def contour_square(
        self,
        y_d_mm: Array,
        command_mm: Array,
        extruding: NDArray[np.bool_],
        enough_mm2: float = np.inf,
    ) -> float:
        """Return the mean squared contour error [mm2] of a piece's command from a path (2, n).

        The mean is over the design's plants, paired between X and Y, and over extruding motion. It
        may be too small if it is above `enough_mm2`: the plants that are left are not asked.
        """
        count = max(axis.members for axis in self._axes)
        reach = round(_REACH_S / self._dt_s)
        total = 0.0
        for j in range(count):
            y = member_response(self._axes, command_mm, j)
            total += contour_square(y_d_mm, y, extruding, reach, _STRIDE)
            if total > count * enough_mm2:
                break
        return total / count

    def accel_limits_mm_s2(self, y_d_mm: Array) -> tuple[float, float]:
        """Return the largest acceleration allowed to the commands of X and Y on a path (2, n)."""
        return self._accel_limits_mm_s2([Extremes.of(p, p[0], p[0]) for p in y_d_mm])

    def _accel_limits_mm_s2(self, asked: list[Extremes]) -> tuple[float, float]:
        path_accel = max(one.accel for one in asked) / self._dt_s**2
        x, y = (self._accel_share * limits.accel_mm_s2 for limits in self._limits)
        wanted = ACCEL_RATIO * path_accel
        return min(x, max(wanted, 0.25 * x)), min(y, max(wanted, 0.25 * y))

    def _bounds(self, i: int, asked: Extremes, accel_limit: float) -> Bounds:
        travel, dt = self._travel[i], self._dt_s
        if self._unused[i]:
            return Bounds(np.inf, np.inf, -np.inf, np.inf)
        return Bounds(
            accel=accel_limit * dt**2,
            speed=self._limits[i].velocity_mm_s * dt,
            # The path itself may touch the ends of the travel, or be judged elsewhere.
            low_mm=min(travel.min_mm, asked.low_mm),
            high_mm=max(travel.max_mm, asked.high_mm),
        )

    def _ladder(self, axis: PreviewAxis, task: AxisTask) -> _Solution:
        """Return the command of the most accurate rung that keeps the limits."""
        for rung in range(axis.rung, axis.last_rung):
            # A design may fail its acceptance where a gentler one does not.
            with contextlib.suppress(DesignError):
                return self._on_rung(axis, rung, task)
        return self._on_rung(axis, axis.last_rung, task)

    def _on_rung(self, axis: PreviewAxis, rung: int, task: AxisTask) -> _Solution:
        dt, bounds = self._dt_s, task.bounds
        bounded: frozenset[int] = frozenset()
        for _ in range(_BOUNDED_ROUNDS + 1):
            solution = _solved(axis, rung, task, bounded)
            command = solution.command.position_mm
            reached = Extremes.of(command, command[0], command[0], stops=True)
            rms = np.sqrt(reached.mean_square) / dt**2
            if rms > task.rms_limit_mm_s2 and rung < GENTLE_RUNG:
                axis.refuse(rung, task, rms)
                break
            if bounds.kept(reached):
                axis.accept(rung, task, rms)
                return solution
            outside = axis.windows_outside(bounds, command)
            few = len(bounded | outside) <= max(2, _BOUNDED_SHARE * len(command) / axis.update)
            if outside <= bounded or not (few or rung == axis.last_rung):
                break
            bounded |= outside
        path = Extremes.of(task.path_mm, task.path_mm[0], task.path_mm[0])
        raise DesignError(
            f"axis {axis.name}: even the gentlest design does not stay within "
            f"{bounds.accel / dt**2:.0f} mm/s2, {bounds.speed / dt:.0f} mm/s and {bounds.low_mm:g} "
            f"to {bounds.high_mm:g} mm; the path itself asks for {path.accel / dt**2:.0f} mm/s2, "
            f"{path.speed / dt:.0f} mm/s and {path.low_mm:g} to {path.high_mm:g} mm (allowed are "
            f"the command and travel limits of the machine, and at most {ACCEL_RATIO:g} times the "
            "path's acceleration, or a quarter of that limit; docs/proof.md tells how to measure "
            "what the motors bear)"
        )


def _solved(axis: PreviewAxis, rung: int, task: AxisTask, bounded: frozenset[int]) -> _Solution:
    return _Solution(axis.command(rung, task, bounded), rung, bounded)


def _merged(stops: Ints) -> Ints:
    """Return the stops in order, with touching ones merged."""
    spans: list[list[int]] = []
    for a, b in sorted(map(tuple, stops.tolist())):
        if spans and a <= spans[-1][1]:
            spans[-1][1] = max(b, spans[-1][1])
        else:
            spans.append([a, b])
    return np.array(spans, dtype=np.int64)


def _weighted(
    sets: list[PlantSet], robust: str, *design: Any
) -> list[tuple[tuple[DiscretePlant, ...], tuple[float, ...]]]:
    """Return the plants and weights of X and Y for a robust mode.

    Parameters
    ----------
    design
        dt_s and what follows it in `compensation.sliding.balanced_weights`.
    """
    if robust == "off":
        return [((plants.nominal,), (1.0,)) for plants in sets]
    given = [(plants.members, tuple(plants.weights.tolist())) for plants in sets]
    if robust == "ensemble":
        return given
    if len(given[0][0]) == len(given[1][0]):
        x, y = given
        weights = list(balanced_weights(x, y, *design))
    else:
        weights = [tuple(guarded_weights(plants).tolist()) for plants in sets]
    return [(plants.members, share) for plants, share in zip(sets, weights, strict=True)]
