"""Choose and control the speed of every class of moves within a budget of contour error.

The paces of classes of moves (features, travel) are chosen on excerpts from all over the file
(`pace_search`), compensated and planned as they will be, and judged by the worst plant of the
machine's set. While the file is written its errors are measured in the same way, and paces are
corrected up and down. A file that still exceeds its budget is written again with lower paces, and
finally with its own.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from stillpath.compensation.cautious import Caution
from stillpath.gcode.pacing import (
    AS_SLICED,
    TRAVEL,
    FirstLayer,
    move_classes,
    paced,
    top_limits,
)
from stillpath.gcode.pieces import Piece
from stillpath.gcode.slicers.features import feature_name, feature_title
from stillpath.gcode.types import Moves
from stillpath.models.machine import CommandLimits, Machine
from stillpath.pipeline.measuring.reference_shaper import BestShaper
from stillpath.pipeline.measuring.set_errors import WHOLE, ErrorSum, whole
from stillpath.pipeline.options import LEAST_BUDGET_UM, Options
from stillpath.pipeline.pacing.excerpts import Excerpt, FileExcerpts
from stillpath.pipeline.pacing.pace_search import PaceChoice, allowed_um, search
from stillpath.pipeline.pacing.pace_trials import Factors, PaceTrials, compensated, paces, shaped
from stillpath.pipeline.result import BudgetClass, BudgetFigures

__all__ = ["SpeedBudget"]

_SLOWEST = 0.05
"""Lowest pace with the shaper, which may have to be slower than the file."""
_ABOVE, _FULL, _ROOM = 1.001, 0.97, 0.9
"""Ratios of error to bound: too large above the first, slow down above the second, speed up below
the last."""
_HELPLESS = 0.99
"""Above this, other classes slow down for one that is already at its own pace."""
_SLOWER, _FASTER = 0.9, 1.08
_FURTHEST = 2.0
"""Highest pace while writing, relative to the one chosen on excerpts."""
_GENTLER = (1.0, 0.6, 0.3)
"""Exponents applied in turn to a piece's factors where no command can follow it."""
_SURE_S = 5.0
"""Extruding time after which the error of a class is meaningful."""
_ATTEMPTS = 4
"""Largest number of times a file is written; the last time at its own paces."""
_MILDER, _POWER = 0.9, 0.5
"""The next attempt aims at this share of the bound, assuming error ~ acceleration^_POWER."""


