"""Response of a whole machine to a command: ripple, dry friction, plants that may change.

`simulation.response` has the linear part of it, for plants as they are.
"""

from __future__ import annotations

import numpy as np

from stillpath.models.arrays import Array
from stillpath.models.friction import DryFriction
from stillpath.models.machine import Machine
from stillpath.models.operating import BLEND_STEP, REMEMBERED_S, OperatingGrid, machine_at
from stillpath.models.plants import DiscretePlant, PlantSetSpec, discretise, plant_set
from stillpath.models.ripple import MachineRipple
from stillpath.models.schedule import EMPTY, OperatingPoint
from stillpath.simulation.response import PlantStream

__all__ = ["SIMULATION_STEP", "MachineStream"]

SIMULATION_STEP = 0.001
"""Ratio, minus 1, by which a resonance moves in mass or height before the plants are taken anew."""


class MachineStream:
    """Response of X and Y of a machine to a command that arrives in blocks.

    The nominal plants respond to the command with the machine's ripple added and what dry friction
    holds back taken off. The machine stands still at the first sample pushed. Where plants depend
    on x and y, all nodes of the grid respond and are blended by weights of the planned position.

    Parameters
    ----------
    point : OperatingPoint
        Where the machine is at first; without schedules it does not matter.
    member : int, optional
        The plants with this number in the sets of both axes respond, not the nominal ones; the
        shorter list repeats.
    """

    def __init__(
        self,
        machine: Machine,
        dt_s: float,
        point: OperatingPoint = EMPTY,
        *,
        member: int | None = None,
    ) -> None:
        self._machine, self._dt_s = machine, dt_s
        self._member = member
        self._ripple = MachineRipple(machine.kinematics, machine.ripple)
        self._friction = DryFriction(machine.friction_mm, dt_s)
        self._grid = OperatingGrid(machine, step=SIMULATION_STEP, blend_step=BLEND_STEP)
        self._remembered = round(REMEMBERED_S / dt_s) if machine.schedules else 0
        self._past = np.zeros((2, 0))
        self._level: OperatingPoint | None = None
        self._streams: list[PlantStream] = []
        self.operate_at(point)

    def stand(self) -> None:
        """Stand still from here on: the next sample pushed is the first one again."""
        self._past = self._past[:, :0]
        self._friction.stand()
        for stream in self._streams:
            stream.stand()

    def operate_at(self, point: OperatingPoint) -> None:
        """Continue with the plants of this point, which still vibrate from the motion before."""
        if self._streams and not self._machine.schedules:
            return
        level = self._grid.level(point)
        if level == self._level:
            return
        self._level = level
        self._streams = []
        for node in self._grid.at_level(level):
            axes = machine_at(self._machine, node).axes
            stream = PlantStream([self._plant(axes[a]) for a in ("x", "y")])
            stream.push(self._past)
            self._streams.append(stream)

    def push(self, u_mm: Array, path_mm: Array, out: Array | None = None) -> Array:
        """Return the response to a command, shape (2, n).

        Parameters
        ----------
        u_mm, path_mm : ndarray, shape (2, n)
            The command, and the planned positions that weigh the plants.
        out : ndarray, shape (2, n), optional
            Where the response is written to.
        """
        return self.respond(self.received_mm(u_mm), path_mm, out)

    def received_mm(self, u_mm: Array) -> Array:
        """Return the next block of a command as ripple and dry friction let the plants have it."""
        return self._friction.received_mm(self._ripple.received_mm(u_mm))

    def respond(self, received_mm: Array, path_mm: Array, out: Array | None = None) -> Array:
        """Return the response (2, n) to a command as the plants received it; see `push`."""
        if self._remembered:
            past = np.concatenate([self._past, received_mm], axis=1)
            self._past = past[:, -self._remembered :].copy()
        moved = np.empty(received_mm.shape) if out is None else out
        self._respond(received_mm, path_mm, moved)
        if self._machine.ripple:
            moved += self._ripple.added_mm(path_mm)
        return moved

    def _plant(self, axis: PlantSetSpec) -> DiscretePlant:
        if self._member is None:
            return discretise(axis.nominal, self._dt_s)
        members = plant_set(axis, self._dt_s).members
        return members[self._member % len(members)]

    def _respond(self, u_mm: Array, path_mm: Array, out: Array) -> None:
        if len(self._streams) == 1:
            self._streams[0].push(u_mm, out)
            return
        out[:] = u_mm
        for share, stream in zip(self._grid.weights(path_mm), self._streams, strict=True):
            out += share * (stream.push(u_mm) - u_mm)
