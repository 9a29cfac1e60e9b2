"""Approximate inversion as a compensator, low-passed until the machine can follow.

The gain of an inverse grows with frequency, and so does the error due to uncancellable zeros. A
zero-phase low-pass limits both; its corner is the highest of a ladder whose command keeps the
machine's limits (docs/method.md, "Other methods").
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from stillpath.compensation.base import DesignError, Memoryless
from stillpath.compensation.inversion import Inversion, invert
from stillpath.compensation.rests import stand_still
from stillpath.models.arrays import Array
from stillpath.models.machine import Machine
from stillpath.models.plants import DiscretePlant, plant_set

__all__ = ["InversionCompensator", "zero_phase_fir"]

_FASTEST_HZ, _SLOWEST_HZ, _STEP = 400.0, 15.0, 0.85
_BLEND_S = 0.03
_EXTRA_TERMS = 3
"""Terms that ebzpetc adds to zpetc: enough for less than a fifth of the error of a zero at -3.7."""
_LEFT, _MOST_TERMS = 1e-3, 400
"""Largest remainder of the slowest zero in the series of ts, and largest number of terms."""


def zero_phase_fir(
    cutoff_hz: float, dt_s: float, length: int | None = None, passes: int = 1
) -> Array:
    """Return the symmetric low-pass alpha_-l .. alpha_l with sum 1.

    A sampled first-order response delta_n = exp(-2 pi f n dt), n = 0..l, convolved with its own
    mirror image (paper 002); `length` is l, by default where delta has fallen to 2 %. With
    several `passes` it falls off that many times as steeply (and is as many times longer).

    Raises
    ------
    DesignError
        If the cutoff is not below the Nyquist frequency.
    """
    if not 0 < cutoff_hz < 0.5 / dt_s:
        raise DesignError(f"FIR cutoff {cutoff_hz} Hz must lie between 0 and {0.5 / dt_s:g} Hz")
    rate = 2 * math.pi * cutoff_hz * dt_s
    last = math.ceil(4.0 / rate) if length is None else length
    delta = np.exp(-rate * np.arange(last + 1))
    once = taps = np.convolve(delta, delta[::-1])
    for _ in range(passes - 1):
        taps = np.convolve(taps, once)
    return np.asarray(taps / taps.sum())


class InversionCompensator(Memoryless):
    """An approximate inverse for X and Y with a zero-phase low-pass.

    Parameters
    ----------
    kind : str
        A key of `compensation.inversion.KINDS`.
    order : int or None
        n1 of ``ebzpetc`` and ``ts``. None: 3, and as many as leave a remainder below 0.1 %.
    cutoff_hz : float or None
        Corner of the low-pass. None: for every run the highest of a ladder from 400 to 15 Hz
        whose command stays within the machine's limits.

    Raises
    ------
    DesignError
        If an axis has zeros that the method cannot handle.
    """

    def __init__(
        self,
        machine: Machine,
        dt_s: float,
        *,
        kind: str = "zpetc",
        order: int | None = None,
        cutoff_hz: float | None = None,
    ) -> None:
        self.name = kind
        self._dt_s = dt_s
        self._limits = machine.command.of("x"), machine.command.of("y")
        self.filters = [
            _designed(kind, name, plant_set(machine.axes[name], dt_s).nominal, order)
            for name in ("x", "y")
        ]
        self._ladder = (cutoff_hz,) if cutoff_hz is not None else _ladder(0.4 / dt_s)
        self._firs = [
            [zero_phase_fir(f, dt_s, passes=_passes(design)) for f in self._ladder]
            for design in self.filters
        ]
        self._blend = max(2, round(_BLEND_S / dt_s))

    def compensate(
        self,
        y_d_mm: Array,
        extruding: NDArray[np.bool_],  # noqa: ARG002
        rests: NDArray[np.int64],
    ) -> Array:
        """See `compensation.base.Compensator.compensate`."""
        return np.stack([self._within_limits(i, y_d, rests) for i, y_d in enumerate(y_d_mm)])

    def _within_limits(self, axis: int, y_d: Array, rests: NDArray[np.int64]) -> Array:
        dt, limits = self._dt_s, self._limits[axis]
        accel = speed = 0.0
        for fir in self._firs[axis]:
            u = self.filters[axis].apply(y_d, fir)
            u = stand_still(np.stack([u, u]), np.stack([y_d, y_d]), rests, self._blend)[0]
            speed = float(np.abs(np.diff(u)).max(initial=0.0)) / dt
            accel = float(np.abs(np.diff(u, 2)).max(initial=0.0)) / dt**2
            if speed <= limits.velocity_mm_s and accel <= limits.accel_mm_s2:
                return np.asarray(u)
        raise DesignError(
            f"{self.name}, axis {'xy'[axis]}: even with a low-pass at {self._ladder[-1]:.0f} Hz "
            f"the command needs {speed:.0f} mm/s and {accel:.0f} mm/s2 (limits "
            f"{limits.velocity_mm_s:.0f}, {limits.accel_mm_s2:.0f}); use fbf"
        )


def _designed(kind: str, axis: str, plant: DiscretePlant, order: int | None) -> Inversion:
    """Invert one axis, choosing n1 by the zeros if not given."""
    try:
        if order is None:
            order = _enough_terms(invert("zpetc", plant)) if kind == "ts" else _EXTRA_TERMS
        design = invert(kind, plant, order, unit_dc=True)
        if kind == "ebzpetc":
            _check_convergence(plant)
    except DesignError as error:
        raise DesignError(f"axis {axis}: {error}") from None
    return design


def _enough_terms(design: Inversion) -> int:
    """Return the terms of ts after which the slowest zero has decayed."""
    if len(design.uncancelled) == 0:
        return 1
    slowest = float(np.abs(np.log(np.abs(design.uncancelled))).min())
    terms = math.inf if slowest == 0 else math.ceil(-math.log(_LEFT) / slowest)
    if terms > _MOST_TERMS:
        near = design.uncancelled[np.argmin(np.abs(np.log(np.abs(design.uncancelled))))]
        raise DesignError(
            f"ts: zero z = {near:.6g} (|z| = {abs(near):.4f}) is so near the unit circle that its "
            f"series needs {terms} terms for {_LEFT:.1%}, limit {_MOST_TERMS}; use zpetc or fbf"
        )
    return int(terms)


def _check_convergence(plant: DiscretePlant) -> None:
    """Raise if more terms make ebzpetc worse: the gain of zpetc must stay below 2."""
    f_hz = np.linspace(0.0, 0.5 / plant.dt_s, 2001)
    gain = np.abs(invert("zpetc", plant).overall.response(f_hz, plant.dt_s))
    if gain.max() >= 2.0:
        raise DesignError(
            f"ebzpetc: the gain error of zpetc reaches {gain.max():.3g} (2 above "
            f"{f_hz[gain >= 2.0][0]:.0f} Hz), so that the series of its inverse does not converge: "
            "a zero right of the imaginary axis; use ts or fbf"
        )


def _passes(design: Inversion) -> int:
    """Return the passes of the low-pass: where F G grows with frequency, one is too weak."""
    peak = np.abs(design.overall.response(np.linspace(0.0, 0.5, 501), 1.0)).max()
    return 1 if peak < 2.0 else 3


def _ladder(highest_hz: float) -> tuple[float, ...]:
    steps = math.floor(math.log(_SLOWEST_HZ / _FASTEST_HZ) / math.log(_STEP))
    ladder = tuple(_FASTEST_HZ * _STEP**k for k in range(steps + 1))
    return tuple(f for f in ladder if f <= highest_hz)
