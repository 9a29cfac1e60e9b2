"""One axis in limited preview: its designs, the state of its plants, and the command of a piece."""

from __future__ import annotations

from collections.abc import Set
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from stillpath.compensation._preview_kernels import advance_state, advance_window, impulse_states
from stillpath.compensation._window_kernels import Functions, Memory, Stepping, solve_windows
from stillpath.compensation.base import DesignError
from stillpath.compensation.basis import BASES, ce_opt_basis, robust_basis
from stillpath.compensation.block_response import BlockResponse
from stillpath.compensation.lifted_window import LiftedWindow, condensed, lifted_window
from stillpath.compensation.preview import PreviewDesign
from stillpath.compensation.window_problem import (
    TRAVEL_SLACK_MM,
    Bounds,
    functions_of,
    refusing_singular,
    within_bounds,
)
from stillpath.models.arrays import Array, Ints
from stillpath.models.plants import DiscretePlant

__all__ = [
    "BAND_MARGIN",
    "GENTLE_RUNG",
    "LADDER",
    "WEIGHT_REST",
    "WEIGHT_TRAVEL",
    "AxisCommand",
    "AxisTask",
    "Designs",
    "PreviewAxis",
    "Rung",
    "designs",
    "functions_within",
]


@dataclass(frozen=True, slots=True)
class Rung:
    """One step of the ladder: number of functions (per 300 samples) and price of acceleration.

    Both refer to samples of 1 ms: at another sampling time the same ladder is another design.
    """

    n: int
    price: float


LADDER = (
    *(Rung(90, price) for price in (0.03, 0.1, 0.3, 1.0)),
    *(Rung(n, 3.0) for n in (75, 60, 45, 34, 26, 18)),
)
"""Designs from the most accurate to the gentlest."""
GENTLE_RUNG = 3
"""Last rung with all functions: gentler ones trade accuracy for smoothness."""
BAND_MARGIN = 1.2
"""Ratio of a command's bandwidth to its model's band. The price makes the cut-off gradual: little
is left beyond the band, while a cut-off right at its edge would cost accuracy within it."""

REST_FUNCTIONS = 64
"""Most functions (per 300 samples) in windows with a rest, which are solved individually."""
ROBUST_CHOICE = 1.1
"""The robust basis selects n of this many times n functions."""
WEIGHT_TRAVEL = 0.2
WEIGHT_REST = 0.5
"""Ringing during a rest is above the end of a line. A smaller weight allows more of it without any
gain while extruding; from 1 on, accuracy while extruding suffers."""
_FORGOTTEN = 1e-12
"""A vibration that has decayed to this share is dropped from the state."""
_NESTED = {"ce-opt", "dct"}
"""Bases whose n functions are the first n of any larger number."""


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
class _Drive:
    """The part of a piece's command that does not depend on the plants' states.

    Attributes
    ----------
    path_mm, weight : ndarray, shape (windows * update + window,)
        Those of the task, relative to the start of the path, extended beyond its end.
    slid_mm : ndarray, shape (components, n), or (components, 0) where the path is the target
        What is added to the targets of the set's components.
    command : ndarray, shape (windows, update)
        S y_d of every window.
    state : ndarray, shape (windows, nz)
        H y_d.
    memory : Memory
        Windows solved individually.
    """

    task: AxisTask
    rung: int
    path_mm: Array
    weight: Array
    slid_mm: Array
    command: Array
    state: Array
    memory: Memory


