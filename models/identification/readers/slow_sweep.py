"""Whether a file shows the slow square wave that Klipper's test has had since 2024-12."""

from __future__ import annotations

import math

import numpy as np

from stillpath.models.identification.readers.table_range import first_band_hz
from stillpath.models.identification.types import AccelerationLog, Spectrum

__all__ = ["log_sweeps", "table_sweeps"]

_MOVED_MM_S2 = 500.0
"""Acceleration, rms: below it the sensor did not move with the test and tells nothing."""
_BESIDE_SLOW_HZ, _SLOW_RATE_HZ, _LEAST_SLOW_S = 0.05, 20.0, 30.0
"""Of a log: half the band about the slow frequency, the rate at which it is looked for, and the
least duration."""
_SLOW_MM_S2 = (60.0, 180.0)
"""Slow motion in a log without and with the slow sweep, rms: its 400 mm/s^2 are 360 in the first
harmonic."""
_SLOW_BAND_HZ, _SLOW_IN_TABLE_MM_S2 = (1.0, 4.0), (110.0, 150.0)
_LEAST_SLOW = 0.5
"""The same in a table, where the window leaves 228 mm/s^2 of the slow sweep, 1.5 times the power of
the test itself from 8 to 15 Hz. Without it up to 92 mm/s^2 and 0.21 times (45 real tables); more of
a test with a large accel_per_hz."""


def table_sweeps(table: Spectrum, start_hz: float | None) -> bool | None:
    """Return whether a table shows the slow square wave of tests since 2024-12; None if unsure."""
    axes = [psd for name, psd in table.psd.items() if name in ("x", "y", "z")]
    densities = np.array([np.sum(axes, axis=0)] if axes else [*table.psd.values()])
    powers = densities * np.gradient(table.f_hz)

    def largest(band_hz: tuple[float, float]) -> float:
        within = (table.f_hz >= band_hz[0]) & (table.f_hz <= band_hz[1])
        return float(powers[:, within].sum(axis=1).max())

    if table.f_hz[0] > _SLOW_BAND_HZ[1]:
        # Klipper before 2024-12 cuts normalised tables at 5 Hz (shaper_calibrate.py, 16b4b6b30).
        return False
    slow = largest(_SLOW_BAND_HZ)
    least, most = np.square(_SLOW_IN_TABLE_MM_S2)
    if slow >= most and slow >= _LEAST_SLOW * largest(first_band_hz(start_hz)):
        return True
    moved = largest((0.0, math.inf)) >= _MOVED_MM_S2**2
    return False if slow <= least and moved else None


def log_sweeps(log: AccelerationLog, period_s: float) -> bool | None:
    """Return whether a log shows the slow square wave of tests since 2024-12; None if unsure."""
    time_s, accel = log.time_s, log.accel_mm_s2
    accel = accel[:, ~np.isnan(accel).any(axis=0)]
    if not accel.size or time_s[-1] - time_s[0] < _LEAST_SLOW_S:
        return None
    rate_hz = len(time_s) / float(time_s[-1] - time_s[0])
    block = max(1, round(rate_hz / _SLOW_RATE_HZ))
    means = accel[: len(accel) // block * block].reshape(-1, block, accel.shape[1]).mean(axis=1)
    f_hz = np.fft.rfftfreq(len(means), block / rate_hz)
    slow = np.fft.rfft(means - means.mean(axis=0), axis=0) / len(means)
    inside = np.abs(f_hz - 1.0 / period_s) <= _BESIDE_SLOW_HZ
    slow_mm_s2 = math.sqrt(2.0 * float(np.sum(np.abs(slow[inside]) ** 2)))
    if slow_mm_s2 >= _SLOW_MM_S2[1]:
        return True
    moved_mm_s2 = math.sqrt(float(np.sum(np.var(accel, axis=0))))
    return False if slow_mm_s2 <= _SLOW_MM_S2[0] and moved_mm_s2 >= _MOVED_MM_S2 else None
