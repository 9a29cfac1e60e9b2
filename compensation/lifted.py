"""Plants and plant sets in lifted form: from models to operators and Gram matrices.

A set of plants is stored as two matrices, A = sum l_j G_j'G_j and B = sum l_j G_j, which is all
that a robust basis or nominal model needs, for any number of plants.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from stillpath.compensation.base import DesignError
from stillpath.compensation.operators import LiftedOperator, TimeVaryingOperator, ToeplitzOperator
from stillpath.models.arrays import Array
from stillpath.models.plants import DiscretePlant

__all__ = [
    "LiftedSet",
    "checked_weights",
    "free_response",
    "integrated",
    "lift",
    "lifted_set",
    "lifted_set_of",
    "time_varying",
]

_WEIGHT_SUM = 1e-9
"""Tolerance of the sum 1 of weights."""


@dataclass(frozen=True, slots=True, eq=False)
class LiftedSet:
    """A weighted set of plants, reduced to what robust designs need.

    Attributes
    ----------
    gram : ndarray, shape (cols, cols)
        A = sum_j l_j G_j' G_j.
    mean : ndarray, shape (rows, cols)
        B = sum_j l_j G_j.
    samples : int
        Samples per input; cols / samples is the number of inputs.
    """

    gram: Array
    mean: Array
    samples: int


def lift(plant: DiscretePlant | ArrayLike, samples: int) -> ToeplitzOperator:
    """Lift a plant over a number of samples.

    Parameters
    ----------
    plant : DiscretePlant or array_like, shape (k,)
        A discrete plant, or its Markov parameters or FIR taps, cut or zero-padded to `samples`.
    samples : int
        M + 1.

    Raises
    ------
    DesignError
        If the plant is unstable: no command is bounded for it (paper 003, remark 2.2).
    """
    if samples < 1:
        raise DesignError(f"{samples} samples: a lifted system needs at least one")
    if isinstance(plant, DiscretePlant):
        check_stable(plant, "the plant")
        return ToeplitzOperator(plant.impulse_response(samples))
    markov = np.zeros(samples)
    given = np.asarray(plant, np.float64)[:samples]
    markov[: len(given)] = given
    return ToeplitzOperator(markov)


def time_varying(
    plants: Sequence[DiscretePlant], starts: Sequence[int], samples: int
) -> TimeVaryingOperator:
    """Lift a plant that changes at known samples.

    Parameters
    ----------
    plants : sequence of DiscretePlant
        All of one order and in the same coordinates, since the state is passed on unchanged.
    starts : sequence of int
        First sample of each plant: 0, then rising.
    samples : int
        M + 1.

    Raises
    ------
    DesignError
        If a plant is unstable, orders differ, or `starts` does not rise from 0.
    """
    orders = sorted({plant.order for plant in plants})
    if len(orders) != 1:
        raise DesignError(
            f"time-varying plant of orders {orders}: the state is handed over from plant to plant, "
            "so all must have the same order and coordinates"
        )
    begins = np.append(np.asarray(starts, np.int64), samples)
    if len(begins) != len(plants) + 1 or begins[0] != 0 or np.any(np.diff(begins) <= 0):
        raise DesignError(
            f"{len(plants)} plants start at {list(starts)} of {samples} samples: give one start "
            "per plant, the first 0, rising, and all below the number of samples"
        )
    for i, plant in enumerate(plants):
        check_stable(plant, f"plant {i} of the time-varying system")
    return TimeVaryingOperator(
        np.stack([p.a for p in plants]),
        np.stack([p.b for p in plants]),
        np.stack([p.c for p in plants]),
        np.array([p.d for p in plants]),
        np.repeat(np.arange(len(plants)), np.diff(begins)),
    )


def free_response(plant: DiscretePlant, samples: int) -> Array:
    """Return O, shape (samples, order): O x0 is the zero-input response (paper 003, 2.14)."""
    out = np.empty((samples, plant.order))
    row = plant.c.copy()
    for k in range(samples):
        out[k] = row
        row = row @ plant.a
    return out


def integrated(markov: ArrayLike) -> Array:
    """Return the Markov parameters, (m,) or (l, m), with two integrators in front of the plant.

    The input is then the second difference of the command: the plant of limited preview.
    """
    return np.cumsum(np.cumsum(np.asarray(markov, np.float64), axis=-1), axis=-1)


def lifted_set(markov: ArrayLike, weights: ArrayLike) -> LiftedSet:
    """Make the set of time-invariant plants from their Markov parameters.

    A obeys A[i, k] = A[i+1, k+1] + K[M-i, M-k] with K = sum_j l_j h_j h_j': one small matrix
    product and running sums along the diagonals instead of l products of (M+1)^3.

    Parameters
    ----------
    markov : array_like, shape (l, m)
        One row per plant.
    weights : array_like, shape (l,)
        lambda_j of paper 003, 4.2: not negative, sum 1.

    Raises
    ------
    DesignError
        If the set is empty, or weights are negative or do not sum to 1.
    """
    h = np.asarray(markov, np.float64)
    shares = checked_weights(weights, len(h))
    if h.ndim != 2 or h.shape[1] == 0:
        raise DesignError(f"Markov parameters of shape {h.shape}: give one row per plant, (l, m)")
    scaled = np.sqrt(shares)[:, None] * h
    sums = scaled.T @ scaled
    for row in range(1, len(sums)):
        sums[row, 1:] += sums[row - 1, :-1]
    gram = np.ascontiguousarray(sums[::-1, ::-1])
    return LiftedSet(gram, ToeplitzOperator(shares @ h).dense(), h.shape[1])


def lifted_set_of(
    members: Sequence[LiftedOperator], weights: ArrayLike, inputs: int = 1
) -> LiftedSet:
    """Make the set of any lifted systems (time-varying, several axes) by dense products.

    Parameters
    ----------
    members : sequence of LiftedOperator
        All of the same shape.
    weights : array_like, shape (l,)
    inputs : int
        Number of inputs stacked in the columns.

    Raises
    ------
    DesignError
        As `lifted_set`, and if the shapes differ.
    """
    shares = checked_weights(weights, len(members))
    shapes = sorted({member.shape for member in members})
    if len(shapes) != 1 or shapes[0][1] % inputs:
        raise DesignError(
            f"members of shapes {shapes} with {inputs} inputs: all must have one shape, with the "
            "same number of samples for every input"
        )
    rows, cols = shapes[0]
    gram, mean = np.zeros((cols, cols)), np.zeros((rows, cols))
    for share, member in zip(shares, members, strict=True):
        g = member.dense()
        gram += share * (g.T @ g)
        mean += share * g
    return LiftedSet(gram, mean, cols // inputs)


def checked_weights(weights: ArrayLike, members: int) -> Array:
    """Return the weights of a set, shape (members,); raise DesignError for invalid ones."""
    shares = np.asarray(weights, np.float64)
    if members == 0:
        raise DesignError("the set of plants is empty: give at least one")
    if shares.shape != (members,):
        raise DesignError(f"weights of shape {shares.shape} for {members} plants: one for each")
    if not np.all(shares >= 0):
        raise DesignError(
            f"weight {shares.min():g} of a plant set must not be negative; leave out plants that "
            "should not count"
        )
    if abs(shares.sum() - 1) > _WEIGHT_SUM:
        raise DesignError(
            f"weights of a plant set sum to {shares.sum():.10g}, must be 1: divide by that"
        )
    return shares


def check_stable(plant: DiscretePlant, what: str) -> None:
    """Refuse a plant whose commands would not be bounded."""
    radius = float(np.abs(plant.poles()).max(initial=0.0))
    if radius >= 1:
        raise DesignError(
            f"{what} is unstable: largest pole |z| = {radius:.6g}, must be below 1. Filtered basis "
            "functions are feedforward; stabilise by feedback first and design on the closed loop"
        )
