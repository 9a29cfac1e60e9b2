"""Repetitive control at the least common multiple of fundamental and sampling rate (paper 004).

The error is zero-inserted to F times the rate, where a period is a whole number of samples, the
repetitive part runs there, and every F-th value of it drives the plant. The loop sees

    C_eq(f) = (1/F) sum_k C_all(f - k fs),    1 + P C_eq = mean of G_k,   G_k(f) = G_0(f - k fs),

with G_0 = 1 + P C_all at the fast rate. Where G_0 is small above fs/2, G is small below, and the
loop amplifies there, which no design at the slow rate shows. The low-pass must therefore be checked
up to half the fast rate (`alias_spectra`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from stillpath.compensation.feedback.controller import (
    Controller,
    Design,
    Prediction,
    Refusal,
    Uncertainty,
    judged,
)
from stillpath.compensation.feedback.repetitive import (
    Compared,
    InternalModel,
    ServoInverse,
    internal_model,
    invert_servo,
    notch_grid,
    observed_error,
    repetitive_blocks,
    repetitive_coefficients,
    shared_period,
)
from stillpath.models.arrays import Array, Complex
from stillpath.models.diagrams import Block
from stillpath.models.loops import Loop

__all__ = ["FastRate", "alias_spectra", "design_multirate", "fast_rate", "multirate_factor"]

_LARGEST_FACTOR = 32


@dataclass(frozen=True, slots=True)
class FastRate:
    """f' = lcm(fs, f0): `factor` F times the sampling rate, `period` N samples of f0."""

    rate_hz: float
    factor: int
    period: int


def design_multirate(
    loops: Sequence[Loop],
    fast: Loop,
    fundamental_hz: float,
    *,
    alpha: float = 0.999,
    nyquist_pairs: int = 3,
    notches_hz: Sequence[float] = (),
    compared: Compared = "response",
    uncertainty: Uncertainty | None = None,
) -> Controller:
    """Design a repetitive controller at the fast rate.

    Parameters
    ----------
    loops : sequence of Loop
        At the sampling rate: the nominal loop, then the members of its plant set.
    fast : Loop
        The same machine, identified at the fast rate; its servo is inverted.
    alpha, nyquist_pairs, notches_hz, compared, uncertainty
        See `compensation.feedback.repetitive.design_wide_band`.

    Raises
    ------
    Refusal
        If the fast rate is impractically high, `fast` has another rate, or the loop would be
        unstable.
    """
    nominal = loops[0]
    rates = fast_rate(1.0 / nominal.dt_s, fundamental_hz)
    if abs(fast.dt_s * rates.rate_hz - 1) > 1e-6:
        raise Refusal(
            "inverse",
            f"the fast model is sampled at {1 / fast.dt_s:.6g} Hz, the least common multiple is "
            f"{rates.rate_hz:.6g} Hz; identify the servo at that rate",
        )
    model = internal_model(fast.dt_s, rates.period, alpha, nyquist_pairs, notches_hz)
    inverse = invert_servo(fast.servo_num, fast.t0_den)
    model = replace(model, mean_free=inverse.blocks_constants)
    expected, error = observed_error(nominal, compared, rates.factor)
    upsampled = Block("up", error, every=rates.factor, zero_between=True)
    kept = Block("c", (("w", 1.0),), every=rates.factor)
    blocks = (*expected, upsampled, *repetitive_blocks(model, inverse, (("up", 1.0),), "w"), kept)
    # The notches at the fast rate have images at all multiples of the sampling rate over N.
    f = notch_grid(nominal.dt_s, rates.period, fundamental_hz)
    factor = multirate_factor(nominal, model, inverse, rates.factor, f)
    design = Design(
        "rc-multirate",
        blocks,
        Prediction(f, nominal.s0(f), factor),
        repetitive_coefficients(model, inverse),
        every=rates.factor,
        settings={"fundamental_hz": fundamental_hz, "alpha": alpha, "period": rates.period,
                  "nyquist_pairs": nyquist_pairs, "notches_hz": tuple(notches_hz),
                  "compared": compared, "factor": rates.factor, "fast_rate_hz": rates.rate_hz},
        notes=inverse.notes,
    )  # fmt: skip
    return judged(design, loops, uncertainty)


def fast_rate(rate_hz: float, fundamental_hz: float) -> FastRate:
    """Return the least common multiple of sampling rate and fundamental.

    Raises
    ------
    Refusal
        If the fundamental is not below half the sampling rate, or the multiple is more than 32
        times that rate (paper 004 prints 1918.4 kHz for 16 kHz and 1199 Hz; it is 19184 kHz, 1199
        times).
    """
    if not fundamental_hz < 0.5 * rate_hz:
        raise Refusal(
            "singular",
            f"a fundamental of {fundamental_hz:g} Hz is not below half the sampling rate "
            f"({0.5 * rate_hz:g} Hz): give that of the error as the loop samples it",
        )
    share = shared_period(rate_hz, fundamental_hz)
    factor, period = share.numerator, share.denominator
    if factor > _LARGEST_FACTOR:
        fits_hz = rate_hz / float((1 / share).limit_denominator(_LARGEST_FACTOR))
        raise Refusal(
            "singular",
            f"the least common multiple of {rate_hz:g} and {fundamental_hz:g} Hz is "
            f"{factor * rate_hz:.10g} Hz, {factor} times the sampling rate (limit "
            f"{_LARGEST_FACTOR}): use the wide-band design, or round the fundamental (the nearest "
            f"that fits is {fits_hz:.7g} Hz)",
        )
    return FastRate(factor * rate_hz, factor, period)


def alias_spectra(
    loop: Loop, model: InternalModel, inverse: ServoInverse | None, fast: Loop, f_hz: ArrayLike
) -> Complex:
    """Return G_0 = 1 + P C_all at the fast rate, at any frequencies up to half of it.

    Folded to below fs/2, the mean of its images is 1/S. `inverse` None: exact, as published.
    """
    f = np.atleast_1d(np.asarray(f_hz, float))
    angle = 2 * np.pi * f * fast.dt_s
    undo = 1 / fast.servo(f) if inverse is None else inverse.response(angle)
    internal = model.response(angle)
    # 1 + P C + P R, over 1 + P C: the servo in place of the plant.
    add_on = loop.servo(f) * undo * internal / (1 - internal)
    return np.asarray((1 + add_on) / loop.s0(f))


def multirate_factor(
    loop: Loop,
    model: InternalModel,
    inverse: ServoInverse | Loop,
    factor: int,
    f_hz: Array,
) -> Complex:
    """Return S/S0 of the multirate loop.

    Parameters
    ----------
    loop : Loop
        The true loop at the sampling rate.
    inverse : ServoInverse or Loop
        The inverse in use, or the fast loop whose exact inverse is used, as published.
    factor : int
        F.
    f_hz : ndarray, shape (n,)
    """
    rate = 1.0 / loop.dt_s
    total = np.zeros(len(f_hz), complex)
    for k in range(factor):
        image = f_hz - k * rate
        angle = 2 * np.pi * image * loop.dt_s / factor
        undo = 1 / inverse.servo(image) if isinstance(inverse, Loop) else inverse.response(angle)
        internal = model.response(angle)
        total += undo * internal / (1 - internal)
    return np.asarray(1 / (1 + loop.servo(f_hz) * total / factor))
