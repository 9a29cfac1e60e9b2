"""The window problem with rests inside: the command must stand still while only E or Z moves.

Over a rest [a, b) the increments are tied down: the one at a stops the command, the others are
zero, and the remaining functions are solved for by weighted least squares with a small price on
acceleration, under the constraint that the command stands exactly on the path. The weight is low
inside the rest (nothing is printed) and back to normal after it, otherwise the command would
wander off (docs/method.md).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from compensation.preview import PreviewDesign

__all__ = ["EFFORT_PRICE", "solve_window"]

EFFORT_PRICE = 0.5
"""Price of squared increments (mm/sample^2)^2 against squared error mm^2."""
EDGE_PRICE = 3.0
"""How much more the one increment costs with which the command stops or starts."""


def solve_window(
    design: PreviewDesign,
    z: NDArray[np.float64],
    path_mm: NDArray[np.float64],
    weight: NDArray[np.float64],
    rests: NDArray[np.int64],
) -> NDArray[np.float64]:
    """Command of one window that stands still over the given rests.

    Parameters
    ----------
    design : PreviewDesign
        Gains and lifted members of the axis.
    z : ndarray, shape (nz,)
        Member states and the last two commands.
    path_mm, weight : ndarray, shape (window,)
        Planned positions and the weight of their errors.
    rests : ndarray of int64, shape (k, 2)
        Ranges [a, b) of samples, relative to the window, in which u(i) = u(i - 1) = path(i - 1).

    Returns
    -------
    ndarray, shape (window,)
    """
    last, previous = z[-2], z[-1]
    tied, offset, rows = _tie_down(design.basis, last - previous, rests, design.window)
    squared = weight * weight
    price = max(EFFORT_PRICE, design.price)
    # The price of the untied functions keeps the matrix definite when a rest leaves few samples.
    normal = price * (tied.T @ tied + design.effort)
    right = -price * (tied.T @ offset)
    edges = np.clip(rests[rests > 0], 0, design.window - 1)
    normal += EDGE_PRICE * price * (tied[edges].T @ tied[edges])
    right -= EDGE_PRICE * price * (tied[edges].T @ offset[edges])
    change = tied[rows] - design.basis[rows]
    first = 0
    for member, filtered in zip(design.members, design.filtered, strict=True):
        states = len(member.plant.b)
        error = (
            path_mm
            - member.from_state @ z[first : first + states]
            - member.from_history @ z[-2:]
            - member.integrated @ offset
        )
        response = filtered + member.integrated[:, rows] @ change
        weighted = response * (member.weight * squared)[:, None]
        normal += weighted.T @ response
        right += weighted.T @ error
        first += states
    factor = cho_factor(normal, lower=True, overwrite_a=True)
    coefficients = cho_solve(factor, right)
    free = last + np.arange(1.0, design.window + 1.0) * (last - previous)
    fixed = free + np.cumsum(np.cumsum(offset))
    pins = rests[rests[:, 0] > 0, 0] - 1
    if len(pins):
        # Equality constraints by their multipliers: u(pin) = path(pin).
        through = np.cumsum(np.cumsum(tied, axis=0), axis=0)[pins]
        reach = cho_solve(factor, through.T)
        miss = through @ coefficients - (path_mm[pins] - fixed[pins])
        coefficients = coefficients - reach @ np.linalg.solve(through @ reach, miss)
    command = fixed + np.cumsum(np.cumsum(tied @ coefficients))
    command[pins] = path_mm[pins]
    for a, b in rests:
        # Rounding must not move a resting axis.
        command[max(a, 0) : b] = last if a <= 0 else command[a - 1]
    return np.asarray(command)


def _tie_down(
    basis: NDArray[np.float64],
    speed: float,
    rests: NDArray[np.int64],
    window: int,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    """Basis and fixed increments that obey the rests, and the rows that differ from `basis`."""
    tied = basis.copy()
    offset = np.zeros(window)
    moving = 0
    rows: list[NDArray[np.int64]] = []
    for begin, end in rests:
        a, b = max(int(begin), 0), min(int(end), window)
        tied[a] = -basis[moving:a].sum(axis=0)
        tied[a + 1 : b] = 0.0
        if moving == 0:
            offset[a] = -speed
        rows.append(np.arange(a, b))
        moving = b
    return tied, offset, np.concatenate(rows)
