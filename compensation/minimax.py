"""Find weights of a plant set with which least squares minimises the worst member's error.

For a command u = C y_d the expected squared error of member j is e_j^2 = sum_w S |1 - G_j C|^2, S
the spectrum of the path. The least weighted sum over all C,

    D(l) = sum_w S (1 - |sum_j l_j G_j|^2 / sum_j l_j |G_j|^2),

is concave in the weights l, and its maximum over the simplex is the smallest worst case: there the
members with weight all have the same error (docs/method.md). Ensemble least squares with these
weights is then the minimax design.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from stillpath.compensation.base import DesignError
from stillpath.models.arrays import Array
from stillpath.models.plants import PlantSet

__all__ = ["guarded_weights", "member_errors", "path_spectrum", "worst_case_weights"]

_LOWEST_HZ, _HIGHEST_HZ = 2.0, 150.0
_POINTS = 600
_NEGLIGIBLE = 1e-4


def path_spectrum(f_hz: ArrayLike) -> Array:
    """Return the power spectrum of a path with corners, up to a factor: f^-4, as speed steps."""
    return np.asarray(f_hz, float) ** -4.0


def member_errors(responses: ArrayLike, spectrum: ArrayLike, weights: ArrayLike) -> Array:
    """Return the mean squared error of every member under the least squares for `weights`.

    Parameters
    ----------
    responses : array_like of complex, shape (members, frequencies)
    spectrum : array_like, shape (frequencies,)
    weights : array_like, shape (members,)

    Returns
    -------
    ndarray, shape (members,)
        e_j^2, as a share of the path's power.
    """
    g, s, share = np.asarray(responses), np.asarray(spectrum, float), np.asarray(weights, float)
    command = np.conj(share @ g) / (share @ np.abs(g) ** 2)
    return np.asarray(np.abs(1.0 - g * command) ** 2 @ s / s.sum())


def worst_case_weights(responses: ArrayLike, spectrum: ArrayLike) -> Array:
    """Return the weights on the simplex for which least squares has the smallest worst error.

    Parameters
    ----------
    responses : array_like of complex, shape (members, frequencies)
    spectrum : array_like, shape (frequencies,)

    Raises
    ------
    DesignError
        If there is no member.
    """
    g = np.atleast_2d(np.asarray(responses))
    members = g.shape[0]
    if g.size == 0:
        raise DesignError("the plant set is empty; give at least one plant")
    if members == 1:
        return np.ones(1)
    scale = float(np.max(member_errors(g, spectrum, np.full(members, 1.0 / members))))
    if scale == 0.0:
        return np.full(members, 1.0 / members)

    def loss(share: Array) -> tuple[float, Array]:
        # The gradient of the dual is the members' errors themselves (Danskin).
        errors = member_errors(g, spectrum, share) / scale
        return -float(share @ errors), -errors

    from scipy.optimize import minimize  # slow to import, seldom needed

    result = minimize(  # type: ignore[call-overload]
        loss,
        np.full(members, 1.0 / members),
        jac=True,
        method="SLSQP",
        bounds=[(0.0, 1.0)] * members,
        constraints={"type": "eq", "fun": lambda share: share.sum() - 1.0, "jac": np.ones_like},
        options={"maxiter": 300, "ftol": 1e-10},
    )
    share = np.where(result.x > _NEGLIGIBLE, result.x, 0.0)
    return np.asarray(share / share.sum())


@lru_cache(maxsize=32)
def guarded_weights(plants: PlantSet) -> Array:
    """Return the mean of the set's own weights and the worst-case weights for a path with corners.

    The worst-case weights alone ignore most members.
    """
    f_hz = np.linspace(_LOWEST_HZ, min(_HIGHEST_HZ, 0.45 / plants.dt_s), _POINTS)
    responses = np.array([p.frequency_response(f_hz) for p in plants.members])
    weights = 0.5 * (plants.weights + worst_case_weights(responses, path_spectrum(f_hz)))
    weights.flags.writeable = False
    return weights
