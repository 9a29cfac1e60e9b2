"""Limited-preview filtered basis functions on command increments, for one axis.

A window starts with the plant states x and the last two commands u1, u2 known. The command
continues in a straight line (u_free) plus the double running sum of v = Psi c; c minimises the
error over the window, the first `update` samples are committed, and the window moves on
(docs/method.md). Everything independent of the path is folded into constant gains, so that a window
without a rest costs one matrix product:

    u_up = E z + S y_d        z = [x_1 .. x_l, u1, u2]
    z'   = F z + H y_d

The design fails if the recursion is unstable or the basis nearly dependent.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr, solve_triangular

from stillpath.compensation._least_squares_kernels import BLOCK
from stillpath.compensation.base import DesignError
from stillpath.compensation.basis import BASES
from stillpath.compensation.defaults import DEFAULT_BASIS
from stillpath.compensation.lifted_window import LiftedWindow
from stillpath.models.arrays import Array

__all__ = ["MAX_CONDITION", "MAX_SPECTRAL_RADIUS", "PreviewDesign", "running_gram"]

MAX_SPECTRAL_RADIUS = 0.9
MAX_CONDITION = 1e10
_NODE_TOLERANCE = 1e-11
"""Interpolation error of the nodes relative to the largest row: below 1 nm on a 200 mm path."""


class PreviewDesign:
    """Constant gains of one axis for one basis and one number of functions.

    Parameters
    ----------
    lifted : LiftedWindow
        One plant, or a weighted set (ensemble least squares).
    n : int
        Number of basis functions; n / (2 window dt) is the cut-off frequency of the command.
    basis : str
        A key of `compensation.basis.BASES`.
    price : float
        Weight of squared increments (mm/sample^2)^2 relative to squared error mm^2. A small weight
        turns the sharp cut-off at n into a slope, which needs less acceleration for the same
        accuracy.
    psi : ndarray, shape (window, >= n), optional
        Precomputed functions, most important first; the first n are used.

    Attributes
    ----------
    window, update : int
    command_gain, path_gain : ndarray
        E, shape (update, nz), and S, shape (update, window).
    nodes, spread : ndarray, shapes (k,) and (update, k)
        Some samples of the update, and the interpolation to all of them, S = spread S[nodes]: the
        functions' commands are smooth.
    target_gain : ndarray, shape (components, k, window)
        S[nodes] for separate targets of each component; weighted by `lifted.target` they sum to it.
    state_gain, state_drive : ndarray
        F, shape (nz, nz), and the effect of S y_d on z, shape (nz, update): H = state_drive S.
    basis : ndarray, shape (window, n)
        Psi scaled so that its filtered columns are orthonormal over the (weighted) members.
    summed : ndarray, shape (window, n)
        Its double running sum: the commands of the functions.
    filtered : ndarray, shape (components, window, n)
    effort : ndarray, shape (n, n)
        Gram matrix of `basis`: the squared command acceleration of a coefficient vector.
    efforts, grams : ndarray, shape (blocks + 1, n, n)
        Gram matrices of `basis` and `filtered` before every `BLOCK`th sample, and of all.
    spectral_radius, condition : float
        rho(F) and cond(R), the acceptance criteria.

    Raises
    ------
    DesignError
        If rho(F) > 0.9 or cond(R) > 1e10.
    """

    def __init__(
        self,
        lifted: LiftedWindow,
        n: int,
        basis: str = DEFAULT_BASIS,
        price: float = 0.0,
        psi: Array | None = None,
    ) -> None:
        self.lifted, self.n, self.price = lifted, n, price
        self.window, self.update = window, update = lifted.window, lifted.update
        psi = BASES[basis](lifted.lifted_set(), n) if psi is None else psi[:, :n]

        # One QR of the stacked components: normal equations would lose half the digits.
        q, r = np.linalg.qr(np.concatenate(lifted.integrated @ psi))
        self.condition = float(np.linalg.cond(r))
        if not self.condition <= MAX_CONDITION:
            raise DesignError(
                f"{n} {basis} functions over {window} samples are nearly dependent "
                f"(condition {self.condition:.1e}, limit {MAX_CONDITION:.0e}): take another basis"
            )
        self.basis = np.ascontiguousarray(solve_triangular(r, psi.T, trans="T").T)
        self.effort = self.basis.T @ self.basis
        self.filtered = q.reshape(-1, window, n)

        solve = np.linalg.solve(np.eye(n) + price * self.effort, q.T).reshape(n, -1, window)
        self.summed = np.cumsum(np.cumsum(self.basis, axis=0), axis=0)
        summed = self.summed[:update]
        step = np.arange(1.0, update + 1.0)
        self.nodes, self.spread = _nodes(summed)
        self.target_gain = np.tensordot(summed[self.nodes], solve, 1).swapaxes(0, 1)
        self.path_gain = summed @ np.einsum("nkw,k->nw", solve, lifted.target)
        self.command_gain = -summed @ np.tensordot(solve, lifted.from_state, 2)
        self.command_gain[:, -2:] += np.stack([step + 1.0, -step], axis=1)
        self._condense()
        self.spectral_radius = float(np.max(np.abs(np.linalg.eigvals(self.state_gain))))
        if not self.spectral_radius <= MAX_SPECTRAL_RADIUS:
            raise DesignError(
                f"{n} {basis} functions over {window} samples: the windows' recursion has spectral "
                f"radius {self.spectral_radius:.3f}, limit {MAX_SPECTRAL_RADIUS}: a plant "
                "rings for longer than a window; take robust off or another basis, or measure again"
            )

    @cached_property
    def node_gain(self) -> Array:
        """S[nodes]."""
        return np.asarray(self.path_gain[self.nodes])

    @cached_property
    def state_spread(self) -> Array:
        """Effect of S[nodes] y_d on z."""
        return np.asarray(self.state_drive @ self.spread)

    @cached_property
    def efforts(self) -> Array:
        """Running Gram matrices of `basis`."""
        return running_gram(self.basis[None])

    @cached_property
    def grams(self) -> Array:
        """Running Gram matrices of `filtered`."""
        return running_gram(self.filtered)

    def _condense(self) -> None:
        lifted = self.lifted
        # The last two commands, newest first, follow the members' states.
        self.state_drive = np.concatenate([lifted.drive, np.eye(lifted.update)[-1:-3:-1]])
        self.state_gain = self.state_drive @ self.command_gain
        self.state_gain[:-2, :-2] += lifted.advance


def _nodes(rows: Array) -> tuple[NDArray[np.int64], Array]:
    """Return a few rows that span a matrix, and the coefficients of all rows in them.

    Source: the interpolative decomposition by pivoted QR of H. Cheng, Z. Gimbutas, P. G.
    Martinsson and V. Rokhlin, SIAM J. Sci. Comput. 26 (2005).
    """
    r, order = qr(rows.T, mode="r", pivoting=True)
    size = np.abs(np.diag(r))
    k = int(np.sum(size > _NODE_TOLERANCE * size[0]))
    spread = np.empty((len(rows), k))
    spread[order[:k]] = np.eye(k)
    spread[order[k:]] = solve_triangular(r[:k, :k], r[:k, k:]).T
    return order[:k].astype(np.int64), spread


def running_gram(rows: Array) -> Array:
    """Return Gram matrices of rows before every `BLOCK`th sample, and of all.

    Parameters
    ----------
    rows : ndarray, shape (components, window, n)

    Returns
    -------
    ndarray, shape (blocks + 1, n, n)
    """
    starts = range(0, rows.shape[1], BLOCK)
    blocks = [np.concatenate(rows[:, start : start + BLOCK]) for start in starts]
    grams = [np.zeros((rows.shape[2],) * 2), *(block.T @ block for block in blocks)]
    return np.asarray(np.cumsum(grams, axis=0))
