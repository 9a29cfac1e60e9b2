"""Limited-preview filtered basis functions on command increments, for one axis.

A window of `window` samples starts with the plant state x and the last two commands u1, u2 known.
The command continues in a straight line (u_free) plus the double running sum of v = Psi c; c
minimises the error over the window, the first `update` samples are committed, and the window moves
on (docs/method.md). Everything that does not depend on the path is folded into constant gains, so
that a window without a rest costs one matrix product:

    u_up = E z + S y_d        z = [x_1 .. x_l, u1, u2]
    z'   = F z + H y_d

The design refuses itself when the recursion is unstable or the basis nearly dependent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular, toeplitz

from compensation.base import DesignError
from compensation.basis import BASES
from compensation.lifted import LiftedSet, lifted_set
from models.plants import DiscretePlant

__all__ = [
    "MAX_CONDITION",
    "MAX_SPECTRAL_RADIUS",
    "PreviewDesign",
    "lifted_members",
    "lifted_plant",
]

MAX_SPECTRAL_RADIUS = 0.9
MAX_CONDITION = 1e10


@dataclass(frozen=True, slots=True)
class LiftedPlant:
    """One plant over one window.

    Attributes
    ----------
    integrated : ndarray, shape (window, window)
        From command increments v to position (lower-triangular Toeplitz).
    from_state : ndarray, shape (window, states)
        Free response to the plant state.
    from_history : ndarray, shape (window, 2)
        Response to u_free, as a function of (u1, u2).
    advance : ndarray, shape (states, states)
        State after `update` samples of no input.
    drive : ndarray, shape (states, update)
        State after `update` samples, from those samples of the command.
    """

    weight: float
    plant: DiscretePlant
    integrated: NDArray[np.float64]
    from_state: NDArray[np.float64]
    from_history: NDArray[np.float64]
    advance: NDArray[np.float64]
    drive: NDArray[np.float64]


def lifted_plant(plant: DiscretePlant, weight: float, window: int, update: int) -> LiftedPlant:
    """Lift a discrete plant over a window (first-order-hold model, D != 0 allowed)."""
    states = len(plant.b)
    markov = np.empty(window)
    from_state = np.empty((window, states))
    markov[0] = plant.d
    response, row = plant.b.copy(), plant.c.copy()
    from_state[0] = row
    for k in range(1, window):
        markov[k] = plant.c @ response
        response = plant.a @ response
        row = row @ plant.a
        from_state[k] = row
    drive = np.empty((states, update))
    response = plant.b.copy()
    for k in range(update - 1, -1, -1):
        drive[:, k] = response
        response = plant.a @ response
    step = np.arange(1.0, window + 1.0)
    return LiftedPlant(
        weight=weight,
        plant=plant,
        integrated=toeplitz(np.cumsum(np.cumsum(markov)), np.zeros(window)),
        from_state=from_state,
        from_history=toeplitz(markov, np.zeros(window)) @ np.stack([step + 1.0, -step], axis=1),
        advance=np.linalg.matrix_power(plant.a, update),
        drive=drive,
    )


def lifted_members(members: Sequence[LiftedPlant]) -> LiftedSet:
    """Return the members as one set, as bases are made for it."""
    return lifted_set(
        np.stack([m.integrated[:, 0] for m in members]), np.array([m.weight for m in members])
    )


class PreviewDesign:
    """Constant gains of one axis for one basis and one number of functions.

    Parameters
    ----------
    members : sequence of LiftedPlant
        One plant, or a weighted set (ensemble least squares); weights sum to 1.
    n : int
        Number of basis functions; n / (2 window dt) is the cut-off frequency of the command.
    basis : str
        A key of `compensation.basis.BASES`.
    price : float
        Price of squared increments (mm/sample^2)^2 against squared error mm^2. A small price
        bends the sharp cut-off at n into a slope, which asks for less acceleration at the same
        accuracy.
    psi : ndarray, shape (window, >= n), optional
        Functions made before, most important first; the first n of them are used.

    Attributes
    ----------
    command_gain, path_gain : ndarray
        E, shape (update, nz), and S, shape (update, window).
    state_gain, state_path_gain : ndarray
        F, shape (nz, nz), and H, shape (nz, window).
    basis : ndarray, shape (window, n)
        Psi scaled so that its filtered columns are orthonormal over the (weighted) members.
    effort : ndarray, shape (n, n)
        Gram matrix of `basis`: the squared command acceleration of a coefficient vector.
    spectral_radius, condition : float
        rho(F) and cond(R): the acceptance figures.

    Raises
    ------
    DesignError
        When rho(F) > 0.9 or cond(R) > 1e10.
    """

    def __init__(
        self,
        members: Sequence[LiftedPlant],
        n: int,
        basis: str = "ce-opt",
        price: float = 0.0,
        psi: NDArray[np.float64] | None = None,
    ) -> None:
        window = len(members[0].from_state)
        update = members[0].drive.shape[1]
        self.members, self.n, self.price = members, n, price
        self.window, self.update = window, update
        psi = BASES[basis](lifted_members(members), n) if psi is None else psi[:, :n]

        # One QR of the stacked members: normal equations would lose half the digits.
        roots = [np.sqrt(m.weight) for m in members]
        q, r = np.linalg.qr(
            np.concatenate([s * (m.integrated @ psi) for s, m in zip(roots, members, strict=True)])
        )
        self.condition = float(np.linalg.cond(r))
        if not self.condition <= MAX_CONDITION:
            raise DesignError(
                f"{n} {basis} functions over {window} samples are nearly dependent "
                f"(condition {self.condition:.1e}, limit {MAX_CONDITION:.0e}): take fewer"
            )
        self.basis = np.ascontiguousarray(solve_triangular(r, psi.T, trans="T").T)
        self.effort = self.basis.T @ self.basis
        self.filtered = [m.integrated @ self.basis for m in members]

        shrink = np.linalg.inv(np.eye(n) + price * self.effort)
        solve = [shrink @ (s * q[j * window : (j + 1) * window].T) for j, s in enumerate(roots)]
        summed = np.cumsum(np.cumsum(self.basis, axis=0), axis=0)[:update]
        step = np.arange(1.0, update + 1.0)
        free = np.stack([step + 1.0, -step], axis=1)
        self.path_gain = np.ascontiguousarray(summed @ sum(solve[1:], solve[0]))
        history = sum(
            (k @ m.from_history for k, m in zip(solve, members, strict=True)), np.zeros((n, 2))
        )
        self.command_gain = np.concatenate(
            [-summed @ (k @ m.from_state) for k, m in zip(solve, members, strict=True)]
            + [free - summed @ history],
            axis=1,
        )
        self._condense()
        self.spectral_radius = float(np.max(np.abs(np.linalg.eigvals(self.state_gain))))
        if not self.spectral_radius <= MAX_SPECTRAL_RADIUS:
            raise DesignError(
                f"{n} {basis} functions over {window} samples: the windows' recursion has spectral "
                f"radius {self.spectral_radius:.3f}, limit {MAX_SPECTRAL_RADIUS}; take a longer "
                "window or fewer functions"
            )

    def _condense(self) -> None:
        states = [len(m.plant.b) for m in self.members]
        size = sum(states) + 2
        f, h = np.zeros((size, size)), np.zeros((size, self.window))
        row = 0
        for member, count in zip(self.members, states, strict=True):
            block = slice(row, row + count)
            f[block, block] = member.advance
            f[block] += member.drive @ self.command_gain
            h[block] = member.drive @ self.path_gain
            row += count
        f[-2], h[-2] = self.command_gain[-1], self.path_gain[-1]
        f[-1], h[-1] = self.command_gain[-2], self.path_gain[-2]
        self.state_gain, self.state_path_gain = f, h

    def rest_state(self, position_mm: float) -> NDArray[np.float64]:
        """Vector z of an axis that stands at `position_mm`, shape (nz,)."""
        parts = [
            np.linalg.solve(np.eye(len(m.plant.b)) - m.plant.a, m.plant.b * position_mm)
            for m in self.members
        ]
        return np.concatenate([*parts, np.full(2, position_mm)])
