"""Kernels that put the ends of segments where a machine responds least to the error of a fit."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillpath.models.jit import kernel

__all__ = ["Weight", "normal_equations", "reach"]


class Weight(NamedTuple):
    """How errors of a fit count: the cost of an error e is the sum of e[k] g[k - l] e[l].

    Attributes
    ----------
    correlation : ndarray, shape (lags,)
        g at lags 0, 1, ..; it is even, and 0 beyond.
    moments : ndarray, shape (lags + 2,)
        An even sequence whose fourth difference is g. Beyond the table it is a cubic.
    bends : ndarray, shape (2,)
        The second difference of `moments` at its last two lags.
    """

    correlation: NDArray[np.float64]
    moments: NDArray[np.float64]
    bends: NDArray[np.float64]


@kernel(allocates=False)
def reach(knot: NDArray[np.int64], lags: int) -> int:
    """Return how many segments further on an end still counts together with this one."""
    most = 0
    j = 1
    for i in range(1, len(knot) - 1):
        j = max(j, i)
        while j + 1 < len(knot) - 1 and knot[j] - knot[i + 1] < lags:
            j += 1
        most = max(most, j - i)
    return most


@kernel(allocates=False)
def normal_equations(
    command: NDArray[np.float64],
    knot: NDArray[np.int64],
    weight: Weight,
    error: NDArray[np.float64],
    felt: NDArray[np.float64],
    band: NDArray[np.float64],
    right: NDArray[np.float64],
) -> None:
    """Compute the equations for the shifts of the inner ends of a stretch's segments.

    Parameters
    ----------
    command : ndarray, shape (n,)
        One axis of the command.
    knot : ndarray of int64, shape (m,)
        Samples at which segments end, rising, with the beginning of the first.
    weight : Weight
    error, felt : ndarray, shape (n,)
        Scratch.
    band : ndarray, shape (u + 1, m - 2)
        The upper part of the matrix, in LAPACK's banded form.
    right : ndarray, shape (m - 2,)
    """
    first, last = knot[0], knot[len(knot) - 1]
    for i in range(1, len(knot)):
        a, b = knot[i - 1], knot[i]
        slope = (command[b] - command[a]) / (b - a)
        for k in range(a, b):
            error[k] = command[k] - command[a] - slope * (k - a)
    error[last] = 0.0
    # The error as it counts: convolved with the correlation.
    for k in range(first, last + 1):
        felt[k] = weight.correlation[0] * error[k]
    for lag in range(1, len(weight.correlation)):
        g = weight.correlation[lag]
        for k in range(first, last + 1 - lag):
            felt[k] += g * error[k + lag]
        for k in range(first + lag, last + 1):
            felt[k] += g * error[k - lag]
    above = band.shape[0] - 1
    for i in range(1, len(knot) - 1):
        a, b, c = knot[i - 1], knot[i], knot[i + 1]
        total = felt[b]
        for k in range(a + 1, b):
            total += felt[k] * (k - a) / (b - a)
        for k in range(b + 1, c):
            total += felt[k] * (c - k) / (c - b)
        right[i - 1] = total
        for j in range(max(1, i - above), i + 1):
            band[above + j - i, i - 1] = _product(knot, i, j, weight)
        # Rounding must not make the matrix indefinite.
        band[above, i - 1] *= 1.0 + 1e-9


@kernel(force_inline=True, allocates=False)
def _product(knot: NDArray[np.int64], i: int, j: int, weight: Weight) -> float:
    """Cost of two hats, one around each end: a sum over their bends of the moments."""
    total = 0.0
    for p in range(-1, 2):
        for q in range(-1, 2):
            lag = abs(knot[i + p] - knot[j + q])
            total += _bend(knot, i, p) * _bend(knot, j, q) * _moment(lag, weight)
    return total


@kernel(force_inline=True, allocates=False)
def _bend(knot: NDArray[np.int64], i: int, p: int) -> float:
    """Second difference, at knot i + p, of the hat that is 1 at knot i and 0 at its neighbours."""
    rises, falls = 1.0 / (knot[i] - knot[i - 1]), 1.0 / (knot[i + 1] - knot[i])
    if p < 0:
        return float(rises)
    if p > 0:
        return float(falls)
    return float(-(rises + falls))


@kernel(force_inline=True, allocates=False)
def _moment(lag: int, weight: Weight) -> float:
    """Return the moments' value at a lag, also beyond the table."""
    last = len(weight.moments) - 2
    if lag <= last + 1:
        return float(weight.moments[lag])
    t = float(lag - last)
    step = weight.moments[last + 1] - weight.moments[last]
    bend, change = weight.bends[0], weight.bends[1] - weight.bends[0]
    inner = 0.5 * t * (t - 1.0) * bend + change * (t - 1.0) * t * (t + 1.0) / 6.0
    return float(weight.moments[last] + t * step + inner)
