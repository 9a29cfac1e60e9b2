"""Mix fbf with a shaper as far as the plants are known: what `robust=auto` decides.

The aim: no plant that explains the measurement prints worse than with the shaper that is tuned from
the same measurement. Both commands are simulated on the reference motion with all members of the
set, and the mixture that is best for the likely members is chosen. Being worse than the shaper on
any member has a price (`_PRICE`); it is not forbidden, since plants contradict each other. The
error ratio of the worst member is stored with the choice.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from stillpath.compensation.base import DesignError
from stillpath.compensation.cautious import Caution
from stillpath.compensation.defaults import DEFAULT_BASIS
from stillpath.compensation.fbf import PreviewFbf
from stillpath.compensation.shapers import ShaperCompensator
from stillpath.models.arrays import Array
from stillpath.models.machine import CommandLimits, Machine
from stillpath.models.plants import DiscretePlant, PlantSetSpec, plant_set
from stillpath.models.reference_motion import reference_motion_of
from stillpath.models.typed_in import stated_hz
from stillpath.pipeline.error_range import (
    phase_unseen,
    side_by_side,
)
from stillpath.pipeline.files import kept
from stillpath.pipeline.measuring.reference_shaper import BestShaper
from stillpath.pipeline.options import Options
from stillpath.simulation.measures import PathDistances
from stillpath.simulation.response import response

__all__ = [
    "Mixture",
    "Mixtures",
    "Shares",
    "best_shares",
    "caution_for",
    "choose_caution",
    "design_mode",
    "has_measured_set",
    "measured_set",
    "most_share",
    "set_or_nominal",
]

T = TypeVar("T")
Pair: TypeAlias = tuple[DiscretePlant, DiscretePlant]
Shares: TypeAlias = tuple[float, float]
"""Share of a command in its mixture with the shaper's, for X and Y."""

_VERSION = 17
_SHARES = (1.0, 0.85, 0.7, 0.55, 0.4, 0.2, 0.0)
_UNSEEN_SHARE = 0.85
"""Largest share where the phase was not measured: a set cannot warn of what it does not contain."""
_PRICE = 0.5
"""Weight, in the ranking, of the worst member's error in excess of the shaper's. Members contradict
each other: fully protecting the least likely one would mean not compensating the others."""
_COARSE_UM, _LEAST_FIT = 4.0, 0.5
"""Contour error from which segments may use their full tolerance, and the least share of it below:
on a well-known machine the segments would otherwise be the larger error."""
_STRIDE = 5
_NO_RESTS = np.zeros((0, 2), np.int64)


@dataclass(frozen=True, slots=True)
class Mixture:
    """A mixture for a machine, and its errors over the set on the reference motion.

    Attributes
    ----------
    shares : (float, float)
        Share of filtered basis functions in the command of X and Y.
    worst, mean : float
        Largest and weighted geometric mean, over the members, of the ratio of the contour error to
        the shaper's.
    worst_to_none : float
        Largest ratio to the contour error without compensation.
    rms_um : float
        Contour error, weighted geometric mean over the members.
    """

    shares: Shares
    worst: float
    mean: float
    worst_to_none: float
    rms_um: float

    @property
    def fit_share(self) -> float:
        """Share of the tolerance that a fit to the command may use.

        A shaper's command has more edges: fitted to 2 µm it leaves up to 1.2 times its error.
        """
        if not any(self.shares):
            return _LEAST_FIT
        return float(np.clip(self.rms_um / _COARSE_UM, _LEAST_FIT, 1.0))


def measured_set(axis: PlantSetSpec) -> bool:
    """Return whether an axis has a set of several plants from a measurement."""
    members = isinstance(axis.members, tuple) and len(axis.members) > 1
    return members and stated_hz(axis) is None


def has_measured_set(machine: Machine) -> bool:
    """Return whether an axis of a machine has a set of several plants from a measurement."""
    return any(map(measured_set, machine.axes.values()))


def design_mode(machine: Machine, *, budget: bool = False) -> str:
    """Return the robust mode of `compensation.fbf.PreviewFbf` that `robust=auto` tries first.

    A speed budget limits the error of the worst plant, so with one that plant counts more.
    """
    if not has_measured_set(machine):
        return "off"
    return "minimax" if budget else "ensemble"