class Designs:
    """The designs of an axis, computed when first needed.

    Attributes
    ----------
    ladder : tuple of Rung
        `LADDER` with at most as many functions as the model's band allows; equal rungs are merged.
    at_rests : Condensed
        Reduced form of `lifted` for windows with rests.
    """

    def __init__(self, lifted: LiftedWindow, basis: str, most: int = 300) -> None:
        self.lifted = lifted
        capped = (Rung(min(rung.n, most), rung.price) for rung in LADDER)
        self.ladder = tuple(dict.fromkeys(capped))
        self._basis = basis
        self._made: dict[tuple[int, float], PreviewDesign] = {}
        self._set = lifted.lifted_set()
        self._functions: dict[int, Array] = {}
        self.at_rests = condensed(lifted)
        self._rest_functions: dict[PreviewDesign, Functions] = {}

    def rest_functions(self, rung: int) -> Functions:
        """Return the functions for a rung's windows that contain a rest (`Condensed`)."""
        design = self.design(rung, REST_FUNCTIONS)
        if design not in self._rest_functions:
            made = functions_of(design, at_rests=True, part=self.at_rests)
            self._rest_functions[design] = made
        return self._rest_functions[design]

    def design(self, rung: int, most: int = 300) -> PreviewDesign:
        """Return the design of a rung, with at most `most` functions per 300 samples."""
        step = self.ladder[rung]
        n = self._scaled(min(step.n, most))
        if (n, step.price) not in self._made:
            psi = self._psi(n)
            self._made[n, step.price] = PreviewDesign(self.lifted, n, self._basis, step.price, psi)
        return self._made[n, step.price]

    def check(self) -> None:
        """Raise the DesignError of the first rung if all rungs fail."""
        refusals = []
        for rung in range(len(self.ladder)):
            try:
                self.design(rung)
            except DesignError as error:
                refusals.append(error)
            else:
                return
        raise refusals[0]

    def _psi(self, n: int) -> Array:
        size = self._scaled(self.ladder[0].n) if self._basis in _NESTED else n
        if size not in self._functions:
            self._functions[size] = self._made_for(size)
        return self._functions[size]

    def _made_for(self, n: int) -> Array:
        # With equal members all functions are equally robust.
        if self._basis == "robust" and len(self.lifted.integrated) == 1:
            return ce_opt_basis(self._set.gram, n)
        if self._basis != "robust":
            return BASES[self._basis](self._set, n)
        # Far above its modes a set also agrees, as it hardly responds: choose among the directions
        # of largest gain (4.10).
        window = self.lifted.window
        kept = min(window, round(ROBUST_CHOICE * n))
        return robust_basis(self._set.gram, self._set.mean, n, window - kept)

    def _scaled(self, n: int) -> int:
        return max(4, round(n * self.lifted.window / 300))


@lru_cache(maxsize=12)
def designs(
    plants: tuple[DiscretePlant, ...],
    weights: tuple[float, ...],
    window: int,
    update: int,
    basis: str,
    most: int = 300,
) -> Designs:
    """Return the designs of an axis, cached by recent use (up to 30 MB each for sets)."""
    return Designs(lifted_window(plants, weights, window, update), basis, most)


def functions_within(band_hz: tuple[float, float] | None, dt_s: float) -> int:
    """Return the most functions per 300 samples that keep a command within its model's band.

    n functions over a window T span frequencies up to n / (2 T).
    """
    return 300 if band_hz is None else max(4, int(2 * 300 * dt_s * BAND_MARGIN * band_hz[1]))


