"""One axis in limited preview: the state of its plants, and the command of a piece."""

from __future__ import annotations

from collections.abc import Set
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from stillpath.compensation._preview_kernels import advance_state, advance_window, impulse_states
from stillpath.compensation._window_kernels import Memory, Stepping, solve_windows
from stillpath.compensation.block_response import BlockResponse
from stillpath.compensation.ladder import GENTLE_RUNG, Designs
from stillpath.compensation.window_problem import (
    TRAVEL_SLACK_MM,
    Bounds,
    functions_of,
    refusing_singular,
    within_bounds,
)
from stillpath.models.arrays import Array, Ints

__all__ = ["WEIGHT_REST", "WEIGHT_TRAVEL", "AxisCommand", "AxisTask", "PreviewAxis"]

WEIGHT_TRAVEL = 0.2
WEIGHT_REST = 0.5
"""Ringing during a rest is above the end of a line. A smaller weight allows more of it without any
gain while extruding; from 1 on, accuracy while extruding suffers."""
_ROOM, _LEAST_ROOM = 0.8, 0.6
"""Share of the rms limit below which a more accurate rung is tried, before its own is known, and
the least that one odd piece can make of it."""
_FORGOTTEN = 1e-12
"""A vibration that has decayed to this share is dropped from the state."""


@dataclass(frozen=True, slots=True, eq=False)
class AxisTask:
    """The command problem of an axis for one piece.

    Attributes
    ----------
    path_mm : ndarray, shape (n,)
        Planned positions; the command starts and ends on them.
    weight : ndarray, shape (n,)
        Weight of the errors in windows with a rest.
    stops : ndarray of int64, shape (k, 2)
        Ranges [a, b) of samples in which the command stands, including those before and after the
        piece.
    rms_limit_mm_s2 : float
        Largest rms acceleration of a command that counts as smooth.
    """

    path_mm: Array
    weight: Array
    stops: Ints
    bounds: Bounds
    rms_limit_mm_s2: float


@dataclass(frozen=True, slots=True, eq=False)
class AxisCommand:
    """Command of an axis for one piece, and the final states of the plants.

    Attributes
    ----------
    position_mm : ndarray, shape (n,)
    states : ndarray
        States of all members, relative to the last position.
    """

    position_mm: Array
    states: Array


@dataclass(frozen=True, slots=True, eq=False)
class _Prepared:
    """A task as the windows of one rung need it: all that does not depend on the plants' states.

    Attributes
    ----------
    path_mm, weight : ndarray, shape (windows * update + window,)
        Those of the task, relative to the start of the path, extended beyond its end.
    slid_mm : ndarray, shape (components, n), or (components, 0) where the path is the target
        What is added to the targets of the set's components.
    command_from_path, state_from_path : ndarray, shapes (windows, update) and (windows, nz)
        S y_d and H y_d of every window (`compensation.preview`).
    memory : Memory
        Windows solved individually.
    """

    task: AxisTask
    rung: int
    path_mm: Array
    weight: Array
    slid_mm: Array
    command_from_path: Array
    state_from_path: Array
    memory: Memory


