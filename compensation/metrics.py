"""Accuracy of a lifted controller without knowledge of the path (paper 003, 2.5 to 4.4).

Frobenius norms of the error and of the controller, divided by the root of the number of samples:
expected rms error and command for white noise of rms 1. For smooth paths they rank designs but do
not predict errors. Every metric exists twice, from matrices and in the closed form for filtered
basis functions; n counts functions, the paper's n + 1.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from stillpath.compensation.base import DesignError
from stillpath.compensation.lifted import LiftedSet
from stillpath.compensation.operators import LiftedOperator
from stillpath.models.arrays import Array

__all__ = [
    "best_number",
    "effort_metric",
    "effort_of_ce_opt",
    "error_metric",
    "error_of_functions",
    "robust_error_metric",
    "robust_error_of_functions",
    "robust_error_of_spread",
    "toeplitz_metric",
]


def error_metric(plant: LiftedOperator, controller: Array) -> float:
    """Return J_e = |I - G C|_F / sqrt(rows) (2.18); C has the shape (inputs, rows)."""
    error = np.eye(plant.shape[0]) - plant.apply(controller)
    return float(np.linalg.norm(error) / np.sqrt(plant.shape[0]))


def error_of_functions(n: int, samples: int) -> float:
    """Return J_e = sqrt(1 - n / samples) of n independent filtered functions (2.26).

    Raises
    ------
    DesignError
    """
    if not 0 <= n <= samples:
        raise DesignError(f"{n} functions for {samples} samples: take 0 to {samples}")
    return float(np.sqrt(1.0 - n / samples))


def effort_metric(controller: Array) -> float:
    """Return J_c = |C|_F / sqrt(samples) (3.4), C of shape (inputs, samples)."""
    return float(np.linalg.norm(controller) / np.sqrt(controller.shape[1]))


def effort_of_ce_opt(singular_values: ArrayLike, n: int) -> float:
    """Return the least J_c of n functions, sqrt(sum 1 / sigma_i^2 / samples) (3.23).

    Parameters
    ----------
    singular_values : array_like, shape (samples,)
        Of the lifted plant, falling.

    Raises
    ------
    DesignError
        If the plant responds to fewer than n directions.
    """
    sigma = np.asarray(singular_values, np.float64)
    if not 1 <= n <= len(sigma) or sigma[n - 1] <= 0:
        raise DesignError(
            f"n = {n} functions of a plant with {int(np.sum(sigma > 0))} singular values above 0: "
            "take 1 to that many"
        )
    return float(np.sqrt(np.sum(sigma[:n] ** -2.0) / len(sigma)))


def robust_error_metric(members: LiftedSet, controller: Array) -> float:
    """Return J_e,r = sqrt(sum_j l_j |I - G_j C|_F^2 / rows) (4.2), C of shape (inputs, rows).

    Computed from the Gram matrices of the set, without the individual plants.
    """
    rows = len(members.mean)
    cross = float(np.sum(members.mean * controller.T))
    square = float(np.sum(controller * (members.gram @ controller)))
    return float(np.sqrt(max(0.0, 1.0 + (square - 2.0 * cross) / rows)))


def robust_error_of_functions(functions: Array, spread: Array) -> float:
    """Return J_e,r of functions that are decoupled for the nominal model (4.5).

    Parameters
    ----------
    functions : ndarray, shape (m, n)
        Psi_nom: G_nom Psi_nom has orthonormal columns.
    spread : ndarray, shape (m, m)
        Delta'Delta of (4.14).
    """
    m, n = functions.shape
    unknown = float(np.sum(functions * (spread @ functions)))
    return float(np.sqrt(1.0 + (unknown - n) / m))


def robust_error_of_spread(singular_values: ArrayLike, n: int, samples: int) -> float:
    """Return J_e,r of the n most robust functions (4.24).

    Parameters
    ----------
    singular_values : array_like
        Of Delta_nom,s, in any order.

    Raises
    ------
    DesignError
    """
    sigma = np.sort(np.asarray(singular_values, np.float64))
    if not 0 <= n <= len(sigma):
        raise DesignError(f"n = {n} of {len(sigma)} robust functions: take 0 to all of them")
    return float(np.sqrt(1.0 + (np.sum(sigma[:n] ** 2) - n) / samples))


def best_number(singular_values: ArrayLike) -> int:
    """Return how many functions are most robust: those with singular values below 1 (remark 4.5).

    All of them if every value is below 1 (scenario i), one if none is (ii).
    """
    return max(1, int(np.sum(np.asarray(singular_values) < 1.0)))


def toeplitz_metric(coefficients: ArrayLike, samples: int) -> float:
    """Return |T|_F / sqrt(samples) of a time-invariant system from its coefficients (D.1).

    It tends to the 2-norm of the system as the number of samples grows (2.20).

    Parameters
    ----------
    coefficients : array_like, shape (2 k + 1,)
        e_-k .. e_k, with k < samples.

    Raises
    ------
    DesignError
    """
    e = np.asarray(coefficients, np.float64)
    lags = np.abs(np.arange(len(e)) - len(e) // 2)
    if len(e) % 2 == 0 or lags[0] >= samples:
        raise DesignError(
            f"{len(e)} coefficients over {samples} samples: give an odd number, at most "
            f"{2 * samples - 1}"
        )
    return float(np.sqrt(np.sum((1.0 - lags / samples) * e**2)))
