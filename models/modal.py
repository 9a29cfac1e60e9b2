"""Plants as sums of first-order recurrences, the cheapest form to compute with."""

from __future__ import annotations

import numpy as np

from stillpath.models.arrays import Array
from stillpath.models.plants import DiscretePlant

__all__ = ["modal_form"]

_LARGEST_CONDITION = 1e4
"""The weights of poles that are nearly one grow with it and cancel each other: positions are wrong
by its square times the rounding error: by a share of 2e-8 here. Usual plants have 1 to 250."""


def modal_form(plant: DiscretePlant) -> Array | None:
    """Return the plant as a sum of complex first-order recurrences.

    y(k) = d u(k) + sum_i Re(w_i x_i(k)), x_i(k+1) = lambda_i x_i(k) + u(k): partial fractions,
    one recurrence for a real pole and one for a pair.

    Returns
    -------
    ndarray, shape (m, 4), or None
        Rows (re lambda, im lambda, re w, im w), m a multiple of three (padded with zeros). None if
        poles are so close that the partial fractions cancel (condition of the modal matrix > 1e4).
    """
    if plant.order == 0:
        return np.zeros((0, 4))
    values, vectors = np.linalg.eig(plant.a)
    if not np.linalg.cond(vectors) < _LARGEST_CONDITION:
        return None
    weights = (plant.c @ vectors) * np.linalg.solve(vectors, plant.b.astype(complex))
    keep = values.imag >= 0
    twice = np.where(values.imag > 0, 2.0, 1.0)
    rows = np.column_stack(
        [values.real, values.imag, (twice * weights).real, (twice * weights).imag]
    )[keep]
    return np.vstack([rows, np.zeros((-len(rows) % 3, 4))])
