"""PD design by pole placement, with velocity from the output (paper 002, section III-C).

    v = kp (r - y) - kv (1 - p) (1 - z^-1) / (1 - p z^-1) y,    p = exp(-2 pi corner dt)

The poles are placed for a pure inertia 2 b0 z^-1 / (1 - z^-1)^2 without the filter's pole: the
variant that gives the paper's 40 degrees and 9.3 dB. With the velocity of the error instead of the
output, the ZPETC filter would peak at 27.5 dB and not above 50.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from stillpath.compensation.base import DesignError
from stillpath.models.arrays import Complex
from stillpath.models.loops import Loop

__all__ = ["Margins", "inertia_pd", "loop_margins", "margins"]

_POINTS = 200_001


@dataclass(frozen=True, slots=True)
class Margins:
    """Stability margins of an open loop; infinite where there is no crossover."""

    phase_deg: float
    phase_at_hz: float
    gain_db: float
    gain_at_hz: float


def inertia_pd(b0: float, dt_s: float, f_hz: float, zeta: float) -> tuple[float, float]:
    """Return kp and kv that place the poles of an inertia.

    Parameters
    ----------
    b0 : float
        The plant is b0 (1 + z^-1) / (1 - z^-1)^2 with any delay; K dt^2 / 2.
    f_hz, zeta : float
        Natural frequency and damping ratio of the dominant poles.

    Raises
    ------
    DesignError
        If the poles are not below the Nyquist frequency, or not damped.
    """
    if not (0 < f_hz < 0.5 / dt_s and 0 < zeta <= 1 and b0 > 0):
        raise DesignError(
            f"PD poles at {f_hz:g} Hz with damping {zeta:g}: 0 to {0.5 / dt_s:g} Hz and above 0 "
            f"up to 1 are possible, with b0 {b0:g} above 0"
        )
    rate = 2 * math.pi * f_hz * dt_s
    decay = math.exp(-zeta * rate)
    a1 = -2 * decay * math.cos(rate * math.sqrt(1 - zeta**2))
    a2 = decay**2
    return (1 + a1 + a2) / (2 * b0), (1 - a2) / (2 * b0)


def loop_margins(loop: Loop) -> Margins:
    """Return the margins of P C, opened at the plant's input."""
    f_hz = np.linspace(0.5 / loop.dt_s / _POINTS, 0.5 / loop.dt_s, _POINTS)
    return margins(f_hz, loop.t0(f_hz) / loop.s0(f_hz))


def margins(f_hz: ArrayLike, open_loop: Complex) -> Margins:
    """Return the smallest margins of a measured or computed open loop.

    Parameters
    ----------
    f_hz : array_like, shape (n,)
        Rising and dense: crossovers are interpolated.
    open_loop : ndarray of complex, shape (n,)
        Negative feedback.
    """
    f = np.asarray(f_hz, float)
    size = 20 * np.log10(np.abs(open_loop))
    phase = np.degrees(np.unwrap(np.angle(open_loop)))
    # Shift the phase so that crossings of -180 degrees lie at multiples of 360.
    turn = np.mod(phase + 180.0, 360.0)
    phase_margin, phase_at = math.inf, math.nan
    for i in np.flatnonzero(np.diff(np.sign(size)) != 0):
        share = size[i] / (size[i] - size[i + 1])
        angle = np.mod(phase[i] + share * (phase[i + 1] - phase[i]) + 180.0 + 180.0, 360.0) - 180.0
        if abs(angle) < abs(phase_margin):
            phase_margin, phase_at = float(angle), float(f[i] + share * (f[i + 1] - f[i]))
    gain_margin, gain_at = math.inf, math.nan
    for i in np.flatnonzero(np.abs(np.diff(turn)) > 180.0):
        down = turn[i] if turn[i] < 180.0 else turn[i] - 360.0
        up = turn[i + 1] if turn[i + 1] < 180.0 else turn[i + 1] - 360.0
        share = down / (down - up)
        left = -float(size[i] + share * (size[i + 1] - size[i]))
        if abs(left) < abs(gain_margin):
            gain_margin, gain_at = left, float(f[i] + share * (f[i + 1] - f[i]))
    return Margins(phase_margin, phase_at, gain_margin, gain_at)
