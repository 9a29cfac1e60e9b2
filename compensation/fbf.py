"""The product's main compensator: filtered basis functions in limited preview, X and Y apart.

Accuracy is set by the number of functions n, which is the command's bandwidth; the basis then
keeps the effort small. A run therefore takes, axis by axis, the largest n of a ladder whose command
stays within the machine's limits (two-step design, paper 003, remark 3.2).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from compensation._preview_kernels import run_windows
from compensation.base import DesignError
from compensation.preview import LiftedPlant, PreviewDesign, lifted_plant
from compensation.rests import solve_window
from models.machine import Machine
from models.plants import DiscretePlant, plant_set

__all__ = ["LADDER", "PreviewFbf"]

LADDER = (120, 105, 90, 75, 66, 58, 51, 45, 40, 35, 30, 26, 22, 18)
"""Numbers of functions for a window of 300 samples, tried from the largest down."""

WEIGHT_TRAVEL = 0.3
WEIGHT_REST = 0.05
ACCEL_RATIO = 2.0
"""The command may ask for at most this multiple of the planned path's own peak acceleration."""


class PreviewFbf:
    """Limited-preview FBF for the two axes of a machine.

    Parameters
    ----------
    machine : Machine
        Plants of X and Y, travel and command limits.
    dt_s : float
        Sampling time of the path.
    basis : str
        `ce-opt` or `bspline`.
    window_s, update_s : float
        Preview window and how much of it is committed before the next one starts.
    """

    name = "fbf"
    handles_rests = True
    lead_s = 0.0
    tail_s = 0.15

    def __init__(
        self,
        machine: Machine,
        dt_s: float,
        *,
        basis: str = "ce-opt",
        window_s: float = 0.3,
        update_s: float = 0.15,
    ) -> None:
        self._dt_s = dt_s
        self._window = round(window_s / dt_s)
        self._update = round(update_s / dt_s)
        self._limits = machine.command
        self._axes: list[_Axis] = []
        for axis in ("x", "y"):
            plants = plant_set(machine.axes[axis], dt_s)
            self._axes.append(
                _Axis([(1.0, plants.nominal)], self._window, self._update, basis, axis)
            )

    def compensate(
        self,
        y_d_mm: NDArray[np.float64],
        extruding: NDArray[np.bool_],
        rests: NDArray[np.int64],
    ) -> NDArray[np.float64]:
        """Command of a run that starts at rest and stands still at its end.

        Parameters
        ----------
        y_d_mm : ndarray, shape (2, n)
            Planned X and Y; the axis is at rest at the first sample and stays at the last.
        extruding : ndarray of bool, shape (n,)
        rests : ndarray of int64, shape (k, 2)
            Ranges [a, b) of samples in which u(i) = u(i - 1).

        Returns
        -------
        ndarray, shape (2, n)

        Raises
        ------
        DesignError
            When no rung of the ladder keeps the machine's limits.
        """
        weight = np.where(extruding, 1.0, WEIGHT_TRAVEL)
        for a, b in rests:
            weight[a:b] = WEIGHT_REST
        return np.stack(
            [self._axis_command(axis, y_d_mm[i], weight, rests) for i, axis in enumerate(self._axes)]
        )

    def _axis_command(
        self,
        axis: _Axis,
        path: NDArray[np.float64],
        weight: NDArray[np.float64],
        rests: NDArray[np.int64],
    ) -> NDArray[np.float64]:
        dt = self._dt_s
        path_accel = _peak(np.diff(path, 2)) / dt**2
        accel_limit = min(
            self._limits.accel_mm_s2, max(ACCEL_RATIO * path_accel, 0.1 * self._limits.accel_mm_s2)
        )
        for rung in range(axis.rung, len(LADDER)):
            command = axis.command(rung, path, weight, rests)
            accel = _peak(np.diff(command, 2)) / dt**2
            if accel <= accel_limit and _peak(np.diff(command)) / dt <= self._limits.velocity_mm_s:
                # The next run starts here, or one rung higher where there was room to spare.
                axis.rung = max(0, rung - 1) if accel < 0.6 * accel_limit else rung
                return command
        raise DesignError(
            f"axis {axis.name}: even {LADDER[-1]} functions break the machine's command limits "
            f"({accel_limit:.0f} mm/s2, {self._limits.velocity_mm_s:.0f} mm/s)"
        )


class _Axis:
    """Designs of one axis, made when first asked for."""

    def __init__(
        self,
        members: Sequence[tuple[float, DiscretePlant]],
        window: int,
        update: int,
        basis: str,
        name: str,
    ) -> None:
        self.name = name
        self.rung = 0
        self._basis = basis
        self._window, self._update = window, update
        self._lifted: list[LiftedPlant] = [lifted_plant(p, w, window, update) for w, p in members]
        self._designs: dict[int, PreviewDesign] = {}

    def design(self, rung: int) -> PreviewDesign:
        if rung not in self._designs:
            n = max(4, round(LADDER[rung] * self._window / 300))
            self._designs[rung] = PreviewDesign(self._lifted, n, self._basis)
        return self._designs[rung]

    def command(
        self,
        rung: int,
        path: NDArray[np.float64],
        weight: NDArray[np.float64],
        rests: NDArray[np.int64],
    ) -> NDArray[np.float64]:
        design = self.design(rung)
        n, window, update = len(path), self._window, self._update
        windows = -(-n // update)
        # Coordinates relative to the start keep the digits for the vibration.
        origin = path[0]
        padded = np.concatenate(
            [path - origin, np.full(windows * update + window - n, path[-1] - origin)]
        )
        weights = np.concatenate([weight, np.ones(len(padded) - n)])
        views = np.lib.stride_tricks.sliding_window_view(padded, window)[: windows * update : update]
        command_drive = views @ design.path_gain.T
        state_drive = views @ design.state_path_gain.T

        u = np.empty(windows * update)
        z = design.rest_state(0.0)
        starts = np.arange(windows) * update
        resting = np.zeros(windows, dtype=bool)
        for a, b in rests:
            resting |= (starts < b) & (starts + window > a)
        w = 0
        while w < windows:
            if not resting[w]:
                following = w + int(np.argmax(np.append(resting[w:], True)))
                run_windows(
                    design.command_gain, design.state_gain, command_drive, state_drive, z, w, following, u
                )
                w = following
                continue
            k = w * update
            local = rests[(rests[:, 0] < k + window) & (rests[:, 1] > k)] - k
            committed = solve_window(design, z, padded[k : k + window], weights[k : k + window], local)
            committed = committed[:update]
            u[k : k + update] = committed
            z = _advance(design, z, committed)
            w += 1
        return np.asarray(u[:n] + origin)


def _advance(
    design: PreviewDesign, z: NDArray[np.float64], committed: NDArray[np.float64]
) -> NDArray[np.float64]:
    """State after the committed samples."""
    following = np.empty_like(z)
    row = 0
    for member in design.members:
        states = slice(row, row + len(member.plant.b))
        following[states] = member.advance @ z[states] + member.drive @ committed
        row = states.stop
    following[-2], following[-1] = committed[-1], committed[-2]
    return following


def _peak(values: NDArray[np.float64]) -> float:
    return float(np.max(np.abs(values), initial=0.0))
