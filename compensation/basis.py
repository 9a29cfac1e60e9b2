"""Basis functions, of which commands are linear combinations.

A basis is a matrix Psi of shape (m, n) with orthonormal columns, so that the coefficients' norm is
the effort; n counts functions (the n + 1 of paper 003, Ramani's dissertation). In full preview they
compose the command itself; in limited preview its second difference, where the plant is G with two
integrators in front (docs/method.md). CE-Opt, robust and DCT functions are nested: those for n are
the first n of those for more.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from stillpath.compensation.base import DesignError
from stillpath.compensation.lifted import LiftedSet
from stillpath.compensation.operators import LiftedOperator
from stillpath.models.arrays import Array

__all__ = [
    "BASES",
    "TOLERANCE",
    "ZERO",
    "Basis",
    "bspline_basis",
    "bspline_functions",
    "ce_opt_basis",
    "ce_opt_basis_of",
    "dct_basis",
    "orthonormal",
    "robust_basis",
    "robust_basis_for",
    "robust_functions",
    "spread_functions",
]

Basis = Callable[[LiftedSet, int], Array]

TOLERANCE = 1e-7
"""Directions with less than this share of the largest gain are left out of robust bases. A Gram
matrix contains squares: it resolves singular values to 1e-8 of the largest."""
ZERO = 1e-13
"""Singular values below this share of the largest are zero apart from rounding."""


def bspline_functions(samples: int, n: int, degree: int = 3) -> Array:
    """Clamped uniform B-splines, shape (samples, n).

    Paper 003, F.2 and F.3: local, not negative, sum 1 at every sample.

    Raises
    ------
    DesignError
        If n is below degree + 1 or above the number of samples.
    """
    _check(n, samples)
    if n <= degree:
        raise DesignError(f"n = {n} B-splines of degree {degree}: take at least {degree + 1}")
    from scipy.interpolate import BSpline  # takes half a second to import, rarely needed

    inner = np.linspace(0.0, samples - 1.0, n - degree + 1)
    knots = np.concatenate([np.full(degree, inner[0]), inner, np.full(degree, inner[-1])])
    design = BSpline.design_matrix(np.arange(samples, dtype=float), knots, degree)
    return np.asarray(design.toarray(), np.float64)


def bspline_basis(samples: int, n: int, degree: int = 3) -> Array:
    """B-splines (paper 003, F.2 and F.3), orthonormalised, shape (samples, n).

    Parameters
    ----------
    n : int
        Number of functions, at least ``degree + 1``.
    degree : int
        Degree of the splines; a command made of increments is two degrees smoother.
    """
    return orthonormal(bspline_functions(samples, n, degree))


def dct_basis(samples: int, n: int) -> Array:
    """Cosines of the discrete cosine transform (paper 003, F.1), shape (samples, n)."""
    _check(n, samples)
    k, i = np.arange(samples)[:, None], np.arange(n)
    angles = np.pi / (2 * samples) * ((2 * k + 1) * i)
    functions: Array = np.sqrt(2.0 / samples) * np.cos(angles)
    functions[:, 0] /= np.sqrt(2.0)
    return functions


def ce_opt_basis(gram: Array, n: int) -> Array:
    """Control-effort-optimal basis: the n functions that need the least effort per output.

    Parameters
    ----------
    gram : ndarray, shape (m, m)
        G' G; for a plant set `LiftedSet.gram`.
    n : int
        Number of functions.

    Returns
    -------
    ndarray, shape (m, n)
        Leading eigenvectors of `gram`, which are the right singular vectors of G with the
        largest singular values (paper 003, 3.22).
    """
    _check(n, len(gram))
    _, vectors = np.linalg.eigh(gram)
    return _signed(vectors[:, ::-1][:, :n])


def ce_opt_basis_of(plant: LiftedOperator, n: int) -> Array:
    """`ce_opt_basis` of one plant by Lanczos steps, for paths too long for a Gram matrix.

    Only products with G and G' are needed: 600 functions of 10 000 samples take seconds and a tenth
    of the memory. At most m - 1 functions; for more than some m / 5 the Gram matrix is faster.
    """
    m = plant.shape[1]
    _check(n, m - 1)
    from scipy.sparse.linalg import svds  # slow to import, seldom needed

    # A fixed start vector makes the result repeatable.
    start = np.cos(np.arange(m) ** 1.5)
    _, sigma, vt = svds(plant.as_linear_operator(), k=n, v0=start)
    return _signed(np.asarray(vt[np.argsort(-sigma)].T, np.float64))


def robust_basis(gram: Array, mean: Array, n: int, r: int | None = None) -> Array:
    """Best basis of ensemble least squares over a plant set.

    With C = Psi Y and the best Y, sum_j l_j |I - G_j C|^2 = rows - trace((Psi'A Psi)^-1 Psi'B'B
    Psi), which is least when Psi spans the top eigenvectors of the pair (B'B, A). For r = 0 this
    is (4.22) of paper 003 with the nominal model (4.28): see docs/fbf.md.

    Parameters
    ----------
    gram, mean : ndarray, shapes (m, m), (rows, m)
        A and B of `LiftedSet`.
    n : int
        Number of functions, at most m - r.
    r : int, optional
        Number of directions with the least gain to leave out, as in (4.10). By default those whose
        singular value is below `TOLERANCE` times the largest.

    Returns
    -------
    ndarray, shape (m, n)
        Orthonormal and nested, the most robust functions first.

    Raises
    ------
    DesignError
        If the set responds to fewer than n directions.
    """
    _check(n, len(gram))
    functions, mu = robust_functions(gram, mean, r)
    if n > len(mu):
        raise DesignError(
            f"n = {n} robust functions, but the plant set answers {len(mu)} of {len(gram)} "
            f"directions (tolerance {TOLERANCE:g}): take at most {len(mu)}"
        )
    return orthonormal(functions[:, :n])


def robust_functions(gram: Array, mean: Array, r: int | None = None) -> tuple[Array, Array]:
    """Order the input directions of a plant set by how well its members agree on them.

    Parameters
    ----------
    gram, mean, r
        As in `robust_basis`.

    Returns
    -------
    functions : ndarray, shape (m, m - r)
        Eigenvectors of the pair (B'B, A), the most robust first, decoupled: F'A F = I.
    mu : ndarray, shape (m - r,)
        Eigenvalues, falling. n functions reach J_e,r^2 = 1 - sum(mu_1 .. mu_n) / rows, and
        sqrt(1 - mu_i) are the singular values of Delta_nom,s for the nominal model (4.28).

    Raises
    ------
    DesignError
        If `r` leaves nothing, or directions that the plants hardly respond to.
    """
    m = len(gram)
    squared, w = np.linalg.eigh(gram)
    squared, w = squared[::-1], w[:, ::-1]
    answered = int(np.sum(squared > TOLERANCE**2 * squared[0]))
    kept = answered if r is None else m - r
    if not 1 <= kept <= answered:
        raise DesignError(
            f"r = {r} of {m} directions left out, but {m - answered} are answered by less than "
            f"{TOLERANCE:g} of the largest: take {m - answered} to {m - 1}, or leave r out"
        )
    scaled = w[:, :kept] / np.sqrt(squared[:kept])
    seen = mean @ scaled
    mu, vectors = np.linalg.eigh(seen.T @ seen)
    return scaled @ vectors[:, ::-1], mu[::-1]


def robust_basis_for(nominal: Array, spread_gram: Array, n: int, r: int = 0) -> Array:
    """Robust basis for a given nominal model (paper 003, 4.22), as printed.

    Parameters
    ----------
    nominal, spread_gram, r
        As in `spread_functions`.
    n : int
        Number of functions, at most m - r.

    Returns
    -------
    ndarray, shape (m, n)
        Psi_nom: G_nom Psi_nom has orthonormal columns; the most robust functions first.

    Raises
    ------
    DesignError
        If there are not `n` such functions.
    """
    functions, _ = spread_functions(nominal, spread_gram, r)
    m, most = functions.shape
    if not 1 <= n <= most:
        raise DesignError(
            f"n = {n} robust functions with r = {r} of {m} directions left out: "
            f"1 <= n <= {most} needed"
        )
    return _signed(functions[:, :n])


def spread_functions(nominal: Array, spread_gram: Array, r: int = 0) -> tuple[Array, Array]:
    """Order the input directions of a nominal model by how much the plants differ from it.

    Parameters
    ----------
    nominal : ndarray, shape (rows, m)
        G_nom.
    spread_gram : ndarray, shape (m, m)
        Delta'Delta of (4.14), from `compensation.nominal.spread_gram`.
    r : int
        Number of the smallest singular values of G_nom to leave out (4.10).

    Returns
    -------
    functions : ndarray, shape (m, m - r)
        W_nom S_nom^-1 W_Delta of (4.22), the most robust first.
    singular_values : ndarray, shape (m - r,)
        Of Delta_nom,s (4.11), rising.

    Raises
    ------
    DesignError
        If r is not in 0 .. m - 1, or a remaining singular value is zero.
    """
    m = nominal.shape[1]
    if not 0 <= r < m:
        raise DesignError(f"r = {r} of {m} directions left out: 0 <= r < {m} needed")
    _, sigma, wt = np.linalg.svd(nominal, full_matrices=False)
    zeros = m - int(np.sum(sigma > ZERO * sigma[0]))
    if zeros > r:
        raise DesignError(
            f"r = {r}, but {zeros} singular values of the nominal model are zero: take r = {zeros}"
        )
    scaled = wt[: m - r].T / sigma[: m - r]
    squares, xi = np.linalg.eigh(scaled.T @ spread_gram @ scaled)
    return scaled @ xi, np.sqrt(np.maximum(squares, 0.0))


def orthonormal(functions: Array) -> Array:
    """Return functions, shape (m, n), orthonormalised in their order, signs fixed."""
    q, _ = np.linalg.qr(functions)
    return _signed(np.asarray(q, np.float64))


def _signed(functions: Array) -> Array:
    # The sign of eigenvectors is arbitrary; fix it so that the same model gives the same bytes.
    top = functions[np.argmax(np.abs(functions), axis=0), np.arange(functions.shape[1])]
    return np.ascontiguousarray(functions * np.sign(top))


def _per_input(members: LiftedSet, n: int, functions: Callable[[int, int], Array]) -> Array:
    """Give every input of the set the same functions."""
    inputs = len(members.gram) // members.samples
    if n % inputs:
        raise DesignError(f"n = {n} functions for {inputs} inputs: take a multiple of {inputs}")
    return np.asarray(np.kron(np.eye(inputs), functions(members.samples, n // inputs)), np.float64)


def _check(n: int, window: int) -> None:
    if not 1 <= n <= window:
        raise DesignError(f"n = {n} basis functions of {window} samples: take 1 to {window}")


BASES: dict[str, Basis] = {
    "bspline": lambda members, n: _per_input(members, n, bspline_basis),
    "dct": lambda members, n: _per_input(members, n, dct_basis),
    "ce-opt": lambda members, n: ce_opt_basis(members.gram, n),
    "robust": lambda members, n: robust_basis(members.gram, members.mean, n),
}
