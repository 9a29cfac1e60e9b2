"""Read a ring test's accelerometer log: the vibration after every stop that it covers.

The log is located by `matching`, and rotated by least squares into its direction of motion while
the file moves one axis. A stop counts if the log shows its braking.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal.windows import tukey

from stillpath.applications.proof.matching import Match, Signal, band_pass, log_signal, match
from stillpath.applications.proof.ring_motion import RATE_HZ, RingMotion, Stop
from stillpath.applications.proof.ring_test import Axis
from stillpath.models.arrays import Array
from stillpath.models.identification.readers.checks import check_range
from stillpath.models.identification.types import AccelerationLog

__all__ = [
    "AxisLog",
    "FrequencyBand",
    "Power",
    "floor",
    "joined",
    "lag_s",
    "misplaced",
    "misses",
    "place",
    "read_axis",
    "residual",
    "unusable",
]

WINDOW_S = (0.01, 0.31)
"""Evaluated time after a stop; the clock is known to about a millisecond."""
_MOUNT_BAND_HZ = (3.0, 20.0)
_BRAKING_S = 0.06
"""Time on both sides of the braking that is checked for it in the log."""
_COHERENT = 0.6
_TAPER = 0.2
_MATCHED, CORRELATED = 0.5, 0.8
GAINS = (0.6, 1.6)
"""A sensor may be 16 % off, and a frame excited by reaction adds up to about 30 %."""
_EDGE_S = 0.1
_KEPT_HZ = (0.5, 0.4 * RATE_HZ)
"""Pass band of the log: removes what could alias into the compared band."""
_SETTLED_S = 0.5
"""Time after which vibration of the move before a rest has decayed."""
_LOWEST_HZ = 5.0
_LAG_BAND_HZ = (3.0, 30.0)
_LAG_SAMPLES = 20


@dataclass(frozen=True, slots=True)
class FrequencyBand:
    """Frequency band of the evaluated vibration."""

    low_hz: float
    high_hz: float


@dataclass(frozen=True, slots=True)
class Power:
    """Mean squares after each stop, shape (stops,): acceleration in (mm/s^2)^2, way in um^2."""

    accel: Array
    way: Array


@dataclass(frozen=True, slots=True, eq=False)
class AxisLog:
    """One axis of a log, on the file's time.

    Attributes
    ----------
    measured : ndarray, shape (n,)
        Acceleration along the axis at the samples of the command; 0 outside the log.
    inside : ndarray of bool, shape (n,)
        Where there is a log.
    gain : float
        Measured over predicted acceleration, 3 to 20 Hz.
    correlation : float
        Of both, in that band, over the whole axis.
    seen : tuple of Stop
        Those whose braking is in the log.
    within : int
        Number of stops in the time of the log.
    clipped : str
        Why the sensor's range is too small; empty: it is not.
    """

    axis: Axis
    measured: Array
    inside: NDArray[np.bool_]
    gain: float
    correlation: float
    seen: tuple[Stop, ...]
    within: int
    clipped: str


def place(log: AccelerationLog, predicted: Array) -> tuple[Signal, Match]:
    """Return a log on a uniform grid, and where it lies in a ring test.

    Parameters
    ----------
    predicted : ndarray, shape (2, n)
        Accelerations of X and Y.

    Raises
    ------
    ModelError
        For a log that is too short or too slow.
    """
    signal = log_signal(log)
    return signal, match(Signal(0.0, 1.0 / RATE_HZ, predicted), signal)


def read_axis(
    log: AccelerationLog,
    signal: Signal,
    found: Match,
    motion: RingMotion,
    predicted: Array,
    axis: Axis,
) -> AxisLog | None:
    """Return the ringing of an axis in a log; None if it was taken at another time of the file.

    Parameters
    ----------
    predicted : ndarray, shape (n,)
        Acceleration of the axis.
    """
    dt = 1.0 / RATE_HZ
    t = np.asarray(np.arange(len(predicted)) * dt, np.float64)
    own = found.log_time_s(t)
    last_s = signal.t0_s + signal.duration_s
    rows = np.flatnonzero((own > signal.t0_s + _EDGE_S) & (own < last_s - _EDGE_S))
    about = motion.about[axis][rows]
    if np.count_nonzero(about) < RATE_HZ:
        return None
    low_hz, high_hz = _KEPT_HZ
    smooth = Signal(signal.t0_s, signal.dt_s, band_pass(signal.rows, signal.dt_s, low_hz, high_hz))
    m = smooth.at(own[rows])
    low_p, low_m = (band_pass(x, dt, *_MOUNT_BAND_HZ)[..., about] for x in (predicted[rows], m))
    d = low_m @ low_p / max(float(low_p @ low_p), 1e-12)
    gain = float(np.linalg.norm(d))
    along = d / max(gain, 1e-12)
    spread = float(np.linalg.norm(low_p) * np.linalg.norm(along @ low_m))
    measured, inside = np.zeros(len(predicted)), np.zeros(len(predicted), bool)
    measured[rows], inside[rows] = along @ m, True
    within = [s for s in motion.stops if s.axis == axis and _covered(inside, s)]
    columns = dict(zip("xyz", log.accel_mm_s2.T, strict=True))
    recorded = {name: v for name, v in columns.items() if np.all(np.isfinite(v))}
    return AxisLog(
        axis,
        measured,
        inside,
        gain,
        float(along @ low_m @ low_p) / max(spread, 1e-12),
        tuple(s for s in within if _coherent(measured, predicted, s)),
        len(within),
        " ".join(check_range(recorded)),
    )


def misplaced(name: str, found: Match) -> str:
    """Return why a log has no place in the file; empty if it has."""
    if found.explained >= _MATCHED and found.plan_end_s > found.plan_start_s:
        return ""
    return (
        f"{name} is not of this file: the best place explains {100 * found.explained:.0f} % of "
        "what the sensor felt between 2 and 22 Hz"
    )


def unusable(
    name: str,
    log: AxisLog | None,
    axis: Axis,
    *,
    gains: tuple[float, float] = GAINS,
    correlated: float = CORRELATED,
) -> str:
    """Return why a log says nothing of an axis; empty if it does.

    Parameters
    ----------
    gains, correlated : (float, float), float
        What its gain and its correlation must be.
    """
    if log is None:
        return f"{name} was not taken while the file moved {axis.upper()}"
    if not gains[0] <= log.gain <= gains[1] or log.correlation < correlated:
        return (
            f"in {name} the sensor felt {log.gain:.2f} of the commanded motion of {axis.upper()} "
            f"(correlation {log.correlation:.2f}, 3 to 20 Hz): it is not fixed to the part "
            f"that moves in {axis.upper()}, or its scale is wrong"
        )
    return f"{name}: {log.clipped}" if log.clipped else ""


def residual(accel: Array, stops: Sequence[Stop], band: FrequencyBand) -> Power:
    """Return the vibration in a band after each stop; `accel`, (n,), is in mm/s^2 at `RATE_HZ`."""
    return _power(accel, [stop.at_s + WINDOW_S[0] for stop in stops], band)


def floor(log: AxisLog, motion: RingMotion, band: FrequencyBand) -> Power:
    """Return the vibration before the first move, which the machine does not cause."""
    length_s = WINDOW_S[1] - WINDOW_S[0]
    starts = [
        start
        for from_s, until_s in motion.quiet_s[log.axis]
        for start in np.arange(until_s - length_s - 0.05, from_s + _SETTLED_S, -length_s)
    ]
    ok = [s for s in starts if log.inside[_rows(s, length_s)].all()]
    return _power(log.measured, ok, band)


def joined(parts: Sequence[Power]) -> Power:
    """Return the stops of several logs as one."""
    return Power(np.concatenate([p.accel for p in parts]), np.concatenate([p.way for p in parts]))


def misses(log: AxisLog, motion: RingMotion, predicted: Array, band: FrequencyBand) -> float:
    """Return how much of the motion a prediction misses, 0 to 1 and above.

    The rms of measured minus predicted acceleration over that of the measured one, gain and lag of
    the sensor fitted, its noise floor taken off both.

    Parameters
    ----------
    predicted : ndarray, shape (n,)
        Acceleration along the log's axis, mm/s^2 at `RATE_HZ`, as long as the log.
    """
    own = np.flatnonzero(motion.about[log.axis] & log.inside)
    at = np.arange(len(predicted))
    late = np.interp(at - lag_s(log, motion, predicted) * RATE_HZ, at, predicted)
    m, p = (
        band_pass(x[log.inside], 1.0 / RATE_HZ, _LOWEST_HZ, band.high_hz)
        for x in (log.measured, late)
    )
    kept = np.searchsorted(np.flatnonzero(log.inside), own)
    m, p = m[kept], p[kept]
    rest = m - p * float(m @ p) / max(float(p @ p), 1e-12)
    noise = float(floor(log, motion, FrequencyBand(_LOWEST_HZ, band.high_hz)).accel.mean())
    missed, whole = (float(np.mean(x**2)) - noise for x in (rest, m))
    return float(np.sqrt(max(missed, 0.0) / max(whole, 1e-12)))


def lag_s(log: AxisLog, motion: RingMotion, predicted: Array) -> float:
    """Return the delay of the log relative to a prediction (as of `misses`), below the modes."""
    m, p = (band_pass(x, 1.0 / RATE_HZ, *_LAG_BAND_HZ) for x in (log.measured, predicted))
    kept = motion.about[log.axis] & log.inside
    shifts = np.arange(-_LAG_SAMPLES, _LAG_SAMPLES + 1)
    product = np.array([m[kept] @ np.roll(p, k)[kept] for k in shifts])
    k = int(np.clip(np.argmax(product), 1, len(product) - 2))
    left, middle, right = product[k - 1 : k + 2]
    bend = left - 2 * middle + right
    fraction = 0.5 * (left - right) / bend if bend < 0 else 0.0
    return float((shifts[k] + np.clip(fraction, -1.0, 1.0)) / RATE_HZ)


def _rows(start_s: float, length_s: float) -> slice:
    first = round(start_s * RATE_HZ)
    return slice(first, first + round(length_s * RATE_HZ))


def _power(accel: Array, starts_s: Sequence[float], band: FrequencyBand) -> Power:
    n = round((WINDOW_S[1] - WINDOW_S[0]) * RATE_HZ)
    window = tukey(n, _TAPER)
    f = np.fft.rfftfreq(n, 1.0 / RATE_HZ)
    inside = (f >= band.low_hz) & (f <= band.high_hz)
    first = np.rint(np.asarray(starts_s) * RATE_HZ).astype(int)
    cut = accel[first[:, None] + np.arange(n)] if len(first) else np.zeros((0, n))
    cut = cut - cut.mean(axis=1, keepdims=True)
    power = 2.0 * np.abs(np.fft.rfft(window * cut, axis=1)[:, inside]) ** 2
    power /= n * float(np.sum(window**2))
    to_um = 1e3 / (2 * np.pi * f[inside]) ** 2
    return Power(power.sum(axis=1), (power * to_um**2).sum(axis=1))


def _covered(inside: NDArray[np.bool_], stop: Stop) -> bool:
    first, last = _around(stop)
    end = round((stop.at_s + WINDOW_S[1]) * RATE_HZ)
    return first >= 0 and end < len(inside) and bool(inside[first : max(last, end)].all())


def _coherent(measured: Array, predicted: Array, stop: Stop) -> bool:
    first, last = _around(stop)
    m, p = measured[first:last], predicted[first:last]
    product = float(np.linalg.norm(m) * np.linalg.norm(p))
    return float(m @ p) > _COHERENT * product > 0.0


def _around(stop: Stop) -> tuple[int, int]:
    first = round((stop.from_s - _BRAKING_S) * RATE_HZ)
    return first, round((stop.at_s + _BRAKING_S) * RATE_HZ)