class PreviewAxis:
    """One axis: its designs and the state of its plants.

    Attributes
    ----------
    rung : int
        Rung at which the next piece starts.
    last_rung : int
        The gentlest design.
    members : int
        Number of plants in the designs.
    """

    def __init__(self, name: str, designs: Designs) -> None:
        self.name, self._designs = name, designs
        self.window, self.update = designs.lifted.window, designs.lifted.update
        self._plants = designs.lifted.plants
        self.members = len(self._plants)
        settling = [p.settling_time_s(_FORGOTTEN) / p.dt_s for p in self._plants]
        self._memory = max(1, round(max(settling)))
        self._rest_at_one = np.concatenate([p.rest_state() for p in self._plants])
        self.rung = self._next_rung = 0
        self._refused: tuple[AxisTask, int, float] | None = None
        self._room = [_ROOM] * len(designs.ladder)
        self._cached: _Prepared | None = None
        self.last_rung = len(designs.ladder) - 1
        self.reset(0.0)

    def reset(self, position: float) -> None:
        """Assume that the axis stands still at `position`."""
        # States are relative to `origin`, so that the vibration keeps full precision.
        self._origin = position
        self._states = np.zeros(sum(p.order for p in self._plants))

    def observe(self, command: Array) -> None:
        """Account for a command (n,) made elsewhere; what follows begins one sample later."""
        if len(command) == 0:
            return
        origin = float(command[-1])
        self._move_origin(origin)
        if len(command) <= self._memory:
            self._states = self._advanced(self._states, command - origin)
            return
        # All that came before is forgotten, as if the axis had stood where this begins.
        recent = command[-self._memory :]
        began = float(recent[0])
        self._states = self._resting(began - origin) + self._remembered @ (recent - began)

    @cached_property
    def _remembered(self) -> Array:
        """Effect of each recent sample on the states, shape (states, samples)."""
        return np.concatenate([impulse_states(p.a, p.b, self._memory) for p in self._plants])

    def commit(self, command: AxisCommand) -> None:
        """Mark a command as executed."""
        self._origin, self._states = float(command.position_mm[-1]), command.states
        self.rung = self._next_rung
        self._cached = None

    def commit_as(self, command: Array) -> None:
        """Mark a command (n,) derived from the last one as executed.

        Unlike what is observed, a piece shares its last sample with what follows.
        """
        self.observe(command[:-1])
        self._move_origin(float(command[-1]))
        self.rung = self._next_rung
        self._cached = None

    def response(self, member: int, command: Array) -> Array:
        """Return the response (n,) of a member of the set to a command (n,)."""
        first = sum(p.order for p in self._plants[:member])
        respond = self._responses[member]
        self._move_origin(float(command[0]))
        state = self._states[first : first + self._plants[member].order]
        return respond(self._origin, state, command)

    @cached_property
    def _responses(self) -> list[BlockResponse]:
        return [BlockResponse(plant) for plant in self._plants]

    def refuse(self, rung: int, task: AxisTask, rms_mm_s2: float) -> None:
        """Note that a rung's command is not smooth enough."""
        self._refused = task, rung, rms_mm_s2

    def accept(self, rung: int, task: AxisTask, rms_mm_s2: float) -> None:
        """Choose the rung of the next piece: this one, or a more accurate one if there is room.

        How much smoother a rung's commands are than those of the rung before hardly differs from
        piece to piece.
        """
        if self._refused is not None and self._refused[:2] == (task, rung - 1):
            self._room[rung] = max(rms_mm_s2 / self._refused[2], _LEAST_ROOM)
        self._refused = None
        if len(task.path_mm) > self.update:
            has_room = rms_mm_s2 < self._room[rung] * task.rms_limit_mm_s2 or rung > GENTLE_RUNG
            self._next_rung = max(0, rung - 1) if has_room else rung

    def windows_outside(self, bounds: Bounds, command: Array) -> set[int]:
        """Return the windows in which a command (n,) exceeds the bounds, and those before them."""
        bend, step = _changes(command)
        accel, speed, low_mm, high_mm = bounds.limits()
        outside = (command < low_mm) | (command > high_mm)
        outside |= (np.abs(bend) > accel) | (np.abs(step) > speed)
        windows = np.unique(np.flatnonzero(outside) // self.update)
        return {int(w) for w in windows} | {int(w) - 1 for w in windows if w > 0}

    def command(
        self, rung: int, task: AxisTask, bounded: Set[int], targets_mm: Array | None = None
    ) -> AxisCommand:
        """Return the command of a piece; windows with rests and `bounded` ones are solved singly.

        Parameters
        ----------
        rung : int
            Index into `Designs.ladder`.
        bounded : set of int
            Windows in which the bounds are kept.
        targets_mm : ndarray, shape (members, n), optional
            Desired motion of each member; by default the path.
        """
        prepared = self._prepared(rung, task, targets_mm)
        self._move_origin(float(task.path_mm[0]))
        u, last_states = self._solved(rung, task, bounded, prepared)
        # The windows continue past the end of the path, where the command stands.
        n, origin, end_mm = len(task.path_mm), self._origin, float(task.path_mm[-1])
        u[n - 1] = end_mm - origin
        states = self._advanced(last_states, u[len(u) - self.update : n - 1])
        # Snap positions that rounding put just outside the travel.
        u += origin
        position = _snapped(u[:n], task.bounds)
        position[-1] = end_mm
        return AxisCommand(position, states - self._resting(end_mm - origin))

    def _solved(
        self, rung: int, task: AxisTask, bounded: Set[int], prepared: _Prepared
    ) -> tuple[Array, Array]:
        """Return the command of all windows, and the states where the last one begins."""
        design, window, update = self._designs.design(rung), self.window, self.update
        bounds = task.bounds.seen_from(self._origin)
        is_bounded = np.zeros(len(prepared.command_from_path), bool)
        is_bounded[list(bounded)] = True
        lifted = self._designs.lifted
        functions = functions_of(design, at_rests=False)
        rest_functions = self._designs.rest_functions(rung)
        stepping = Stepping(
            design.command_gain,
            design.state_gain,
            lifted.advance,
            design.state_drive,
            prepared.command_from_path,
            prepared.state_from_path,
        )

        windows = len(prepared.command_from_path)
        u = np.empty(windows * update)
        z, w = np.append(self._states, [0.0, 0.0]), 0
        # Pause before the last window, to note the states there.
        for until in (windows - 1, windows):
            last_states = z[:-2].copy()
            while w < until:
                with refusing_singular():
                    w, tied = solve_windows(
                        stepping,
                        functions,
                        rest_functions,
                        self._designs.at_rests.squeeze,
                        prepared.path_mm,
                        lifted.target,
                        prepared.slid_mm,
                        prepared.weight,
                        task.stops,
                        is_bounded,
                        bounds.limits(),
                        prepared.memory,
                        z,
                        w,
                        until,
                        u,
                    )
                if w == until:
                    break
                # This window needs its bounds.
                start = w * update
                path_mm = prepared.path_mm[start : start + window]
                used = rest_functions if len(tied.moving) > 1 else functions
                committed = u[start : start + update]
                committed[:] = within_bounds(used, tied, z, path_mm, bounds)[:update]
                prepared.memory.known[w], prepared.memory.z[w] = True, z
                prepared.memory.committed[w] = committed
                advance_window(lifted.advance, design.state_drive, z, committed)
                w += 1
        return u, last_states

    def _prepared(self, rung: int, task: AxisTask, targets_mm: Array | None) -> _Prepared:
        """Prepare a task for a rung; the last result is reused if both are the same.

        A piece is often requested again with a few more windows within bounds. Windows with the
        same initial state are then not solved again.
        """
        cached = self._cached
        if cached is not None and targets_mm is None and (cached.task, cached.rung) == (task, rung):
            return cached
        design, path = self._designs.design(rung), task.path_mm
        window, update = self.window, self.update
        padding = -(-len(path) // update) * update + window - len(path)
        padded = np.empty(len(path) + padding)
        np.subtract(path, path[0], out=padded[: len(path)])
        padded[len(path) :] = path[-1] - path[0]
        nodes = _products(padded, design.node_gain, update)
        slid = np.empty((len(self._designs.lifted.target), 0))
        if targets_mm is not None:
            slid = self._designs.lifted.mix @ (targets_mm - path)
            for component, gain in zip(slid, design.target_gain, strict=True):
                followed = np.append(component, np.zeros(padding))
                nodes += _products(followed, gain, update)
        command_from_path = nodes @ design.spread.T
        state_from_path = nodes @ design.state_spread.T
        weight = np.full(len(padded), WEIGHT_REST)
        weight[: len(path)] = task.weight
        memory = Memory(
            known=np.zeros(len(nodes), bool),
            z=np.empty(state_from_path.shape),
            committed=np.empty(command_from_path.shape),
        )
        prepared = _Prepared(
            task, rung, padded, weight, slid, command_from_path, state_from_path, memory
        )
        # Separate targets are passed in an array that changes: do not cache them.
        self._cached = prepared if targets_mm is None else None
        return prepared

    def _move_origin(self, origin: float) -> None:
        self._states = self._states + self._resting(self._origin - origin)
        self._origin = origin

    def _resting(self, position: float) -> Array:
        return self._rest_at_one * position

    def _advanced(self, states: Array, command: Array) -> Array:
        parts, row = [], 0
        for plant in self._plants:
            part = states[row : row + plant.order]
            parts.append(advance_state(plant.a, plant.b, part, command))
            row += plant.order
        return np.concatenate(parts)


def _changes(command: Array) -> tuple[Array, Array]:
    """Return second and first differences at every sample, with standstill at both ends."""
    standing = np.concatenate([command[:1], command, command[-1:]])
    return np.diff(standing, 2), np.diff(standing)[:-1]


def _products(samples: Array, gain: Array, update: int) -> Array:
    """Return the products of a gain, (k, window), with all windows, one row each.

    The gain is split into blocks, so that overlapping windows need not be copied.
    """
    window = gain.shape[1]
    windows = (len(samples) - window) // update
    total = np.zeros((windows, len(gain)))
    for first in range(0, window, update):
        part = gain[:, first : first + update]
        blocks = samples[first : first + windows * update].reshape(windows, update)
        total += blocks[:, : part.shape[1]] @ part.T
    return total


def _snapped(position: Array, bounds: Bounds) -> Array:
    for end, nearest in ((bounds.low_mm, position.min()), (bounds.high_mm, position.max())):
        if abs(nearest - end) <= TRAVEL_SLACK_MM:
            position = np.where(np.abs(position - end) <= TRAVEL_SLACK_MM, end, position)
    return position
