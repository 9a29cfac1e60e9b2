"""Zero phase error tracking control: the plant inverted, except for what cannot be.

Poles and well-behaved zeros are cancelled. A zero outside the unit circle would make the
inverse unstable; its reflection cancels its phase instead and leaves a gain error that grows
with frequency, which a zero-phase low-pass keeps from shaking the machine.

Sources: M. Tomizuka 1987; paper 002 (equations checked in docs/method.md): with G = z^-d Bc Bu / A,
F = z^d A(z^-1) Bu(z) / (Bc(z^-1) Bu(1)^2), preview d plus the number of zeros in Bu.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.signal import sosfilt, zpk2sos

from compensation.base import DesignError, Memoryless
from compensation.holds import stand_still
from models.machine import Machine
from models.plants import DiscretePlant, plant_set

__all__ = ["Zpetc", "ZpetcFilter", "zero_phase_fir"]

Array = NDArray[np.float64]

_ON_CIRCLE = 5e-4
"""Zeros this near the unit circle are refused: their inverse would ring for 2000 samples."""
_FASTEST_HZ, _SLOWEST_HZ, _STEP = 400.0, 15.0, 0.85
_BLEND_S = 0.03


def zero_phase_fir(
    cutoff_hz: float, dt_s: float, length: int | None = None, passes: int = 1
) -> Array:
    """Return the symmetric low-pass alpha_-l .. alpha_l with sum 1.

    A sampled first-order response delta_n = exp(-2 pi f n dt), n = 0..l, convolved with its own
    mirror image (paper 002); `length` is l, by default where delta has fallen to 2 %. With
    several `passes` it falls off that many times as steeply (and is as many times longer).
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


class ZpetcFilter:
    """The non-causal filter F of one axis.

    Parameters
    ----------
    plant : DiscretePlant

    Attributes
    ----------
    preview : int
        Samples by which the command runs ahead of the plan.
    passes : int
        How many times the low-pass should be applied: more if F G grows with frequency.
    memory : int
        Samples after which the slowest cancelled zero has decayed to 0.1 %.
    uncancelled : ndarray of complex
        The reflected zeros.

    Raises
    ------
    DesignError
        If a zero lies at 1 or so near the unit circle that its inverse never comes to rest.
    """

    def __init__(self, plant: DiscretePlant) -> None:
        poles, zeros = plant.poles(), plant.zeros()
        # Zeros at infinity of rounding size are delays, and far ones are harmless reflected.
        size = np.abs(zeros)
        for zero in zeros[np.abs(size - 1) < _ON_CIRCLE]:
            f_hz = abs(float(np.angle(zero))) / (2 * math.pi * plant.dt_s)
            raise DesignError(
                f"zero z = {zero:.6g} lies on the unit circle ({f_hz:.4g} Hz): the plant does not "
                "answer there, so its inverse would ring without end; use fbf, or correct the "
                "damping of that zero in the model"
            )
        self.uncancelled = zeros[size > 1]
        cancelled = zeros[size < 1]
        mirrored = 1.0 / self.uncancelled
        self.preview = len(poles) - len(zeros) + len(self.uncancelled)
        top = np.concatenate([poles, mirrored])
        delays = len(top) - len(cancelled)
        bottom = np.concatenate([cancelled, np.zeros(delays)])
        gain = float(np.real(np.prod(1 - bottom) / np.prod(1 - top)))
        self._sections = zpk2sos(top, bottom, gain) if len(top) else None
        slowest = float(np.abs(cancelled).max()) if len(cancelled) else 0.0
        # F G = |Bu|^2 / Bu(1)^2 is real; where it grows, a low-pass of order two is too weak.
        at_nyquist = np.prod(np.abs((1 + self.uncancelled) / (1 - self.uncancelled)) ** 2)
        self.passes = 1 if at_nyquist < 2.0 else 3
        self.memory = delays + (math.ceil(math.log(1e-3) / math.log(slowest)) if slowest else 0)

    def apply(self, y_d_mm: Array, fir: Array | None = None) -> Array:
        """Return the command for one axis, shape (n,); the plan stands still beyond its ends."""
        n = len(y_d_mm)
        half = 0 if fir is None else len(fir) // 2
        before = half + self.memory
        origin = float(y_d_mm[0])
        padded = np.pad(y_d_mm - origin, (before, self.preview + half), mode="edge")
        if fir is not None:
            padded = np.convolve(padded, fir)[half : half + len(padded)]
            # The convolution saw zeros beyond the end; there the plan stands still.
            padded[len(padded) - half :] = y_d_mm[-1] - origin
        if self._sections is not None:
            padded = sosfilt(self._sections, padded)
        at = before + self.preview
        return np.asarray(padded[at : at + n] + origin)

    def response(self, f_hz: Array, dt_s: float) -> NDArray[np.complex128]:
        """Return F(exp(2 pi j f dt)) with its preview, without the FIR."""
        at = np.exp(2j * np.pi * np.asarray(f_hz) * dt_s)
        value = np.ones(len(at), complex)
        if self._sections is not None:
            for b0, b1, b2, a0, a1, a2 in self._sections:
                value *= (b0 + b1 / at + b2 / at**2) / (a0 + a1 / at + a2 / at**2)
        return np.asarray(value * at**self.preview, np.complex128)


