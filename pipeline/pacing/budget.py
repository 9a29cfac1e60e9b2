"""Speed of every class of moves within a budget of contour error.

The paces of classes of moves (features, travel) are chosen on samples from all over the file
(`pace_search`): as compensated as they will be, with the moves planned for the firmware, and judged
by the worst plant of the machine's set. While the file is written its errors are measured in the
same way, and paces follow them, up and down. A file that ends above its budget all the same is
written once more, with lower paces, and at last with its own.
"""

from __future__ import annotations

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
from stillpath.models.machine import Machine
from stillpath.pipeline.measuring.reference_shaper import BestShaper
from stillpath.pipeline.measuring.set_errors import ErrorSum
from stillpath.pipeline.options import Options
from stillpath.pipeline.pacing.pace_search import PaceChoice, allowed_um, search
from stillpath.pipeline.pacing.pace_trials import Factors, PaceTrials, compensated, paces, shaped
from stillpath.pipeline.pacing.samples import FileSamples, Sample
from stillpath.pipeline.result import BudgetClass, BudgetFigures

__all__ = ["SpeedBudget"]

_SLOWEST = 0.05
"""Least pace of the shaper, which may have to be slower than the file."""
_ABOVE, _FULL, _ROOM = 1.001, 0.97, 0.9
"""Error over its bound: too large above the first, lower the pace above the second, raise it below
the last."""
_HELPLESS = 0.99
"""Above this the others slow down for a class that is already at its own pace."""
_SLOWER, _FASTER = 0.9, 1.08
_FURTHEST = 2.0
"""Highest pace while writing, relative to the one chosen on samples."""
_GENTLER = (1.0, 0.6, 0.3)
"""Exponents applied in turn to a piece's factors where no command can follow it."""
_SURE_S = 5.0
"""Extruding time after which the error of a class is meaningful."""
_ATTEMPTS = 4
"""Most times that a file is written; the last time at its own paces."""
_MILDER, _POWER = 0.9, 0.5
"""The next attempt aims at this part of the bound, if error ~ acceleration^_POWER."""


