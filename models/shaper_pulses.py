"""Input shapers as the firmware defines them: the pulses with which the command is convolved."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from stillpath.models.arrays import Array
from stillpath.models.errors import ModelError

__all__ = ["SHAPERS", "Pulses", "shaper_pulses"]

Pulses = tuple[Array, Array]
"""Weights and delays [s]."""

_EI_TOLERANCE = 0.05
"""Vibration that the EI shaper leaves at its design frequency (Klipper: 1 / 20)."""

# Polynomials in the damping ratio, lowest power first, one row a pulse; times in undamped
# periods. Facts from klippy/extras/shaper_defs.py as of 2026-08-07 (they go back to Singhose's
# curve fits); tables older than 2026-03-31 miss a comma in the first row of 3hump_ei.
_TWO_HUMP_TIMES = (
    (0.0,),
    (0.49890, 0.16270, -0.54262, 6.16180),
    (0.99748, 0.18382, -1.58270, 8.17120),
    (1.49920, -0.09297, -0.28338, 1.85710),
)
_TWO_HUMP_WEIGHTS = (
    (0.16054, 0.76699, 2.26560, -1.22750),
    (0.33911, 0.45081, -2.58080, 1.73650),
    (0.34089, -0.61533, -0.68765, 0.42261),
    (0.15997, -0.60246, 1.00280, -0.93145),
)
_THREE_HUMP_TIMES = (
    (0.0,),
    (0.49974, 0.23834, 0.44559, 12.4720),
    (0.99849, 0.29808, -2.36460, 23.3990),
    (1.49870, 0.10306, -2.01390, 17.0320),
    (1.99960, -0.28231, 0.61536, 5.40450),
)
_THREE_HUMP_WEIGHTS = (
    (0.11275, 0.76632, 3.29160, -1.44380),
    (0.23698, 0.61164, -2.57850, 4.85220),
    (0.30008, -0.19062, -2.14560, 0.13744),
    (0.23775, -0.73297, 0.46885, -2.08650),
    (0.11244, -0.45439, 0.96382, -1.46000),
)


def shaper_pulses(name: str, f_hz: float, zeta: float = 0.1) -> Pulses:
    """Return weights (sum 1) and delays [s] of a firmware shaper.

    Parameters
    ----------
    name : str
        zv, mzv, ei, 2hump_ei or 3hump_ei.
    f_hz, zeta : float
        Undamped frequency and damping ratio that it is built for.

    Raises
    ------
    ModelError
        For an unknown name, a frequency that is not positive, or a damping ratio that the
        firmware refuses too.

    Notes
    -----
    Source: klippy/extras/shaper_defs.py (Klipper, 2026-08-07), derived again:
    ZV and MZV cancel a damped mode exactly: pulses of the undamped shaper at times t, weights
    multiplied by the decay exp(-zeta w t) up to t, where time runs in damped periods. EI and the
    humps are curve fits over damping.
    """
    if name not in SHAPERS:
        raise ModelError(f"no shaper is called {name!r}; there are {', '.join(SHAPERS)}")
    rule, largest = _RULES[name]
    if not (math.isfinite(f_hz) and f_hz > 0):
        raise ModelError(f"shaper frequency {f_hz} Hz must be positive")
    if not 0 <= zeta <= largest:
        raise ModelError(f"{name}: damping ratio {zeta} must lie between 0 and {largest}")
    weights, times = rule(zeta)
    return weights / weights.sum(), times / f_hz


def _zv(zeta: float) -> Pulses:
    return _damped(zeta, np.array([1.0, 1.0]), np.array([0.0, 0.5]))


def _mzv(zeta: float) -> Pulses:
    # Undamped: three pulses 3/8 of a period apart, Klipper's spacing. That the vibration cancels
    # gives the weights 1 - 1/sqrt 2, sqrt 2 - 1, 1 - 1/sqrt 2.
    outer = 1 - math.sqrt(0.5)
    return _damped(
        zeta, np.array([outer, math.sqrt(2.0) - 1.0, outer]), np.array([0.0, 0.375, 0.75])
    )


def _ei(zeta: float) -> Pulses:
    v, z = _EI_TOLERANCE, zeta
    first = (0.24968 + 0.24961 * v) + (0.80008 + 1.23328 * v) * z + (0.49599 + 3.17316 * v) * z**2
    last = (0.25149 + 0.21474 * v) + (-0.83249 + 1.41498 * v) * z + (0.85181 - 4.90094 * v) * z**2
    middle = (
        0.4999
        + (0.46159 + 8.57843 * v) * v * z
        + (4.26169 - 108.644 * v) * v * z**2
        + (1.75601 + 336.989 * v) * v * z**3
    )
    damped = math.sqrt(1 - z * z)
    return np.array([first, 1 - first - last, last]), np.array([0.0, middle, 1.0]) / damped


def _fitted(times: tuple[tuple[float, ...], ...], weights: tuple[tuple[float, ...], ...]) -> Rule:
    def rule(zeta: float) -> Pulses:
        polynomial = np.polynomial.polynomial.polyval
        return (
            np.array([float(polynomial(zeta, row)) for row in weights]),
            np.array([float(polynomial(zeta, row)) for row in times]),
        )

    return rule


def _damped(zeta: float, weights: Array, periods: Array) -> Pulses:
    """Undamped pulses for a damped mode: periods grow, weights follow the decay."""
    root = math.sqrt(1 - zeta * zeta)
    return weights * np.exp(-2 * math.pi * zeta / root * periods), periods / root


Rule = Callable[[float], Pulses]

_RULES: dict[str, tuple[Rule, float]] = {
    "zv": (_zv, 0.99),
    "mzv": (_mzv, 0.99),
    "ei": (_ei, 0.4),
    "2hump_ei": (_fitted(_TWO_HUMP_TIMES, _TWO_HUMP_WEIGHTS), 0.3),
    "3hump_ei": (_fitted(_THREE_HUMP_TIMES, _THREE_HUMP_WEIGHTS), 0.2),
}
SHAPERS = tuple(_RULES)
"""Names of the firmware's shapers, from the shortest to the longest."""