def set_or_nominal(mode: str, design: Callable[[str], T]) -> T:
    """Return the design of a robust mode, or that of the nominal plants where it is refused.

    A set is refused if some of its plants ring for longer than any window.
    """
    try:
        return design(mode)
    except DesignError:
        if mode == "off":
            raise
        return design("off")


def caution_for(
    machine: Machine, options: Options, shaper: BestShaper, directory: Path, dt_s: float
) -> tuple[Caution, Mixture] | None:
    """Return the mixture for `robust=auto` and the reason; None where no shaper is mixed in."""
    if options.vibration != "fbf" or options.robust != "auto":
        return None
    measured = has_measured_set(machine)
    # A schedule of the resonance means that more is known than its typed-in frequency.
    stated = not machine.schedules and any(map(stated_hz, machine.axes.values()))
    if not measured and not stated:
        return None
    mode = design_mode(machine, budget=options.budget_um is not None)
    return choose_caution(machine, shaper, directory, dt_s, options.basis, mode)


def choose_caution(
    machine: Machine,
    shaper: BestShaper,
    directory: Path,
    dt_s: float,
    basis: str = DEFAULT_BASIS,
    mode: str = "ensemble",
) -> tuple[Caution, Mixture]:
    """Choose the mixture of compensation and shaper for a machine, once per machine revision.

    Parameters
    ----------
    shaper : BestShaper
        Tuned for the nominal plants.
    directory : Path
        Folder in which choices are kept.
    dt_s : float
        Sampling time of the commands.
    basis : str
        A key of `compensation.basis.BASES`.
    mode : str
        Robust mode of `compensation.fbf.PreviewFbf`.
    """
    path = directory / f"caution-{machine.revision}-{basis}-{mode}-v{_VERSION}.json"
    choice = kept(path, _read, lambda: _chosen_by_trial(machine, shaper, dt_s, basis, mode))
    return (
        Caution(choice.shares, shaper.type, shaper.fx_hz, shaper.fy_hz, choice.fit_share),
        choice,
    )


def _read(document: dict[str, Any]) -> Mixture:
    return Mixture(**{**document, "shares": tuple(document["shares"])})


class Mixtures:
    """Contour errors of mixtures on one motion, for every pair of members of X and Y.

    Parameters
    ----------
    path_mm, smooth_mm : ndarray, shape (2, n)
        The motion, and the shaper's command for it.
    extruding : ndarray of bool, shape (n,)

    Attributes
    ----------
    shaped_mm : ndarray, shape (pairs,)
        Errors with the shaper.
    """

    def __init__(
        self,
        machine: Machine,
        path_mm: Array,
        extruding: NDArray[np.bool_],
        smooth_mm: Array,
        dt_s: float,
    ) -> None:
        self._at = np.flatnonzero(extruding).astype(np.int64)[::_STRIDE]
        self._distances = PathDistances(path_mm, dt_s)
        # A delay between the axes adds the same error to all commands: it cannot rank them.
        axes = [machine.axes[axis].without_delay() for axis in ("x", "y")]
        self._pairs = side_by_side(*(plant_set(axis, dt_s).members for axis in axes))
        self._weights = _pair_weights(machine, len(self._pairs))
        self._smooth = self.responses(smooth_mm)
        self.shaped_mm = np.maximum(self.errors_mm(self._smooth), 1e-12)

    def responses(self, command_mm: Array) -> list[Array]:
        """Return the motion of every pair at the measured points, shape (2, points) each."""
        return [response(pair, command_mm)[:, self._at] for pair in self._pairs]

    def errors_mm(self, responses: Sequence[Array], shares: Shares = (1.0, 1.0)) -> Array:
        """Return the rms contour errors [mm] with a command, or a mixture of it, shape (pairs,).

        Parameters
        ----------
        responses : sequence of ndarray
            To the command.
        shares : (float, float)
            Of the command on X and on Y; the rest is the shaper's.
        """
        a = np.array(shares)[:, None]
        both = zip(responses, self._smooth, strict=True)
        return np.array([self._rms(a * exact + (1.0 - a) * smooth) for exact, smooth in both])

    def mean(self, values: Array) -> float:
        """Return the weighted geometric mean over the pairs."""
        return float(np.exp(self._weights @ np.log(values)))

    def rms_mm(self, motion_mm: Array) -> float:
        """Return the rms contour error of a motion (2, n)."""
        return self._rms(motion_mm[:, self._at])

    def _rms(self, points: Array) -> float:
        return float(np.sqrt(np.mean(self._distances.at(points, self._at) ** 2)))


