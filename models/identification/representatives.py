"""Choose up to sixteen plants that represent many: those that differ most in effect on a path."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from stillpath.models.arrays import Array
from stillpath.models.identification.types import ModeEstimate
from stillpath.models.plants import PlantSpec, RelativeModesSpec, frequency_response

__all__ = ["Population", "mode_spread", "representatives"]

P = TypeVar("P", bound=PlantSpec)

_MEMBERS = 16
_F_HZ: Array = np.linspace(1.0, 150.0, 300)
_PATH = _F_HZ**-2.0
"""Amplitude of a path with corners: its speed steps."""
_OUTLIERS = 0.9
"""Share of the crowd, from the middle outwards, among which members are chosen."""
_APART = 0.5
"""Smallest |G_i - G_j| at which members count as disagreeing."""
_DEVIATION = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""


@dataclass(frozen=True, slots=True)
class Population(Generic[P]):
    """Members that stand for a crowd of plants.

    Attributes
    ----------
    members : tuple of PlantSpec
        The one in the middle first.
    weights : tuple of float
        Share of the crowd that each stands for; they add up to 1.
    middle : int
        Index of the first member in `centres`.
    crowd : tuple of PlantSpec
    """

    members: tuple[P, ...]
    weights: tuple[float, ...]
    middle: int
    crowd: tuple[P, ...]

    def agree_below_hz(self) -> float:
        """Return the frequency up to which all members respond alike to a command."""
        answers = np.array([frequency_response(m, _F_HZ) for m in self.members])
        apart = np.max(np.abs(answers - answers[0]), axis=0) > _APART
        return float(_F_HZ[np.argmax(apart)]) if apart.any() else float(_F_HZ[-1])


def mode_spread(population: Population[RelativeModesSpec]) -> tuple[ModeEstimate, ...]:
    """Return the modes of the first member, with their scatter over the crowd.

    The counterpart of a mode is the nearest in frequency.
    """
    first, out = population.members[0], []
    for mode in first.modes:
        near = [
            min(other.modes, key=lambda m: abs(np.log(m.f_hz / mode.f_hz)))
            for other in population.crowd
        ]
        f, zeta = (np.array([getattr(m, name) for m in near]) for name in ("f_hz", "zeta"))
        out.append(
            ModeEstimate(
                f_hz=mode.f_hz,
                zeta=mode.zeta,
                f_sd_hz=_DEVIATION * float(np.median(np.abs(f - mode.f_hz))),
                zeta_sd=_DEVIATION * float(np.median(np.abs(zeta - mode.zeta))),
                peak=float(abs(frequency_response(first, mode.f_hz)[0])),
            )
        )
    return tuple(out)


def representatives(centres: Sequence[P], crowd: Sequence[P]) -> Population[P]:
    """Choose members: one in the middle, then repeatedly the one farthest from those chosen.

    The distance of plants is the rms difference of their responses to a path with corners.

    Parameters
    ----------
    centres : sequence of PlantSpec
        Candidates for the middle: the one nearest to all of the crowd is taken.
    crowd : sequence of PlantSpec
    """
    answers = np.array([_PATH * frequency_response(plant, _F_HZ) for plant in crowd])
    middles = np.array([_PATH * frequency_response(plant, _F_HZ) for plant in centres])
    to_all = np.array([np.linalg.norm(answers - one, axis=1) for one in middles])
    middle = int(np.argmin(to_all.sum(axis=1)))
    members, places = [centres[middle]], [middles[middle]]
    away = to_all[middle]
    usual = away <= np.quantile(away, _OUTLIERS)
    nearest = away.copy()
    while len(members) < min(_MEMBERS, len(crowd)):
        chosen = int(np.argmax(np.where(usual, nearest, -1.0)))
        if nearest[chosen] <= 0.0:
            break
        members.append(crowd[chosen])
        places.append(answers[chosen])
        nearest = np.minimum(nearest, np.linalg.norm(answers - answers[chosen], axis=1))
    belongs = np.argmin([np.linalg.norm(answers - place, axis=1) for place in places], axis=0)
    # One more each: a member that represents only itself must not vanish.
    stands_for = np.bincount(belongs, minlength=len(members)) + 1.0
    weights = stands_for / stands_for.sum()
    return Population(tuple(members), tuple(weights.tolist()), middle, tuple(crowd))
