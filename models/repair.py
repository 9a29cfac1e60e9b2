"""Repair of printed transfer functions whose rounding moved the DC gain."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from models.errors import ModelError

__all__ = ["repair_rounded"]


def repair_rounded(
    num: ArrayLike,
    den: ArrayLike,
    num_decimals: Sequence[int],
    den_decimals: Sequence[int],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Move a discrete num/den as little as the rounding allows, so that num(1) = den(1).

    The smallest weighted change, weights the half units of the last printed decimal: with
    gap = den(1) - num(1) every coefficient moves by its share h^2 / sum h^2 of the gap.

    Parameters
    ----------
    num, den : array_like, highest power first
    num_decimals, den_decimals : sequence of int
        Printed decimals of each coefficient; the leading 1 of `den` never moves.

    Returns
    -------
    num, den : ndarray
        The repaired coefficients.
    moved : ndarray
        The change of (num, den) in units of the half last decimal; 0 for the leading 1.

    Raises
    ------
    ModelError
        If a coefficient would have to leave its rounding.
    """
    b, a = np.array(num, float), np.array(den, float)
    half_b = 0.5 * 10.0 ** -np.array(num_decimals, float)
    half_a = 0.5 * 10.0 ** -np.array(den_decimals, float)
    half_a[0] = 0.0
    gap = a.sum() - b.sum()
    share = gap / (np.sum(half_b**2) + np.sum(half_a**2))
    change_b, change_a = half_b**2 * share, -(half_a**2) * share
    moved = np.concatenate([change_b / half_b, [0.0], change_a[1:] / half_a[1:]])
    if np.abs(moved).max() > 1.0:
        raise ModelError(
            f"DC gain 1 needs {np.abs(moved).max():.2g} times the rounding of the coefficients: "
            "the model is off by more than its rounding, fit it again"
        )
    return b + change_b, a + change_a, moved