@dataclass(slots=True)
class SpeedBudget:
    """The paces of a file, chosen on samples and corrected as it is written.

    Attributes
    ----------
    paces : PaceChoice
        Of the file that is written, at its beginning.
    shaper_paces : PaceChoice
        With the best firmware shaper instead of the compensation, at the same budget.
    tops : dict
        Highest factor of every class.
    attempt : int
        How often the file was written before.
    """

    machine: Machine
    budget_um: float
    first_layer: FirstLayer
    paces: PaceChoice
    shaper_paces: PaceChoice
    tops: Factors
    attempt: int = 0
    _factors: Factors = field(init=False)
    _since: dict[int, ErrorSum] = field(init=False, default_factory=dict)
    """Errors so far when a class last got another pace."""
    _shaper_s: float = field(init=False, default=0.0)
    """How long what was told so far takes with the shaper."""
    _gentler_s: float = field(init=False, default=0.0)
    """How long the pieces last, as sliced, that no command could follow at their pace."""

    def __post_init__(self) -> None:
        self._factors = dict(self.paces.factors)

    @classmethod
    def chosen(
        cls,
        found: FileSamples,
        machine: Machine,
        options: Options,
        shaper: BestShaper,
        caution: Caution | None = None,
    ) -> SpeedBudget:
        """Choose the paces of a file.

        Parameters
        ----------
        caution : Caution, optional
            What the command takes of the shaper.

        Raises
        ------
        DesignError, ModelError
            The method cannot be designed for this machine.
        """
        assert options.budget_um is not None
        tops = _tops(found.samples, machine)
        ours = PaceTrials(found.samples, machine, compensated(machine, options, shaper, caution))
        theirs = PaceTrials(found.samples, machine, shaped(shaper))
        return cls(
            machine,
            options.budget_um,
            found.first_layer,
            search(ours, 1.0, tops, options.budget_um),
            search(theirs, _SLOWEST, tops, options.budget_um),
            tops,
        )

    def classes(self, moves: Moves) -> NDArray[np.int32]:
        """Return the class of every move; `AS_SLICED` of one that stays as it is."""
        return move_classes(moves, self.first_layer)

    def paced(self, piece: Piece) -> Iterator[Piece]:
        """Yield a piece at its new pace, then gentler ones, and at last the piece as sliced.

        What it would take with the shaper is counted.
        """
        classes = self.classes(piece.moves)
        if self.shaper_paces.reached:
            slow = paced(piece, classes, paces(self.shaper_paces.factors), self.machine)
            self._shaper_s += slow.phases.duration_s
        for share in _GENTLER:
            factors = {one: factor**share for one, factor in self._factors.items()}
            quick = paced(piece, classes, paces(factors), self.machine)
            if quick is piece:
                break
            yield quick
            self._gentler_s += piece.phases.duration_s if share == 1.0 else 0.0
        yield piece

    def passed(self, seconds: float) -> None:
        """Count what stays as sliced."""
        self._shaper_s += seconds

    def correct(self, sums: Mapping[int, ErrorSum]) -> None:
        """Let paces follow the errors so far: down near the bound, up where there is room."""
        used = {one: self._used(one, sums[one]) for one in self._factors if one in sums}
        roomy = max(used.values(), default=0.0) < _FULL
        for one, factor in sorted(self._factors.items()):
            if one not in used:
                continue
            new = sums[one] - self._since[one] if one in self._since else sums[one]
            if new.seconds < _SURE_S:
                continue
            lately, wanted = self._used(one, new), factor
            if min(used[one] / _FULL, lately / _ROOM) > 1.0:
                wanted = max(1.0, _SLOWER * factor)
                helpless = factor == 1.0 and min(used[one], lately) > _HELPLESS
                if helpless and self._keeps_budget(one):
                    self._slow_others()
                    self._since[one] = sums[one]
            elif roomy and max(used[one], lately) < _ROOM:
                most = min(self.tops[one], _FURTHEST * self.paces.factors[one])
                wanted = max(factor, min(_FASTER * factor, most))
            if wanted != factor:
                self._factors[one], self._since[one] = wanted, sums[one]

    def _slow_others(self) -> None:
        """Slow down what shakes a class that is at its own pace: travel, and then all others."""
        travel_first = self._factors.get(TRAVEL, 1.0) > 1.0
        for one in [TRAVEL] if travel_first else [*self._factors]:
            self._factors[one] = max(1.0, _SLOWER * self._factors[one])

    def gentler(self, sums: Mapping[int, ErrorSum]) -> SpeedBudget | None:
        """Return the lower budget for another attempt; None if the written file may stay."""
        kept = [one for one in self._factors if one in sums and self._keeps_budget(one)]
        over = {one: self._used(one, sums[one]) for one in kept}
        over = {one: ratio for one, ratio in over.items() if ratio > _ABOVE}
        quicker = any(factor > 1.0 for factor in self.paces.factors.values())
        if not over or not quicker or self.attempt + 1 == _ATTEMPTS:
            return None
        factors = {
            one: min(factor, self.paces.factors[one]) for one, factor in self._factors.items()
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
        """Return the same as it was before anything was written."""
        return replace(self)

    def _keeps_budget(self, one: int) -> bool:
        """Return whether a class keeps the budget at its own pace, in the samples."""
        return self.paces.bounds_um[one] <= allowed_um(one, self.budget_um)

    def _used(self, one: int, found: ErrorSum) -> float:
        """Return the part of its bound that an error of a class is."""
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
                    acceleration_factor=round(self._factors.get(one, 1.0), 4),
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
        """Return where the budget is not kept, in words."""
        warnings = []
        for one, found in sorted(sums.items()):
            error = found.worst
            if error.rms_um <= _ABOVE * allowed_um(one, self.budget_um):
                continue
            raised = self._factors.get(one, 1.0) > 1.0
            remedy = (
                "give a smaller budget"
                if raised
                else "nothing of it is quicker than in the file: its own accelerations are too high"
                " for the budget"
            )
            warnings.append(
                f"The contour error of {_name(one, names)} is {error.rms_um:.2f} um (rms, worst "
                f"plant of the set), above the budget of {self.budget_um:g} um; {remedy}."
            )
        if self._gentler_s > 0.0:
            warnings.append(
                f"Pieces of {self._gentler_s:.0f} s as sliced are slower than the budget allows: "
                "no command within the machine's limits (command in its document) could follow "
                "them."
            )
        return warnings


def _tops(samples: list[Sample], machine: Machine) -> Factors:
    """Return the highest pace of every class: that at which its slowest moves are at the limits."""
    most = top_limits(machine)
    tops: Factors = {}
    for sample in samples:
        phases = sample.piece.phases
        for one in np.unique(sample.classes[sample.classes != AS_SLICED]).tolist():
            rows = sample.classes == one
            ratio = most.accel_mm_s2 / float(np.min(phases.accel_mm_s2[rows]))
            tops[one] = max(tops.get(one, 1.0), ratio)
    return tops


def _name(one: int, names: Sequence[str]) -> str:
    if one == TRAVEL:
        return "travel"
    if one == AS_SLICED:
        return "all that stays as sliced"
    return feature_name(one, names)
