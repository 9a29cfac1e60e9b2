"""The product's main compensator: filtered basis functions in limited preview, X and Y apart.

Accuracy is set by the number of functions n, which is the command's bandwidth; the basis then
keeps the effort small. A run therefore takes, axis by axis, the largest n of a ladder whose command
stays within the machine's limits (two-step design, paper 003, remark 3.2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compensation._preview_kernels import advance_state, run_windows
from compensation.base import DesignError
from compensation.basis import ce_opt_basis
from compensation.preview import LiftedPlant, PreviewDesign, lifted_members, lifted_plant
from compensation.rests import solve_window
from models.machine import Machine
from models.plants import DiscretePlant, plant_set

__all__ = ["LADDER", "PreviewFbf"]


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
EDGE_PRICES = (3.0, 12.0, 50.0, 200.0, 1000.0)
"""Prices of the increments at the edges of rests, relative to others, tried in this order: dear
edges make soft stops, and soft stops before a Z move take time."""
EDGE_SAMPLES = 4
WEIGHT_TRAVEL = 0.3
WEIGHT_REST = 0.05
ACCEL_RATIO = 2.0
"""The command may ask for at most this multiple of the planned path's own peak acceleration."""
RMS_RATIO = 1.5
"""The same for the rms acceleration, as long as that costs no functions."""
GENTLE_RUNG = 3


