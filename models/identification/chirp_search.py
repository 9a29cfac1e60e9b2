"""Search an accelerometer log for a chirp, the command of a resonance test.

Its cross-correlation with the log has one sharp peak. The correlation is a vector (one component
per sensor axis): its norm finds the start whichever way the sensor is mounted, and its direction is
that of the tested axis as the sensor sees it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft, rfftfreq
from scipy.interpolate import CubicSpline

from stillpath.models.arrays import Array
from stillpath.models.errors import ModelError
from stillpath.models.identification.excitation import VelocityProfile, regenerate
from stillpath.models.identification.types import AccelerationLog, Excitation

__all__ = ["Placed", "band_pass", "best_placed", "resample", "sampling_rate_hz"]

_SECOND_PEAK = 0.8
_APART_S = 2.0  # beyond the side lobes of one peak
_AS_LONG_S = 2e-3  # the kinds of a test differ by 11 ms from 10 Hz on, by 21 ms from 5 Hz on
_PHASES_HZ, _EVERY_HZ, _LATE_S = 16.0, 0.5, 0.02  # where phases are compared, and how


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """A test where it fits a log best.

    Attributes
    ----------
    profile : VelocityProfile
        Of `excitation`, which begins at `start_s` on the clock of the log.
    other_s : float or None
        Where it fits nearly as well, if anywhere.
    command : ndarray, shape (n,)
        Acceleration at the samples of the log, averages over their interval [mm/s^2].
    vector : ndarray, shape (3,)
        Inner products of the command with the axes of the sensor, in the band.
    correlation : float
        Of the command and the acceleration along `vector`, in the band, 0 to 1.
    """

    excitation: Excitation
    profile: VelocityProfile
    start_s: float
    other_s: float | None
    command: Array
    vector: Array
    correlation: float


def resample(log: AccelerationLog) -> tuple[Array, Array]:
    """Return a uniform grid and the accelerations on it, medians (gravity) taken off.

    Cubic splines at the rounded rate 1/median(dt); columns that were not recorded become 0.

    Returns
    -------
    time_s : ndarray, shape (n,)
    accel_mm_s2 : ndarray, shape (n, 3)

    Raises
    ------
    ModelError
        If nothing was recorded, or nothing that changes.
    """
    time_s = log.time_s
    recorded = ~np.isnan(log.accel_mm_s2).any(axis=0)
    if len(time_s) < 16 or not np.ptp(log.accel_mm_s2[:, recorded], axis=0).any():
        raise ModelError(
            f"{log.source}: nothing that changes in {len(time_s)} samples: no axis of the sensor "
            "was recorded, or it is dead; check its wiring and record the test again"
        )
    rate_hz = float(round(1.0 / float(np.median(np.diff(time_s)))))
    count = int((time_s[-1] - time_s[0]) * rate_hz) + 1
    grid_s = time_s[0] + np.arange(count) / rate_hz
    accel = np.zeros((count, 3))
    accel[:, recorded] = CubicSpline(time_s, log.accel_mm_s2[:, recorded])(grid_s)
    return grid_s, accel - np.median(accel, axis=0)


def best_placed(
    excitation: Excitation, grid_s: Array, accel: Array, band_hz: tuple[float, float]
) -> Placed:
    """Return a test where it fits a log best, of the kind that fits best.

    A test without the slow square wave may be that of before 2024-12 (`out_and_back`).

    Parameters
    ----------
    grid_s, accel : ndarray, shapes (n,) and (n, 3)
        From `resample`.
    band_hz : (float, float)
        In which command and log are correlated. From its lower end on the phases of the kinds are
        compared.
    """
    kinds = [_place(kind, grid_s, accel, band_hz) for kind in _kinds(excitation)]
    likely = _as_long(kinds, grid_s) or kinds
    rate_hz = sampling_rate_hz(grid_s)
    return max(likely, key=lambda placed: _agreement(placed, accel, rate_hz, band_hz[0]))


def sampling_rate_hz(grid_s: Array) -> float:
    """Return the rate of a uniform grid."""
    return (len(grid_s) - 1) / float(grid_s[-1] - grid_s[0])


def band_pass(f_hz: Array, band_hz: tuple[float, float]) -> Array:
    """Return 1 in the band, with cosine flanks of 1 Hz inside it."""
    low, high = band_hz
    inside = np.clip(np.minimum(f_hz - low, high - f_hz), 0.0, 1.0)
    return np.asarray(0.5 - 0.5 * np.cos(np.pi * inside), np.float64)


def _kinds(excitation: Excitation) -> tuple[Excitation, ...]:
    """Return the tests it may be: without the slow square wave, that of before 2024-12 too."""
    if excitation.sweeping_accel_mm_s2 > 0.0 and excitation.sweeping_period_s > 0.0:
        return (excitation,)
    return tuple(replace(excitation, out_and_back=old) for old in (False, True))


def _place(
    excitation: Excitation, grid_s: Array, accel: Array, band_hz: tuple[float, float]
) -> Placed:
    rate_hz = sampling_rate_hz(grid_s)
    profile = regenerate(excitation)
    start_s, other_s = _find_start(profile, excitation, grid_s, accel, band_hz)
    command = profile.cell_averages(grid_s - start_s, 1.0 / rate_hz)
    vector, correlation = _correlate(command, accel, rate_hz, band_hz)
    return Placed(excitation, profile, start_s, other_s, command, vector, correlation)


def _as_long(kinds: Sequence[Placed], grid_s: Array) -> list[Placed]:
    """Return the tests that last as long as the log, which Klipper ends with its test."""
    span_s = float(grid_s[-1] - grid_s[0])
    return [one for one in kinds if abs(span_s - one.profile.duration_s) <= _AS_LONG_S]


def _agreement(placed: Placed, accel: Array, rate_hz: float, low_hz: float) -> float:
    """Return how well the phases agree at low frequency if the log may be late, 0 to 1.

    A quarter of a period at every frequency is no delay. Every half hertz counts alike, since a
    frame on its feet turns the phase most where it makes the motion large.
    """
    end_hz = min(low_hz + _PHASES_HZ, placed.excitation.f_end_hz)
    edges_hz = np.arange(low_hz, end_hz, _EVERY_HZ)
    size = next_fast_len(len(placed.command), real=True)
    edges = np.searchsorted(rfftfreq(size, 1.0 / rate_hz), edges_hz)
    u = rfft(placed.command, size)[: edges[-1]]
    y = rfft(accel @ (placed.vector / np.linalg.norm(placed.vector)), size)[: edges[-1]]
    cross, sent, seen = (
        np.add.reduceat(v, edges[:-1]) for v in (u.conj() * y, np.abs(u) ** 2, np.abs(y) ** 2)
    )
    alike = cross / np.sqrt(np.maximum(np.real(sent * seen), 1e-300))
    middles_hz = 0.5 * (edges_hz[1:] + edges_hz[:-1])
    late_s = np.arange(-_LATE_S, _LATE_S, 1e-4)
    turned = np.exp(2j * np.pi * late_s[:, None] * middles_hz)
    return float(np.max((turned @ alike).real)) / len(alike)


def _find_start(
    profile: VelocityProfile,
    excitation: Excitation,
    grid_s: Array,
    accel: Array,
    band_hz: tuple[float, float],
) -> tuple[float, float | None]:
    """Return the time of the greatest norm of the cross-correlation, to a fraction of a sample.

    And the time of another peak of nearly that height, if there is one.
    """
    h = float(grid_s[1] - grid_s[0])
    # Only the part of the sweep that passes the band takes part: 1 Hz more for its flanks.
    head_s = (band_hz[1] + 1.0 - excitation.f_start_hz) / excitation.hz_per_s
    head = int(min(head_s, profile.duration_s) / h)
    command = profile.cell_averages(np.arange(head) * h, h)
    size = next_fast_len(len(accel) + head, real=True)
    passed = band_pass(rfftfreq(size, h), band_hz)
    cross = rfft(accel, size, axis=0) * (passed * rfft(command, size).conj())[:, None]
    norm = np.linalg.norm(irfft(cross, size, axis=0), axis=1)
    best = int(np.argmax(norm))
    before, peak, after = norm[best - 1], norm[best], norm[(best + 1) % size]
    fraction = 0.5 * (before - after) / (before - 2 * peak + after)
    # The last `head` lags are negative ones: the log begins within the test.
    signed = np.where(np.arange(size) < len(accel), 0, -size) + np.arange(size)
    start_s = float(grid_s[0] + (signed[best] + fraction) * h)
    elsewhere = np.where(np.abs(signed - signed[best]) * h > _APART_S, norm, 0.0)
    other = int(np.argmax(elsewhere))
    rivals = norm[other] > _SECOND_PEAK * peak
    return start_s, float(grid_s[0] + signed[other] * h) if rivals else None


def _correlate(
    command: Array, accel: Array, rate_hz: float, band_hz: tuple[float, float]
) -> tuple[Array, float]:
    """Return the inner products of command and accelerations in the band, and their correlation."""
    size = next_fast_len(len(command), real=True)
    passed = np.flatnonzero(band_pass(rfftfreq(size, 1.0 / rate_hz), band_hz))
    u = rfft(command, size)[passed]
    a = rfft(accel, size, axis=0)[passed]
    vector = np.real(u.conj() @ a)
    along = a @ (vector / max(float(np.linalg.norm(vector)), 1e-300))
    energy = float(np.sum(np.abs(u) ** 2) * np.sum(np.abs(along) ** 2))
    return np.asarray(vector, np.float64), float(np.linalg.norm(vector) / np.sqrt(energy or 1.0))
