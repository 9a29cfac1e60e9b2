"""Nominal models for robust design, in the lifted domain (paper 003, sections 4.3 to 4.5).

Everything is computed from A = sum l_j G_j'G_j and B = sum l_j G_j of a `LiftedSet`, not from
individual plants: Delta'Delta = A - G'B - B'G + G'G.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stillpath.compensation.base import DesignError
from stillpath.compensation.basis import TOLERANCE, orthonormal, robust_functions, spread_functions
from stillpath.compensation.lifted import LiftedSet
from stillpath.compensation.metrics import best_number
from stillpath.models.arrays import Array

__all__ = ["PSEUDO_INVERSE_TOLERANCE", "TwoStep", "lifted_optimum", "spread_gram", "two_step"]

PSEUDO_INVERSE_TOLERANCE = 1e-10
"""Singular values of B below this share of the largest are zero in the pseudo-inverse of (4.28)."""


@dataclass(frozen=True, slots=True, eq=False)
class TwoStep:
    """A robust design according to remark 4.7.

    Attributes
    ----------
    nominal : ndarray, shape (rows, cols)
        G_nom, given or (4.28).
    basis : ndarray, shape (cols, n)
        The most robust functions for it.
    singular_values : ndarray, shape (cols - r,)
        Of Delta_nom,s, rising.
    best : int
        Best number of functions by remark 4.5 (n + 1 in the paper's count).
    r : int
        Number of directions left out.
    """

    nominal: Array
    basis: Array
    singular_values: Array
    best: int
    r: int


def lifted_optimum(members: LiftedSet) -> Array:
    """Return the nominal model (4.28): the pseudo-inverse of B' times A, shape (rows, cols).

    It minimises |Delta G_nom^-1|_F (4.26). It is neither Toeplitz nor causal. Plants with relative
    degree or non-minimum-phase zeros have directions that cannot be inverted
    (`PSEUDO_INVERSE_TOLERANCE`).

    Raises
    ------
    DesignError
        If the plants cancel each other: B is zero.
    """
    u, sigma, vt = np.linalg.svd(members.mean, full_matrices=False)
    if sigma[0] <= PSEUDO_INVERSE_TOLERANCE * np.sqrt(np.trace(members.gram)):
        raise DesignError(
            "the plants of the set cancel each other (their mean is zero), so no nominal model is "
            "better than none: check their signs"
        )
    kept = sigma > PSEUDO_INVERSE_TOLERANCE * sigma[0]
    return np.asarray(
        u[:, kept] @ ((vt[kept] @ members.gram) / sigma[kept, None]), dtype=np.float64
    )


def spread_gram(members: LiftedSet, nominal: Array) -> Array:
    """Return Delta'Delta = sum_j l_j (G_j - G_nom)'(G_j - G_nom) of (4.14), shape (cols, cols).

    Raises
    ------
    DesignError
        If the shapes do not fit.
    """
    if nominal.shape != members.mean.shape:
        raise DesignError(
            f"nominal model of shape {nominal.shape} for plants of shape {members.mean.shape}"
        )
    # (G - B)'(G - B) + (A - B'B) would need a product more; the two cross terms are transposes.
    cross = nominal.T @ (members.mean - 0.5 * nominal)
    return np.asarray(members.gram - cross - cross.T, np.float64)


def two_step(
    members: LiftedSet,
    n: int | None = None,
    *,
    nominal: Array | None = None,
    r: int | None = None,
) -> TwoStep:
    """Design robustly: first the nominal model, then the basis for it (remark 4.7).

    Parameters
    ----------
    members : LiftedSet
        The plants that may be met.
    n : int, optional
        Number of functions; by default the best one by remark 4.5.
    nominal : ndarray, shape (rows, cols), optional
        A given nominal model; by default (4.28).
    r : int, optional
        Directions to leave out (4.10); by default those with less than 1e-7 of the largest gain.

    Raises
    ------
    DesignError
        If the plants respond to fewer than n directions.
    """
    if nominal is None:
        # Identical to the other branch with (4.28), without the singular values of G_nom.
        nominal = lifted_optimum(members)
        functions, mu = robust_functions(members.gram, members.mean, r)
        sigma = np.sqrt(np.maximum(1.0 - mu, 0.0))
    else:
        if r is None:
            gains = np.linalg.svd(nominal, compute_uv=False)
            r = nominal.shape[1] - int(np.sum(gains > TOLERANCE * gains[0]))
        functions, sigma = spread_functions(nominal, spread_gram(members, nominal), r)
    best = best_number(sigma)
    count = best if n is None else n
    left_out = len(functions) - len(sigma)
    if not 1 <= count <= len(sigma):
        raise DesignError(
            f"n = {count} robust functions, but the plants answer {len(sigma)} directions "
            f"(r = {left_out}): take 1 to {len(sigma)}"
        )
    return TwoStep(nominal, orthonormal(functions[:, :count]), sigma, best, left_out)
