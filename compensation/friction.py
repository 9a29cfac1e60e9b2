"""Compensation of dry friction on top of a vibration compensator.

With the command w + c s(w) the axes receive w (`models.friction`). The reversals of s are smoothed
symmetrically, so that the motors can follow: more so, or not compensated, around places where the
vibration compensator already needs what the motors can do.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d

from stillpath.compensation.base import Compensator
from stillpath.compensation.overlay import Overlay
from stillpath.compensation.rests import stand_still
from stillpath.models.friction import bend_of
from stillpath.models.machine import Machine

__all__ = ["FrictionCompensator", "against_friction"]

Array = NDArray[np.float64]

_ROUNDED_S = (4e-3, 8e-3, 16e-3)
"""Lengths of the smoothing window: around each place, the first that keeps the machine's limits."""
_BLEND_S = 0.01
_PASSES = 4
"""The way over to a gentler command may exceed the limits too; then it begins earlier."""


def against_friction(
    wanted_mm: Array,
    held_mm: Sequence[float],
    rests: NDArray[np.int64],
    dt_s: float,
    rounded_s: float = _ROUNDED_S[0],
) -> Array:
    """Return the command with which axes receive `wanted_mm`, shape (2, n).

    Parameters
    ----------
    held_mm : (float, float)
        Distance by which friction holds X and Y back.
    rests : ndarray of int64, shape (k, 2)
        Sample ranges [a, b) in which nothing is added.
    rounded_s : float
        Length of the window that smooths reversals.
    """
    window = _window(rounded_s, dt_s)
    bends = np.stack([_rounded(bend_of(row), window) for row in wanted_mm])
    added = np.array(held_mm)[:, None] * bends
    blend = max(2, round(_BLEND_S / dt_s))
    return wanted_mm + stand_still(added, np.zeros_like(added), rests, blend)


class FrictionCompensator(Overlay):
    """Compensate dry friction on top of another compensator.

    In rests, and at the ends of a piece, the command stands on the plan; the correction fades out
    and in within `_BLEND_S` before and after.

    Parameters
    ----------
    inner : Compensator
        Compensates vibration: its command is what the axes should receive.
    machine : Machine
        With friction in its axes.
    dt_s : float
    """

    def __init__(self, inner: Compensator, machine: Machine, dt_s: float) -> None:
        self.name = inner.name
        super().__init__(inner, machine, dt_s)
        self._held_mm = machine.friction_mm
        self._travel = [machine.travel[axis] for axis in ("x", "y")]

    def compensate(
        self, y_d_mm: Array, extruding: NDArray[np.bool_], rests: NDArray[np.int64]
    ) -> Array:
        """See `compensation.base.Compensator.compensate`."""
        wanted = self._inner.compensate(y_d_mm, extruding, rests)
        u = self._against(wanted, rests, _ROUNDED_S[0])
        for rounded_s in _ROUNDED_S[1:]:
            u = self._eased(u, self._against(wanted, rests, rounded_s), wanted)
        u = self._eased(u, wanted, wanted)
        left = np.any(self._beyond(u, wanted), axis=1, keepdims=True)
        return np.where(left, wanted, u)

    def _against(self, wanted: Array, rests: NDArray[np.int64], rounded_s: float) -> Array:
        u = against_friction(wanted, self._held_mm, rests, self._dt_s, rounded_s)
        return self._within_travel(wanted, u)

    def _eased(self, u: Array, gentler: Array, wanted: Array) -> Array:
        """Return a command that passes over to a gentler one where it exceeds the limits."""
        for _ in range(_PASSES):
            beyond = self._beyond(u, wanted)
            if not beyond.any():
                break
            u = u + _around(beyond, self._dt_s) * (gentler - u)
        return u

    def _within_travel(self, wanted: Array, u: Array) -> Array:
        for row, inner, travel in zip(u, wanted, self._travel, strict=True):
            low, high = min(travel.min_mm, inner.min()), max(travel.max_mm, inner.max())
            np.clip(row, low, high, out=row)
        return u


def _window(length_s: float, dt_s: float) -> Array:
    """Return a symmetric window of odd length that sums to 1."""
    half = max(1, round(0.5 * length_s / dt_s))
    window = np.hanning(2 * half + 3)[1:-1]
    return np.asarray(window / window.sum())


def _rounded(row: Array, window: Array) -> Array:
    half = len(window) // 2
    return np.convolve(np.pad(row, half, mode="edge"), window, mode="valid")


def _around(beyond: NDArray[np.bool_], dt_s: float) -> Array:
    """Return 1 around marked samples, and less further away, shape (2, n)."""
    reach = round(_ROUNDED_S[-1] / dt_s)
    near = maximum_filter1d(beyond.astype(float), 4 * reach + 1, axis=1)
    return np.stack([_rounded(row, _window(2 * _ROUNDED_S[-1], dt_s)) for row in near])
