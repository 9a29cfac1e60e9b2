"""Find the part of a print that an accelerometer log covers, and the sensor's mounting.

The nozzle's predicted acceleration p (x, y) and the log m (three columns) are related by
m(t) = D p(t + lag) + noise with unknown 3 x 2 matrix D and a lag that drifts with the clocks. Below
the first resonances p does not depend on the model, so a coarse search there finds the place; the
lag is then followed from segment to segment.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.signal import butter, correlate, sosfiltfilt
from scipy.stats import theilslopes

from stillpath.models.arrays import Array
from stillpath.models.errors import ModelError
from stillpath.models.identification.readers import read_measurements
from stillpath.models.identification.types import AccelerationLog

__all__ = ["Match", "Signal", "band_pass", "log_signal", "match", "read_log"]

_COARSE_HZ = 125.0
_COARSE_BAND_HZ = (2.0, 22.0)
_FINE_BAND_HZ = (3.0, 60.0)
_WINDOW_S = 40.0
_SEGMENTS_S = (2.5, 8.0)
_SHORTEST_S = 4.0
_CANDIDATES, _NEAR = 6, 0.05
_REACH_S = 0.2
_FOLLOWS = 0.5
"""A segment follows the plan if this share of its power is explained."""
_JUMP_S = 4e-3
"""Largest clock drift between segments; more is a pause that is not in the plan."""


@dataclass(frozen=True, slots=True)
class Signal:
    """Rows sampled every `dt_s` from time `t0_s` on, shape (rows, n)."""

    t0_s: float
    dt_s: float
    rows: Array

    @property
    def duration_s(self) -> float:
        """Time from the first to the last sample."""
        return float(self.dt_s * (self.rows.shape[1] - 1))

    def at(self, t_s: Array) -> Array:
        """Return the rows at other times, by cubic interpolation, shape (rows, len(t_s))."""
        own = self.t0_s + self.dt_s * np.arange(self.rows.shape[1])
        inside = slice(*np.searchsorted(own, [t_s[0] - 8 * self.dt_s, t_s[-1] + 8 * self.dt_s]))
        return np.asarray(CubicSpline(own[inside], self.rows[:, inside], axis=1)(t_s))


@dataclass(frozen=True, slots=True)
class Match:
    """Where a log belongs.

    Attributes
    ----------
    explained : float
        Share of the log's power (2 to 22 Hz) that the plan explains at the best place, 0 to 1.
    plan_start_s, plan_end_s : float
        The part of the plan that the log follows without a jump.
    offset_s, rate : float
        Log time = offset_s + rate * plan time.
    places : int
        Places in the plan that fit about as well (repeated layers); the best one was taken.
    """

    explained: float
    plan_start_s: float
    plan_end_s: float
    offset_s: float
    rate: float
    log_s: float
    places: int

    def log_time_s(self, plan_s: Array) -> Array:
        """Return the log's time at times of the plan."""
        return self.offset_s + self.rate * plan_s


def band_pass(signal: Array, dt_s: float, low_hz: float, high_hz: float) -> Array:
    """Return rows, shape (..., n), within a band, without delay (Butterworth, there and back)."""
    nyquist = 0.5 / dt_s
    sos = butter(3, [low_hz / nyquist, min(high_hz / nyquist, 0.95)], "band", output="sos")
    return np.asarray(sosfiltfilt(sos, signal, axis=-1))


def read_log(path: Path, otherwise: str) -> AccelerationLog:
    """Read raw accelerations.

    Parameters
    ----------
    otherwise : str
        Advice in the message about a file of another kind.

    Raises
    ------
    ModelError
        The file cannot be read, or holds something else.
    """
    recorded = read_measurements(path)[0]
    if not isinstance(recorded, AccelerationLog):
        kind = type(recorded).__name__
        raise ModelError(f"{path.name} holds no raw accelerations but a {kind}; {otherwise}")
    return recorded


