"""Rational fits by repeated linear least squares, in s or in z.

C. K. Sanathanan, J. Koerner, "Transfer function synthesis as a ratio of two complex
polynomials", IEEE Trans. Automatic Control 8 (1963): minimise |B - H A|^2, weighted by the
1/|A|^2 of the round before, so that what is minimised tends to |B/A - H|^2.
"""

from __future__ import annotations

import numpy as np

from stillpath.models.arrays import Array, Complex

__all__ = ["pairs_of", "polynomial_basis", "sanathanan_koerner"]

_ROUNDS = 15


def sanathanan_koerner(
    basis: Complex,
    response: Complex,
    weight: Array,
    numerator: int,
    denominator: int,
) -> tuple[Array, Array, float]:
    """Fit B/A with A = 1 + a_1 x + ... + a_n x^n.

    Parameters
    ----------
    basis : ndarray of complex, shape (points, at least max(numerator, denominator) + 1)
        Powers of x at the points, from x^0 = 1.
    response, weight : ndarray, shape (points,)
    numerator, denominator : int
        Degrees of B and A.

    Returns
    -------
    b, a : ndarray, shapes (numerator + 1,), (denominator + 1,)
        Lowest power first, a[0] = 1: those of the best round.
    error : float
        Root of sum |weight (B/A - H)|^2 over sum |weight H|^2.
    """
    top, bottom = basis[:, : numerator + 1], basis[:, : denominator + 1]
    matrix = np.hstack([top, -response[:, None] * bottom[:, 1:]])
    size = float(np.linalg.norm(weight * response))
    scale = weight.copy()
    best: tuple[Array, Array, float] | None = None
    for _ in range(_ROUNDS):
        b, rest = np.split(
            _least_squares(matrix * scale[:, None], response * scale), [numerator + 1]
        )
        a = np.concatenate([[1.0], rest])
        denominators = bottom @ a
        fitted = (top @ b) / denominators
        error = float(np.linalg.norm(weight * (fitted - response))) / size
        if best is not None and abs(error - best[2]) < 1e-6 * best[2]:
            break
        if best is None or error < best[2]:
            best = (b, a, error)
        scale = weight / np.abs(denominators)
    assert best is not None
    return best


def polynomial_basis(x: Complex, degree: int) -> Complex:
    """Return x^0 ... x^degree, shape (len(x), degree + 1)."""
    return np.asarray(np.vander(x, degree + 1, increasing=True), np.complex128)


def pairs_of(coefficients: Array) -> tuple[Array, Array]:
    """Split a polynomial, lowest power first, into factors (1 + tau x) and pairs.

    Returns
    -------
    pairs : ndarray, shape (k, 2)
        Rows (w, zeta) of factors 1 + 2 zeta x/w + (x/w)^2, rising in w. Two real roots on the
        same side make a pair with |zeta| > 1.
    tau : ndarray
        What is left of the real roots, as factors 1 + tau x.
    """
    roots = np.roots(np.trim_zeros(coefficients[::-1], "f"))
    roots = roots[np.abs(roots) > 0]
    upper = roots[roots.imag > 0]
    rows = [(abs(r), -r.real / abs(r)) for r in upper]
    left: list[float] = []
    for side in (-1, 1):
        real = np.sort(np.abs(roots[(roots.imag == 0) & (np.sign(roots.real) == side)].real))
        for low, high in zip(real[0::2], real[1::2], strict=False):
            rows.append((np.sqrt(low * high), -side * (low + high) / (2 * np.sqrt(low * high))))
        if len(real) % 2:
            left.append(-side / real[-1])
    pairs = np.array(sorted(rows), float).reshape(-1, 2)
    return pairs, np.array(left)


def _least_squares(matrix: Complex, right: Complex) -> Array:
    """Solve for real unknowns, columns scaled to equal size."""
    real = np.vstack([matrix.real, matrix.imag])
    length = np.linalg.norm(real, axis=0)
    length[length == 0] = 1.0
    q, r = np.linalg.qr(real / length)
    target = q.T @ np.concatenate([right.real, right.imag])
    return np.asarray(np.linalg.lstsq(r, target, rcond=None)[0] / length, np.float64)
