"""A plant, or a weighted set of plants, over one preview window.

The members of a set respond almost alike. Their responses to command increments, as rows sqrt(l_j)
h_j of one matrix, are therefore expressed in its leading right singular vectors: a few *components*
whose squared errors sum to those of all members, for any weights of the samples. A set of ten costs
about as much as five plants, and one plant is its own component.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag, toeplitz

from stillpath.compensation.base import DesignError
from stillpath.compensation.lifted import (
    LiftedSet,
    check_stable,
    checked_weights,
    free_response,
    integrated,
    lifted_set,
)
from stillpath.models.arrays import Array
from stillpath.models.plants import DiscretePlant

__all__ = ["Condensed", "LiftedWindow", "condensed", "lifted_window"]

_TOLERANCE = 1e-5
"""Components below this share of the largest are dropped: .1 um of a 10 mm move."""
_COARSE = 1e-3
"""The same for windows with rests, where every component is costly. Often only the mean response
remains; `benchmarks/twins.py` gives the same errors as with 1e-5."""
_HANKEL = 1e-5
"""There, states with a smaller Hankel singular value relative to the largest are dropped."""


@dataclass(frozen=True, slots=True, eq=False)
class LiftedWindow:
    """Plants lifted over a window, with the increments v of the command as input.

    With z = [x_1 .. x_l, u1, u2] (states of all members, last two commands), component k of the
    error over the window is

        target[k] y_d - from_state[k] z - integrated[k] v

    Attributes
    ----------
    weights : ndarray, shape (l,)
    update : int
        Samples that are committed before the next window starts.
    integrated : ndarray, shape (components, window, window)
        Lower-triangular Toeplitz: increments to position.
    mix : ndarray, shape (components, l)
        Weight of each member's error in each component.
    target : ndarray, shape (components,)
        Its sum over the members: a component's target per unit of a path common to all.
    from_state : ndarray, shape (components, window, nz)
        Free response with the command continued in a straight line.
    advance : ndarray, shape (nz - 2, nz - 2)
        States after `update` samples without a command.
    reach : ndarray, shape (nz - 2, window)
        Maps the window's command samples to the states after it; the last m columns do so for m
        samples.
    """

    plants: tuple[DiscretePlant, ...]
    weights: Array
    update: int
    integrated: Array
    mix: Array
    target: Array
    from_state: Array
    advance: Array
    reach: Array

    @property
    def window(self) -> int:
        """Samples in the window."""
        return int(self.integrated.shape[1])

    @property
    def states(self) -> int:
        """Size nz of z."""
        return int(self.from_state.shape[2])

    @property
    def drive(self) -> Array:
        """Map from `update` command samples to the states after them, shape (nz - 2, update)."""
        return self.reach[:, self.window - self.update :]

    def lifted_set(self) -> LiftedSet:
        """Return the data of a basis: Gram matrix and mean of the integrated plants."""
        markov = np.array([integrated(p.impulse_response(self.window)) for p in self.plants])
        return lifted_set(markov, self.weights)

    def rest_state(self, position_mm: float) -> Array:
        """Return z of an axis that stands at `position_mm`."""
        parts = [p.rest_state(position_mm) for p in self.plants]
        return np.concatenate([*parts, np.full(2, position_mm)])


def lifted_window(
    plants: Sequence[DiscretePlant], weights: Sequence[float] | Array, window: int, update: int
) -> LiftedWindow:
    """Lift plants over a window (first-order-hold models, D != 0 allowed).

    Parameters
    ----------
    weights : sequence of float
        Weights of the members, positive, sum 1.
    window, update : int
        Samples in the window and samples committed.

    Raises
    ------
    DesignError
        For an empty set, weights that do not fit, an unstable member, plants that answer later than
        the window, or update > window.
    """
    share = checked_weights(weights, len(plants))
    if not 2 <= update <= window:
        raise DesignError(f"update of {update} samples: between 2 and the window's {window} needed")
    for j, plant in enumerate(plants):
        check_stable(plant, f"plant {j} of the set")
    markov = np.array([integrated(p.impulse_response(window)) for p in plants])
    mix, components = _components(markov, np.sqrt(share))

    zeros = np.zeros(window)
    step = np.arange(1.0, window + 1.0)
    straight = np.stack([step + 1.0, -step], axis=1)
    history = [toeplitz(np.diff(m, 2, prepend=[0.0, 0.0]), zeros) @ straight for m in markov]
    free = [free_response(p, window) for p in plants]
    return LiftedWindow(
        plants=tuple(plants),
        weights=share,
        update=update,
        integrated=np.array([toeplitz(c, zeros) for c in components]),
        mix=mix,
        target=mix.sum(axis=1),
        from_state=np.array(
            [
                np.concatenate(
                    [
                        *(m * f for m, f in zip(row, free, strict=True)),
                        sum(m * h for m, h in zip(row, history, strict=True)),
                    ],
                    axis=1,
                )
                for row in mix
            ]
        ),
        advance=block_diag(*(np.linalg.matrix_power(p.a, update) for p in plants)),
        reach=np.concatenate([_reach(p, window) for p in plants]),
    )


@dataclass(frozen=True, slots=True, eq=False)
class Condensed:
    """Reduced form of a lifted set for windows that are solved individually.

    Attributes
    ----------
    components : int
        Number of leading components kept.
    squeeze : ndarray, shape (k, nz - 2)
        Maps the members' states to a few in balanced coordinates.
    from_state : ndarray, shape (components, window, k + 2)
    reach : ndarray, shape (k, window)
        As in `LiftedWindow`, for the reduced states.
    """

    components: int
    squeeze: Array
    from_state: Array
    reach: Array


def condensed(lifted: LiftedWindow) -> Condensed:
    """Reduce a lifted set by dropping negligible components and states.

    Source: balanced truncation (B. C. Moore, IEEE Trans. Autom. Control 26, 1981), with the
    Gramians of the window instead of infinite ones.
    """
    size = np.linalg.norm(lifted.integrated[:, :, 0], axis=1)
    count = int(np.sum(size > _COARSE * size[0]))
    free, ends = np.split(lifted.from_state[:count], [-2], axis=2)
    if len(size) == 1:
        return Condensed(1, np.eye(free.shape[2]), lifted.from_state, lifted.reach)
    rows = free.reshape(-1, free.shape[2])
    spread, turn = np.linalg.eigh(lifted.reach @ lifted.reach.T)
    reachable = turn * np.sqrt(np.maximum(spread, 0.0))
    seen = rows @ reachable
    squares, turn = np.linalg.eigh(seen.T @ seen)
    hankel = np.sqrt(np.maximum(squares[::-1], 0.0))
    kept = hankel > _HANKEL * hankel[0]
    outputs = seen @ (turn[:, ::-1][:, kept] / hankel[kept])
    outputs *= np.sign(outputs[np.argmax(np.abs(outputs), axis=0), np.arange(outputs.shape[1])])
    squeeze = outputs.T @ rows
    return Condensed(
        count,
        squeeze,
        np.concatenate([outputs.reshape(*free.shape[:2], -1), ends], axis=2),
        squeeze @ lifted.reach,
    )


def _components(markov: Array, roots: Array) -> tuple[Array, Array]:
    """Return the mix of every component, and the components' own responses.

    Parameters
    ----------
    markov : ndarray, shape (plants, window)
    roots : ndarray, shape (plants,)
        Square roots of the weights.
    """
    u, s, vt = np.linalg.svd(roots[:, None] * markov, full_matrices=False)
    if s[0] == 0.0:
        raise DesignError(
            f"no plant answers within the preview of {markov.shape[1]} samples: leave a delay that "
            "both axes share out of the model, and measure an axis again that alone is so late"
        )
    count = int(np.sum(s > _TOLERANCE * s[0]))
    # The sign of singular vectors is arbitrary; fix it so that the same model gives the same bytes.
    sign = np.sign(vt[np.arange(len(s)), np.argmax(np.abs(vt), axis=1)])
    return (u * sign)[:, :count].T * roots, (s * sign)[:count, None] * vt[:count]


def _reach(plant: DiscretePlant, samples: int) -> Array:
    columns = np.empty((plant.order, samples))
    column = plant.b
    for k in range(samples - 1, -1, -1):
        columns[:, k] = column
        column = plant.a @ column
    return columns