def log_signal(log: AccelerationLog) -> Signal:
    """Return a log on a uniform grid, gravity removed; columns not recorded are left out.

    Raises
    ------
    ModelError
        For a log that is too short or too slow to be compared.
    """
    t = log.time_s
    if len(t) < 2 or t[-1] - t[0] < _SHORTEST_S:
        seconds = t[-1] - t[0] if len(t) else 0.0
        raise ModelError(f"{log.source}: {seconds:.1f} s are too short; record {_SHORTEST_S:g} s")
    dt_s = float(np.median(np.diff(t)))
    if dt_s > 1.0 / 400.0:
        raise ModelError(f"{log.source}: {1 / dt_s:.6g} samples per second are too few; 400 needed")
    columns = log.accel_mm_s2[:, np.all(np.isfinite(log.accel_mm_s2), axis=0)]
    if columns.shape[1] == 0:
        raise ModelError(f"{log.source}: no column of accelerations is complete")
    grid = t[0] + dt_s * np.arange(int((t[-1] - t[0]) / dt_s) + 1)
    rows = CubicSpline(t, columns - np.median(columns, axis=0))(grid).T
    return Signal(float(t[0]), dt_s, np.ascontiguousarray(rows))


def match(plan: Signal, log: Signal) -> Match:
    """Find the place of a log in a plan.

    Parameters
    ----------
    plan : Signal
        Predicted acceleration of the nozzle, rows x y, from time 0 on.
    """
    segment_s = float(np.clip(log.duration_s / 8.0, *_SEGMENTS_S))
    coarse_plan, coarse_log = (_coarse(signal) for signal in (plan, log))
    first, count = _busiest(coarse_log, round(_WINDOW_S * _COARSE_HZ))
    window = coarse_log[:, first : first + count]
    # The log may begin before the plan or end after it.
    pad = count - 1
    padded = np.pad(coarse_plan, ((0, 0), (pad, pad)))
    explained = _explained(padded, window)
    tracks = []
    for place in _peaks(explained):
        lag = place - pad - first
        followed = _follow(coarse_plan, coarse_log, lag, segment_s)
        tracks.append((followed, float(explained[place])))
    (segments, lags, shares), best = max(tracks, key=lambda track: float(np.sum(track[0][2])))
    places = sum(bool(np.sum(t[0][2]) > 0.98 * np.sum(shares)) for t in tracks)
    good = shares > _FOLLOWS
    at_s, lag_s = _refined(plan, log, segments[good], lags[good], segment_s)
    if len(at_s) == 0:
        return Match(best, 0.0, 0.0, 0.0, 1.0, log.duration_s, places)
    run = _longest_run(at_s, lag_s, segment_s)
    at_s, lag_s = at_s[run], lag_s[run]
    # Plan time = log time + lag.
    slope, intercept = (
        (0.0, float(lag_s[0])) if len(run) < 3 else map(float, theilslopes(lag_s, at_s)[:2])
    )
    half = 0.5 * segment_s
    low, high = at_s[0] - half, at_s[-1] + half
    start, end = ((1.0 + slope) * t + intercept for t in (low, high))
    rate = 1.0 / (1.0 + slope)
    return Match(
        explained=best,
        plan_start_s=max(start, 0.0),
        plan_end_s=min(end, plan.duration_s),
        offset_s=-intercept * rate,
        rate=rate,
        log_s=log.duration_s,
        places=places,
    )


def _coarse(signal: Signal) -> Array:
    """Low frequencies at `_COARSE_HZ`."""
    low = band_pass(signal.rows, signal.dt_s, *_COARSE_BAND_HZ)
    t = np.arange(int(signal.duration_s * _COARSE_HZ)) / _COARSE_HZ
    own = signal.dt_s * np.arange(low.shape[1])
    return np.stack([np.interp(t, own, row) for row in low])


def _busiest(log: Array, count: int) -> tuple[int, int]:
    """First sample and length of the window with the most motion."""
    count = min(count, log.shape[1])
    power = np.concatenate([[0.0], np.cumsum(np.sum(log**2, axis=0))])
    return int(np.argmax(power[count:] - power[:-count])), count


