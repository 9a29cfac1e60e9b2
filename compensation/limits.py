"""Where a command asks more of the motors than they bear, and a gentler one around such places."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d

from stillpath.models.machine import Machine

__all__ = ["CommandBounds", "eased", "smoothed", "window"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_ROUNDED = 1.0 + 1e-9
_REACH_S = 0.016
"""A command is replaced within twice this of a place, and partly within twice as much."""
_PASSES = 4
"""The way over to a gentler command may exceed the limits too; then it begins earlier."""


class CommandBounds:
    """Speed and acceleration that a machine allows to a command of X and Y.

    Parameters
    ----------
    machine : Machine
    dt_s : float
        Sampling time of the commands.
    """

    def __init__(self, machine: Machine, dt_s: float) -> None:
        limits = machine.command
        axes = [limits.of("x"), limits.of("y")]
        self._axes = [[getattr(one, name) * dt_s**k for one in axes] for name, k in _ORDERS]
        motors = limits.motors
        self._motors = [
            None if motors is None or (most := getattr(motors, name)) is None else most * dt_s**k
            for name, k in _ORDERS
        ]

    def beyond(self, u_mm: Array, wanted_mm: Array | None = None) -> Mask:
        """Return where a command (2, n) exceeds the limits, shape (2, n).

        Both rows are marked where X and Y together ask too much of a motor of a CoreXY.

        Parameters
        ----------
        wanted_mm : ndarray, shape (2, n), optional
            What this one needs anywhere is allowed everywhere.
        """
        beyond = np.zeros(u_mm.shape, np.bool_)
        for order, axes, motors in zip((1, 2), self._axes, self._motors, strict=True):
            for mixed, most in ((_separate, np.array(axes)), (_together, motors)):
                if most is None:
                    continue
                if wanted_mm is not None:
                    own = np.abs(np.diff(mixed(wanted_mm), order)).max(axis=1, initial=0.0)
                    most = np.maximum(own, most)
                over = np.abs(np.diff(mixed(u_mm), order)) > _ROUNDED * np.reshape(most, (-1, 1))
                beyond[:, order:] |= over if mixed is _separate else over.any(axis=0)
        return beyond


_ORDERS = (("velocity_mm_s", 1), ("accel_mm_s2", 2))


def _separate(u_mm: Array) -> Array:
    return u_mm


def _together(u_mm: Array) -> Array:
    """Return the way of the motors of a CoreXY."""
    return np.stack([u_mm[0] + u_mm[1], u_mm[0] - u_mm[1]])


def eased(u_mm: Array, gentler_mm: Array, beyond: Callable[[Array], Mask], dt_s: float) -> Array:
    """Return a command (2, n) that passes over to a gentler one around places beyond the limits."""
    for _ in range(_PASSES):
        over = beyond(u_mm)
        if not over.any():
            break
        u_mm = u_mm + _around(over, dt_s) * (gentler_mm - u_mm)
    return u_mm


def _around(marked: Mask, dt_s: float) -> Array:
    """Return 1 around marked samples, and less further away, shape (2, n)."""
    reach = round(_REACH_S / dt_s)
    near = maximum_filter1d(marked.astype(float), 4 * reach + 1, axis=1)
    return np.stack([smoothed(row, window(2 * _REACH_S, dt_s)) for row in near])


def window(length_s: float, dt_s: float) -> Array:
    """Return a symmetric window of odd length that sums to 1."""
    half = max(1, round(0.5 * length_s / dt_s))
    weights = np.hanning(2 * half + 3)[1:-1]
    return np.asarray(weights / weights.sum())


def smoothed(row: Array, weights: Array) -> Array:
    """Return a row (n,) averaged with a symmetric window, its ends continued."""
    half = len(weights) // 2
    return np.convolve(np.pad(row, half, mode="edge"), weights, mode="valid")
