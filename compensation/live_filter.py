"""A time-invariant preview filter per axis, for compensation at print time.

A printing firmware knows its plan some hundredths of a second ahead. A finite impulse response over
+-80 ms fits into that: u(k) = sum_j h(j) y_d(k - j). It is designed for all members of a plant set
at once. Standstill and constant speed pass unchanged: its DC gain is exactly 1 and its first moment
exactly 0.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter1d

from stillpath.models.arrays import Array
from stillpath.models.plants import DiscretePlant
from stillpath.models.shaper_pulses import Pulses

__all__ = ["FADE", "REACH", "LiveFilter", "design_taps", "shaper_taps"]

REACH = 80
"""Taps on either side, samples of 1 ms."""
FADE = 24
"""Samples in which the filter fades out before, and in after, motion that limits forbid."""
_FREQUENCIES = 1001
_SLOW_HZ, _FAST_HZ = 1.0, 20.0
"""Corners of the spectrum of printed motion: acceleration is flat between them, ~ 1/f above."""


@dataclass(frozen=True, slots=True)
class LiveFilter:
    """The filter that the extra inside Klipper applies to a plan.

    Attributes
    ----------
    taps : ndarray, shape (2, 2 reach + 1)
        Taps of X and Y; tap `reach + j` weights the plan j samples earlier.
    dt_s, velocity_mm_s, accel_mm_s2 : float
        Sampling time, and limits of the command of an axis.
    bounds_mm : ndarray, shape (2, 2)
        Travel of X and Y.
    motor_velocity_mm_s, motor_accel_mm_s2 : float
        Limits of x + y and of x - y, the motors of a CoreXY.
    """

    taps: Array
    dt_s: float
    velocity_mm_s: float
    accel_mm_s2: float
    bounds_mm: Array
    motor_velocity_mm_s: float = math.inf
    motor_accel_mm_s2: float = math.inf

    @property
    def margin(self) -> int:
        """Samples that must be known on either side."""
        return int(self.taps.shape[1]) // 2 + 2 * FADE + 2

    def command(self, path_mm: Array) -> Array:
        """Return the command for all samples but `margin` of them at either end.

        Where the filtered path would break a limit that the path itself keeps, the share of the
        filter is less, and changes within `FADE` samples around.

        Parameters
        ----------
        path_mm : ndarray, shape (2, n)

        Returns
        -------
        ndarray, shape (2, n - 2 margin)
            Samples of a motion whose acceleration is constant between the midpoints of samples.
        """
        reach = self.taps.shape[1] // 2
        plan = path_mm[:, reach:-reach]
        away = np.stack(
            [
                np.convolve(row - row[:1], taps, "valid") - (mid - row[:1])
                for row, taps, mid in zip(path_mm, self.taps, plan, strict=True)
            ]
        )
        allowed = self._allowed(plan, away)
        if allowed.min() < 1.0:
            ramp = np.convolve(np.ones(FADE + 1), np.ones(FADE + 1))
            least = minimum_filter1d(allowed, 2 * FADE + 1)[FADE:-FADE]
            share = np.convolve(least, ramp / ramp.sum(), "valid")
        else:
            share = np.ones(len(allowed) - 4 * FADE)
        cut = 2 * FADE + 1
        points = plan[:, cut:-cut] + share * away[:, cut:-cut]
        # Values of the quadratic B-spline with these control points.
        return np.asarray((points[:, :-2] + 6.0 * points[:, 1:-1] + points[:, 2:]) / 8.0)

    def _allowed(self, plan: Array, away: Array) -> Array:
        """Return the largest share that keeps the limits, for all samples but the outermost."""
        share = np.ones(plan.shape[1] - 2)

        def keep(own: Array, more: Array, most: float | Array) -> None:
            too_much = np.abs(own + more) > most
            room = np.maximum(most - own * np.sign(more), 0.0)
            size = np.maximum(np.abs(more), 1e-300)
            np.minimum(share, np.where(too_much, np.minimum(room, size) / size, 1.0), out=share)

        def keep_moving(own: Array, more: Array, velocity_mm_s: float, accel_mm_s2: float) -> None:
            keep(np.diff(own, 2), np.diff(more, 2), accel_mm_s2 * self.dt_s**2)
            keep(np.diff(own)[:-1], np.diff(more)[:-1], velocity_mm_s * self.dt_s)

        of_motors = self.motor_velocity_mm_s, self.motor_accel_mm_s2
        if np.isfinite(of_motors).any():
            keep_moving(plan[0] + plan[1], away[0] + away[1], *of_motors)
            keep_moving(plan[0] - plan[1], away[0] - away[1], *of_motors)
        for own, more, (least, most) in zip(plan, away, self.bounds_mm, strict=True):
            keep_moving(own, more, self.velocity_mm_s, self.accel_mm_s2)
            centre = (least + most) / 2.0
            keep(own[1:-1] - centre, more[1:-1], (most - least) / 2.0)
        return share


def design_taps(
    members: Sequence[DiscretePlant], weights: Array, corner_hz: float, reach: int = REACH
) -> Array:
    """Design the filter of one axis for a set of plants.

    Parameters
    ----------
    members : sequence of DiscretePlant
        With DC gain 1, no delay of slow motion, and one sampling time.
    weights : ndarray, shape (len(members),)
        Probability of each member; sum 1.
    corner_hz : float
        Frequency from which the command's acceleration outweighs the error it removes.

    Returns
    -------
    ndarray, shape (2 reach + 1,)

    Notes
    -----
    Least squares in frequency: sum_m w_m |1 - B G_m H|^2 S + (f / corner)^4 |H|^2 S, S the
    spectrum of acceleration-limited motion and B that of the quadratic B-spline which the motors
    follow. The members enter by P = sum_m w_m |B G_m|^2 and C = sum_m w_m conj(B G_m) / P (the
    ensemble of `docs/method.md` in frequency; dissertation (4.22)). The constraints on gain and
    first moment are eliminated from the unknowns.
    """
    dt_s = members[0].dt_s
    f = np.linspace(0.0, 0.5 / dt_s, _FREQUENCIES)[1:]
    spline = 0.75 + 0.25 * np.cos(2.0 * np.pi * f * dt_s)
    responses = [spline * m.frequency_response(f) for m in members]
    power = sum(w * np.abs(g) ** 2 for w, g in zip(weights, responses, strict=True))
    target = sum(w * np.conj(g) for w, g in zip(weights, responses, strict=True)) / power
    motion = 1.0 / ((f**2 + _SLOW_HZ**2) * np.sqrt(1.0 + (f / _FAST_HZ) ** 2))
    delays = np.arange(-reach, reach + 1)
    wave = np.exp(-2j * np.pi * dt_s * np.outer(f, delays))
    error, effort = motion * np.sqrt(power), motion * (f / corner_hz) ** 2
    rows = np.concatenate([error[:, None] * wave, effort[:, None] * wave])
    wanted = np.concatenate([error * target, np.zeros(len(f))])
    start = (delays == 0).astype(float)
    free = _moving_nothing(delays)
    matrix = np.concatenate([rows.real, rows.imag]) @ free
    residual = wanted - rows @ start
    found = np.linalg.lstsq(matrix, np.concatenate([residual.real, residual.imag]), rcond=1e-12)[0]
    return exact_moments(start + free @ found)


def shaper_taps(pulses: Pulses, dt_s: float, reach: int = REACH) -> Array:
    """Return a centred firmware shaper as taps; pulses between samples are split.

    Raises
    ------
    ValueError
        If it is longer than the filter.
    """
    weights, delays = pulses
    late = (delays - float(weights @ delays)) / dt_s + reach
    if late.min() < 0.0 or late.max() > 2 * reach - 1:
        raise ValueError(f"the shaper is longer than {2 * reach * dt_s:g} s")
    taps = np.zeros(2 * reach + 1)
    whole = np.floor(late).astype(int)
    np.add.at(taps, whole, weights * (1.0 - late + whole))
    np.add.at(taps, whole + 1, weights * (late - whole))
    return exact_moments(taps)


def exact_moments(taps: Array) -> Array:
    """Return taps corrected for rounding: gain exactly 1, first moment exactly 0."""
    late = np.arange(len(taps)) - len(taps) // 2
    reach = float(late @ late)
    for _ in range(3):
        taps = taps - (float(np.sum(taps * late)) / reach) * late
        taps = taps.copy()
        taps[len(taps) // 2] += 1.0 - float(np.sum(taps))
    return taps


def _moving_nothing(late: NDArray[np.int64]) -> Array:
    """Return a basis, (n, n - 2), of filters with zero gain and first moment."""
    held = np.stack([np.ones(len(late)), late / np.abs(late).max()])
    return np.asarray(np.linalg.svd(held)[2][2:].T)
