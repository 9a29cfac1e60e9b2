"""Basis functions for the increments of a command over one preview window.

The functions act on the second difference v of the command u, that is on its acceleration: the
plant seen by them is G with two integrators in front (docs/method.md). A basis is a matrix Psi of
shape (window, n) with orthonormal columns, so that the coefficients' norm is the effort.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from compensation.base import DesignError

__all__ = ["BASES", "bspline_basis", "ce_opt_basis"]

Basis = Callable[[NDArray[np.float64], int], NDArray[np.float64]]


def ce_opt_basis(gram: NDArray[np.float64], n: int) -> NDArray[np.float64]:
    """Control-effort-optimal basis: the n functions that need the least acceleration per output.

    Parameters
    ----------
    gram : ndarray, shape (window, window)
        G_a' G_a, with G_a the lifted plant from command increments to position; for a plant set
        the weighted sum over its members.
    n : int
        Number of functions.

    Returns
    -------
    ndarray, shape (window, n)
        Leading eigenvectors of `gram`, which are the right singular vectors of G_a with the
        largest singular values (dissertation of paper 003, equation 3.22).
    """
    _check(n, len(gram))
    _, vectors = np.linalg.eigh(gram)
    psi = vectors[:, ::-1][:, :n]
    # Eigenvectors are free in sign; fix it so that the same model gives the same bytes.
    sign = np.sign(psi[np.argmax(np.abs(psi), axis=0), np.arange(n)])
    return np.ascontiguousarray(psi * sign)


def bspline_basis(gram: NDArray[np.float64], n: int, degree: int = 3) -> NDArray[np.float64]:
    """Clamped uniform B-splines over the window (paper 003, F.2 and F.3), orthonormalised.

    Parameters
    ----------
    gram : ndarray, shape (window, window)
        Only its size is used: these functions do not depend on the plant.
    n : int
        Number of functions, at least ``degree + 1``.
    degree : int
        Degree of the splines in v; the command itself is two degrees smoother.
    """
    window = len(gram)
    from scipy.interpolate import BSpline  # half a second to import, seldom needed

    _check(n, window)
    if n <= degree:
        raise DesignError(f"n = {n} B-splines of degree {degree}: take at least {degree + 1}")
    inner = np.linspace(0.0, window - 1.0, n - degree + 1)
    knots = np.concatenate([np.full(degree, inner[0]), inner, np.full(degree, inner[-1])])
    design = BSpline.design_matrix(np.arange(window, dtype=float), knots, degree).toarray()
    q, _ = np.linalg.qr(design)
    return np.ascontiguousarray(q)


BASES: dict[str, Basis] = {"ce-opt": ce_opt_basis, "bspline": bspline_basis}


def _check(n: int, window: int) -> None:
    if not 1 <= n <= window:
        raise DesignError(f"n = {n} basis functions in a window of {window} samples: 1 <= n needed")
