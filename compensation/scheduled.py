"""Compensation of a machine whose plants change during the print, by operating point.

Mass and height change between pieces, which begin and end at rest. The compensator of the new point
then replays the motion of the last seconds, so that it knows the present vibration; commands begin
and end on the path, so there are no steps. Plants that depend on x and y are blended within a
piece: u = sum_i w_i(y_d) u_i, with weights of the planned position that sum to 1. Where the plan
stands, the weights are constant, and every u_i stands on the plan.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from stillpath.compensation.base import Compensator, DesignError
from stillpath.models.arrays import Array
from stillpath.models.machine import Machine
from stillpath.models.operating import BLEND_STEP, REMEMBERED_S, OperatingGrid, machine_at
from stillpath.models.schedule import EMPTY, OperatingPoint

__all__ = ["DESIGN_STEP", "ScheduledCompensator"]

DESIGN_STEP = 0.02
"""Relative change of a resonance between neighbouring designs in mass and height."""
_ROOM = 0.98
"""Share of the limits for each design, as a blend slightly exceeds those of its parts."""


class ScheduledCompensator:
    """Compensators of the same kind for the operating points of a machine.

    Parameters
    ----------
    machine : Machine
        With schedules.
    make : callable
        Makes the compensator of a machine without schedules.

    Attributes
    ----------
    name, lead_s, tail_s
        As in `compensation.base.Compensator`.

    Raises
    ------
    DesignError
        If the compensator of the empty machine cannot be designed.
    """

    def __init__(
        self, machine: Machine, make: Callable[[Machine], Compensator], dt_s: float
    ) -> None:
        self._machine, self._make, self._dt_s = machine, make, dt_s
        self._grid = OperatingGrid(machine, step=DESIGN_STEP, blend_step=BLEND_STEP)
        self._remembered = round(REMEMBERED_S / dt_s)
        self._made: dict[OperatingPoint, Compensator] = {}
        self._share = 1.0
        self._knowing: set[OperatingPoint] = set()
        """Points whose compensators know the present state of the machine."""
        self._past = np.zeros((2, 1))
        self._last: Array | None = None
        self._used: tuple[OperatingPoint, ...] = ()
        self._level: OperatingPoint | None = None
        self._points: list[OperatingPoint] = []
        self.lead_s = self.tail_s = 0.0
        self.operate_at(EMPTY)
        self.name = self._made[self._points[0]].name

    def reset(self, position_mm: Array) -> None:
        """Assume that the machine stands still at `position_mm` (2,)."""
        self._past = np.array(position_mm, float)[:, None]
        for point in self._knowing:
            self._made[point].reset(position_mm)

    def observe(self, command_mm: Array) -> None:
        """Account for a command (2, n) that did not come from `compensate`."""
        self._remember(command_mm)
        for point in self._knowing:
            self._made[point].observe(command_mm)

    def commit(self) -> None:
        """Mark the last command as executed."""
        if self._last is None:
            return
        # The last sample of a piece is the first one of what follows.
        self._remember(self._last[:, :-1])
        for point in self._used:
            self._made[point].commit()
        # A blended command is not that of any single compensator.
        self._knowing = set(self._used) if len(self._used) == 1 else set()

    def operate_at(self, point: OperatingPoint) -> None:
        """Switch to the designs for this point; the machine stands still.

        Raises
        ------
        DesignError
            If there is none.
        """
        level = self._grid.level(point)
        if level == self._level:
            return
        left, self._level = self._points, level
        self._points = self._grid.at_level(level)
        # A print alternates between levels before it finally leaves one.
        kept = {*left, *self._points}
        self._made = {p: c for p, c in self._made.items() if p in kept}
        self._knowing &= set(self._points)
        made = [self._compensator(self._points[0])]
        if made[0].lead_s or made[0].tail_s:
            made = [self._compensator(one) for one in self._points]
        # Others need no standing time anywhere; the nodes that a print never touches are not made.
        self.lead_s, self.tail_s = max(c.lead_s for c in made), max(c.tail_s for c in made)

    def ease(self, accel_share: float) -> bool:
        """See `compensation.base.Compensator.ease`."""
        self._share = accel_share
        return all(one.ease(accel_share) for one in list(self._made.values()))

    def compensate(
        self,
        y_d_mm: Array,
        extruding: NDArray[np.bool_],
        rests: NDArray[np.int64],
    ) -> Array:
        """See `compensation.base.Compensator.compensate`.

        Raises
        ------
        DesignError
            Also if a blend exceeds the machine's limits.
        """
        weights = self._grid.weights(y_d_mm)
        shares = {p: w for p, w in zip(self._points, weights, strict=True) if np.any(w)}
        self._used = tuple(shares)
        commands = {p: self._with_past(p).compensate(y_d_mm, extruding, rests) for p in shares}
        if len(commands) == 1:
            self._last = commands[self._used[0]]
        else:
            # Relative to the path: where all commands are on it, the blend is exactly too.
            self._last = y_d_mm + sum(w * (commands[p] - y_d_mm) for p, w in shares.items())
            self._check(self._last, y_d_mm)
        return self._last

    def _compensator(self, point: OperatingPoint) -> Compensator:
        if point not in self._made:
            then = machine_at(self._machine, point)
            if self._grid.nodes > 1:
                limits = then.command
                room = limits.scaled(velocity=_ROOM, accel=_ROOM)
                then = then.model_copy(update={"command": room})
            self._made[point] = self._make(then)
            self._made[point].ease(self._share)
        return self._made[point]

    def _with_past(self, point: OperatingPoint) -> Compensator:
        """Return a compensator that knows the present vibration."""
        one = self._compensator(point)
        if point not in self._knowing:
            one.reset(self._past[:, 0])
            one.observe(self._past)
            self._knowing.add(point)
        return one

    def _remember(self, command_mm: Array) -> None:
        past = np.concatenate([self._past, command_mm], axis=1)
        self._past = past[:, -self._remembered :].copy()

    def _check(self, command: Array, y_d_mm: Array) -> None:
        """Raise unless the blend keeps the limits, or the path itself exceeds them."""
        dt, machine = self._dt_s, self._machine
        axes = [machine.command.of("x"), machine.command.of("y")]
        for what, limits, order in (
            ("mm/s", np.array([one.velocity_mm_s for one in axes]), 1),
            ("mm/s2", np.array([one.accel_mm_s2 for one in axes]), 2),
        ):
            asked, path = (
                np.max(np.abs(np.diff(rows, order)), axis=1, initial=0.0) / dt**order
                for rows in (command, y_d_mm)
            )
            for i in np.flatnonzero(asked > np.maximum(limits, path) * (1.0 + 1e-9)):
                raise DesignError(
                    f"axis {'xy'[i]}: blended over the position, the command asks for "
                    f"{asked[i]:.0f} {what}; allowed are {limits[i]:.0f} {what} (command limits of "
                    "the machine): print more slowly, or measure the plants at nearer positions"
                )