class Zpetc(Memoryless):
    """ZPETC for X and Y with a zero-phase low-pass.

    Parameters
    ----------
    machine : Machine
    dt_s : float
    cutoff_hz : float or None
        Corner of the low-pass. None: for every run the highest of a ladder from 400 to 15 Hz
        whose command stays within the machine's limits.
    """

    name = "zpetc"

    def __init__(self, machine: Machine, dt_s: float, *, cutoff_hz: float | None = None) -> None:
        self._dt_s = dt_s
        self._limits = machine.command
        self.filters = [
            ZpetcFilter(plant_set(machine.axes["x"], dt_s).nominal),
            ZpetcFilter(plant_set(machine.axes["y"], dt_s).nominal),
        ]
        self._ladder = (cutoff_hz,) if cutoff_hz is not None else _ladder(0.4 / dt_s)
        self._firs = [
            [zero_phase_fir(f, dt_s, passes=design.passes) for f in self._ladder]
            for design in self.filters
        ]
        self._blend = max(2, round(_BLEND_S / dt_s))
        self.cutoffs_hz: tuple[float, float] = (self._ladder[0], self._ladder[0])
        """What the last run used for X and Y."""

    def compensate(
        self,
        y_d_mm: Array,
        extruding: NDArray[np.bool_],  # noqa: ARG002
        rests: NDArray[np.int64],
    ) -> Array:
        """See `compensation.base.Compensator.compensate`."""
        rows, used = [], []
        for axis, y_d in enumerate(y_d_mm):
            row, cutoff_hz = self._within_limits(axis, y_d, rests)
            rows.append(row)
            used.append(cutoff_hz)
        self.cutoffs_hz = (used[0], used[1])
        return np.stack(rows)

    def _within_limits(
        self, axis: int, y_d: Array, rests: NDArray[np.int64]
    ) -> tuple[Array, float]:
        dt, limits = self._dt_s, self._limits
        accel = speed = 0.0
        for cutoff_hz, fir in zip(self._ladder, self._firs[axis], strict=True):
            u = self.filters[axis].apply(y_d, fir)
            u = stand_still(np.stack([u, u]), np.stack([y_d, y_d]), rests, self._blend)[0]
            speed = float(np.abs(np.diff(u)).max(initial=0.0)) / dt
            accel = float(np.abs(np.diff(u, 2)).max(initial=0.0)) / dt**2
            if speed <= limits.velocity_mm_s and accel <= limits.accel_mm_s2:
                return u, cutoff_hz
        raise DesignError(
            f"zpetc, axis {'xy'[axis]}: even with a low-pass at {self._ladder[-1]:.0f} Hz the "
            f"command needs {speed:.0f} mm/s and {accel:.0f} mm/s2 (limits "
            f"{limits.velocity_mm_s:.0f}, {limits.accel_mm_s2:.0f}); use fbf"
        )


def _ladder(highest_hz: float) -> tuple[float, ...]:
    steps = math.floor(math.log(_SLOWEST_HZ / _FASTEST_HZ) / math.log(_STEP))
    ladder = tuple(_FASTEST_HZ * _STEP**k for k in range(steps + 1))
    return tuple(f for f in ladder if f <= highest_hz)
