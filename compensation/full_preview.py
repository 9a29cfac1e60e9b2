"""Filtered basis functions with the whole path known (paper 003, chapters 2 to 4).

u = Phi gamma, and gamma minimises the weighted error of one plant or of a set. The design is kept
in decoupled form (appendix E): functions Psi and targets T with C = Psi T', so that a command costs
two thin products for any plant.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import solve_triangular, svdvals

from stillpath.compensation.base import DesignError
from stillpath.compensation.basis import TOLERANCE
from stillpath.compensation.lifted import LiftedSet, checked_weights, free_response, lift
from stillpath.compensation.operators import LiftedOperator
from stillpath.models.arrays import Array
from stillpath.models.plants import DiscretePlant

__all__ = [
    "RANK_TOLERANCE",
    "FullPreview",
    "Independence",
    "Solvability",
    "independence",
]

RANK_TOLERANCE = 1e-12
"""Filtered functions count as dependent below this singular value, relative to the largest."""
_DEPENDENT = 1e-13
"""The same for the unfiltered functions."""
_SILENT = 1e-9
"""Inputs whose output is smaller, relative to the largest, count as silent."""


@dataclass(frozen=True, slots=True)
class Solvability:
    """Conditioning of the least-squares problem (2.10).

    Attributes
    ----------
    functions, rank : int
        Number of functions, and of those independent after the plant.
    condition : float
        Largest over smallest singular value of the filtered functions.
    tolerance : float
        Relative singular value below which a direction was left out.
    """

    functions: int
    rank: int
    condition: float
    tolerance: float

    @property
    def unique(self) -> bool:
        """Whether the coefficients are unique; otherwise the minimum-norm ones are used."""
        return self.rank == self.functions


@dataclass(frozen=True, slots=True)
class Independence:
    """Ranks of the test (2.17).

    Attributes
    ----------
    rank : int
        Of the functions and filter initial states, [Phi; X].
    augmented : int
        Of the same beside the inputs and states without output, [Phi U; X X_u].
    silent : int
        Dimension of these: the order of the plant.
    """

    rank: int
    augmented: int
    silent: int

    @property
    def independent(self) -> bool:
        """Whether the filtered functions are linearly independent."""
        return self.augmented == self.rank + self.silent


class FullPreview:
    """Filtered basis functions for one lifted system or a set of them.

    Parameters
    ----------
    plants : LiftedOperator, sequence of LiftedOperator, or LiftedSet
        One plant (2.10), or several for ensemble least squares: stacked and solved by QR, or, as
        a `LiftedSet`, from its Gram matrices, which takes the same time for any number of plants
        but keeps half the digits.
    basis : ndarray, shape (cols, n)
        Phi, any functions of the inputs.
    weights : array_like, shape (l,), optional
        Of a sequence of plants; sum 1.
    weighting : LiftedOperator, optional
        Filter of the error (remark 3.3): |W e| is minimised.
    responses, states : ndarray, shapes (rows, order), (order, n), optional
        Zero-input response O of the plant and the initial state of each function's filter, X
        (2.16): functions are filtered as G Phi + O X, and the plant starts in `initial_state`.
    rank_tolerance : float
        See `RANK_TOLERANCE`; from a `LiftedSet` never below 1e-7.

    Attributes
    ----------
    basis : ndarray, shape (cols, n)
    functions : ndarray, shape (cols, rank)
        Psi: decoupled functions; the first k of them span the first k of the basis, if unique.
    targets : ndarray, shape (rows, rank)
        T: the coefficient of psi_i is the path's projection on t_i. For one unweighted plant: the
        filtered Psi, with orthonormal columns (E.1).
    transform : ndarray, shape (rank, n)
        Omega of (E.3): Phi = Psi Omega, upper triangular with positive diagonal if unique.
    report : Solvability

    Raises
    ------
    DesignError
        If there are more functions than samples, the functions are dependent before the plant,
        the plant responds to none of them, or shapes do not match.
    """

    def __init__(
        self,
        plants: LiftedOperator | Sequence[LiftedOperator] | LiftedSet,
        basis: Array,
        *,
        weights: ArrayLike | None = None,
        weighting: LiftedOperator | None = None,
        responses: Array | None = None,
        states: Array | None = None,
        rank_tolerance: float = RANK_TOLERANCE,
    ) -> None:
        self.basis = np.asarray(basis, np.float64)
        if isinstance(plants, LiftedSet):
            _check_basis(self.basis, plants.gram.shape[0])
            if weights is not None or weighting is not None or states is not None:
                raise DesignError(
                    "a LiftedSet has its weights in it and takes no weighting filter or filter "
                    "states: make it from the weighted plants, or give the plants one by one"
                )
            self._states = None
            self._from_set(plants, max(rank_tolerance, TOLERANCE))
            return
        members = [plants] if isinstance(plants, LiftedOperator) else list(plants)
        given = np.full(len(members), 1.0 / max(len(members), 1)) if weights is None else weights
        roots = np.sqrt(checked_weights(given, len(members)))
        for member in members:
            _check_basis(self.basis, member.shape[1])
        filtered = [member.apply(self.basis) for member in members]
        self._states = _checked_states(states, responses, filtered)
        if responses is not None and states is not None:
            filtered = [filtered[0] + responses @ states]
        if weighting is not None:
            filtered = [weighting.apply(f) for f in filtered]
        q = self._from_filtered(
            np.concatenate([s * f for s, f in zip(roots, filtered, strict=True)]), rank_tolerance
        )
        parts = np.split(q, len(members))
        targets = np.sum([s * part for s, part in zip(roots, parts, strict=True)], axis=0)
        self.targets = targets if weighting is None else weighting.apply_adjoint(targets)

    def coefficients(self, y_d: ArrayLike, free: ArrayLike = 0.0) -> Array:
        """Return gamma of (2.10), shape (n,) or (n, k), of minimum norm if not unique.

        Parameters
        ----------
        y_d : array_like, shape (rows,) or (rows, k)
            Desired outputs.
        free : array_like, broadcast to y_d
            Output of the plant without a command: O x0 of a nonzero initial state.
        """
        seen = self._seen(y_d, free)
        if self.report.unique:
            return np.asarray(solve_triangular(self.transform, seen), np.float64)
        # Omega = S V' with orthonormal rows V': its pseudo-inverse is Omega' S^-2.
        squares = np.sum(self.transform**2, axis=1)
        return np.asarray(self.transform.T @ (seen.T / squares).T, np.float64)

    def command(self, y_d: ArrayLike, free: ArrayLike = 0.0) -> Array:
        """Return u = C (y_d - free), shape (cols,) or (cols, k); see `coefficients`."""
        return np.asarray(self.functions @ self._seen(y_d, free), np.float64)

    def commands(self, y_d: ArrayLike, counts: Sequence[int]) -> Array:
        """Return the commands of the first k functions alone, for every k in `counts`.

        Parameters
        ----------
        y_d : array_like, shape (rows,)

        Returns
        -------
        ndarray, shape (cols, len(counts))
            Column i is what a design with the first counts[i] functions would command.

        Raises
        ------
        DesignError
            If the filtered functions are dependent: then they have no order.
        """
        if not self.report.unique:
            raise DesignError(
                f"filtered functions are dependent (rank {self.report.rank} of "
                f"{self.report.functions}): design each number of functions by itself"
            )
        if min(counts) < 1 or max(counts) > self.report.rank:
            raise DesignError(
                f"{min(counts)} to {max(counts)} of {self.report.rank} functions: take 1 to all"
            )
        shares = self.functions * self._seen(y_d, 0.0)
        np.cumsum(shares, axis=1, out=shares)
        return shares[:, np.asarray(counts) - 1]

    def initial_state(self, y_d: ArrayLike) -> Array:
        """Return X gamma, the required initial state of the plant if filters had states.

        Raises
        ------
        DesignError
            If they had none.
        """
        if self._states is None:
            raise DesignError("this design was made without filter initial states")
        return np.asarray(self._states @ self.coefficients(y_d), np.float64)

    def controller(self) -> Array:
        """Return C of (2.11) and (E.7) as a matrix, shape (cols, rows)."""
        return np.asarray(self.functions @ self.targets.T, np.float64)

    def _seen(self, y_d: ArrayLike, free: ArrayLike) -> Array:
        path = np.asarray(y_d, np.float64)
        if path.ndim not in (1, 2) or len(path) != len(self.targets):
            raise DesignError(
                f"path of shape {path.shape}: this design takes ({len(self.targets)},) or "
                f"({len(self.targets)}, k) samples"
            )
        return np.asarray(self.targets.T @ (path - np.asarray(free, np.float64)), np.float64)

    def _from_filtered(self, filtered: Array, tolerance: float) -> Array:
        """Decouple by QR, or by SVD where functions are dependent; return orthonormal columns."""
        q, r = np.linalg.qr(filtered)
        sigma = svdvals(r)
        rank = self._judge(sigma, len(r[0]), tolerance)
        if rank == len(r[0]):
            # Positive diagonal: R is then the Cholesky factor of appendix E.
            sign = np.sign(np.diag(r))
            self.transform = r * sign[:, None]
            self.functions = solve_triangular(self.transform, self.basis.T, trans="T").T
            return np.asarray(q * sign, np.float64)
        u, sigma, vt = np.linalg.svd(r)
        self.transform = sigma[:rank, None] * vt[:rank]
        self.functions = self.basis @ (vt[:rank].T / sigma[:rank])
        return np.asarray(q @ u[:, :rank], np.float64)

    def _from_set(self, plants: LiftedSet, tolerance: float) -> None:
        squares, v = np.linalg.eigh(self.basis.T @ (plants.gram @ self.basis))
        squares, v = squares[::-1], v[:, ::-1]
        sigma = np.sqrt(np.maximum(squares, 0.0))
        rank = self._judge(sigma, len(v), tolerance)
        if rank == len(v):
            # The QR of a square root of the Gram matrix is its Cholesky factor.
            _, r = np.linalg.qr(sigma[:, None] * v.T)
            self.transform = r * np.sign(np.diag(r))[:, None]
            self.functions = solve_triangular(self.transform, self.basis.T, trans="T").T
        else:
            self.transform = sigma[:rank, None] * v[:, :rank].T
            self.functions = self.basis @ (v[:, :rank] / sigma[:rank])
        self.targets = plants.mean @ self.functions

    def _judge(self, sigma: Array, n: int, tolerance: float) -> int:
        top = float(sigma[0])
        rank = int(np.sum(sigma > tolerance * top)) if top > 0 else 0
        if rank == 0:
            raise DesignError(
                f"the plant answers none of the {n} functions: is its gain zero, or its delay "
                "longer than the path?"
            )
        smallest = float(sigma[n - 1]) if len(sigma) >= n else 0.0
        condition = top / smallest if smallest > 0 else float("inf")
        self.report = Solvability(n, rank, condition, tolerance)
        return rank


def independence(plant: DiscretePlant, basis: Array, states: Array | None = None) -> Independence:
    """Test by (2.17) whether the filtered functions will be independent, before filtering them.

    Parameters
    ----------
    basis : ndarray, shape (m, n)
    states : ndarray, shape (order, n), optional
        Initial states X of the filters; zero by default.

    Notes
    -----
    A silent input together with an initial state gives no output over m samples, (2.15): growing
    exponentials of the zeros outside the unit circle, or whatever comes in the last samples of a
    plant with delay. They are found as the null space of [G O].
    """
    phi = np.asarray(basis, np.float64)
    m, n = phi.shape
    x = np.zeros((plant.order, n)) if states is None else np.asarray(states, np.float64)
    if x.shape != (plant.order, n):
        raise DesignError(f"filter states of shape {x.shape}: ({plant.order}, {n}) needed")
    answers = np.concatenate([lift(plant, m).dense(), free_response(plant, m)], axis=1)
    _, _, vt = np.linalg.svd(answers)
    silent = vt[m:].T
    q, sigma, _ = np.linalg.svd(np.concatenate([phi, x]), full_matrices=False)
    rank = int(np.sum(sigma > _SILENT * sigma[0]))
    both = svdvals(np.concatenate([q[:, :rank], silent], axis=1))
    return Independence(rank, int(np.sum(both > _SILENT)), plant.order)


def _check_basis(basis: Array, cols: int) -> None:
    if basis.ndim != 2 or basis.shape[0] != cols:
        raise DesignError(
            f"basis of shape {basis.shape}: one row for each of the plant's {cols} inputs needed"
        )
    n = basis.shape[1]
    if not 1 <= n <= cols:
        raise DesignError(f"{n} functions for {cols} input samples: take 1 to {cols}")
    if not np.isfinite(basis).all():
        raise DesignError("the basis holds values that are not finite")
    gram = basis.T @ basis
    if np.abs(gram - np.eye(n)).max() < 1e-6:
        return  # orthonormal, as all bases of `compensation.basis` are
    sigma = svdvals(np.linalg.qr(basis, mode="r"))
    rank = int(np.sum(sigma > _DEPENDENT * sigma[0]))
    if rank < n:
        raise DesignError(
            f"the {n} basis functions are linearly dependent before any filtering (rank {rank}): "
            f"leave out {n - rank}, or orthonormalise them"
        )


def _checked_states(
    states: Array | None, responses: Array | None, filtered: list[Array]
) -> Array | None:
    if states is None and responses is None:
        return None
    if states is None or responses is None or len(filtered) > 1:
        raise DesignError("filter initial states need one plant, its `responses` and `states`")
    rows, n = filtered[0].shape
    order = states.shape[0]
    if states.shape != (order, n) or responses.shape != (rows, order):
        raise DesignError(
            f"filter states {states.shape} with responses {responses.shape}: (order, {n}) and "
            f"({rows}, order) needed"
        )
    return states
