"""The exponential of a small matrix, in numpy alone: what scipy has takes long to import."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["exponential"]

_TERMS = 18
"""Of the Taylor series: what is left of it is below 1e-17 for matrices of norm 1 (Moler, Van Loan,
Nineteen Dubious Ways to Compute the Exponential of a Matrix, SIAM Review 2003, methods 1 and 3)."""


def exponential(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return exp(matrix) by its Taylor series, scaling and squaring.

    Parameters
    ----------
    matrix : ndarray, shape (n, n)
    """
    norm = float(np.abs(matrix).sum(axis=0).max(initial=1.0))
    squarings = int(np.ceil(np.log2(norm)))
    scaled = matrix / 2.0**squarings
    one = np.eye(len(matrix))
    grown = one
    for k in range(_TERMS, 0, -1):
        grown = one + scaled @ grown / k
    for _ in range(squarings):
        grown = grown @ grown
    return grown
