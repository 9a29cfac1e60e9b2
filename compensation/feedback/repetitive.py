"""Plug-in repetitive control at the loop's rate, for whole and fractional periods (paper 004).

    C_all = (C + P^-1 L) / (1 - L),   L = (1 - a^N) z^-N / (1 - a^N z^-N) * prod q_j(1/z) q_j(z)

With the servo V = P / (1 + PC), for which 1/V = 1/P + C, that is C plus an add-on

    R = L / (1 - L) * 1/V      on the control error,

and neither P, which has an integrator, nor 1/P has to be computed. With the exact inverse
S = S0 (1 - L); with E = V times its approximate inverse, S = S0 (1 - L) / (1 + L (E - 1)).

The period need not divide the sampling rate: ``wide-band`` rounds N and widens the notches by a,
``quasi`` takes the greatest common divisor for the fundamental; `compensation.feedback.multirate`
takes the least common multiple for the rate.

The inverse: zeros of V up to radius 0.97 are cancelled; those near the circle are cancelled as if
they lay at 0.97 (an exact inverse rings there: paper 004's own fast plant has two at |z| = 1), and
those outside are expanded into the future, which the period's delay allows.

A baseline with integral action blocks constants from the add-on, V(1) = 0. A memory of constants
would drift unnoticed in y, so the mean over a period is subtracted: the gain is zero at constants
and unchanged at the harmonics.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import diric

from stillpath.compensation.feedback.controller import (
    CoefficientSet,
    Controller,
    Design,
    Extreme,
    Prediction,
    Refusal,
    Uncertainty,
    frequency_grid,
    judged,
)
from stillpath.models.arrays import Array, Complex
from stillpath.models.diagrams import Block, polynomial_response
from stillpath.models.loops import Loop

__all__ = [
    "Compared",
    "InternalModel",
    "ServoInverse",
    "design_quasi",
    "design_wide_band",
    "exact_frequency",
    "instant_margin",
    "internal_model",
    "invert_servo",
    "notch_grid",
    "observed_error",
    "periodic_residual",
    "plug_in_factor",
    "repetitive_blocks",
    "repetitive_coefficients",
    "shared_period",
]

Compared = Literal["response", "reference"]
"""Whether the error is the output less the loop's response to the reference, which leaves every
reference as it is, or less the reference itself (the paper's figure 2), which makes the output
follow periodic references but takes the lead of a prefiltered one for an error."""
_RADIUS = 0.97
_SERIES_LEFT = 1e-3
_LARGEST_PERIOD = 1000
_NOTHING = 1e-9
_LOWEST_NOTCH = 1e-2


@dataclass(frozen=True, slots=True)
class InternalModel:
    """L, the memory of a repetitive controller over a period.

    Attributes
    ----------
    period : int
        N, samples.
    alpha : float
        a in 0..1: smaller is wider.
    nyquist_pairs : int
        n0: the low-pass is cos(w/2)^(2 n0).
    notches : tuple of float
        Further zero-phase pairs, rad per sample: ((cos w - cos W) / (1 - cos W))^2.
    mean_free : bool
        Subtract the mean over a period: constants are not rejected.
    """

    period: int
    alpha: float
    nyquist_pairs: int = 3
    notches: tuple[float, ...] = ()
    mean_free: bool = False

    @property
    def taps(self) -> Array:
        """Symmetric zero-phase filter: a low-pass of sum 1, less the mean if `mean_free`."""
        taps = np.ones(1)
        for _ in range(self.nyquist_pairs):
            taps = np.convolve(taps, [0.25, 0.5, 0.25])
        for notch in self.notches:
            pair = np.array([0.5, -math.cos(notch), 0.5]) / (1 - math.cos(notch))
            taps = np.convolve(taps, np.convolve(pair, pair))
        if self.mean_free:
            taps = np.convolve(taps, self._without_mean())
        return np.asarray(taps)

    @property
    def lead(self) -> int:
        """Samples by which the low-pass looks ahead."""
        return len(self.taps) // 2

    def lowpass(self, angle: ArrayLike) -> Array:
        """Return the low-pass at `angle` rad per sample; real."""
        w = np.asarray(angle, float)
        value = np.cos(w / 2) ** (2 * self.nyquist_pairs)
        for notch in self.notches:
            value = value * ((np.cos(w) - math.cos(notch)) / (1 - math.cos(notch))) ** 2
        if self.mean_free:
            even = np.cos(w / 2) if self.period % 2 == 0 else 1.0
            value = value * (1 - diric(w, self.period) * even)
        return np.asarray(value)

    def response(self, angle: ArrayLike) -> Complex:
        """Return L at `angle` rad per sample."""
        w = np.asarray(angle, float)
        past, share = np.exp(-1j * w * self.period), self.alpha**self.period
        return np.asarray((1 - share) * past / (1 - share * past) * self.lowpass(w))

    def generator(self) -> tuple[Array, Array]:
        """Return numerator and denominator of z^(N - lead) L / (1 - L), powers of z^-1."""
        share = self.alpha**self.period
        den = np.zeros(self.period + self.lead + 1)
        den[0] = 1.0
        den[self.period] -= share
        den[self.period - self.lead :] -= (1 - share) * self.taps
        return (1 - share) * self.taps, den

    def _without_mean(self) -> Array:
        """Return 1 less the mean over a period; an even one has half samples at its ends."""
        taps = np.full(2 * (self.period // 2) + 1, -1.0 / self.period)
        if self.period % 2 == 0:
            taps[[0, -1]] *= 0.5
        taps[self.period // 2] += 1.0
        return taps


@dataclass(frozen=True, slots=True, eq=False)
class ServoInverse:
    """z^-preview / V, causal and stable.

    Attributes
    ----------
    num, den : tuple of float
        Powers of z^-1.
    preview : int
        Samples of look-ahead, to be compensated by a delay elsewhere.
    blocks_constants : bool
        V(1) = 0: its input must be free of constants.
    """

    num: tuple[float, ...]
    den: tuple[float, ...]
    preview: int
    notes: tuple[str, ...] = ()
    blocks_constants: bool = False

    def response(self, angle: ArrayLike) -> Complex:
        """Return the approximate 1/V itself at `angle` rad per sample."""
        z = np.exp(1j * np.asarray(angle, float))
        return np.asarray(polynomial_response(self.num, self.den, z) * z**self.preview)


def design_wide_band(
    loops: Sequence[Loop],
    fundamental_hz: float,
    *,
    alpha: float = 0.8,
    nyquist_pairs: int = 3,
    notches_hz: Sequence[float] = (),
    compared: Compared = "response",
    uncertainty: Uncertainty | None = None,
) -> Controller:
    """Design with the period rounded to whole samples and the notches widened.

    Parameters
    ----------
    loops : sequence of Loop
        The nominal loop, then the members of its plant set.
    notches_hz : sequence of float
        Frequencies at which the add-on has no effect.
    compared
        See `Compared`.
    uncertainty
        See `compensation.feedback.controller.judged`.

    Raises
    ------
    Refusal
        If the period is too short for the inverse, or the loop would be unstable.
    """
    period = round(1.0 / (loops[0].dt_s * fundamental_hz)) if fundamental_hz > 0 else 0
    model = internal_model(loops[0].dt_s, period, alpha, nyquist_pairs, notches_hz)
    asked = {"fundamental_hz": fundamental_hz, "alpha": alpha, "nyquist_pairs": nyquist_pairs,
             "notches_hz": tuple(notches_hz)}  # fmt: skip
    return _designed("rc-wide", loops, model, fundamental_hz, asked, compared, uncertainty)


def design_quasi(
    loops: Sequence[Loop],
    fundamental_hz: float,
    *,
    alpha: float = 0.999,
    nyquist_pairs: int = 3,
    notches_hz: Sequence[float] = (),
    compared: Compared = "response",
    uncertainty: Uncertainty | None = None,
) -> Controller:
    """Design for the greatest common divisor of fundamental and sampling rate.

    Parameters and errors as `design_wide_band`. A divisor far below the fundamental makes a long
    memory, most of whose notches are where nothing is to be rejected (a note says how many).
    """
    rate_hz = 1.0 / loops[0].dt_s
    share = shared_period(rate_hz, fundamental_hz)
    if share.denominator > _LARGEST_PERIOD:
        fits_hz = float(share.limit_denominator(_LARGEST_PERIOD)) * rate_hz
        raise Refusal(
            "singular",
            f"{fundamental_hz:g} and {rate_hz:g} Hz share a period of {share.denominator} samples "
            f"only (limit {_LARGEST_PERIOD}): the nearest fundamental that fits is {fits_hz:.7g} "
            "Hz; or use the wide-band design",
        )
    model = internal_model(loops[0].dt_s, share.denominator, alpha, nyquist_pairs, notches_hz)
    asked = {"fundamental_hz": fundamental_hz, "divisor_hz": rate_hz / share.denominator,
             "alpha": alpha, "nyquist_pairs": nyquist_pairs,
             "notches_hz": tuple(notches_hz)}  # fmt: skip
    note = f"one notch of {share.numerator} lies on the disturbance"
    return _designed(
        "rc-quasi", loops, model, fundamental_hz, asked, compared, uncertainty, (note,)
    )


def shared_period(rate_hz: float, fundamental_hz: float) -> Fraction:
    """Return fundamental over rate as M/N: N samples hold M periods.

    Both are rounded to 1 mHz. If N is then longer than any memory, a shorter N is used that still
    matches the fundamental to 1 mHz: 1230.769 Hz at 16 kHz is 1/13.
    """
    rate, wanted = exact_frequency(rate_hz), exact_frequency(fundamental_hz)
    share = wanted / rate
    short = share.limit_denominator(_LARGEST_PERIOD)
    return short if abs(short * rate - wanted) <= Fraction(1, 2000) else share


def exact_frequency(f_hz: float) -> Fraction:
    """Return a frequency as a fraction, exact to 1 mHz.

    Raises
    ------
    Refusal
        If it is not positive.
    """
    if not (math.isfinite(f_hz) and f_hz > 0):
        raise Refusal("singular", f"frequency {f_hz} Hz must be positive")
    return Fraction(round(f_hz * 1000), 1000)


def invert_servo(num: Sequence[float], den: Sequence[float]) -> ServoInverse:
    """Return a causal, stable inverse of V = num/den up to a preview.

    Parameters
    ----------
    num, den : sequence of float
        Powers of z^-1.
    """
    radius = _RADIUS
    top = np.trim_zeros(np.asarray(num, float), "b")
    delay = int(np.flatnonzero(top)[0])
    top = top[delay:]
    blocked = abs(float(top.sum())) <= _NOTHING * float(np.abs(top).sum())
    if blocked:
        # Handled separately: the gain is matched at DC, where this zero makes it 0.
        top = np.polydiv(top, [1.0, -1.0])[0]
    zeros = np.roots(top)
    size = np.abs(zeros)
    near = (size > radius) & (size <= 1 / radius)
    far = zeros[size > 1 / radius]
    pulled = np.where(near, radius * zeros / np.where(size == 0, 1, size), zeros)[
        size <= 1 / radius
    ]
    # The steady gain counts; moving a pole would change it.
    bottom = np.real(np.poly(pulled)) if len(pulled) else np.ones(1)
    left = float(top.sum() / bottom.sum())
    if blocked:
        bottom = np.convolve(bottom, [1.0, -radius])
    series, preview = np.ones(1), delay
    for zero in far:
        # 1 / (1 - a/z) = -(z/a) (1 + z/a + (z/a)^2 + ...), |a| > 1: the future.
        terms = max(1, math.ceil(-math.log(_SERIES_LEFT) / math.log(abs(zero))))
        part = -((1 / zero) ** np.arange(terms, 0, -1))
        series = np.convolve(series, part)
        preview += terms
    series = np.real(series)
    numerator = np.convolve(np.asarray(den, float), series / series.sum()) / left
    notes = [f"zero at |z| = {s:.4f} inverted as if at {radius:g}" for s in size[near][::2]]
    notes += [f"zero at |z| = {abs(zero):.4g} inverted into the future" for zero in far]
    if blocked:
        notes.append("constants are left to the baseline: its own integrator removes them")
    return ServoInverse(
        tuple(numerator.tolist()), tuple(bottom.tolist()), preview, tuple(notes), blocked
    )


def internal_model(
    dt_s: float, period: int, alpha: float, pairs: int, notches_hz: Sequence[float]
) -> InternalModel:
    """Return L with checked parameters; frequencies are for the rate 1 / `dt_s`.

    Raises
    ------
    Refusal
        If a parameter is out of range.
    """
    if not 0 < alpha < 1:
        raise Refusal("singular", f"alpha {alpha} must lie between 0 and 1")
    if not 0 <= pairs <= 20:
        raise Refusal("singular", f"{pairs} zero pairs at Nyquist; 0 to 20 are possible")
    angles = tuple(2 * math.pi * f * dt_s for f in notches_hz)
    if any(not _LOWEST_NOTCH <= angle <= math.pi for angle in angles):
        raise Refusal(
            "singular",
            f"notches {tuple(notches_hz)} Hz must lie between {_LOWEST_NOTCH / math.tau / dt_s:g} "
            f"and {0.5 / dt_s:g} Hz",
        )
    if not 2 <= period <= _LARGEST_PERIOD:
        raise Refusal(
            "singular",
            f"a period of {period} samples (2 to {_LARGEST_PERIOD} are possible): round the "
            "fundamental, or use the wide-band design",
        )
    return InternalModel(period, alpha, pairs, angles)


def plug_in_factor(internal: Complex, match: Complex | float = 1.0) -> Complex:
    """Return S/S0 = (1 - L) / (1 + L (E - 1)), E = V times the inverse in use; 1 if exact."""
    return np.asarray((1 - internal) / (1 + internal * (match - 1)))


def repetitive_blocks(
    model: InternalModel, inverse: ServoInverse, source: tuple[tuple[str, float], ...], target: str
) -> tuple[Block, Block]:
    """Return R = L / (1 - L) / V as two blocks from `source` to `target`.

    Raises
    ------
    Refusal
        If the period is shorter than the look-ahead of low-pass and inverse.
    """
    spare = model.period - model.lead - inverse.preview
    if spare < 0:
        raise Refusal(
            "inverse",
            f"a period of {model.period} samples is shorter than the {model.lead} samples of the "
            f"low-pass and the {inverse.preview} of the inverse; fewer zero pairs, or multirate",
        )
    num, den = model.generator()
    generator = Block("rc", source, tuple(num.tolist()), tuple(den.tolist()), delay=spare)
    return generator, Block(target, (("rc", 1.0),), inverse.num, inverse.den)


def observed_error(
    loop: Loop, compared: Compared, every: int = 1
) -> tuple[tuple[Block, ...], tuple[tuple[str, float], ...]]:
    """Return blocks, and the signals and gains whose sum is the error; ticks as `Loop.blocks`."""
    if compared == "reference":
        return (), (("ym", 1.0), ("r", -1.0))
    expected = Block("expected", (("r", 1.0),), loop.tracking_num, loop.t0_den, every=every)
    return (expected,), (("ym", 1.0), ("expected", -1.0))


def notch_grid(dt_s: float, period: int, fundamental_hz: float) -> Array:
    """Return frequencies that are dense around the harmonics and around all notches of a memory.

    The add-on is least robust beside a notch, and most of them may not lie on harmonics.
    """
    spacing_hz = 1.0 / (dt_s * period)
    notches = spacing_hz * np.arange(1, (period + 1) // 2)
    harmonics = np.arange(fundamental_hz, 0.5 / dt_s, fundamental_hz)
    centres = [*notches.tolist(), *harmonics.tolist()]
    return frequency_grid(dt_s, centres, [0.05 * spacing_hz] * len(centres))


def instant_margin(loop: Loop, model: InternalModel, harmonics_hz: Sequence[float]) -> Extreme:
    """Return min 1/|T| in closed form: around a narrow notch T follows a circle.

    Its diameter is from T0 to T0 + S0 q, q the low-pass there; so the largest |T| of a notch is
    |T0 + S0 q / 2| + |S0 q / 2|. Exact for a -> 1, without the inverse's error.
    """
    f = np.asarray(harmonics_hz, float)
    half = 0.5 * loop.s0(f) * model.lowpass(2 * np.pi * f * loop.dt_s)
    allowed = 1.0 / (np.abs(loop.t0(f) + half) + np.abs(half))
    worst = int(np.argmin(allowed))
    return Extreme(float(allowed[worst]), float(f[worst]))


def periodic_residual(servo: Complex, factor: Complex, amplitudes: Sequence[float]) -> float:
    """Return the rms of y under sine disturbances at the plant's input."""
    lines = np.abs(servo * factor) * np.asarray(amplitudes, float)
    return math.sqrt(float(np.sum(lines**2)) / 2)


def repetitive_coefficients(
    model: InternalModel, inverse: ServoInverse
) -> tuple[CoefficientSet, ...]:
    """Return the coefficients to load: the memory of a period, and the inverse after it."""
    return (
        CoefficientSet(
            "memory",
            "repetitive",
            {
                "period": model.period,
                "share": float(model.alpha**model.period),
                "lead": model.lead,
                "taps": tuple(model.taps.tolist()),
            },
        ),
        CoefficientSet(
            "inverse", "iir", {"num": inverse.num, "den": inverse.den, "preview": inverse.preview}
        ),
    )


def _designed(
    method: str,
    loops: Sequence[Loop],
    model: InternalModel,
    fundamental_hz: float,
    asked: dict[str, object],
    compared: Compared,
    uncertainty: Uncertainty | None,
    notes: tuple[str, ...] = (),
) -> Controller:
    nominal = loops[0]
    inverse = invert_servo(nominal.servo_num, nominal.t0_den)
    model = replace(model, mean_free=inverse.blocks_constants)
    expected, error = observed_error(nominal, compared)
    blocks = (*expected, *repetitive_blocks(model, inverse, error, "c"))
    f = notch_grid(nominal.dt_s, model.period, fundamental_hz)
    angle = 2 * np.pi * f * nominal.dt_s
    match = nominal.servo(f) * inverse.response(angle)
    factor = plug_in_factor(model.response(angle), match)
    design = Design(
        method,
        blocks,
        Prediction(f, nominal.s0(f), factor),
        repetitive_coefficients(model, inverse),
        settings=asked | {"compared": compared, "period": model.period},
        notes=(*inverse.notes, *notes),
    )
    return judged(design, loops, uncertainty)
