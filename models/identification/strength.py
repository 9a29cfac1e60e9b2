"""How strong the pulses of a resonance test were, by the slow sweep beside them."""

from __future__ import annotations

import numpy as np
from scipy.fft import next_fast_len, rfft
from scipy.signal.windows import tukey

from stillpath.models.arrays import Array
from stillpath.models.identification.local_model import (
    Transformed,
    local_response,
    log_residual,
)

__all__ = ["strength"]

_TRIED, _NEAR = np.geomspace(0.4, 4.0, 28), np.linspace(0.91, 1.09, 7)
_BAND_HZ, _STEP_HZ, _HALF_BAND_HZ = 9.0, 0.25, 1.0
"""From the beginning of the test on. Above, the harmonics of the slow sweep fade."""
_TAPER = 0.01
_CLEARLY = 0.05
"""Logarithm of the ratio of residuals from which another strength is clear; it is .3 and more but
where an axis rubs and the frame shakes. On a heavy bed slinger with its frame at 9 Hz (2026-11-29)
the residual was .03 smaller at .8, with pulses of just the strength that was assumed. (The level
does not tell: that frame lifts it by a fifth.)"""


def strength(
    slow: Array, pulses: Array, measured: Array, rate_hz: float, f_start_hz: float
) -> float:
    """Return the ratio of the pulses' acceleration to that which was assumed.

    At any frequency an axis responds to the harmonics of the slow sweep as to the pulses, whatever
    friction, the frame or the sensor's gain make of it. So only the right ratio of the two leaves
    a response that is smooth: it has the smallest residual. Where that is not clear, it is 1.

    Parameters
    ----------
    slow, pulses, measured : ndarray, shape (n,)
        The slow sweep and the pulses as commanded, and what followed, mm/s^2.
    """
    n = len(measured)
    size = next_fast_len(n, real=True)
    spacing_hz = rate_hz / size
    bins = int((f_start_hz + _BAND_HZ + 2.0 * _HALF_BAND_HZ) / spacing_hz)
    window = tukey(n, _TAPER) / np.sqrt(n)
    swept, pulsed, seen = (rfft(row * window, size)[:bins] for row in (slow, pulses, measured))
    f_hz = np.arange(f_start_hz + _HALF_BAND_HZ, f_start_hz + _BAND_HZ - _HALF_BAND_HZ, _STEP_HZ)

    def left(ratio: float) -> float:
        record = Transformed(spacing_hz, np.asarray(swept + ratio * pulsed, np.complex128), seen)
        coherence = local_response([record], f_hz, _HALF_BAND_HZ).coherence
        return float(np.mean(log_residual(coherence)))

    rough = min(_TRIED.tolist(), key=left)
    tried = rough * _NEAR
    residuals = np.array([left(float(ratio)) for ratio in tried])
    i = int(np.clip(np.argmin(residuals), 1, len(tried) - 2))
    bend, slope, _ = np.polyfit(tried[i - 1 : i + 2] - tried[i], residuals[i - 1 : i + 2], 2)
    ratio = float(tried[i] - 0.5 * slope / bend) if bend > 0.0 else rough
    return ratio if left(1.0) - left(ratio) > _CLEARLY else 1.0
