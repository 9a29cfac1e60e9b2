"""Model-based multirate predictor (MMP) and observer for tones beyond the sensor's Nyquist rate.

Paper 001 (Xiao, Jiang, Chen, Mechatronics 2019). A sensor gives every L-th sample; between them
d[nL + k] = sum_j w_kj dL[n - j] - sum_j b_j d[(n - j)L + k], exact for the tones it is made for.
The published system (22)-(24) has 2mL unknowns; only its 2m equations at the tones matter:
W_k(e^-jth_i) = e^(jw_i k) B(e^-jth_i), w_i = 2 pi f_i Ts, th_i = L w_i.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from stillpath.compensation.base import DesignError
from stillpath.compensation.feedback.controller import (
    CoefficientSet,
    Controller,
    Design,
    Prediction,
    Refusal,
    Uncertainty,
    frequency_grid,
    judged,
)
from stillpath.compensation.feedback.fmsdob import Shape, band_widths, design_q, model_blocks
from stillpath.models.arrays import Array, Complex
from stillpath.models.diagrams import Block, polynomial_response
from stillpath.models.disturbances import SensorSpec
from stillpath.models.loops import Loop

__all__ = ["Predictor", "mmp", "predictor", "predictor_of_gain", "singular_distance_hz"]

DEFAULT_NOISE_GAIN = 2.0
_ALPHAS = (0.5, 0.7, 0.8, 0.85, 0.9, 0.93, 0.95, 0.97, 0.98, 0.99)


@dataclass(frozen=True, slots=True, eq=False)
class Predictor:
    """Predicts fast samples from slow ones.

    Attributes
    ----------
    f_hz : tuple of float
        The tones it is exact for.
    ratio : int
        L, fast samples per slow one.
    dt_s : float
        Between fast samples.
    alpha : float
        Pole radius per slow sample: 0 has no memory, near 1 averages noise.
    b : tuple of float
        1, b_1 .. b_2m.
    w : ndarray, shape (L, 2m)
        Row k gives the sample k after the newest slow one.
    late : int
        Age of the newest slow sample, in slow samples. If 0, row 0 is unused: the sample is known.
    """

    f_hz: tuple[float, ...]
    ratio: int
    dt_s: float
    alpha: float
    b: tuple[float, ...]
    w: Array
    late: int = 0

    @property
    def runs(self) -> tuple[tuple[tuple[float, ...], tuple[float, ...]], ...]:
        """Numerator and denominator, per slow sample, of the L interleaved filters."""
        rows = tuple((tuple(row.tolist()), self.b) for row in self.w)
        return rows if self.late else (((1.0,), (1.0,)), *rows[1:])

    @property
    def noise_gain(self) -> float:
        """Largest rms of a predicted sample per rms of white noise on the slow ones."""
        z = np.exp(1j * np.linspace(0, np.pi, 4097))
        predicting = self.runs if self.late else self.runs[1:]
        power = [np.mean(np.abs(polynomial_response(*run, z)) ** 2) for run in predicting]
        return float(np.sqrt(max(power)))

    @property
    def settling_s(self) -> float:
        """Time in which the initial transient decays to 1 %."""
        runs = len(self.b) if self.alpha == 0 else math.log(0.01) / math.log(self.alpha)
        return runs * self.ratio * self.dt_s

    def response(self, f_hz: ArrayLike) -> Complex:
        """Return the part of the output at f of a tone at f; 1 at the tones (no aliases)."""
        w = 2 * np.pi * np.atleast_1d(np.asarray(f_hz, float)) * self.dt_s
        slow = np.exp(1j * w * self.ratio)
        parts = [
            np.exp(-1j * w * (k + self.late * self.ratio)) * polynomial_response(*run, slow)
            for k, run in enumerate(self.runs)
        ]
        return np.asarray(np.mean(parts, axis=0), complex)

    def coefficients(self) -> CoefficientSet:
        """Return the coefficients that a controller loads."""
        w = tuple(tuple(row) for row in self.w.tolist())
        return CoefficientSet("predictor", "predictor", {"ratio": self.ratio, "b": self.b, "w": w})

    def blocks(self, source: str, target: str) -> tuple[Block, ...]:
        """Return the predictor as blocks; `source` holds its value between slow samples."""
        return tuple(
            Block(target, ((source, 1.0),), *run, every=self.ratio, phase=k)
            for k, run in enumerate(self.runs)
        )


def predictor(
    f_hz: Sequence[float], ratio: int, dt_s: float, alpha: float = 0.95, late: int = 0
) -> Predictor:
    """Return the predictor of given tones.

    Parameters
    ----------
    ratio : int
        L, at least 2.
    dt_s : float
        Between fast samples.
    alpha : float
        In [0, 1).
    late : int
        Age of the newest slow sample when it arrives, in slow samples.

    Raises
    ------
    DesignError
        If a parameter is out of range.
    Refusal
        If two tones, or a tone and its mirror image, alias to the same frequency.
    """
    if ratio < 2 or not 0 <= alpha < 1 or late < 0:
        raise DesignError(
            f"predictor with L = {ratio}, alpha = {alpha:g}, {late} samples late: L must be at "
            "least 2, alpha in [0, 1), the age not negative"
        )
    w = 2 * np.pi * np.asarray(f_hz, float) * dt_s
    if len(w) == 0 or not np.all((w > 0) & (w < np.pi)):
        raise DesignError(f"tones {list(f_hz)} Hz: each must lie between 0 and {0.5 / dt_s:g} Hz")
    distance = singular_distance_hz(f_hz, ratio * dt_s)
    if distance * ratio * dt_s < 1e-9:
        raise Refusal(
            "singular",
            f"tones {', '.join(f'{f:g}' for f in f_hz)} Hz cannot be told apart with a sensor at "
            f"{1 / (ratio * dt_s):g} Hz: two of them, or one and half its rate, look alike to it; "
            "change its rate",
        )
    b = np.ones(1)
    for turn in w * ratio:
        b = np.convolve(b, [1.0, -2 * alpha * math.cos(turn), alpha**2])
    powers = np.arange(2 * len(w))
    at = np.exp(-1j * np.outer(w * ratio, powers))
    b_at = np.polyval(b[::-1], np.exp(-1j * w * ratio))
    ahead = np.exp(1j * np.outer(w, np.arange(ratio) + late * ratio)) * b_at[:, None]
    rows = np.linalg.solve(
        np.concatenate([at.real, at.imag]), np.concatenate([ahead.real, ahead.imag])
    ).T
    tones = tuple(float(f) for f in f_hz)
    return Predictor(tones, ratio, dt_s, alpha, tuple(b.tolist()), rows, late)


def predictor_of_gain(
    f_hz: Sequence[float],
    ratio: int,
    dt_s: float,
    noise_gain: float = DEFAULT_NOISE_GAIN,
    late: int = 0,
) -> Predictor:
    """Return the fastest predictor whose noise gain is at most `noise_gain`.

    Raises
    ------
    Refusal
        If even a slow one exceeds it: the tones are too near the singular set.
    """
    for alpha in _ALPHAS:
        made = predictor(f_hz, ratio, dt_s, alpha, late)
        if made.noise_gain <= noise_gain:
            return made
    raise Refusal(
        "singular",
        f"tones {', '.join(f'{f:g}' for f in f_hz)} Hz with a sensor at {1 / (ratio * dt_s):g} Hz: "
        f"noise gain {made.noise_gain:.3g} even at alpha = {made.alpha:g} (at most "
        f"{noise_gain:g}); they lie {singular_distance_hz(f_hz, ratio * dt_s):.3g} Hz from tones "
        "that look alike, change the sensor's rate",
    )


def singular_distance_hz(f_hz: Sequence[float], slow_dt_s: float) -> float:
    """Return how far a set of tones is from the singular set of a sensor, paper 001 (14).

    The least distance of any f_i to a multiple of half the sensor's rate, or of any f_i +- f_j to
    a multiple of its rate.
    """
    rate = 1.0 / slow_dt_s
    tones = [float(f) for f in f_hz]
    found = [abs(f - round(2 * f / rate) * rate / 2) for f in tones]
    for i, first in enumerate(tones):
        for second in tones[:i]:
            found += [
                abs(both - round(both / rate) * rate) for both in (first + second, first - second)
            ]
    return min(found)


def mmp(
    loops: Sequence[Loop],
    targets_hz: Sequence[float],
    sensor: SensorSpec,
    *,
    alpha: float | None = 0.95,
    bandwidth_hz: float | Sequence[float] = 10.0,
    shape: Shape = "pointwise",
    noise_gain: float = DEFAULT_NOISE_GAIN,
    uncertainty: Uncertainty | None = None,
) -> Controller:
    """Design predictor and forward-model observer for tones seen by a slow sensor.

    Parameters
    ----------
    loops : sequence of Loop
        The nominal loop, then the members of its plant set.
    sensor : SensorSpec
        Its rate (`every` is L) and age.
    alpha : float or None
        Of the predictor; None: the fastest with at most `noise_gain`.
    bandwidth_hz : float or sequence of float
        -3 dB width of the band pass, of all tones or of each.

    Raises
    ------
    DesignError
        If a parameter is out of range.
    Refusal
        Singular tones, too much noise gain, an unstable member, or small gain violated.
    """
    nominal = loops[0]
    made = _quiet_predictor(nominal, targets_hz, sensor, alpha, noise_gain)
    model = CoefficientSet("model", "iir", {"num": nominal.servo_num, "den": nominal.t0_den})
    q = design_q(nominal, targets_hz, shape=shape, bandwidth_hz=bandwidth_hz)
    f = frequency_grid(nominal.dt_s, targets_hz, band_widths(bandwidth_hz, len(targets_hz)))
    add_on = 1.0 - nominal.servo(f) * q.response(2 * np.pi * f * nominal.dt_s) * made.response(f)
    distance = singular_distance_hz(targets_hz, sensor.every * nominal.dt_s)
    design = Design(
        "mmp",
        (*_compared(nominal, sensor), *made.blocks("dslow", "dhat"), *q.blocks("dhat", "c")),
        Prediction(f, nominal.s0(f), add_on),
        (made.coefficients(), *q.coefficients(), model),
        noise_gain=made.noise_gain,
        sensor=sensor,
        settings={
            "targets_hz": [float(t) for t in targets_hz],
            "ratio": sensor.every,
            "alpha": made.alpha,
            "bandwidth_hz": _stored(bandwidth_hz),
            "shape": shape,
        },
        notes=(
            "noise gain: of the predictor, per slow sample",
            "sensitivity: at the disturbance's own frequency, aliases of others left out",
            f"the tones lie {distance:.4g} Hz from the singular set",
        ),
    )
    return judged(design, loops, uncertainty)


def _stored(bandwidth_hz: float | Sequence[float]) -> float | list[float]:
    return list(bandwidth_hz) if isinstance(bandwidth_hz, Sequence) else bandwidth_hz


def _quiet_predictor(
    loop: Loop,
    targets_hz: Sequence[float],
    sensor: SensorSpec,
    alpha: float | None,
    noise_gain: float,
) -> Predictor:
    """Return the predictor; refuse one that the servo would hear, or that multiplies noise."""
    if loop.fed_back:
        raise DesignError(
            f"mmp on {loop.name!r}: the servo is fed back and would hear the slow sensor; "
            "mmp is for sensors beside the servo (disturbed: outside)"
        )
    every, late = sensor.every, sensor.delay_samples
    if alpha is None:
        made = predictor_of_gain(targets_hz, every, loop.dt_s, noise_gain, late)
    else:
        made = predictor(targets_hz, every, loop.dt_s, alpha, late)
    if made.noise_gain > noise_gain:
        distance = singular_distance_hz(targets_hz, every * loop.dt_s)
        raise Refusal(
            "singular",
            f"mmp on {loop.name!r}: the predictor multiplies sensor noise by "
            f"{made.noise_gain:.3g} (at most {noise_gain:g}); the tones lie {distance:.3g} Hz "
            "from tones that look alike. Raise alpha, or change the sensor's rate",
        )
    return made


def _compared(loop: Loop, sensor: SensorSpec) -> tuple[Block, ...]:
    """Return blocks that compute the disturbance at the sensor's samples."""
    late, every = sensor.delay_samples, sensor.every
    return (
        *model_blocks(loop),
        Block("seen", (("model", 1.0),), delay=late, every=every),
        Block("dslow", (("ym", 1.0), ("seen", -1.0)), every=every),
    )
