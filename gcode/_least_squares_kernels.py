"""Kernels that put the ends of segments where a machine responds least to the error of a fit."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillpath.models.jit import kernel

__all__ = ["Weight", "line_errors", "normal_equations", "solve", "together"]


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
def together(knot: NDArray[np.int64], lags: int, first: NDArray[np.int64]) -> int:
    """Find the first inner end, from 0 on, with which each still counts.

    Parameters
    ----------
    knot : ndarray of int64, shape (m,)
        As in `line_errors`.
    first : ndarray of int64, shape (m - 2,)
        Filled.

    Returns
    -------
    int
        How many ends back that is at most.
    """
    most = j = 0
    for i in range(len(first)):
        while j < i and knot[i] - knot[j + 2] >= lags:
            j += 1
        first[i] = j
        most = max(most, i - j)
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
    first: NDArray[np.int64],
    weight: Weight,
    felt: NDArray[np.float64],
    rows: NDArray[np.float64],
    right: NDArray[np.float64],
) -> None:
    """Compute the equations for the shifts of the inner ends of a stretch's segments.

    Parameters
    ----------
    knot : ndarray of int64, shape (m,)
        As in `line_errors`.
    first : ndarray of int64, shape (m - 2,)
        From `together`.
    weight : Weight
    felt : ndarray, shape (knot[m - 1] - knot[0] + 1,)
        The errors as they count: convolved with the correlation.
    rows : ndarray, shape (m - 2, most + 1)
        Row i receives the matrix from its column first[i] to its diagonal, which comes last.
    right : ndarray, shape (m - 2,)
    """
    begin, last = knot[0], rows.shape[1] - 1
    for i in range(len(right)):
        a, b, c = knot[i], knot[i + 1], knot[i + 2]
        right[i] = _under_hat(a - begin, b - begin, c - begin, felt)
        # The cost of two hats is a sum over the bends of both: first of this one's, at the three
        # knots of the other.
        j = first[i]
        before, here = _moments(a, b, c, knot[j], weight), _moments(a, b, c, knot[j + 1], weight)
        for j in range(first[i], i + 1):
            after = _moments(a, b, c, knot[j + 2], weight)
            rises, falls = 1.0 / (knot[j + 1] - knot[j]), 1.0 / (knot[j + 2] - knot[j + 1])
            rows[i, last - i + j] = rises * before - (rises + falls) * here + falls * after
            before, here = here, after
        # Rounding must not make the matrix indefinite.
        rows[i, last] *= 1.0 + 1e-9


@kernel(allocates=False)
def solve(first: NDArray[np.int64], rows: NDArray[np.float64], x: NDArray[np.float64]) -> bool:
    """Solve such equations in place, by the matrix's Cholesky factor; False if it has none.

    Parameters
    ----------
    first, rows
        As in `normal_equations`; `rows` becomes the factor.
    x : ndarray, shape (m - 2,)
        The right sides; becomes the solution.
    """
    last = rows.shape[1] - 1
    for i in range(len(x)):
        row, square, value = rows[i], 0.0, x[i]
        for j in range(first[i], i):
            other, total = rows[j], row[last - i + j]
            for k in range(max(first[i], first[j]), j):
                total -= row[last - i + k] * other[last - j + k]
            share = total / other[last]
            row[last - i + j] = share
            square += share * share
            value -= share * x[j]
        if not row[last] > square:
            return False
        row[last] = np.sqrt(row[last] - square)
        x[i] = value / row[last]
    for i in range(len(x) - 1, -1, -1):
        row = rows[i]
        x[i] /= row[last]
        for j in range(first[i], i):
            x[j] -= row[last - i + j] * x[i]
    return True


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
def _moments(a: int, b: int, c: int, at: int, weight: Weight) -> float:
    """Return the moments of the bends of such a hat, seen from sample `at`."""
    rises, falls = 1.0 / (b - a), 1.0 / (c - b)
    total = rises * _moment(abs(at - a), weight) - (rises + falls) * _moment(abs(at - b), weight)
    return float(total + falls * _moment(abs(at - c), weight))


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
