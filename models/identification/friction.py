"""Dry friction in logs of Klipper's test, and responses corrected for it.

Where the motion reverses, friction reverses too, and the axis receives 2 c less than its command
(`models.friction`): an additional input, known up to its size. It has harmonics, and depends on
slow and fast motion together, so no linear response explains it; the size is the one with the
smallest residual of the logs. Only the band below the resonance is used, as the instants of
reversal are too uncertain above it. Friction makes responses of the fundamental look damped and
stiff; responses to the corrected command do not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft, rfftfreq

from stillpath.models.friction import bend_of
from stillpath.models.identification.alignment import AlignedLog
from stillpath.models.identification.averaging import low_frequency_delay
from stillpath.models.identification.estimation import plateau_gain, response_at
from stillpath.models.identification.types import FrequencyResponse
from stillpath.models.plants import MOST_FRICTION_MM

__all__ = ["dry_friction", "freed"]

Array = NDArray[np.float64]

_SIZES_MM = np.array([0.0, 0.5, 1.0, 2.0, 3.5, 5.0, 7.0, 10.0, 14.0, 20.0]) * 1e-3
_HIGHEST_HZ, _BELOW, _STEP_HZ = 35.0, 0.7, 0.25
_LEAST_HZ = 4.0
"""Width of the band that must be left below the resonance."""
_CLEARLY = 0.01
"""Logarithm of the ratio of residuals with friction and without."""
_APART = 0.5
"""Largest spread of repeats relative to their mean; beyond it, the cause is not friction."""


def dry_friction(
    logs: Sequence[AlignedLog], motions: Sequence[Sequence[FrequencyResponse]]
) -> tuple[float, int]:
    """Return the size of dry friction from repeats, and the motion that explains it best.

    Parameters
    ----------
    logs : sequence of AlignedLog
        Repeats.
    motions : sequence of sequence of FrequencyResponse
        Candidate sliding motions: each a response per log (as measured; relative to the frame).

    Returns
    -------
    held_mm : float
        0 where no friction is clear.
    motion : int
        Index of the motion that explains the logs best.
    """
    every = [[_left(log, one) for log, one in zip(logs, way, strict=True)] for way in motions]
    rows = [np.stack(way) for way in every if way and all(len(row) for row in way)]
    if len(rows) < len(motions) or not rows:
        return 0.0, 0
    motion = int(np.argmin([left.mean(axis=0).min() for left in rows]))
    left = rows[motion].mean(axis=0)
    size_mm = _lowest(left)
    alone = [_lowest(one) for one in rows[motion]]
    clear = left[0] - left.min() > _CLEARLY
    agree = max(alone) - min(alone) <= _APART * size_mm
    return (size_mm if clear and agree else 0.0), motion


def freed(aligned: AlignedLog, response: FrequencyResponse, size_mm: float) -> AlignedLog:
    """Return the log with the command corrected for friction."""
    held = size_mm * _bend_rate(aligned, response)
    return replace(aligned, command_mm_s2=aligned.command_mm_s2 - held)


def _left(aligned: AlignedLog, response: FrequencyResponse) -> Array:
    """Return the mean log residual of responses, by size of friction."""
    top_hz = min(_HIGHEST_HZ, _BELOW * float(response.f_hz[np.argmax(np.abs(response.response))]))
    f_hz = np.arange(float(response.f_hz[0]), top_hz, _STEP_HZ)
    if top_hz - float(response.f_hz[0]) < _LEAST_HZ:
        return np.zeros(0)
    rate = _bend_rate(aligned, response)
    rows = []
    for size_mm in _SIZES_MM:
        told = replace(aligned, command_mm_s2=aligned.command_mm_s2 - size_mm * rate)
        share = 1.0 - response_at(told, f_hz).coherence
        rows.append(float(np.mean(np.log(np.maximum(share, 1e-9)))))
    return np.array(rows)


def _lowest(left: Array) -> float:
    """Return the minimum of a parabola through the lowest value and its neighbours."""
    i = int(np.clip(np.argmin(left), 1, len(left) - 2))
    near = slice(i - 1, i + 2)
    bend, slope, _ = np.polyfit(_SIZES_MM[near], left[near], 2)
    lowest = -0.5 * slope / bend if bend > 0 else _SIZES_MM[int(np.argmin(left))]
    return float(np.clip(lowest, 0.0, MOST_FRICTION_MM))


def _bend_rate(aligned: AlignedLog, response: FrequencyResponse) -> Array:
    """Return the second derivative of the bend as the axis moved, shape (n,), per s^2."""
    step_s = 1.0 / aligned.rate_hz
    accel = aligned.command_mm_s2
    way = np.cumsum(np.cumsum(accel)) * step_s**2
    size = next_fast_len(2 * len(accel), real=True)
    f_hz = rfftfreq(size, step_s)
    s_squared = -((2 * np.pi * np.maximum(f_hz, f_hz[1])) ** 2)
    # Slow motion is followed exactly; the deviation from it is short and has no drift.
    extra = irfft(_extra(response, f_hz) / s_squared * rfft(accel, size), size)[: len(accel)]
    bend = bend_of(way + extra)
    return np.pad(np.diff(bend, 2), 1) / step_s**2


def _extra(response: FrequencyResponse, f_hz: Array) -> NDArray[np.complex128]:
    """Return G - 1 as it was measured: level and delay of slow motion set aside."""
    own_hz = response.f_hz
    level = plateau_gain(response) or float(np.median(np.abs(response.response[:9])))
    delay_s = low_frequency_delay(own_hz, response.response)
    turned = response.response * np.exp(2j * np.pi * own_hz * delay_s)
    sign = 1.0 if turned[: max(3, len(own_hz) // 20)].real.sum() >= 0 else -1.0
    known = np.append(0.0, own_hz)
    extra = np.append(0.0, sign * turned / level - 1.0)
    # Beyond the test an axis hardly moves.
    return np.asarray(np.interp(f_hz, known, extra, right=-1.0), np.complex128)