def best_shares(cost: Callable[[Shares], float], most: Sequence[float]) -> Shares:
    """Return the shares, up to `most`, of least cost: of both axes, then of each alone."""
    best = min(((min(share, most[0]), min(share, most[1])) for share in _SHARES), key=cost)
    for axis in (0, 1):
        alone = [share for share in _SHARES if share <= most[axis]]
        others = [(share, best[1]) if axis == 0 else (best[0], share) for share in alone]
        best = min([best, *others], key=cost)
    return best


def _chosen_by_trial(
    machine: Machine, shaper: BestShaper, dt_s: float, basis: str, mode: str
) -> Mixture:
    path, extruding = reference_motion_of(machine, dt_s)
    most_shares = [most_share(machine.axes[axis]) for axis in ("x", "y")]
    exact, smooth = _commands(machine, shaper, basis, dt_s, mode if any(most_shares) else None)
    mixtures = Mixtures(machine, path, extruding, smooth, dt_s)
    exact_mm = mixtures.responses(exact)
    none_mm = np.maximum(mixtures.errors_mm(mixtures.responses(path)), 1e-12)

    @cache
    def choice(shares: Shares) -> Mixture:
        ours_mm = np.maximum(mixtures.errors_mm(exact_mm, shares), 1e-12)
        ratio = ours_mm / mixtures.shaped_mm
        return Mixture(
            shares,
            float(ratio.max()),
            mixtures.mean(ratio),
            float(np.max(ours_mm / none_mm)),
            1e3 * mixtures.mean(ours_mm),
        )

    return choice(best_shares(lambda shares: _rank(choice(shares)), most_shares))


def _commands(
    machine: Machine, shaper: BestShaper, basis: str, dt_s: float, mode: str | None
) -> tuple[Array, Array]:
    """Return the commands of filtered basis functions and of the shaper on the reference motion.

    Without a robust mode, both are the shaper's.
    """
    path, extruding = reference_motion_of(machine, dt_s)
    smooth = ShaperCompensator(
        machine, dt_s, shaper=shaper.type, fx_hz=shaper.fx_hz, fy_hz=shaper.fy_hz
    ).compensate(path, extruding, _NO_RESTS)
    if mode is None:
        return smooth, smooth
    exact = set_or_nominal(
        mode, lambda tried: PreviewFbf(_strong(machine), dt_s, basis=basis, robust=tried)
    )
    exact.reset(path[:, 0])
    return exact.compensate(path, extruding, _NO_RESTS), smooth


def _strong(machine: Machine) -> Machine:
    """Return the machine with at least the default limits of the command.

    The choice depends on how well the plants are known; the motors' limits are checked for every
    piece of a print (`compensation.cautious`).
    """
    default, own = CommandLimits(), machine.command
    command = default.model_copy(
        update={
            "velocity_mm_s": max(default.velocity_mm_s, own.velocity_mm_s),
            "accel_mm_s2": max(default.accel_mm_s2, own.accel_mm_s2),
            "motors": None,
        }
    )
    return machine.model_copy(update={"command": command})


def _rank(choice: Mixture) -> float:
    """Return the cost of a choice: the mean over likely members plus the worst one's excess."""
    return choice.mean + _PRICE * max(0.0, choice.worst - 1.0)


def most_share(axis: PlantSetSpec) -> float:
    """Return the largest share of compensation in the mixture for an axis; the rest is shaper."""
    if stated_hz(axis) is not None:
        return 0.0
    return _UNSEEN_SHARE if phase_unseen(axis) else 1.0


def _pair_weights(machine: Machine, count: int) -> Array:
    """Return the weight of each pair: the geometric mean of its members' weights, normalised.

    Members are paired by their place in the sets, so this is no joint probability: with the root,
    an unlikely member of one axis does not suppress its partner.
    """
    x, y = (
        np.array([m.weight for m in machine.axes[axis].weighted_members()]) for axis in ("x", "y")
    )
    both = np.array([x[j % len(x)] * y[j % len(y)] for j in range(count)])
    return np.asarray(np.sqrt(both) / np.sqrt(both).sum())
