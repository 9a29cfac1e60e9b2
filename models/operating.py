"""A machine during its print: its plants at an operating point, and grids of such points.

Compensators cannot follow a plant continuously. They use a grid of operating points between which
no resonance moves by more than a step: mass and height are rounded to it where the machine rests, x
and y are blended by smooth weights that sum to 1.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from stillpath.models.arrays import Array
from stillpath.models.machine import Machine
from stillpath.models.schedule import (
    Coordinate,
    GridSchedule,
    MassSchedule,
    OperatingPoint,
    resonances_hz,
)

__all__ = ["BLEND_STEP", "REMEMBERED_S", "OperatingGrid", "machine_at", "mass_schedules"]

BLEND_STEP = 0.02
"""Relative change of a resonance between neighbouring nodes in x and y, which are blended: that
leaves an error of the square of the difference."""
REMEMBERED_S = 4.0
"""How much of the past is shown to plants that take over: older vibration has died down."""


def machine_at(machine: Machine, point: OperatingPoint) -> Machine:
    """Return the machine at a point: the same document with the plants there and no schedules.

    Raises
    ------
    ModelError
        If a schedule does not fit the plants of its axis.
    """
    axes = dict(machine.axes)
    for axis, schedule in machine.schedules.items():
        axes[axis] = schedule.plants(axes[axis], point)
    return machine.model_copy(update={"axes": axes, "schedules": {}})


def mass_schedules(machine: Machine) -> tuple[MassSchedule, ...]:
    """Return the schedules of axes that move the bed."""
    return tuple(s.mass for s in machine.schedules.values() if s.mass is not None)


class OperatingGrid:
    """Operating points of a machine, close enough for every point between them.

    Parameters
    ----------
    step : float
        Largest ratio of a resonance from one mass or height to the next, minus 1.
    blend_step : float
        The same for x and y, whose plants are blended.
    """

    def __init__(self, machine: Machine, *, step: float, blend_step: float) -> None:
        masses = [schedule.moving_mass_kg for schedule in mass_schedules(machine)]
        self._lightest_kg = min(masses, default=math.inf)
        self._step = math.log1p(step)
        grids = [s.grid for s in machine.schedules.values() if s.grid is not None]
        self._z_mm = _refined(grids, "z", self._step)
        self._xy_mm = [_refined(grids, axis, math.log1p(blend_step)) for axis in ("x", "y")]

    @property
    def nodes(self) -> int:
        """Number of points in x and y together; 1 if the plants do not depend on them."""
        return math.prod(len(values) for values in self._xy_mm)

    def level(self, point: OperatingPoint) -> OperatingPoint:
        """Round mass and height to the grid; x and y to its first node."""
        mass_kg = 0.0
        if math.isfinite(self._lightest_kg):
            # Frequency falls as 1 / sqrt(1 + m / m0).
            steps = round(0.5 * math.log1p(point.mass_kg / self._lightest_kg) / self._step)
            mass_kg = self._lightest_kg * math.expm1(2.0 * steps * self._step)
        x_mm, y_mm = (float(values[0]) for values in self._xy_mm)
        near = int(np.argmin(np.abs(self._z_mm - point.z_mm)))
        return OperatingPoint(mass_kg, x_mm, y_mm, float(self._z_mm[near]))

    def at_level(self, level: OperatingPoint) -> list[OperatingPoint]:
        """Return the nodes in x and y at a level, in the order of `weights`."""
        return [
            replace(level, x_mm=float(x), y_mm=float(y)) for x, y in itertools.product(*self._xy_mm)
        ]

    def weights(self, path_mm: Array) -> Array:
        """Return the shares of the nodes along a path (2, n): shape (nodes, n), columns add to 1.

        Between neighbours they are quintic smoothsteps of the position, twice continuously
        differentiable: a blend of accelerations that are continuous is continuous.
        """
        x, y = (_shares(values, row) for values, row in zip(self._xy_mm, path_mm, strict=True))
        return np.asarray((x[:, None] * y[None]).reshape(self.nodes, -1))


def _refined(grids: Sequence[GridSchedule], axis: Coordinate, log_step: float) -> Array:
    """Coordinates of all grids, and so many between them that no resonance moves by more."""
    own = [grid for grid in grids if grid.coordinates_mm(axis)]
    values = sorted({v for grid in own for v in grid.coordinates_mm(axis)})
    if not values:
        return np.zeros(1)
    parts = [np.array(values[:1])]
    for low, high in itertools.pairwise(values):
        change = max(_change(grid, axis, low, high) for grid in own)
        count = max(1, math.ceil(change / log_step - 1e-9))
        parts.append(np.linspace(low, high, count + 1)[1:])
    return np.concatenate(parts)


def _change(grid: GridSchedule, axis: Coordinate, low: float, high: float) -> float:
    """Largest logarithm of the ratio by which a resonance moves from `low` to `high`."""
    worst = 0.0
    for node in grid.nodes:
        here = OperatingPoint(x_mm=node.x_mm or 0.0, y_mm=node.y_mm or 0.0, z_mm=node.z_mm or 0.0)
        ends = [grid.plant(replace(here, **{f"{axis}_mm": v})) for v in (low, high)]
        first, second = (np.log(resonances_hz(plant)) for plant in ends)
        worst = max(worst, float(np.max(np.abs(second - first))))
    return worst


def _shares(values: Array, position: Array) -> Array:
    shares = np.zeros((len(values), len(position)))
    if len(values) == 1:
        shares[0] = 1.0
        return shares
    k = np.clip(np.searchsorted(values, position, "right") - 1, 0, len(values) - 2)
    s = np.clip((position - values[k]) / (values[k + 1] - values[k]), 0.0, 1.0)
    upper = s**3 * (10.0 + s * (6.0 * s - 15.0))
    column = np.arange(len(position))
    shares[k, column] = 1.0 - upper
    shares[k + 1, column] = upper
    return shares