def _explained(plan: Array, window: Array) -> Array:
    """Share of the window's power that m = D p explains, at every place in the plan.

    Least squares over D at each lag: c' P^-1 c summed over the columns of m, with the correlations
    c of m and p and the Gram matrix P of p in the window.
    """
    n = window.shape[1]
    cross = np.array([[correlate(p, m, "valid", "fft") for p in plan] for m in window])

    def sums(product: Array) -> Array:
        total = np.concatenate([[0.0], np.cumsum(product)])
        return np.asarray(total[n:] - total[:-n])

    xx, xy, yy = sums(plan[0] ** 2), sums(plan[0] * plan[1]), sums(plan[1] ** 2)
    # Avoid chance matches where the plan hardly moves.
    floor = 1e-3 * float(np.max(xx + yy)) + 1e-12
    xx, yy = xx + floor, yy + floor
    cx, cy = cross[:, 0], cross[:, 1]
    found = np.sum(yy * cx**2 - 2 * xy * cx * cy + xx * cy**2, axis=0) / (xx * yy - xy**2)
    return np.asarray(found / (float(np.sum(window**2)) + 1e-12))


def _peaks(explained: Array) -> list[int]:
    """Return the best place and others almost as good, half a second apart at least."""
    left = explained.copy()
    apart = round(0.5 * _COARSE_HZ)
    out: list[int] = []
    while len(out) < _CANDIDATES:
        k = int(np.argmax(left))
        if out and left[k] < explained[out[0]] - _NEAR:
            break
        out.append(k)
        left[max(k - apart, 0) : k + apart + 1] = -np.inf
        if not np.isfinite(left).any():
            break
    return out


def _follow(plan: Array, log: Array, lag: int, segment_s: float) -> tuple[Array, Array, Array]:
    """Follow a lag (samples) through the segments of the log, from the middle one outwards.

    Returns
    -------
    first, lags, shares : ndarray, shape (segments,)
        First sample of each segment in the log, its lag, and how much of it is explained.
    """
    n, reach = round(segment_s * _COARSE_HZ), round(_REACH_S * _COARSE_HZ)
    n = min(n, log.shape[1])
    first = np.arange(0, log.shape[1] - n + 1, n)
    pad = n + reach
    padded = np.pad(plan, ((0, 0), (pad, pad)))
    lags, shares = np.zeros(len(first)), np.zeros(len(first))
    for order in (range(len(first)), reversed(range(len(first)))):
        now = lag
        for k in order:
            a = first[k] + now + pad - reach
            if not 0 <= a <= padded.shape[1] - n - 2 * reach:
                continue
            window = log[:, first[k] : first[k] + n]
            found = _explained(padded[:, a : a + n + 2 * reach], window)
            best = int(np.argmax(found))
            if found[best] >= shares[k]:
                lags[k], shares[k] = now + best - reach, found[best]
            if found[best] > _FOLLOWS:
                now += best - reach
    return first, lags, shares


def _refined(
    plan: Signal, log: Signal, first: Array, lags: Array, segment_s: float
) -> tuple[Array, Array]:
    """Log time in the middle of each segment, and its lag in seconds to a part of a sample."""
    dt = plan.dt_s
    fine = band_pass(plan.rows, dt, *_FINE_BAND_HZ)
    smooth = Signal(log.t0_s, log.dt_s, band_pass(log.rows, log.dt_s, *_FINE_BAND_HZ))
    reach = round(1.5 / _COARSE_HZ / dt)
    at, out = [], []
    for begin, lag in zip(first, lags, strict=True):
        t = log.t0_s + begin / _COARSE_HZ
        a = round((begin + lag) / _COARSE_HZ / dt)
        n = round(min(segment_s, log.t0_s + log.duration_s - t) / dt)
        low, high = a - reach, a + n + reach
        if low < 0 or high > fine.shape[1]:
            continue
        window = smooth.at(t + dt * np.arange(n))
        found = _explained(fine[:, low:high], window)
        k = int(np.clip(np.argmax(found), 1, len(found) - 2))
        left, middle, right = found[k - 1 : k + 2]
        bend = left - 2 * middle + right
        shift = 0.5 * (left - right) / bend if bend < 0 else 0.0
        at.append(t + 0.5 * n * dt)
        out.append(dt * (low + k + float(np.clip(shift, -1, 1))) - t)
    return np.array(at), np.array(out)


def _longest_run(at_s: Array, lag_s: Array, segment_s: float) -> NDArray[np.int64]:
    """Rows of the longest stretch whose lag does not jump."""
    rows = np.arange(len(at_s))
    cuts = np.flatnonzero((np.abs(np.diff(lag_s)) > _JUMP_S) | (np.diff(at_s) > 1.5 * segment_s))
    runs = np.split(rows, cuts + 1)
    return np.asarray(max(runs, key=len))