class PreviewAxis:
    """One axis: its designs and the state of its plants.

    Attributes
    ----------
    rung, next_rung : int
        Rung at which this piece starts, and the next one once this is committed.
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
        self.rung = self.next_rung = 0
        self._made: _Drive | None = None
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
        self.rung = self.next_rung
        self._made = None

    def commit_as(self, command: Array) -> None:
        """Mark a command (n,) derived from the last one as executed.

        Unlike what is observed, a piece shares its last sample with what follows.
        """
        self.observe(command[:-1])
        self._move_origin(float(command[-1]))
        self.rung = self.next_rung
        self._made = None

    def answer(self, member: int, command: Array) -> Array:
        """Return the response (n,) of a member of the set to a command (n,)."""
        first = sum(p.order for p in self._plants[:member])
        respond = self._responses[member]
        self._move_origin(float(command[0]))
        state = self._states[first : first + self._plants[member].order]
        return respond(self._origin, state, command)

    @cached_property
    def _responses(self) -> list[BlockResponse]:
        return [BlockResponse(plant) for plant in self._plants]

    def windows_outside(self, bounds: Bounds, command: Array) -> set[int]:
        """Return the windows in which a command (n,) exceeds the bounds, and those before them."""
        bend, step = _changes(command)
        slack = 1.0 + 1e-9
        outside = command < bounds.low_mm - TRAVEL_SLACK_MM
        outside |= command > bounds.high_mm + TRAVEL_SLACK_MM
        outside |= np.abs(bend) > slack * bounds.accel
        outside |= np.abs(step) > slack * bounds.speed
        windows = np.unique(np.flatnonzero(outside) // self.update)
        return {int(w) for w in windows} | {int(w) - 1 for w in windows if w > 0}

    def command(
        self, rung: int, task: AxisTask, careful: Set[int], targets_mm: Array | None = None
    ) -> AxisCommand:
        """Return the command of a piece; windows with rests and `careful` ones are solved singly.

        Parameters
        ----------
        rung : int
            Index into `Designs.ladder`.
        careful : set of int
            Windows in which the bounds are kept.
        targets_mm : ndarray, shape (members, n), optional
            Desired motion of each member; by default the path.
        """
        drive = self._drive(rung, task, targets_mm)
        self._move_origin(float(task.path_mm[0]))
        u, last_states = self._solved(rung, task, careful, drive)
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
        self, rung: int, task: AxisTask, careful: Set[int], drive: _Drive
    ) -> tuple[Array, Array]:
        """Return the command of all windows, and the states where the last one begins."""
        design, window, update = self._designs.design(rung), self.window, self.update
        bounds = task.bounds.seen_from(self._origin)
        alone = np.zeros(len(drive.command), bool)
        alone[list(careful)] = True
        lifted = self._designs.lifted
        functions = functions_of(design, at_rests=False)
        rest_functions = self._designs.rest_functions(rung)
        stepping = Stepping(
            design.command_gain,
            design.state_gain,
            lifted.advance,
            design.state_drive,
            drive.command,
            drive.state,
        )

        windows = len(drive.command)
        u = np.empty(windows * update)
        z, w = np.append(self._states, [0.0, 0.0]), 0
        for until in (windows - 1, windows):
            last_states = z[:-2].copy()
            while w < until:
                with refusing_singular():
                    w, tied = solve_windows(
                        stepping,
                        functions,
                        rest_functions,
                        self._designs.at_rests.squeeze,
                        drive.path_mm,
                        lifted.target,
                        drive.slid_mm,
                        drive.weight,
                        task.stops,
                        alone,
                        bounds.limits(),
                        drive.memory,
                        z,
                        w,
                        until,
                        u,
                    )
                if w == until:
                    break
                # This window needs its bounds.
                start = w * update
                path_mm = drive.path_mm[start : start + window]
                used = rest_functions if len(tied.moving) > 1 else functions
                committed = u[start : start + update]
                committed[:] = within_bounds(used, tied, z, path_mm, bounds)[:update]
                drive.memory.known[w], drive.memory.z[w] = True, z
                drive.memory.committed[w] = committed
                advance_window(lifted.advance, design.state_drive, z, committed)
                w += 1
        return u, last_states

    def _drive(self, rung: int, task: AxisTask, targets_mm: Array | None) -> _Drive:
        """Return the command of a rung for a piece; the last result is reused if both are the same.

        A piece is often requested again with a few more windows within bounds. Windows with the
        same initial state are then not solved again.
        """
        made = self._made
        if made is not None and targets_mm is None and made.task is task and made.rung == rung:
            return made
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
        command = nodes @ design.spread.T
        state = nodes @ design.state_spread.T
        weight = np.full(len(padded), WEIGHT_REST)
        weight[: len(path)] = task.weight
        memory = Memory(
            np.zeros(len(command), bool), np.empty(state.shape), np.empty(command.shape)
        )
        made = _Drive(task, rung, padded, weight, slid, command, state, memory)
        # Separate targets are passed in an array that changes: do not cache them.
        self._made = made if targets_mm is None else None
        return made

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
