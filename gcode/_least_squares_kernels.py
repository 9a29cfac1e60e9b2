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
    correlation : ndarray, shape (2 lags - 1, 2)
        g of X and Y at lags .., -1, 0, 1, ..; it is even, and 0 beyond.
    moments : ndarray, shape (lags + 2, 2)
        An even sequence whose fourth difference is g. Beyond the table it is a cubic.
    bends : ndarray, shape (2, 2)
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

    Those of X and Y are computed side by side, which takes a third of the time.

    Parameters
    ----------
    knot : ndarray of int64, shape (m,)
        As in `line_errors`.
    first : ndarray of int64, shape (m - 2,)
        From `together`.
    weight : Weight
    felt : ndarray, shape (2, knot[m - 1] - knot[0] + 1)
        The errors as they count: convolved with the correlation.
    rows : ndarray, shape (m - 2, most + 1, 2)
        Row i receives the matrices from their column first[i] to their diagonal, which comes last.
    right : ndarray, shape (m - 2, 2)
    """
    begin, last = knot[0], rows.shape[1] - 1
    for i in range(len(right)):
        a, b, c = knot[i], knot[i + 1], knot[i + 2]
        for axis in range(2):
            right[i, axis] = _under_hat(a - begin, b - begin, c - begin, felt[axis])
        # The cost of two hats is a sum over the bends of both: first of this one's, at the three
        # knots of the other.
        j = first[i]
        x0, y0 = _moments(a, b, c, knot[j], weight)
        x1, y1 = _moments(a, b, c, knot[j + 1], weight)
        for j in range(first[i], i + 1):
            x2, y2 = _moments(a, b, c, knot[j + 2], weight)
            rises, falls = 1.0 / (knot[j + 1] - knot[j]), 1.0 / (knot[j + 2] - knot[j + 1])
            rows[i, last - i + j, 0] = rises * x0 - (rises + falls) * x1 + falls * x2
            rows[i, last - i + j, 1] = rises * y0 - (rises + falls) * y1 + falls * y2
            x0, y0, x1, y1 = x1, y1, x2, y2
        # Rounding must not make the matrices indefinite.
        rows[i, last, 0] *= 1.0 + 1e-9
        rows[i, last, 1] *= 1.0 + 1e-9


@kernel(allocates=False)
def solve(first: NDArray[np.int64], rows: NDArray[np.float64], x: NDArray[np.float64]) -> bool:
    """Solve such equations in place, by the matrices' Cholesky factors; False if one has none.

    Two sums that do not wait for each other take hardly longer than one.

    Parameters
    ----------
    first, rows
        As in `normal_equations`; `rows` becomes the factors.
    x : ndarray, shape (m - 2, 2)
        The right sides; becomes the solutions.
    """
    last = rows.shape[1] - 1
    for i in range(len(x)):
        begin, here = first[i], last - i
        x_square = y_square = 0.0
        x_value, y_value = x[i, 0], x[i, 1]
        for j in range(begin, i):
            there = last - j
            x_share, y_share = rows[i, here + j, 0], rows[i, here + j, 1]
            for k in range(max(begin, first[j]), j):
                x_share -= rows[i, here + k, 0] * rows[j, there + k, 0]
                y_share -= rows[i, here + k, 1] * rows[j, there + k, 1]
            x_share /= rows[j, last, 0]
            y_share /= rows[j, last, 1]
            rows[i, here + j, 0], rows[i, here + j, 1] = x_share, y_share
            x_square += x_share * x_share
            y_square += y_share * y_share
            x_value -= x_share * x[j, 0]
            y_value -= y_share * x[j, 1]
        if not (rows[i, last, 0] > x_square and rows[i, last, 1] > y_square):
            return False
        rows[i, last, 0] = np.sqrt(rows[i, last, 0] - x_square)
        rows[i, last, 1] = np.sqrt(rows[i, last, 1] - y_square)
        x[i, 0], x[i, 1] = x_value / rows[i, last, 0], y_value / rows[i, last, 1]
    for i in range(len(x) - 1, -1, -1):
        x[i, 0] /= rows[i, last, 0]
        x[i, 1] /= rows[i, last, 1]
        for j in range(first[i], i):
            x[j, 0] -= rows[i, last - i + j, 0] * x[i, 0]
            x[j, 1] -= rows[i, last - i + j, 1] * x[i, 1]
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
def _moments(a: int, b: int, c: int, at: int, weight: Weight) -> tuple[float, float]:
    """Return the moments of the bends of such a hat, for X and Y, seen from sample `at`."""
    rises, falls = 1.0 / (b - a), 1.0 / (c - b)
    xa, ya = _moment(abs(at - a), weight)
    xb, yb = _moment(abs(at - b), weight)
    xc, yc = _moment(abs(at - c), weight)
    x = rises * xa - (rises + falls) * xb + falls * xc
    return x, rises * ya - (rises + falls) * yb + falls * yc


@kernel(force_inline=True, allocates=False)
def _moment(lag: int, weight: Weight) -> tuple[float, float]:
    """Return the moments' values at a lag."""
    if lag < len(weight.moments):
        return weight.moments[lag, 0], weight.moments[lag, 1]
    return _beyond(lag, weight, 0), _beyond(lag, weight, 1)


@kernel(force_inline=True, allocates=False)
def _beyond(lag: int, weight: Weight, axis: int) -> float:
    """Return the moments' value at a lag beyond the table."""
    moments, bends = weight.moments[:, axis], weight.bends[:, axis]
    last = len(moments) - 2
    t = float(lag - last)
    step = moments[last + 1] - moments[last]
    bend, change = bends[0], bends[1] - bends[0]
    inner = 0.5 * t * (t - 1.0) * bend + change * (t - 1.0) * t * (t + 1.0) / 6.0
    return float(moments[last] + t * step + inner)