class PreviewFbf:
    """Limited-preview FBF for the two axes of a machine.

    Parameters
    ----------
    machine : Machine
        Plants of X and Y and the limits of the command.
    dt_s : float
        Sampling time of the path.
    basis : str
        `ce-opt` or `bspline`.
    window_s, update_s : float
        Preview window and how much of it is committed before the next one starts.

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
        window_s: float = 0.3,
        update_s: float = 0.15,
    ) -> None:
        window, update = round(window_s / dt_s), round(update_s / dt_s)
        self._dt_s = dt_s
        self._limits = machine.command
        self._axes = [
            _Axis(axis, plant_set(machine.axes[axis], dt_s).nominal, window, update, basis)
            for axis in ("x", "y")
        ]

    def reset(self, position_mm: NDArray[np.float64]) -> None:
        """Take the machine to stand still at `position_mm` (2,)."""
        for axis, position in zip(self._axes, position_mm, strict=True):
            axis.reset(float(position))

    def observe(self, command_mm: NDArray[np.float64]) -> None:
        """Let the machine follow a command (2, n) that was not ours."""
        for axis, command in zip(self._axes, command_mm, strict=True):
            axis.observe(command)

    def commit(self) -> None:
        """Take the last command as executed."""
        for axis in self._axes:
            axis.commit()

    def compensate(
        self,
        y_d_mm: NDArray[np.float64],
        extruding: NDArray[np.bool_],
        rests: NDArray[np.int64],
    ) -> NDArray[np.float64]:
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
        accel_limit = self.accel_limit_mm_s2(y_d_mm)
        bend = np.diff(y_d_mm, 2) / self._dt_s**2
        rms_limit = RMS_RATIO * float(np.sqrt(np.max(np.mean(bend**2, axis=1), initial=0.0)))
        return np.stack(
            [
                self._ladder(axis, y_d_mm[i], weight, stops, accel_limit, rms_limit)
                for i, axis in enumerate(self._axes)
            ]
        )

    def accel_limit_mm_s2(self, y_d_mm: NDArray[np.float64]) -> float:
        """Acceleration that the command of a path (2, n) may ask for."""
        ceiling = self._limits.accel_mm_s2
        path_accel = _peak(np.diff(y_d_mm, 2)) / self._dt_s**2
        return min(ceiling, max(ACCEL_RATIO * path_accel, 0.25 * ceiling))

    def _ladder(
        self,
        axis: _Axis,
        path: NDArray[np.float64],
        weight: NDArray[np.float64],
        stops: NDArray[np.int64],
        accel_limit: float,
        rms_limit: float,
    ) -> NDArray[np.float64]:
        dt = self._dt_s
        edges = stops[stops > 0]
        rung, edge_price = axis.rung, EDGE_PRICES[0]
        accel = speed = 0.0
        while rung < len(LADDER):
            command = axis.command(rung, path, weight, stops, edge_price)
            # The piece starts from a stand and ends in one.
            standing = np.concatenate([command[:1], command, command[-1:]])
            accels = np.abs(np.diff(standing, 2)) / dt**2
            accel = _peak(accels)
            speed = _peak(np.diff(command)) / dt
            fast = speed > self._limits.velocity_mm_s
            rms = float(np.sqrt(np.mean(accels**2)))
            rough = rms > rms_limit and rung < GENTLE_RUNG
            if accel <= accel_limit and not fast and not rough:
                # The next piece starts here, or higher where there was room to spare.
                roomy = accel < 0.5 * accel_limit and rms < 0.6 * rms_limit
                axis.next_rung = max(0, rung - 1) if roomy else rung
                return command
            # Stopping and starting at a rest is a matter of its own price, not of the bandwidth.
            hardest = int(np.argmax(accels))
            dearer = [p for p in EDGE_PRICES if p > edge_price]
            if (
                accel > accel_limit
                and dearer
                and np.min(np.abs(edges - hardest), initial=len(path)) <= EDGE_SAMPLES
            ):
                edge_price = dearer[0]
            else:
                rung += 1
        raise DesignError(
            f"axis {axis.name}: even the gentlest design asks for {accel:.0f} mm/s2 and "
            f"{speed:.0f} mm/s; allowed are {accel_limit:.0f} mm/s2 and "
            f"{self._limits.velocity_mm_s:.0f} mm/s (command limits of the machine)"
        )


class _Axis:
    """One axis: its designs, made when first asked for, and the state of its plant."""

    def __init__(
        self, name: str, plant: DiscretePlant, window: int, update: int, basis: str
    ) -> None:
        self.name, self.window, self.update = name, window, update
        self.rung = self.next_rung = 0
        self._basis = basis
        self._lifted: Sequence[LiftedPlant] = [lifted_plant(plant, 1.0, window, update)]
        self._designs: dict[tuple[int, float], PreviewDesign] = {}
        # The optimal functions are nested: those for n are the first n of those for more.
        self._nested = None
        if basis == "ce-opt":
            self._nested = ce_opt_basis(lifted_members(self._lifted).gram, max(r.n for r in LADDER))
        self._plants = [plant]
        self.reset(0.0)

    def design(self, rung: int, most: int = 300) -> PreviewDesign:
        step = LADDER[rung]
        n = max(4, round(min(step.n, most) * self.window / 300))
        if (n, step.price) not in self._designs:
            self._designs[n, step.price] = PreviewDesign(
                self._lifted, n, self._basis, step.price, self._nested
            )
        return self._designs[n, step.price]

    def reset(self, position: float) -> None:
        # States are kept relative to `origin`: the digits belong to the vibration.
        self._origin = position
        self._states = np.zeros(sum(p.order for p in self._plants))
        self._after = (self._origin, self._states)

    def observe(self, command: NDArray[np.float64]) -> None:
        if len(command) == 0:
            return
        origin = float(command[-1])
        self._move_origin(origin)
        row = 0
        for plant in self._plants:
            states = slice(row, row + plant.order)
            self._states[states] = advance_state(
                plant.a, plant.b, self._states[states], command[:-1] - origin
            )
            row = states.stop

    def commit(self) -> None:
        self._origin, self._states = self._after
        self.rung = self.next_rung

    def _move_origin(self, origin: float) -> None:
        shift = self._origin - origin
        self._states = self._states + np.concatenate([p.rest_state(shift) for p in self._plants])
        self._origin = origin

    def command(
        self,
        rung: int,
        path: NDArray[np.float64],
        weight: NDArray[np.float64],
        stops: NDArray[np.int64],
        edge_price: float,
    ) -> NDArray[np.float64]:
        design, resting_design = self.design(rung), self.design(rung, REST_FUNCTIONS)
        n, window, update = len(path), self.window, self.update
        windows = -(-n // update)
        self._move_origin(float(path[0]))
        origin = self._origin
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
        resting = np.zeros(windows, dtype=bool)
        for a, b in stops:
            resting[np.searchsorted(starts, a - window, "right") : np.searchsorted(starts, b)] = (
                True
            )
        last_states = z[:-2]
        w = 0
        while w < windows:
            start = w * update
            if w == windows - 1:
                last_states = z[:-2].copy()
            if resting[w]:
                near = (stops[:, 0] < start + window) & (stops[:, 1] > start)
                committed = solve_window(
                    resting_design,
                    z,
                    padded[start : start + window],
                    weights[start : start + window],
                    stops[near] - start,
                    edge_price,
                )[:update]
                u[start : start + update] = committed
                z = _advanced(design, z, committed)
                w += 1
            else:
                following = w + int(np.argmax(np.append(resting[w:], True)))
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
        begun = (windows - 1) * update
        states = np.empty_like(self._states)
        row = 0
        for plant in self._plants:
            part = slice(row, row + plant.order)
            states[part] = advance_state(plant.a, plant.b, last_states[part], u[begun : n - 1])
            states[part] -= plant.rest_state(end)
            row = part.stop
        self._after = (float(path[-1]), states)
        return np.asarray(u[:n] + origin)


def _advanced(
    design: PreviewDesign, z: NDArray[np.float64], committed: NDArray[np.float64]
) -> NDArray[np.float64]:
    """State after the committed samples."""
    following = np.empty_like(z)
    row = 0
    for member in design.members:
        states = slice(row, row + member.plant.order)
        following[states] = member.advance @ z[states] + member.drive @ committed
        row = states.stop
    following[-2], following[-1] = committed[-1], committed[-2]
    return following


def _peak(values: NDArray[np.float64]) -> float:
    return float(np.max(np.abs(values), initial=0.0))