@dataclass(slots=True)
class SpeedBudget:
    """The paces of a file, chosen on excerpts and corrected as it is written.

    Attributes
    ----------
    paces : PaceChoice
        Paces at the beginning of the written file.
    shaper_paces : PaceChoice
        With the best firmware shaper instead of the compensation, at the same budget.
    tops : dict
        Highest factor of every class.
    attempt : int
        Number of times the file was written before.
    factors : dict
        Factor of every class for the pieces that follow.
    """

    machine: Machine
    budget_um: float
    first_layer: FirstLayer
    paces: PaceChoice
    shaper_paces: PaceChoice
    tops: Factors
    attempt: int = 0
    factors: Factors = field(init=False)
    _since: dict[int, ErrorSum] = field(init=False, default_factory=dict)
    """Sums of errors when the pace of a class last changed."""
    _used_logs: dict[int, float] = field(init=False, default_factory=dict)
    """Integral of the logarithm of each class's factor over the time that was written with it."""
    _counted_s: dict[int, float] = field(init=False, default_factory=dict)
    _shaper_s: float = field(init=False, default=0.0)
    """Time that the moves so far would take with the shaper."""
    _gentler_s: float = field(init=False, default=0.0)
    """Duration, as sliced, of the pieces that no command could follow at their pace."""

    def __post_init__(self) -> None:
        self.factors = dict(self.paces.factors)

    @classmethod
    def chosen(
        cls,
        found: FileExcerpts,
        machine: Machine,
        options: Options,
        shaper: BestShaper,
        caution: Caution | None = None,
    ) -> SpeedBudget:
        """Choose the paces of a file.

        Parameters
        ----------
        caution : Caution, optional
            Mixture of command and shaper.

        Raises
        ------
        DesignError, ModelError
            The method cannot be designed for this machine.
        """
        assert options.budget_um is not None
        tops = _tops(found.excerpts, machine)
        ours = PaceTrials(found.excerpts, machine, compensated(machine, options, shaper, caution))
        theirs = PaceTrials(found.excerpts, machine, shaped(shaper))
        return cls(
            machine,
            options.budget_um,
            found.first_layer,
            search(ours, 1.0, tops, options.budget_um),
            search(theirs, _SLOWEST, tops, options.budget_um),
            tops,
        )

    def classes(self, moves: Moves) -> NDArray[np.int32]:
        """Return the class of every move; `AS_SLICED` for unchanged ones."""
        return move_classes(moves, self.first_layer)

    def paced(self, piece: Piece) -> Iterator[Piece]:
        """Yield a piece at its new pace, then at lower ones, and finally as sliced.

        Its time with the shaper is counted.
        """
        classes = self.classes(piece.moves)
        if self.shaper_paces.reached:
            with_shaper = paced(piece, classes, paces(self.shaper_paces.factors), self.machine)
            self._shaper_s += with_shaper.phases.duration_s
        for share in _GENTLER:
            factors = {one: factor**share for one, factor in self.factors.items()}
            faster = paced(piece, classes, paces(factors), self.machine)
            if faster is piece:
                break
            yield faster
            self._gentler_s += piece.phases.duration_s if share == 1.0 else 0.0
        yield piece

    def passed(self, seconds: float) -> None:
        """Count the time of what stays as sliced."""
        self._shaper_s += seconds

    def correct(self, sums: Mapping[int, ErrorSum]) -> None:
        """Correct paces by the errors so far: down near the bound, up where there is room."""
        for one, factor in self.factors.items():
            if one in sums:
                seconds = sums[one].seconds
                new_s = seconds - self._counted_s.get(one, 0.0)
                self._used_logs[one] = self._used_logs.get(one, 0.0) + new_s * math.log(factor)
                self._counted_s[one] = seconds
        used = {one: self._used(one, sums[one]) for one in self.factors if one in sums}
        everything = whole(sums)
        if everything is not None:
            used[WHOLE] = self._used(WHOLE, everything)
            self._hold_whole(everything)
        has_room = max(used.values(), default=0.0) < _FULL
        for one, factor in sorted(self.factors.items()):
            if one not in used:
                continue
            new = sums[one] - self._since[one] if one in self._since else sums[one]
            if new.seconds < _SURE_S:
                continue
            recent, target = self._used(one, new), factor
            if min(used[one] / _FULL, recent / _ROOM) > 1.0:
                target = max(1.0, _SLOWER * factor)
                at_own_pace = factor == 1.0 and min(used[one], recent) > _HELPLESS
                if at_own_pace and self._keeps_budget(one):
                    self._slow_others()
                    self._since[one] = sums[one]
            elif has_room and self._keeps_budget(one) and max(used[one], recent) < _ROOM:
                highest = min(self.tops[one], _FURTHEST * self.paces.factors[one])
                target = max(factor, min(_FASTER * factor, highest))
            if target != factor:
                self.factors[one], self._since[one] = target, sums[one]

    def _hold_whole(self, found: ErrorSum) -> None:
        """Slow down if all that is extruded uses up the budget, now and since the last time."""
        new = found - self._since[WHOLE] if WHOLE in self._since else found
        recent = self._used(WHOLE, new)
        if new.seconds >= _SURE_S and min(self._used(WHOLE, found), recent) > _HELPLESS:
            self._slow_others()
            self._since[WHOLE] = found

    def _slow_others(self) -> None:
        """Slow down what disturbs a class at its own pace: travel first, then all others."""
        travel_first = self.factors.get(TRAVEL, 1.0) > 1.0
        for one in [TRAVEL] if travel_first else [*self.factors]:
            self.factors[one] = max(1.0, _SLOWER * self.factors[one])

    def gentler(self, sums: Mapping[int, ErrorSum]) -> SpeedBudget | None:
        """Return the lower budget for another attempt; None if the written file may stay."""
        kept = [one for one in self.factors if one in sums and self._keeps_budget(one)]
        over = {one: self._used(one, sums[one]) for one in kept}
        over = {one: ratio for one, ratio in over.items() if ratio > _ABOVE}
        quicker = any(factor > 1.0 for factor in self.paces.factors.values())
        if not over or not quicker or self.attempt + 1 == _ATTEMPTS:
            return None
        factors = {
            one: min(factor, self.paces.factors[one]) for one, factor in self.factors.items()
        }
        if self.attempt + 2 == _ATTEMPTS:
            factors = dict.fromkeys(factors, 1.0)
        elif self.attempt > 0:
            factors = {one: factor**0.5 for one, factor in factors.items()}
        for one, ratio in over.items():
            factors[one] = max(1.0, factors[one] * (_MILDER / ratio) ** (1.0 / _POWER))
        if any(factors[one] == 1.0 for one in over) and TRAVEL in factors:
            factors[TRAVEL] = max(1.0, _MILDER * factors[TRAVEL] / max(over.values()))
        return SpeedBudget(
            self.machine,
            self.budget_um,
            self.first_layer,
            replace(self.paces, factors=factors),
            self.shaper_paces,
            factors,
            self.attempt + 1,
        )

    def again(self) -> SpeedBudget:
        """Return this budget as it was before anything was written."""
        return replace(self)

    def _keeps_budget(self, one: int) -> bool:
        """Return whether a class kept the budget at its own pace in the excerpts."""
        return self.paces.bounds_um[one] <= allowed_um(one, self.budget_um)

    def _mean_factor(self, one: int) -> float:
        """Return the geometric mean of a class's factor over the written file."""
        seconds = self._counted_s.get(one, 0.0)
        return math.exp(self._used_logs[one] / seconds) if seconds else 1.0

    def _used(self, one: int, found: ErrorSum) -> float:
        """Return the ratio of a class's error to its bound."""
        bound_um = self.paces.bounds_um.get(one, allowed_um(one, self.budget_um))
        return found.worst.rms_um / bound_um

    def figures(
        self,
        sums: Mapping[int, ErrorSum],
        names: Sequence[str],
        original_s: float,
        time_s: float,
    ) -> BudgetFigures:
        """Return the figures of the report."""
        classes = []
        for one, found in sorted(sums.items()):
            name = _name(one, names)
            classes.append(
                BudgetClass(
                    name=name,
                    title=feature_title(name),
                    acceleration_factor=round(self._mean_factor(one), 4),
                    shaper_acceleration_factor=round(self.shaper_paces.factors.get(one, 1.0), 4),
                    contour_rms_um=found.worst.rms_um,
                    seconds=round(found.seconds, 3),
                )
            )
        shaper_s = self._shaper_s if self.shaper_paces.reached else None
        return BudgetFigures(
            budget_um=self.budget_um,
            saved_share=1.0 - time_s / original_s if original_s else 0.0,
            shaper_time_s=shaper_s,
            saved_share_against_shaper=1.0 - time_s / shaper_s if shaper_s else None,
            classes=classes,
        )

    def warnings(self, sums: Mapping[int, ErrorSum], names: Sequence[str]) -> list[str]:
        """Return warnings about classes that exceed the budget, and about assumed limits."""
        warnings = self._assumed()
        for one, found in sorted(sums.items()):
            error = found.worst
            if error.rms_um <= _ABOVE * allowed_um(one, self.budget_um):
                continue
            remedy = (
                "nothing of it is quicker than in the file: its own accelerations are too high for "
                "the budget"
            )
            if self._mean_factor(one) > 1.001:
                remedy = "give a smaller budget"
                if self.budget_um <= LEAST_BUDGET_UM:
                    remedy = "no smaller one can be given: without a budget it keeps its speed"
            warnings.append(
                f"The contour error of {_name(one, names)} is {error.rms_um:.2f} µm (rms, worst "
                f"plant of the set), above the budget of {self.budget_um:g} µm; {remedy}."
            )
        if self._gentler_s > 0.0:
            warnings.append(
                f"Pieces of {self._gentler_s:.0f} s as sliced are slower than the budget allows: "
                "no command within the machine's limits (command in its document) could follow "
                "them."
            )
        return warnings

    def _assumed(self) -> list[str]:
        """Return a warning if anything is quicker because of limits that nobody stated."""
        accel_mm_s2 = self.machine.command.accel_mm_s2
        quicker = any(self._mean_factor(one) > _ABOVE for one in self.factors)
        if not quicker or accel_mm_s2 != CommandLimits().accel_mm_s2:
            return []
        warning = (
            f"Moves are quicker than in the file, up to {top_limits(self.machine).accel_mm_s2:.0f} "
            f"mm/s2, because the motors are assumed to bear {accel_mm_s2:.0f} mm/s2 (the default "
            "of command.accel_mm_s2): measure what they bear (motor-test), or put it there, before "
            "you print this file."
        )
        return [warning]


def _tops(excerpts: list[Excerpt], machine: Machine) -> Factors:
    """Return the highest pace of every class, at which its slowest moves reach the limits."""
    most = top_limits(machine)
    tops: Factors = {}
    for excerpt in excerpts:
        phases = excerpt.piece.phases
        for one in np.unique(excerpt.classes[excerpt.classes != AS_SLICED]).tolist():
            rows = excerpt.classes == one
            ratio = most.accel_mm_s2 / float(np.min(phases.accel_mm_s2[rows]))
            tops[one] = max(tops.get(one, 1.0), ratio)
    return tops


def _name(one: int, names: Sequence[str]) -> str:
    if one == TRAVEL:
        return "travel"
    if one == AS_SLICED:
        return "all that stays as sliced"
    return feature_name(one, names)
