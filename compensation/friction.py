"""Compensation of dry friction on top of a vibration compensator.

With the command w + c s(w) the axes receive w (`models.friction`). The reversals of s are smoothed
symmetrically, so that the motors can follow: more so, or not compensated, around places where the
vibration compensator already needs what the motors can do.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from stillpath.compensation.base import Compensator
from stillpath.compensation.limits import eased, hann_weights, smoothed
from stillpath.compensation.overlay import Overlay
from stillpath.compensation.rests import stand_still
from stillpath.models.arrays import Array
from stillpath.models.friction import bend_of
from stillpath.models.machine import Machine

__all__ = ["FrictionCompensator", "against_friction"]

_ROUNDED_S = (4e-3, 8e-3, 16e-3)
"""Lengths of the smoothing window: around each place, the first that keeps the machine's limits."""
_PASSES, _LAST_PASSES = 4, 50
"""Of cross-fading to a longer window, and to no compensation of friction."""
_BLEND_S = 0.01


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
    weights = hann_weights(rounded_s, dt_s)
    bends = np.stack([smoothed(bend_of(row, dt_s), weights) for row in wanted_mm])
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
    """

    def __init__(self, inner: Compensator, machine: Machine, dt_s: float) -> None:
        self.name = inner.name
        super().__init__(inner, machine, dt_s)
        self._held_mm = machine.friction_mm

    def compensate(
        self, y_d_mm: Array, extruding: NDArray[np.bool_], rests: NDArray[np.int64]
    ) -> Array:
        """See `compensation.base.Compensator.compensate`."""
        wanted = self._inner.compensate(y_d_mm, extruding, rests)
        beyond = partial(self._bounds.beyond, wanted_mm=wanted)
        u = self._against(wanted, rests, _ROUNDED_S[0])
        for rounded_s in _ROUNDED_S[1:]:
            if not np.any(beyond(u)):
                return u
            u = eased(u, self._against(wanted, rests, rounded_s), beyond, self._dt_s, _PASSES)
        u = eased(u, wanted, beyond, self._dt_s, _LAST_PASSES)
        left = np.any(beyond(u), axis=1, keepdims=True)
        return np.where(left, wanted, u)

    def _against(self, wanted: Array, rests: NDArray[np.int64], rounded_s: float) -> Array:
        u = against_friction(wanted, self._held_mm, rests, self._dt_s, rounded_s)
        return self._within_travel(wanted, u)
