"""Kernels that put the ends of segments where a machine responds least to the error of a fit."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillpath.models.jit import kernel

__all__ = ["Weight", "line_errors", "normal_equations", "reach"]


class Weight(NamedTuple):
    """How errors of a fit count: the cost of an error e is the sum of e[k] g[k - l] e[l].

    Attributes
    ----------
    correlation : ndarray, shape (2 lags - 1,)
        g at lags .., -1, 0, 1, ..; it is even, and 0 beyond.
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
def line_errors(
    command: NDArray[np.float64], knot: NDArray[np.int64], error: NDArray[np.float64]
) -> None:
    """Fill `error` with the distance of a command from straight lines between its own samples.

    Parameters
    ----------
    command : ndarray, shape (n,)
        One axis of the command.
    knot : ndarray of int64, shape (m,)
        Samples at which segments end, rising, with the beginning of the first.
    error : ndarray, shape (knot[m - 1] - knot[0] + 1,)
        From the first of these samples to the last.
    """
    first = knot[0]
    for i in range(1, len(knot)):
        a, b = knot[i - 1], knot[i]
        slope = (command[b] - command[a]) / (b - a)
        for k in range(a, b):
            error[k - first] = command[k] - command[a] - slope * (k - a)
    error[len(error) - 1] = 0.0


@kernel(allocates=False)
def normal_equations(
    knot: NDArray[np.int64],
    weight: Weight,
    felt: NDArray[np.float64],
    band: NDArray[np.float64],
    right: NDArray[np.float64],
) -> None:
    """Compute the equations for the shifts of the inner ends of a stretch's segments.

    Parameters
    ----------
    knot : ndarray of int64, shape (m,)
        As in `line_errors`.
    weight : Weight
    felt : ndarray, shape (knot[m - 1] - knot[0] + 1,)
        The errors as they count: convolved with the correlation.
    band : ndarray, shape (u + 1, m - 2)
        The upper part of the matrix, in LAPACK's banded form.
    right : ndarray, shape (m - 2,)
    """
    above, inner = band.shape[0] - 1, len(knot) - 2
    for i in range(1, inner + 1):
        right[i - 1] = _under_hat(
            knot[i - 1] - knot[0], knot[i] - knot[0], knot[i + 1] - knot[0], felt
        )
        # The cost of two hats is a sum over the bends of both. From here on of this one's, at the
        # three knots of the other.
        before, here = _moments(knot, i, i - 1, weight), _moments(knot, i, i, weight)
        for j in range(i, min(i + above, inner) + 1):
            after = _moments(knot, i, j + 1, weight)
            rises, falls = 1.0 / (knot[j] - knot[j - 1]), 1.0 / (knot[j + 1] - knot[j])
            band[above + i - j, j - 1] = rises * before - (rises + falls) * here + falls * after
            before, here = here, after
        # Rounding must not make the matrix indefinite.
        band[above, i - 1] *= 1.0 + 1e-9


@kernel(force_inline=True, allocates=False)
def _under_hat(a: int, b: int, c: int, felt: NDArray[np.float64]) -> float:
    """Return the sum of errors times a hat that is 1 at sample b, 0 at a and c."""
    total = felt[b]
    for k in range(a + 1, b):
        total += felt[k] * (k - a) / (b - a)
    for k in range(b + 1, c):
        total += felt[k] * (c - k) / (c - b)
    return float(total)


@kernel(force_inline=True, allocates=False)
def _moments(knot: NDArray[np.int64], i: int, at: int, weight: Weight) -> float:
    """Return the moments of the bends of the hat around knot i, seen from knot `at`."""
    rises, falls = 1.0 / (knot[i] - knot[i - 1]), 1.0 / (knot[i + 1] - knot[i])
    total = rises * _moment(abs(knot[at] - knot[i - 1]), weight)
    total -= (rises + falls) * _moment(abs(knot[at] - knot[i]), weight)
    return float(total + falls * _moment(abs(knot[at] - knot[i + 1]), weight))


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
