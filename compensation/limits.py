"""Where a command asks more of the motors than they bear, and a gentler one around such places."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.ndimage import maximum_filter1d

from stillpath.models.arrays import Array, Mask
from stillpath.models.machine import Machine

__all__ = ["CommandBounds", "eased", "hann_weights", "smoothed"]

_SLACK = 1.0 + 1e-9
"""Factor of limits that allows for rounding."""
_LIMITS = ("velocity_mm_s", "accel_mm_s2")
"""Names of the limits of first and second differences."""
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


def eased(
    u_mm: Array, gentler_mm: Array, beyond: Callable[[Array], Mask], dt_s: float, passes: int
) -> Array:
    """Return a command (2, n) that is cross-faded to a gentler one around places beyond the limits.

    The fade may exceed the limits too; then it begins earlier, in the next of `passes`.
    """
    for _ in range(passes):
        over = beyond(u_mm)
        if not over.any():
            break
        u_mm = u_mm + _fade(over, dt_s) * (gentler_mm - u_mm)
    return u_mm


def hann_weights(length_s: float, dt_s: float) -> Array:
    """Return the weights of a Hann window of odd length, sum 1."""
    half = max(1, round(0.5 * length_s / dt_s))
    weights = np.hanning(2 * half + 3)[1:-1]
    return np.asarray(weights / weights.sum())


def smoothed(row: Array, weights: Array) -> Array:
    """Return a row (n,) averaged with a symmetric window, its ends continued."""
    half = len(weights) // 2
    return np.convolve(np.pad(row, half, mode="edge"), weights, mode="valid")


def _exceeds(u: Array, wanted: Array, limits: Array | float, order: int) -> Mask:
    """Return where differences of u (2, n) exceed both the limits and the largest of `wanted`."""
    asked, own = (np.abs(np.diff(rows, order)) for rows in (u, wanted))
    most = np.maximum(own.max(axis=1, initial=0.0), limits)
    return np.asarray(asked > _SLACK * most[:, None], np.bool_)


def _of_motors(u_mm: Array) -> Array:
    """Return the positions of both motors of a CoreXY, shape (2, n)."""
    return np.stack([u_mm[0] + u_mm[1], u_mm[0] - u_mm[1]])


def _fade(marked: Mask, dt_s: float) -> Array:
    """Return the share of the gentler command: 1 around marked samples, then down to 0, (2, n)."""
    reach = round(1.5 * _REACH_S / dt_s)
    near = maximum_filter1d(marked.astype(float), 2 * reach + 1, axis=1)
    return np.stack([smoothed(row, hann_weights(_REACH_S, dt_s)) for row in near])
