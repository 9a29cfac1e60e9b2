"""Discrete disturbance observer for a plant with delay (paper 002, section III).

    u = v - c,   c = Q / Gn* ym - z^-m Q u,   P ~ z^-m Gn*,   L = z^-m Q

The delay is in the model, not in an inverse: S = S0 (1 - L). A double integrator held over a sample
has a zero at -1, and so has the bilinear transform of Q; the inverse of Gn* would ring there
forever. It is cancelled in both before anything is realised (the paper's figure 15).

With P = z^-m Gn* E, S = S0 (1 - L) / (1 + S0 L (E - 1)).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import brentq

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
from stillpath.models.arrays import Array, Complex
from stillpath.models.diagrams import Block, polynomial_response
from stillpath.models.loops import Loop

__all__ = [
    "binomial_q",
    "continuous_q",
    "delay_limit_hz",
    "design_disturbance_observer",
    "observer_sensitivity",
]

_RADIUS = 0.97


def design_disturbance_observer(
    loops: Sequence[Loop],
    cutoff_hz: float,
    *,
    nominal: Loop | None = None,
    uncertainty: Uncertainty | None = None,
) -> Controller:
    """Design the observer for the first of `loops`.

    Parameters
    ----------
    loops : sequence of Loop
        The nominal loop, then the members of its plant set.
    cutoff_hz : float
        1 / (2 pi tau) of Q.
    nominal : Loop, optional
        Loop whose plant the observer assumes (say, inertia and delay). Default: the first loop.
    uncertainty
        See `compensation.feedback.controller.judged`.

    Raises
    ------
    Refusal
        If the plant has a zero that neither Q nor a stable inverse can cancel, or a loop would be
        unstable.
    """
    true, assumed = loops[0], loops[0] if nominal is None else nominal
    dt_s = true.dt_s
    delay, numerator = _split_delay(assumed.plant_num)
    q_num, q_den = binomial_q(cutoff_hz, dt_s)
    reduced, cancelled = _without_common_zeros(q_num, numerator)
    _check_inverse(cancelled, dt_s)
    blocks = (
        Block("est", (("ym", 1.0),), _tuple(np.convolve(reduced, assumed.plant_den)),
              _tuple(np.convolve(cancelled, q_den))),
        Block("own", (("u", 1.0),), _tuple(q_num), _tuple(q_den), delay=delay),
        Block("c", (("est", 1.0), ("own", -1.0))),
    )  # fmt: skip
    f = frequency_grid(dt_s, (cutoff_hz,), (cutoff_hz,))
    z = true.z(f)
    late = z**-delay * polynomial_response(q_num, q_den, z)
    match = true.plant(f) / assumed.plant(f)
    factor = (1 - late) / (1 + true.s0(f) * late * (match - 1))
    design = Design(
        "dob",
        blocks,
        Prediction(f, true.s0(f), np.asarray(factor)),
        (
            CoefficientSet("estimate", "iir", {"num": blocks[0].num, "den": blocks[0].den}),
            CoefficientSet("own", "iir", {"num": blocks[1].num, "den": blocks[1].den,
                                          "delay": delay}),
        ),
        settings={"cutoff_hz": cutoff_hz, "delay_samples": delay},
    )  # fmt: skip
    return judged(design, loops, uncertainty)


def binomial_q(cutoff_hz: float, dt_s: float) -> tuple[Array, Array]:
    """Return Q = (3 tau s + 1) / (tau s + 1)^3 by the bilinear transform: num, den in z^-1.

    Raises
    ------
    Refusal
        If the cutoff is not below the Nyquist frequency.
    """
    if not 0 < cutoff_hz < 0.5 / dt_s:
        raise Refusal("singular", f"cutoff {cutoff_hz:g} Hz must lie in 0 to {0.5 / dt_s:g} Hz")
    k = 2 / (2 * math.pi * cutoff_hz * dt_s)
    # tau s = k (1 - z^-1) / (1 + z^-1); times (1 + z^-1)^3.
    up, down = np.array([1.0, 1.0]), np.array([1.0, -1.0])
    pole = k * down + up
    num = np.convolve(3 * k * down + up, np.convolve(up, up))
    den = np.convolve(pole, np.convolve(pole, pole))
    return num / den[0], den / den[0]


def continuous_q(cutoff_hz: float, f_hz: ArrayLike) -> Complex:
    """Return Q(2 pi j f)."""
    s = 1j * np.asarray(f_hz, float) / cutoff_hz
    return np.asarray((3 * s + 1) / (s + 1) ** 3)


def observer_sensitivity(cutoff_hz: float, dt_s: float, delay: int, f_hz: ArrayLike) -> Complex:
    """Return S_z = 1 - z^-m Q of the observer alone."""
    z = np.exp(2j * np.pi * np.asarray(f_hz, float) * dt_s)
    return 1 - z**-delay * polynomial_response(*binomial_q(cutoff_hz, dt_s), z)


def delay_limit_hz(delay_s: float) -> float:
    """Return the cutoff at which |Q Delta| reaches 1, Delta = exp(-s delay) - 1.

    This limits an observer that does not model the delay (the paper's figure 7).
    """
    f = np.geomspace(1e-3 / delay_s, 20 / delay_s, 20_001)
    error = np.abs(np.exp(-2j * np.pi * f * delay_s) - 1)

    def excess(cutoff_hz: float) -> float:
        return float(np.max(np.abs(continuous_q(cutoff_hz, f)) * error)) - 1.0

    return float(brentq(excess, 1e-3 / delay_s, 1 / delay_s))


def _split_delay(num: Sequence[float]) -> tuple[int, Array]:
    """Return the whole samples of delay, and the numerator without them."""
    values = np.trim_zeros(np.asarray(num, float), "b")
    delay = int(np.flatnonzero(values)[0])
    return delay, values[delay:]


def _without_common_zeros(q_num: Array, plant_num: Array) -> tuple[Array, Array]:
    """Cancel zeros at -1 as long as both have one."""
    up = np.array([1.0, 1.0])
    while abs(np.polyval(plant_num, -1.0)) < 1e-9 * np.abs(plant_num).sum() and len(q_num) > 1:
        left = np.polydiv(q_num, up)
        if abs(left[1]).max() > 1e-9 * np.abs(q_num).sum():
            break
        q_num, plant_num = left[0], np.polydiv(plant_num, up)[0]
    return q_num, plant_num


def _check_inverse(bottom: Array, dt_s: float) -> None:
    zeros = np.roots(bottom)
    for zero in zeros[np.abs(zeros) > _RADIUS]:
        f_hz = abs(float(np.angle(zero))) / (2 * math.pi * dt_s)
        raise Refusal(
            "inverse",
            f"dob: the plant has a zero at |z| = {abs(zero):.4g} ({f_hz:.5g} Hz), limit {_RADIUS}: "
            "its inverse would ring; give a simpler nominal plant (an inertia with delay)",
            f_hz,
        )


def _tuple(values: Array) -> tuple[float, ...]:
    return tuple(float(v) for v in values)
