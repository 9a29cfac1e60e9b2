"""Klipper's recommendation: its five shapers scored on a measured spectrum.

Facts from klippy/extras/shaper_calibrate.py and shaper_defs.py (Klipper, 2026-08), written
again on arrays: the spectrum is divided by frequency, a shaper is judged by the share of it that
passes (worst of three damping ratios, what lies below a twentieth of the peak not counted) and
by how far it rounds a corner.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from stillpath.models.arrays import Array
from stillpath.models.errors import ModelError
from stillpath.models.identification.types import Spectrum
from stillpath.models.shaper_pulses import Pulses, shaper_pulses

__all__ = [
    "ShaperChoice",
    "choose_shaper",
    "choose_shaper_of",
    "klipper_weighting",
    "residual_vibration",
]

_LOWEST_HZ = {"zv": 21.0, "mzv": 23.0, "ei": 29.0, "2hump_ei": 39.0, "3hump_ei": 48.0}
_HIGHEST_HZ = 200.0
_HIGHEST_SHAPER_HZ, _STEP_HZ = 150.0, 0.2
"""Klipper tries no shaper at 150 Hz or above (MAX_SHAPER_FREQ, since 2020-10)."""
_DAMPING = 0.1
_TESTED_DAMPING = (0.075, 0.1, 0.15)
_REDUCTION = 20.0
_ACCEL_MM_S2, _CORNER_MM_S = 5000.0, 5.0
_TARGET_SMOOTHING_MM = 0.12


@dataclass(frozen=True, slots=True)
class ShaperChoice:
    """A shaper at its best frequency.

    Attributes
    ----------
    vibrations : float
        Share of the weighted spectrum that it lets through (0.02 is 2 %).
    smoothing_mm : float
        Rounding of a corner at 5000 mm/s^2.
    max_accel_mm_s2 : float
        Acceleration at which a corner is rounded by 0.12 mm.
    score : float
        What the frequency and the shaper are chosen by; smaller is better.
    """

    name: str
    f_hz: float
    vibrations: float
    smoothing_mm: float
    max_accel_mm_s2: float
    score: float


def choose_shaper_of(spectrum: Spectrum) -> tuple[ShaperChoice, tuple[ShaperChoice, ...]]:
    """Return `choose_shaper` of a file as Klipper reads it.

    The sum over the sensor's axes; of several data sets the worst decides.
    """
    psd = spectrum.psd
    axes = [psd[name] for name in ("x", "y", "z") if name in psd]
    if "xyz" in psd:
        return choose_shaper(spectrum.f_hz, psd["xyz"])
    rows = np.sum(axes, axis=0) if axes else np.stack([*psd.values()])
    return choose_shaper(spectrum.f_hz, rows)


def choose_shaper(f_hz: ArrayLike, psd: ArrayLike) -> tuple[ShaperChoice, tuple[ShaperChoice, ...]]:
    """Return the shaper that Klipper recommends, and every shaper at its best frequency.

    Parameters
    ----------
    f_hz : array_like, shape (n,)
    psd : array_like, shape (n,) or (data sets, n)
        Spectra of the acceleration, summed over the sensor's axes, not normalised.

    Raises
    ------
    ModelError
        If the spectrum holds nothing below 200 Hz.
    """
    f, power = np.asarray(f_hz, float), np.atleast_2d(np.asarray(psd, float))
    used = f <= _HIGHEST_HZ
    if not used.any() or not np.all(power[:, used].max(axis=1) > 0):
        raise ModelError(f"no vibration below {_HIGHEST_HZ:g} Hz: nothing to choose a shaper by")
    f = f[used]
    weighted = power[:, used] * klipper_weighting(f)
    best: ShaperChoice | None = None
    chosen: list[ShaperChoice] = []
    for name in _LOWEST_HZ:
        tried = _tried(name, f, weighted)
        own = _least_smoothing(tried)
        if best is None or _clearly_better(own, best):
            best = own
        for other in reversed(tried):
            if other.vibrations < best.vibrations and other.smoothing_mm < best.smoothing_mm:
                best = own = other
        chosen.append(own)
    assert best is not None
    if best.name == "zv":
        best = next((c for c in chosen[1:] if c.vibrations * 1.1 < best.vibrations), best)
    return best, tuple(chosen)


def klipper_weighting(f_hz: ArrayLike) -> Array:
    """Return what Klipper multiplies a spectrum with: 1/(f + 0.1), rolled off below 10 Hz."""
    f = np.asarray(f_hz, float) + 0.1
    roll_off = np.where(f < 10.1, np.exp(1.0 - (10.0 / f) ** 2), 1.0)
    return np.asarray(roll_off / f, np.float64)


def residual_vibration(pulses: Pulses, f_hz: ArrayLike, zeta: float) -> Array:
    """Return the share of vibration that a shaped step leaves in a mode at every `f_hz`.

    The sum of the pulses as phasors that have decayed until the last one (Singer and Seering,
    1990).
    """
    weights, times = pulses
    pole = 2 * np.pi * np.asarray(f_hz, float) * (-zeta + 1j * np.sqrt(1 - zeta * zeta))
    left = np.exp(np.multiply.outer(pole, times[-1] - times)) @ weights
    return np.asarray(np.abs(left), np.float64)


def _tried(name: str, f: Array, weighted: Array) -> list[ShaperChoice]:
    """Score a shaper at every frequency of Klipper's grid, the highest first."""
    grid = np.arange(_LOWEST_HZ[name], _HIGHEST_SHAPER_HZ, _STEP_HZ)[::-1]
    unit = shaper_pulses(name, 1.0, _DAMPING)
    ignored = weighted.max(axis=1, keepdims=True) / _REDUCTION
    total = np.maximum(weighted - ignored, 0).sum(1)
    # Residual vibration depends on f / f_shaper alone: the shaper of 1 Hz serves all.
    ratio = f / grid[:, None]
    passed = np.zeros(len(grid))
    for zeta in _TESTED_DAMPING:
        left = residual_vibration(unit, ratio, zeta)
        for psd, floor, whole in zip(weighted, ignored, total, strict=True):
            passed = np.maximum(passed, np.maximum(left * psd - floor, 0).sum(1) / whole)
    out = []
    for f_shaper, vibrations in zip(grid, passed, strict=True):
        corner, per_accel, turn = _smoothing((unit[0], unit[1] / f_shaper))
        smoothing = max(corner + per_accel * _ACCEL_MM_S2, turn * _ACCEL_MM_S2)
        limit = min((_TARGET_SMOOTHING_MM - corner) / per_accel, _TARGET_SMOOTHING_MM / turn)
        score = smoothing * (vibrations**1.5 + 0.2 * vibrations + 0.01)
        out.append(
            ShaperChoice(
                name, float(f_shaper), float(vibrations), smoothing, max(limit, 0.0), float(score)
            )
        )
    return out


def _smoothing(pulses: Pulses) -> tuple[float, float, float]:
    """Return the rounding of a right angle (constant, per acceleration) and of a full turn."""
    weights, times = pulses
    late = times - weights @ times
    after = np.maximum(late, 0)
    root = np.sqrt(2.0)
    return (
        float(root * _CORNER_MM_S * (weights @ after)),
        float(root / 2 * (weights @ after**2)),
        float(weights @ late**2 / 2),
    )


def _least_smoothing(tried: list[ShaperChoice]) -> ShaperChoice:
    """Return the best score among those that pass little more than the best one."""
    fewest = min(tried, key=lambda c: c.vibrations)
    near = [c for c in reversed(tried) if c.vibrations < fewest.vibrations * 1.1 + 0.0005]
    best = min(near, key=lambda c: c.score)
    return best if best.score < fewest.score else fewest


def _clearly_better(new: ShaperChoice, old: ShaperChoice) -> bool:
    return new.score * 1.2 < old.score or (
        new.score * 1.05 < old.score and new.smoothing_mm * 1.1 < old.smoothing_mm
    )
