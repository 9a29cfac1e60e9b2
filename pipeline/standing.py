"""Standing time where a printed line begins or ends at rest (retraction, Z hop, end of a piece).

A plan's acceleration a begins and ends there all at once. A nozzle that lags by k a behind its
command, as springs do, follows exactly only if the command jumps by k a, and no motor can. Without
time to make up for it, the largest errors of most prints lie there. So the plan stands
still for as long as the command's acceleration needs for that jump, from rest to rest.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from stillpath.gcode.firmware.registry import adapter
from stillpath.gcode.sampler import sample_phases
from stillpath.gcode.timeline import Group
from stillpath.gcode.types import Phases
from stillpath.models.arrays import Array, Mask
from stillpath.models.machine import Machine
from stillpath.models.plants import DiscretePlant, plant_set

__all__ = ["Standing", "yielding_s2"]

_AXES: tuple[Literal["x", "y"], ...] = ("x", "y")
_SLOW_HZ = 2.0
"""Far below all modes."""
_LEAST_MM = 0.01
"""Smaller jumps are left alone: most stops of a stiff printer cost no time."""


def yielding_s2(plant: DiscretePlant) -> float:
    """Return by how much slow motion lags per acceleration [s2]: the sum of share / omega^2."""
    gain = np.abs(plant.frequency_response([_SLOW_HZ]).item())
    return max(float(gain) - 1.0, 0.0) / (2.0 * np.pi * _SLOW_HZ) ** 2


class Standing:
    """Standing times of a machine.

    Parameters
    ----------
    machine : Machine
        Plants of X and Y and the limits of the command.
    """

    def __init__(self, machine: Machine, dt_s: float) -> None:
        sets = [plant_set(machine.axes[axis].without_delay(), dt_s) for axis in _AXES]
        self._spring_s = np.sqrt([yielding_s2(plants.nominal) for plants in sets])
        # Firmwares other than Klipper may begin and end lines at a speed. Time to make up for that
        # helps none that makes moves of several motor steps: its lines creep to their ends in one.
        self._creeps = adapter(machine).shortest_move_mm > 0.0
        self._accel = np.array([machine.command.of(axis).accel_mm_s2 for axis in _AXES])

    def of(self, phases: Phases, groups: list[Group]) -> tuple[Array, Array]:
        """Return the standing time [s] before and after each group, shape (len(groups),)."""
        first = np.array([group.first for group in groups])
        last = np.array([group.last for group in groups]) - 1
        begin_s, end_s = phases.t_s[first], phases.end_s[last]
        begin_mm_s, end_mm_s = (
            (self._creeps * speed[:, None] * phases.direction)[rows]
            for speed, rows in ((phases.start_mm_s, first), (phases.end_mm_s, last))
        )
        way_mm = np.empty((2, 2, len(groups)))
        for i, spring_s in enumerate(self._spring_s):
            early_s = np.minimum(begin_s + spring_s, end_s)
            late_s = np.maximum(end_s - spring_s, begin_s)
            spans = (begin_s, early_s, begin_mm_s), (late_s, end_s, end_mm_s)
            for k, (from_s, to_s, at_once_mm_s) in enumerate(spans):
                times_s = np.maximum.accumulate(np.stack([from_s, to_s], axis=1).ravel())
                place, _ = sample_phases(phases, times_s, flat=True)
                way_mm[k, i] = np.diff(place[i].reshape(-1, 2), axis=1)[:, 0]
                way_mm[k, i] -= (to_s - from_s) * at_once_mm_s[:, i]
        prints = phases.direction[:, 3] > 0.0
        return self._needed_s(way_mm[0], prints[first]), self._needed_s(way_mm[1], prints[last])

    def _needed_s(self, way_mm: Array, prints: Mask) -> Array:
        """Return the time for the jumps of X and Y, which accelerate by `way_mm` in 1 / omega."""
        jump_mm = 2.0 * np.abs(way_mm)
        # Half of the way accelerating, half braking.
        needed_s = 2.0 * np.sqrt(jump_mm / self._accel[:, None]).max(axis=0)
        return np.where(prints & (np.hypot(*jump_mm) > _LEAST_MM), needed_s, 0.0)
