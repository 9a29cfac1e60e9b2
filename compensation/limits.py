"""Where a command asks more of the motors than they bear, and a gentler one around such places."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.ndimage import maximum_filter1d

from stillpath.models.arrays import Array, Mask
from stillpath.models.machine import Machine

__all__ = ["CommandBounds", "eased", "smoothed", "window"]

_ROUNDED = 1.0 + 1e-9
_REACH_S = 0.032
"""A command is replaced this far from a place beyond the limits, and partly twice as far."""


class CommandBounds:
    """Speed and acceleration that a machine allows to a command of X and Y.

    Parameters
    ----------
    dt_s : float
        Sampling time of the commands.
    """

    def __init__(self, machine: Machine, dt_s: float) -> None:
        limits = machine.command
        axes, motors = [limits.of("x"), limits.of("y")], limits.motors
        self._axes = [
            np.array([getattr(axis, name) for axis in axes]) * dt_s**order
            for order, name in enumerate(_LIMITS, 1)
        ]
        self._motors = [
            (getattr(motors, name, None) or np.inf) * dt_s**order
            for order, name in enumerate(_LIMITS, 1)
        ]

    def beyond(self, u_mm: Array, wanted_mm: Array) -> Mask:
        """Return where a command exceeds the limits and all that another one needs, shape (2, n).

        Both axes are marked where together they ask too much of a motor of a CoreXY.

        Parameters
        ----------
        u_mm, wanted_mm : ndarray, shape (2, n)
        """
        beyond = np.zeros(u_mm.shape, np.bool_)
        for order, (axes, motors) in enumerate(zip(self._axes, self._motors, strict=True), 1):
            beyond[:, order:] |= _exceeds(u_mm, wanted_mm, axes, order)
            if np.isfinite(motors):
                over = _exceeds(_of_motors(u_mm), _of_motors(wanted_mm), motors, order)
                beyond[:, order:] |= over.any(axis=0)
        return beyond


_LIMITS = ("velocity_mm_s", "accel_mm_s2")
"""Of first and second differences."""


def eased(
    u_mm: Array, gentler_mm: Array, beyond: Callable[[Array], Mask], dt_s: float, passes: int
) -> Array:
    """Return a command (2, n) that passes over to a gentler one around places beyond the limits.

    The way over may exceed the limits too; then it begins earlier, in the next of `passes`.
    """
    for _ in range(passes):
        over = beyond(u_mm)
        if not over.any():
            break
        u_mm = u_mm + _around(over, dt_s) * (gentler_mm - u_mm)
    return u_mm


def window(length_s: float, dt_s: float) -> Array:
    """Return a symmetric window of odd length that sums to 1."""
    half = max(1, round(0.5 * length_s / dt_s))
    weights = np.hanning(2 * half + 3)[1:-1]
    return np.asarray(weights / weights.sum())


def smoothed(row: Array, weights: Array) -> Array:
    """Return a row (n,) averaged with a symmetric window, its ends continued."""
    half = len(weights) // 2
    return np.convolve(np.pad(row, half, mode="edge"), weights, mode="valid")


def _exceeds(u: Array, wanted: Array, limits: Array | float, order: int) -> Mask:
    asked, own = (np.abs(np.diff(rows, order)) for rows in (u, wanted))
    most = np.maximum(own.max(axis=1, initial=0.0), limits)
    return np.asarray(asked > _ROUNDED * most[:, None], np.bool_)


def _of_motors(u_mm: Array) -> Array:
    """Return the way of both motors of a CoreXY."""
    return np.stack([u_mm[0] + u_mm[1], u_mm[0] - u_mm[1]])


def _around(marked: Mask, dt_s: float) -> Array:
    """Return 1 around marked samples, and less further away, shape (2, n)."""
    reach = round(1.5 * _REACH_S / dt_s)
    near = maximum_filter1d(marked.astype(float), 2 * reach + 1, axis=1)
    return np.stack([smoothed(row, window(_REACH_S, dt_s)) for row in near])
