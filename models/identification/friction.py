"""Dry friction in logs of Klipper's test, and responses corrected for it.

Where the motion reverses, friction reverses too, and the axis receives 2 c less than its command
(`models.friction`): an additional input, known up to its size. It has harmonics, and depends on
slow and fast motion together, so no linear response explains it; the size is the one with the
smallest residual of the logs. Only the band below the resonance is used, as the instants of
reversal are too uncertain above it. Friction makes responses of the fundamental look damped and
stiff; responses to the corrected command do not.

Below the resonance friction delays the fundamental by 8 c over the test's mm/s per Hz, and a frame
that shakes does so too. Alignment takes that for a later start, so the start is searched again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft, rfftfreq
from scipy.signal.windows import tukey

from stillpath.models.arrays import Array, Complex
from stillpath.models.friction import bend_of
from stillpath.models.identification.alignment import AlignedLog
from stillpath.models.identification.estimation import plateau_gain
from stillpath.models.identification.local_model import (
    Transformed,
    local_response,
    log_residual,
)
from stillpath.models.identification.types import FrequencyResponse
from stillpath.models.plants import MOST_FRICTION_MM, PlantSetSpec

__all__ = [
    "CLEARLY",
    "SIZES_MM",
    "Friction",
    "better_explained",
    "beyond_slow",
    "dry_friction",
    "freed",
    "lowest_size",
]

SIZES_MM = 1e-3 * np.array(
    [0.0, 0.5, 1.0, 2.0, 3.5, 5.0, 7.0, 10.0, 14.0, 20.0, 28.0, 40.0, 57.0, 80.0, 100.0]
)
_LATE_S = 1e-3 * np.array([-1.0, 0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0])
_HIGHEST_HZ, _BELOW, _STEP_HZ, _HALF_BAND_HZ = 35.0, 0.7, 0.5, 1.0
_LEAST_HZ = 4.0
"""Width of the band that must be left below the resonance."""
_TAPER = 0.01
CLEARLY = 0.01
"""Logarithm of the ratio of residuals with friction and without."""
_ABOVE, _CLEARLY_STUCK = 1.1, 0.3
"""Guides stick above the resonance, if the logarithm of the residual falls by this on average."""
_APART = 0.5
"""Largest spread of repeats relative to their mean; beyond it, the cause is not friction."""


@dataclass(frozen=True, slots=True)
class Friction:
    """What the logs of one axis say about its friction.

    Attributes
    ----------
    held_mm : float
        Distance by which it holds the axis back; 0 where no friction is clear.
    late_s : float
        By how much alignment placed the start of the test too late.
    motion : int
        Index of the candidate motion that explains the logs best.
    """

    held_mm: float = 0.0
    late_s: float = 0.0
    motion: int = 0

    def on(self, plants: PlantSetSpec) -> PlantSetSpec:
        """Return plants of the axis with its friction, where there is any."""
        return plants.with_friction(self.held_mm) if self.held_mm else plants


def dry_friction(
    logs: Sequence[AlignedLog], motions: Sequence[Sequence[FrequencyResponse]]
) -> Friction:
    """Return the friction that explains repeats best.

    Parameters
    ----------
    logs : sequence of AlignedLog
        Repeats.
    motions : sequence of sequence of FrequencyResponse
        Candidate sliding motions: each a response per log (as measured; relative to the frame).
    """
    every = [[_left(log, one) for log, one in zip(logs, way, strict=True)] for way in motions]
    rows = [np.stack(way) for way in every if way and all(left.size for left in way)]
    if len(rows) < len(motions) or not rows:
        return Friction()
    motion = int(np.argmin([left.mean(axis=0).min() for left in rows]))
    left = rows[motion].mean(axis=0)
    late = int(np.argmin(left.min(axis=1)))
    held_mm = lowest_size(left[late])
    alone = [lowest_size(one[int(np.argmin(one.min(axis=1)))]) for one in rows[motion]]
    clear = left[:, 0].min() - left.min() > CLEARLY
    agree = max(alone) - min(alone) <= _APART * held_mm
    # Where the residual still falls at the latest start that was tried, it has no minimum.
    clear = clear and late < len(_LATE_S) - 1
    return Friction(held_mm, float(_LATE_S[late]), motion) if clear and agree else Friction()


def freed(
    aligned: AlignedLog, response: FrequencyResponse, friction: Friction
) -> tuple[AlignedLog, AlignedLog]:
    """Return the log with its start and its command corrected for friction; with its start only."""
    command = aligned.command_mm_s2
    size = next_fast_len(len(command), real=True)
    f_hz = rfftfreq(size, 1.0 / aligned.rate_hz)
    earlier = irfft(rfft(command, size) * _earlier(f_hz, friction.late_s), size)[: len(command)]
    held = friction.held_mm * _bend_rate(aligned, response)
    started = replace(aligned, command_mm_s2=earlier, start_s=aligned.start_s - friction.late_s)
    return replace(started, command_mm_s2=earlier - held), started


def better_explained(sliding: FrequencyResponse, stuck: FrequencyResponse) -> FrequencyResponse:
    """Return the response corrected for friction, and the other one above where that is better.

    Well above the resonance an axis moves so little that its guides stick, and act as springs.
    """
    gain = log_residual(sliding.coherence) - log_residual(stuck.coherence)
    resonance_hz = sliding.f_hz[np.argmax(np.abs(sliding.response))]
    above = sliding.f_hz > _ABOVE * resonance_hz
    from_here = np.where(above, np.cumsum(gain[::-1])[::-1], -np.inf)
    first = int(np.argmax(from_here))
    sticks = np.arange(len(gain)) >= first
    if not from_here[first] > _CLEARLY_STUCK * np.count_nonzero(sticks):
        return sliding
    return replace(
        sliding,
        response=np.where(sticks, stuck.response, sliding.response),
        sd=np.where(sticks, stuck.sd, sliding.sd),
        coherence=np.where(sticks, stuck.coherence, sliding.coherence),
    )


def _left(aligned: AlignedLog, response: FrequencyResponse) -> Array:
    """Return the mean log residual by lateness and size of friction, shape (late, sizes)."""
    top_hz = min(_HIGHEST_HZ, _BELOW * float(response.f_hz[np.argmax(np.abs(response.response))]))
    f_hz = np.arange(float(response.f_hz[0]), top_hz, _STEP_HZ)
    if top_hz - float(response.f_hz[0]) < _LEAST_HZ:
        return np.zeros((0, 0))
    # The transforms are linear, so they are needed once for all sizes.
    n = len(aligned.command_mm_s2)
    size = next_fast_len(n, real=True)
    spacing_hz = aligned.rate_hz / size
    bins = int((top_hz + 2 * _HALF_BAND_HZ) / spacing_hz)
    window = tukey(n, _TAPER) / np.sqrt(n)
    command, rate, measured = (
        rfft(row * window, size)[:bins]
        for row in (
            aligned.command_mm_s2,
            _bend_rate(aligned, response),
            aligned.measured_mm_s2,
        )
    )

    bins_hz = np.asarray(np.arange(bins) * spacing_hz, np.float64)

    def left(late_s: float, size_mm: float) -> float:
        received = command * _earlier(bins_hz, late_s) - size_mm * rate
        found = local_response([Transformed(spacing_hz, received, measured)], f_hz, _HALF_BAND_HZ)
        return float(np.mean(log_residual(found.coherence)))

    return np.array([[left(late_s, size_mm) for size_mm in SIZES_MM] for late_s in _LATE_S])


def _earlier(f_hz: Array, late_s: float) -> Complex:
    return np.asarray(np.exp(2j * np.pi * f_hz * late_s))


def lowest_size(left: Array) -> float:
    """Return the minimum of a parabola through the lowest value and its neighbours."""
    i = int(np.clip(np.argmin(left), 1, len(left) - 2))
    near = slice(i - 1, i + 2)
    bend, slope, _ = np.polyfit(SIZES_MM[near], left[near], 2)
    lowest = -0.5 * slope / bend if bend > 0 else SIZES_MM[int(np.argmin(left))]
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
    extra = irfft(beyond_slow(response, f_hz) / s_squared * rfft(accel, size), size)[: len(accel)]
    bend = bend_of(way + extra)
    return np.pad(np.diff(bend, 2), 1) / step_s**2


def beyond_slow(response: FrequencyResponse, f_hz: Array) -> Complex:
    """Return G - 1 as it was measured, its level set aside, at the frequencies `f_hz`."""
    own_hz = response.f_hz
    level = plateau_gain(response) or float(np.median(np.abs(response.response[:9])))
    sign = 1.0 if response.response[: max(3, len(own_hz) // 20)].real.sum() >= 0 else -1.0
    known = np.append(0.0, own_hz)
    extra = np.append(0.0, sign * response.response / level - 1.0)
    # Beyond the test an axis hardly moves.
    return np.asarray(np.interp(f_hz, known, extra, right=-1.0), np.complex128)
