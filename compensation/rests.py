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
from scipy.linalg.lapack import dpotrf, dpotrs

from compensation.base import DesignError
from compensation.preview import PreviewDesign

__all__ = ["EFFORT_PRICE", "solve_window"]

EFFORT_PRICE = 0.5
"""Price of squared increments (mm/sample^2)^2 against squared error mm^2."""


def solve_window(
    design: PreviewDesign,
    z: NDArray[np.float64],
    path_mm: NDArray[np.float64],
    weight: NDArray[np.float64],
    rests: NDArray[np.int64],
    edge_price: float,
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
    edge_price : float
        How much more the increments cost with which the command stops and starts.

    Returns
    -------
    ndarray, shape (window,)
    """
    last, previous = z[-2], z[-1]
    window = design.window
    spans = [(max(int(a), 0), min(int(b), window)) for a, b in rests]
    tied, offset = _tie_down(design.basis, last - previous, spans)
    squared = weight * weight
    price = max(EFFORT_PRICE, design.price)

    # Outside the rests the increments are the untied ones, so their effort is known.
    edges = [k for span in spans for k in span if 0 < k < window]
    normal = 2.0 * price * design.effort
    for a, b in spans:
        normal -= price * (design.basis[a:b].T @ design.basis[a:b])
        normal += price * np.outer(tied[a], tied[a])
    right = -price * (offset @ tied)
    for k in edges:
        # The price of the untied functions keeps the matrix definite when a rest leaves few
        # samples; where the command stops or starts, acceleration costs more.
        normal += edge_price * price * np.outer(tied[k], tied[k])
        right -= edge_price * price * offset[k] * tied[k]
    first = 0
    for member, filtered in zip(design.members, design.filtered, strict=True):
        states = len(member.plant.b)
        error = (
            path_mm
            - member.from_state @ z[first : first + states]
            - member.from_history @ z[-2:]
            - member.integrated @ offset
        )
        response = filtered.copy()
        for a, b in spans:
            # The plant is causal: what is tied at a shows from a on.
            response[a:] += member.integrated[a:, a:b] @ (tied[a:b] - design.basis[a:b])
        weighted = response * (member.weight * squared)[:, None]
        normal += weighted.T @ response
        right += error @ weighted
        first += states
    # LAPACK itself: the wrappers' checks would take as long as the solution.
    factor, flaw = dpotrf(normal, lower=1, overwrite_a=1)
    if flaw:
        raise DesignError(f"the window problem at a rest is singular (LAPACK dpotrf: {flaw})")
    coefficients = dpotrs(factor, right, lower=1)[0]
    step = np.arange(1.0, window + 1.0)
    fixed = last + step * (last - previous) + np.cumsum(np.cumsum(offset))
    pins = [a - 1 for a, _ in spans if a > 0]
    if pins:
        # Equality constraints by their multipliers: u(pin) = path(pin).
        reach_of = np.maximum(np.array(pins)[:, None] + 1.0 - np.arange(window), 0.0)
        through = reach_of @ tied
        reach = dpotrs(factor, through.T, lower=1)[0]
        miss = through @ coefficients - (path_mm[pins] - fixed[pins])
        coefficients = coefficients - reach @ np.linalg.solve(through @ reach, miss)
    command = fixed + np.cumsum(np.cumsum(tied @ coefficients))
    command[pins] = path_mm[pins]
    for a, b in rests:
        # Rounding must not move a resting axis.
        command[max(a, 0) : b] = last if a <= 0 else command[a - 1]
    return np.asarray(command)


def _tie_down(
    basis: NDArray[np.float64], speed: float, spans: list[tuple[int, int]]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Basis and fixed increments that obey the rests."""
    tied = basis.copy()
    offset = np.zeros(len(basis))
    moving = 0
    for a, b in spans:
        tied[a] = -basis[moving:a].sum(axis=0)
        tied[a + 1 : b] = 0.0
        if moving == 0:
            offset[a] = -speed
        moving = b
    return tied, offset
