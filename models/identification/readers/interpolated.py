"""Takes the interpolation of Klipper's tables of several data sets back to the bins behind it."""

from __future__ import annotations

import numpy as np

from stillpath.models.arrays import Array

__all__ = ["at_bins"]

_BINS_HZ = (1.002, 2.005)
"""Half a second, rounded up to a power of two of samples (klippy/extras/shaper_calibrate.py); a
table is as straight between halves of its bins."""
_STEP_HZ = 5e-4
_LEAST_ROWS, _LEAST_BINS = 4, 16
_STRAIGHT = 0.3
"""Between the right bins only rounding bends a table, by 0.05 of what it bends in all."""


def at_bins(f_hz: Array, psd: Array) -> tuple[Array, Array]:
    """Return densities at the bins that a table was interpolated between; others as they are.

    Klipper since 2025-11 writes several data sets every 0.2 Hz, on lines between their bins
    (shaper_calibrate.py, 2aff840f6). The width of the bins is that of the sensor's window, so
    damping depends on it, and the lines lie below every peak.

    Parameters
    ----------
    f_hz, psd : ndarray, shape (rows,) and (rows, columns)
    """
    step_hz = float(f_hz[-1] - f_hz[0]) / (len(f_hz) - 1)
    if _LEAST_ROWS * step_hz > _BINS_HZ[0] or np.ptp(np.diff(f_hz)) > 0.1 * step_hz:
        return f_hz, psd
    # Each data set has bins of its own; the axis is identified from the strongest.
    strongest = psd[:, int(np.argmax(psd.sum(axis=0)))]
    bin_hz = _bin_between(f_hz, strongest, step_hz)
    if bin_hz is None:
        return f_hz, psd
    first, last = np.ceil(f_hz[0] / bin_hz - 1e-6), np.floor(f_hz[-1] / bin_hz)
    bins_hz = bin_hz * np.arange(first, last + 1.0)
    if len(bins_hz) < _LEAST_BINS:
        return f_hz, psd
    columns = [_corners(f_hz, one, bins_hz) for one in psd.T]
    return bins_hz, np.column_stack(columns)


def _bin_between(f_hz: Array, density: Array, step_hz: float) -> float | None:
    """Return the width in Hz of bins between which the density is straight, if there is one."""
    middle = 0.5 * (density[:-2] + density[2:])
    bent = np.abs(density[1:-1] - middle) / np.maximum(middle, np.finfo(float).tiny)
    at = f_hz[1:-1]
    widths = np.arange(*_BINS_HZ, _STEP_HZ)
    left = np.floor((at - step_hz) / widths[:, None])
    within = left == np.floor((at + step_hz) / widths[:, None])
    bends = (within * bent).sum(axis=1) / np.maximum(within.sum(axis=1), 1)
    best = int(np.argmin(bends))
    return float(widths[best]) if bends[best] < _STRAIGHT * np.median(bends) else None


def _corners(f_hz: Array, density: Array, bins_hz: Array) -> Array:
    """Return the values at the bins whose connecting lines are nearest to the density."""
    bin_hz = bins_hz[1] - bins_hz[0]
    used = (f_hz >= bins_hz[0]) & (f_hz <= bins_hz[-1]) & (density > 0.0)
    if np.count_nonzero(used) < len(bins_hz):
        return np.asarray(np.interp(bins_hz, f_hz, density))
    straight = np.interp(bins_hz, f_hz, density)
    hats = np.maximum(1.0 - np.abs(f_hz[used, None] - bins_hz) / bin_hz, 0.0)
    # Normalised tables begin with values of 1e-43: each counts by its own size.
    shares = hats * straight / density[used, None]
    found = straight * np.linalg.lstsq(shares, np.ones(len(shares)), rcond=None)[0]
    # A bin that no row determines, beside rows without a value.
    return np.asarray(np.where(found > 0.0, found, straight))
