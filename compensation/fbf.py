"""The product's main compensator: filtered basis functions in limited preview, X and Y apart.

Accuracy is set by the number of functions n, which is the command's bandwidth; the basis then
keeps the effort small. A piece therefore takes, axis by axis, the first design of a ladder whose
command stays as smooth as the machine needs it (two-step design, paper 003, remark 3.2). Windows in
which it still leaves a bound of the machine are solved again within the bounds.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from compensation._preview_kernels import advance_state, run_windows
from compensation.base import DesignError
from compensation.basis import BASES
from compensation.lifted_window import LiftedWindow, lifted_window
from compensation.minimax import minimax_weights
from compensation.preview import PreviewDesign
from compensation.window_problem import TRAVEL_SLACK_MM, Bounds, solve_window
from models.machine import Machine
from models.plants import DiscretePlant, PlantSet, plant_set

__all__ = ["LADDER", "ROBUST", "PreviewFbf", "Rung"]

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

ROBUST = ("off", "ensemble", "minimax")
"""One nominal plant; least squares over the set with its weights; weights of the worst case."""


@dataclass(frozen=True, slots=True)
class Rung:
    """One step of the ladder: number of functions (per 300 samples) and price of acceleration."""

    n: int
    price: float


LADDER = (
    *(Rung(90, price) for price in (0.03, 0.1, 0.3, 1.0)),
    *(Rung(n, 3.0) for n in (75, 60, 45, 34, 26, 18)),
)
"""Designs from the most accurate to the gentlest."""

REST_FUNCTIONS = 64
"""Most functions (per 300 samples) in windows that hold a rest, which are solved one by one."""
WEIGHT_TRAVEL = 0.3
WEIGHT_REST = 0.05
ACCEL_RATIO = 2.0
"""The command may ask for at most this multiple of the planned path's own peak acceleration."""
RMS_RATIO = 1.5
"""The same for the rms acceleration, as long as that costs no functions."""
GENTLE_RUNG = 3
_BOUNDED_SHARE = 0.2
"""Solve windows again within bounds if so few leave them; otherwise take a gentler design."""
_BOUNDED_ROUNDS = 4
_NESTED = {"ce-opt", "robust", "dct"}
"""Bases whose functions for n are the first n of those for more."""


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
    window_s, update_s : float
        Preview window and how much of it is committed before the next one starts.

    Raises
    ------
    DesignError
        For an unknown basis or robust mode, or a design that fails its acceptance.

    Notes
    -----
    The machine's vibration is carried from one piece to the next: call `commit` when the last
    command was used, `observe` for motion that leaves as it came, `reset` when the position jumps.
    """

    name = "fbf"
    lead_s = 0.0
    tail_s = 0.0

    def __init__(
        self,
        machine: Machine,
        dt_s: float,
        *,
        basis: str = "ce-opt",
        robust: str = "off",
        window_s: float = 0.3,
        update_s: float = 0.15,
    ) -> None:
        if basis not in BASES:
            raise DesignError(f"no basis is called {basis!r}; there are {', '.join(BASES)}")
        if robust not in ROBUST:
            raise DesignError(f"no robust mode is called {robust!r}; there are {', '.join(ROBUST)}")
        window, update = round(window_s / dt_s), round(update_s / dt_s)
        self._dt_s = dt_s
        self._limits = machine.command
        self._travel = [machine.travel[axis] for axis in ("x", "y")]
        self._axes = []
        for axis in ("x", "y"):
            plants, weights = _chosen(plant_set(machine.axes[axis], dt_s), robust)
            self._axes.append(_Axis(axis, _designs(plants, weights, window, update, basis)))

    def reset(self, position_mm: Array) -> None:
        """Take the machine to stand still at `position_mm` (2,)."""
        for axis, position in zip(self._axes, position_mm, strict=True):
            axis.reset(float(position))

    def observe(self, command_mm: Array) -> None:
        """Let the machine follow a command (2, n) that was not ours."""
        for axis, command in zip(self._axes, command_mm, strict=True):
            axis.observe(command)

    def commit(self) -> None:
        """Take the last command as executed."""
        for axis in self._axes:
            axis.commit()

    def compensate(self, y_d_mm: Array, extruding: NDArray[np.bool_], rests: Ints) -> Array:
        """Command of a piece that starts and ends standing still on the path.

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
            When no rung of the ladder keeps the machine's limits.
        """
        n = y_d_mm.shape[1]
        weight = np.where(extruding, 1.0, WEIGHT_TRAVEL)
        for a, b in rests:
            weight[a:b] = WEIGHT_REST
        ends = np.array([[-1, 1], [n, n + self._axes[0].window]], dtype=np.int64)
        stops = np.concatenate([ends[:1], rests, ends[1:]])
        bend = np.diff(y_d_mm, 2) / self._dt_s**2
        rms_limit = RMS_RATIO * float(np.sqrt(np.max(np.mean(bend**2, axis=1), initial=0.0)))
        accel_limit = self.accel_limit_mm_s2(y_d_mm)
        commands = []
        for axis, travel, path in zip(self._axes, self._travel, y_d_mm, strict=True):
            bounds = Bounds(
                accel_limit * self._dt_s**2,
                self._limits.velocity_mm_s * self._dt_s,
                # The path itself may touch the ends of the travel, or be judged elsewhere.
                min(travel.min_mm, float(path.min())),
                max(travel.max_mm, float(path.max())),
            )
            command = self._ladder(axis, path, weight, stops, bounds, rms_limit)
            # Off the rounding by which a bounded solution may miss the end of the travel.
            commands.append(np.clip(command, bounds.low_mm, bounds.high_mm))
        return np.stack(commands)

    def accel_limit_mm_s2(self, y_d_mm: Array) -> float:
        """Acceleration that the command of a path (2, n) may ask for."""
        ceiling = self._limits.accel_mm_s2
        path_accel = float(np.max(np.abs(np.diff(y_d_mm, 2)), initial=0.0)) / self._dt_s**2
        return min(ceiling, max(ACCEL_RATIO * path_accel, 0.25 * ceiling))

    def _ladder(
        self, axis: _Axis, path: Array, weight: Array, stops: Ints, bounds: Bounds, rms_limit: float
    ) -> Array:
        dt = self._dt_s
        rung, last = axis.rung, len(LADDER) - 1
        careful: set[int] = set()
        rounds = 0
        asked = ""
        while True:
            command = axis.command(rung, path, weight, stops, bounds, careful)
            # The piece starts from a stand and ends in one.
            standing = np.concatenate([command[:1], command, command[-1:]])
            bend, step = np.diff(standing, 2), np.diff(standing)[1:]
            rms = float(np.sqrt(np.mean(bend**2))) / dt**2
            if not careful:
                asked = (
                    f"{np.max(np.abs(bend), initial=0.0) / dt**2:.0f} mm/s2, "
                    f"{np.max(np.abs(step), initial=0.0) / dt:.0f} mm/s and "
                    f"{command.min():.3f} to {command.max():.3f} mm"
                )
            if rms <= rms_limit or rung >= GENTLE_RUNG:
                if all(bounds.kept(bend, step, command)):
                    # The next piece starts here, or higher where there was room to spare.
                    roomy = rms < 0.6 * rms_limit or rung > GENTLE_RUNG
                    axis.next_rung = max(0, rung - 1) if roomy else rung
                    return command
                concerned = axis.windows_outside(bounds, bend, step, command)
                few = len(careful | concerned) <= max(2, _BOUNDED_SHARE * len(path) / axis.update)
                if rounds < _BOUNDED_ROUNDS and not concerned <= careful and (few or rung == last):
                    careful |= concerned
                    rounds += 1
                    continue
            if rung == last:
                break
            rung, careful, rounds = rung + 1, set(), 0
        raise DesignError(
            f"axis {axis.name}: even the gentlest design asks for {asked}; allowed are "
            f"{bounds.accel / dt**2:.0f} mm/s2, {self._limits.velocity_mm_s:.0f} mm/s and "
            f"{bounds.low_mm:g} to {bounds.high_mm:g} mm (command and travel limits of the machine)"
        )


class _Designs:
    """The designs of an axis, made when first asked for."""

    def __init__(self, lifted: LiftedWindow, basis: str) -> None:
        self.lifted = lifted
        self._basis = basis
        self._made: dict[tuple[int, float], PreviewDesign] = {}
        self._set = lifted.lifted_set()
        self._functions: dict[int, Array] = {}

    def design(self, rung: int, most: int = 300) -> PreviewDesign:
        step = LADDER[rung]
        n = self._scaled(min(step.n, most))
        if (n, step.price) not in self._made:
            psi = self._psi(n)
            self._made[n, step.price] = PreviewDesign(self.lifted, n, self._basis, step.price, psi)
        return self._made[n, step.price]

    def _psi(self, n: int) -> Array:
        size = self._scaled(max(rung.n for rung in LADDER)) if self._basis in _NESTED else n
        if size not in self._functions:
            self._functions[size] = BASES[self._basis](self._set, size)
        return self._functions[size]

    def _scaled(self, n: int) -> int:
        return max(4, round(n * self.lifted.window / 300))


@lru_cache(maxsize=32)
def _designs(
    plants: tuple[DiscretePlant, ...],
    weights: tuple[float, ...],
    window: int,
    update: int,
    basis: str,
) -> _Designs:
    """Designs of an axis, kept as long as the process works with this machine revision."""
    return _Designs(lifted_window(plants, weights, window, update), basis)


def _chosen(plants: PlantSet, robust: str) -> tuple[tuple[DiscretePlant, ...], tuple[float, ...]]:
    """Plants and weights that a robust mode looks at."""
    if robust == "off" or len(plants.members) < 2:
        return (plants.nominal,), (1.0,)
    weights = minimax_weights(plants) if robust == "minimax" else plants.weights
    used = weights > 0
    return (
        tuple(p for p, w in zip(plants.members, used, strict=True) if w),
        tuple(float(w) for w in weights[used]),
    )


class _Axis:
    """One axis: its designs and the state of its plants."""

    def __init__(self, name: str, designs: _Designs) -> None:
        self.name, self._designs = name, designs
        self.window, self.update = designs.lifted.window, designs.lifted.update
        self._plants = designs.lifted.plants
        self.rung = self.next_rung = 0
        self.reset(0.0)

    def reset(self, position: float) -> None:
        # States are kept relative to `origin`: the digits belong to the vibration.
        self._origin = position
        self._states = np.zeros(sum(p.order for p in self._plants))
        self._after = (self._origin, self._states)

    def observe(self, command: Array) -> None:
        if len(command) == 0:
            return
        origin = float(command[-1])
        self._move_origin(origin)
        self._states = self._advanced(self._states, command[:-1] - origin)

    def commit(self) -> None:
        self._origin, self._states = self._after
        self.rung = self.next_rung

    def windows_outside(self, bounds: Bounds, bend: Array, step: Array, command: Array) -> set[int]:
        """Windows whose command leaves the bounds, and those before them."""
        slack = 1.0 + 1e-9
        outside = command < bounds.low_mm - TRAVEL_SLACK_MM
        outside |= command > bounds.high_mm + TRAVEL_SLACK_MM
        outside |= np.abs(bend) > slack * bounds.accel
        outside[1:] |= np.abs(step[: len(command) - 1]) > slack * bounds.speed
        windows = np.unique(np.flatnonzero(outside) // self.update)
        return {int(w) for w in windows} | {int(w) - 1 for w in windows if w > 0}

    def command(
        self,
        rung: int,
        path: Array,
        weight: Array,
        stops: Ints,
        bounds: Bounds,
        careful: set[int],
    ) -> Array:
        """Command of a piece; windows with rests and `careful` ones are solved one by one."""
        design = self._designs.design(rung)
        resting_design = self._designs.design(rung, REST_FUNCTIONS)
        n, window, update = len(path), self.window, self.update
        windows = -(-n // update)
        self._move_origin(float(path[0]))
        origin = self._origin
        bounds = bounds.seen_from(origin)
        padding = windows * update + window - n
        padded = np.concatenate([path - origin, np.full(padding, path[-1] - origin)])
        weights = np.concatenate([weight, np.full(padding, WEIGHT_REST)])
        views = np.lib.stride_tricks.sliding_window_view(padded, window)[
            : windows * update : update
        ]
        command_drive = views @ design.path_gain.T
        state_drive = views @ design.state_path_gain.T

        u = np.empty(windows * update)
        z = np.append(self._states, [0.0, 0.0])
        starts = np.arange(windows) * update
        apart = np.isin(np.arange(windows), list(careful))
        for a, b in stops:
            apart[np.searchsorted(starts, a - window, "right") : np.searchsorted(starts, b)] = True
        last_states = z[:-2]
        w = 0
        while w < windows:
            start = w * update
            if w == windows - 1:
                last_states = z[:-2].copy()
            if apart[w]:
                near = (stops[:, 0] < start + window) & (stops[:, 1] > start)
                span = slice(start, start + window)
                committed = solve_window(
                    resting_design if near.any() else design,
                    z,
                    padded[span],
                    weights[span],
                    stops[near] - start,
                    bounds,
                )[:update]
                u[start : start + update] = committed
                z = design.advanced(z, committed)
                w += 1
            else:
                following = w + int(np.argmax(np.append(apart[w:], True)))
                run_windows(
                    design.command_gain,
                    design.state_gain,
                    command_drive,
                    state_drive,
                    z,
                    w,
                    following,
                    u,
                )
                w = following
        # The windows run on past the end of the path, where the command stands.
        end = path[-1] - origin
        u[n - 1] = end
        states = self._advanced(last_states, u[(windows - 1) * update : n - 1])
        self._after = (float(path[-1]), states - self._resting(end))
        return np.asarray(u[:n] + origin)

    def _move_origin(self, origin: float) -> None:
        self._states = self._states + self._resting(self._origin - origin)
        self._origin = origin

    def _resting(self, position: float) -> Array:
        return np.concatenate([p.rest_state(position) for p in self._plants])

    def _advanced(self, states: Array, command: Array) -> Array:
        parts, row = [], 0
        for plant in self._plants:
            part = states[row : row + plant.order]
            parts.append(advance_state(plant.a, plant.b, part, command))
            row += plant.order
        return np.concatenate(parts)
