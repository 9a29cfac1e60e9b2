"""Kernels of small least-squares problems: Gram matrices and their triangular factors."""

from __future__ import annotations

import numpy as np

from stillpath.models.arrays import Array
from stillpath.models.jit import kernel

__all__ = ["BLOCK", "add_row", "backward", "factorise", "forward", "weighted_gram"]

BLOCK = 20
"""Samples between two running Gram matrices."""


@kernel
def weighted_gram(running: Array, rows: Array, weight: Array, out: Array) -> None:
    """Add the Gram matrix of weighted rows, most of it from running sums.

    Parameters
    ----------
    running : ndarray, shape (blocks + 1, n, n)
        Gram matrices of the rows before every `BLOCK`th sample, and of all.
    rows : ndarray, shape (components, window, n)
    weight : ndarray, shape (window,)
        Of the squares; piecewise constant.
    out : ndarray, shape (n, n)
    """
    components, window, n = rows.shape
    apart, scaled, count = np.empty((components * window, n)), np.empty((components * window, n)), 0
    before = 0.0
    for block in range(len(running)):
        start, end = block * BLOCK, min((block + 1) * BLOCK, window)
        level = weight[(start + end) // 2] if start < window else 0.0
        if level != before:
            for i in range(n):
                add_row(before - level, running[block, i], out[i])
            before = level
        for r in range(start, end):
            if weight[r] != level:
                for c in range(components):
                    for j in range(n):
                        apart[count, j] = rows[c, r, j]
                        scaled[count, j] = (weight[r] - level) * rows[c, r, j]
                    count += 1
    if count > 0:
        out += np.dot(apart[:count].T, scaled[:count])


@kernel
def factorise(square: Array) -> None:
    """Replace the upper triangle of a positive definite matrix by its Cholesky factor U (U' U).

    For such small matrices LAPACK takes twice as long. The lower triangle is left unchanged.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the matrix is not positive definite.
    """
    for k in range(len(square)):
        row = square[k, k:]
        # Four rows above at a time, so that the row itself is read and written less often.
        i = 0
        while i + 4 <= k:
            a, b, c, d = square[i, k:], square[i + 1, k:], square[i + 2, k:], square[i + 3, k:]
            by_a, by_b, by_c, by_d = a[0], b[0], c[0], d[0]
            for j in range(len(row)):
                row[j] -= by_a * a[j] + by_b * b[j] + by_c * c[j] + by_d * d[j]
            i += 4
        while i < k:
            add_row(-square[i, k], square[i, k:], row)
            i += 1
        if not row[0] > 0.0:
            raise np.linalg.LinAlgError("not positive definite")
        scale = 1.0 / np.sqrt(row[0])
        for j in range(len(row)):
            row[j] *= scale


@kernel
def forward(factor: Array, values: Array) -> None:
    """Solve factor' x = values in place, for an upper triangle."""
    for j in range(len(values)):
        values[j] /= factor[j, j]
        for i in range(j + 1, len(values)):
            values[i] -= factor[j, i] * values[j]


@kernel
def backward(factor: Array, values: Array) -> None:
    """Solve factor x = values in place, for an upper triangle."""
    for j in range(len(values) - 1, -1, -1):
        for i in range(j + 1, len(values)):
            values[j] -= factor[j, i] * values[i]
        values[j] /= factor[j, j]


@kernel(inline=True)
def add_row(gain: float, row: Array, out: Array) -> None:
    """Add a row times a gain to another, in place."""
    for j in range(len(out)):
        out[j] += gain * row[j]
