"""How quick every class of moves may be within a budget of contour error.

The print's own motion is tried on samples from all over the file: as compensated as it will be,
with the moves planned for the firmware, and judged by the worst plant of the machine's set. Each
class of moves (features, travel) has a ladder of paces, from the file's own to what the machine's
command allows; all ladders are searched at once by bisection, so that classes are judged among
their neighbours. While the file is written its errors are measured in the same way, and a class
that turns out to exceed the budget becomes slower from there on.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from compensation.shapers import shape, shaper_pulses
from gcode.pieces import Piece
from gcode.quickening import (
    AS_SLICED,
    TRAVEL,
    FirstLayer,
    Pace,
    move_classes,
    quickened,
    top_limits,
)
from gcode.sampler import sample_phases
from gcode.types import Moves
from models.machine import Machine
from service.pipeline.compensating import DT_S, PieceCompensator, Unfit, as_executed
from service.pipeline.options import Options
from service.pipeline.result import BudgetClass, BudgetFigures
from service.pipeline.samples import FileSamples, Sample
from service.pipeline.set_errors import ClassError, SetErrors
from service.pipeline.yardstick import BestShaper

__all__ = ["PaceChoice", "SpeedBudget", "error_classes"]

_STEPS = 32
"""Rungs of a ladder; a power of 2."""
_SLOWEST = 0.05
"""Least pace of the shaper, which may have to be slower than the file."""
_AIM = 0.95
"""Part of the budget that the samples may use."""
_MENDING_ROUNDS = 4
_NO_WORSE = 1.1
_LANDING = 2.0
"""So many budgets may what is extruded right behind a travel have; its feature has one for all."""
_STRIDE, _STRIDE_WRITTEN = 8, 24
_SHAPER_REACH_S = 0.16
_SLOWER = 0.9
_GENTLER = (1.0, 0.6, 0.3)
"""Exponents of factors that are tried one after the other where no command can follow."""
_SURE_S = 5.0
"""Errors of so much extruding time say something of a class."""

Factors = dict[int, float]
Trial = Callable[[Factors], tuple[dict[int, ClassError], set[int]]]
"""Errors by class, and the classes in samples for which there is no command."""


@dataclass(frozen=True, slots=True)
class PaceChoice:
    """Ratios of accelerations by class.

    Attributes
    ----------
    factors : dict
        1: as the file has it.
    reached : bool
        No class that could be slower exceeds the budget in the samples.
    """

    factors: Factors
    reached: bool


@dataclass(slots=True)
class SpeedBudget:
    """The paces of a file, chosen on samples and corrected as it is written.

    Attributes
    ----------
    paces : PaceChoice
        Of the file that is written.
    shaper_paces : PaceChoice
        With the best firmware shaper instead of the compensation, at the same budget.
    shaper_s : float
        How long what was told so far takes with it.
    """

    machine: Machine
    budget_um: float
    first_layer: FirstLayer
    paces: PaceChoice
    shaper_paces: PaceChoice
    shaper_s: float = 0.0
    gentler_s: float = 0.0
    """How long the pieces last, as sliced, that no command could follow at their pace."""

    @classmethod
    def chosen(
        cls, found: FileSamples, machine: Machine, options: Options, shaper: BestShaper
    ) -> SpeedBudget:
        """Choose the paces of a file.

        Raises
        ------
        DesignError, ModelError
            The method cannot be designed for this machine.
        """
        assert options.budget_um is not None
        limit_um = _AIM * options.budget_um
        tops = _tops(found.samples, machine)
        compensated = _Compensated(found.samples, machine, options, shaper)
        shaped = _Shaped(found.samples, machine, shaper)
        return cls(
            machine,
            options.budget_um,
            found.first_layer,
            _search(compensated, dict.fromkeys(tops, 1.0), tops, limit_um),
            _search(shaped, dict.fromkeys(tops, _SLOWEST), tops, limit_um),
        )

    def paced(self, piece: Piece) -> Iterator[Piece]:
        """Yield a piece at its new pace, then gentler ones, and at last the piece as it came.

        What it would take with the shaper is counted.
        """
        classes = move_classes(piece.moves, self.first_layer)
        with_shaper = quickened(piece, classes, _paces(self.shaper_paces.factors), self.machine)
        self.shaper_s += with_shaper.phases.duration_s
        for share in _GENTLER:
            factors = {one: factor**share for one, factor in self.paces.factors.items()}
            quick = quickened(piece, classes, _paces(factors), self.machine)
            if quick is piece:
                break
            yield quick
            self.gentler_s += piece.phases.duration_s if share == 1.0 else 0.0
        yield piece

    def passed(self, seconds: float) -> None:
        """Count what leaves as it came."""
        self.shaper_s += seconds

    def correct(self, errors: Mapping[int, ClassError]) -> None:
        """Slow down classes whose errors so far exceed the budget."""
        for one, factor in self.paces.factors.items():
            error = errors.get(one)
            if error is None or error.seconds < _SURE_S or factor <= 1.0:
                continue
            if error.rms_um > self.budget_um * _allowed(one):
                self.paces.factors[one] = max(1.0, _SLOWER * factor)

    def figures(
        self,
        errors: Mapping[int, ClassError],
        names: Sequence[str],
        original_s: float,
        time_s: float,
    ) -> BudgetFigures:
        """Return what came of it."""
        classes = []
        for one, error in sorted(errors.items()):
            classes.append(
                BudgetClass(
                    name=_name(one, names),
                    acceleration_factor=round(self.paces.factors.get(one, 1.0), 4),
                    shaper_acceleration_factor=round(self.shaper_paces.factors.get(one, 1.0), 4),
                    contour_rms_um=error.rms_um,
                    seconds=round(error.seconds, 3),
                )
            )
        shaper_s = self.shaper_s if self.shaper_paces.reached else None
        return BudgetFigures(
            budget_um=self.budget_um,
            saved_share=1.0 - time_s / original_s if original_s else 0.0,
            shaper_time_s=shaper_s,
            saved_share_against_shaper=1.0 - time_s / shaper_s if shaper_s else None,
            classes=classes,
        )

    def warnings(self, errors: Mapping[int, ClassError], names: Sequence[str]) -> list[str]:
        """Return where the budget is not kept, in words."""
        warnings = []
        for one, error in sorted(errors.items()):
            if error.rms_um <= self.budget_um * _allowed(one) * (1.0 + 1e-3):
                continue
            raised = self.paces.factors.get(one, 1.0) > 1.0
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
        if self.gentler_s > 0.0:
            warnings.append(
                f"Pieces of {self.gentler_s:.0f} s as sliced are slower than the budget allows: no "
                "command within the machine's limits (command in its document) could follow them."
            )
        return warnings


def error_classes(moves: Moves) -> np.ndarray:
    """Return what the errors of each move count for: its feature, or travel."""
    way = moves.end_mm - moves.start_mm
    travels = ((way[:, 0] != 0.0) | (way[:, 1] != 0.0)) & (way[:, 3] <= 0.0)
    prints = ((way[:, 0] != 0.0) | (way[:, 1] != 0.0)) & (way[:, 3] > 0.0)
    other = np.where(travels, TRAVEL, AS_SLICED)
    return np.where(prints, moves.feature, other).astype(np.int32)


class _Compensated:
    """Samples as they will be written."""

    def __init__(
        self, samples: list[Sample], machine: Machine, options: Options, shaper: BestShaper
    ) -> None:
        self._samples, self._machine = samples, machine
        self._work = PieceCompensator(machine, options, shaper)

    def __call__(self, factors: Factors) -> tuple[dict[int, ClassError], set[int]]:
        errors = SetErrors(self._machine, DT_S, stride=_STRIDE)
        unfit: set[int] = set()
        for sample in self._samples:
            try:
                piece = quickened(sample.piece, sample.classes, _paces(factors), self._machine)
                self._work.compensator.reset(piece.phases.start_mm[0, :2])
                made = self._work.compensate(piece, sample.point)
            except (Unfit, ValueError):
                unfit.update(np.unique(sample.classes).tolist())
                continue
            planned, position, row, extruding = as_executed(made, piece.phases, made.encoded.phases)
            errors.jump()
            errors.operate_at(sample.point)
            errors.add(planned[:2], position[:2], extruding, sample.classes[row])
        errors.finish()
        return errors.errors(), unfit


class _Shaped:
    """Samples with the best firmware shaper."""

    def __init__(self, samples: list[Sample], machine: Machine, shaper: BestShaper) -> None:
        self._samples, self._machine = samples, machine
        frequencies = (shaper.fx_hz, shaper.fy_hz)
        self._pulses = [shaper_pulses(shaper.type, f_hz, shaper.zeta) for f_hz in frequencies]

    def __call__(self, factors: Factors) -> tuple[dict[int, ClassError], set[int]]:
        errors = SetErrors(self._machine, DT_S, stride=_STRIDE)
        pad = round(_SHAPER_REACH_S / DT_S)
        for sample in self._samples:
            piece = quickened(sample.piece, sample.classes, _paces(factors), self._machine)
            phases = piece.phases
            count = max(round(phases.duration_s / DT_S), 1)
            position, row = sample_phases(phases, (0.0, DT_S, count))
            path = np.pad(position[:2], ((0, 0), (pad, pad)), mode="edge")
            command = [shape(p, DT_S, pulses) for p, pulses in zip(path, self._pulses, strict=True)]
            direction = phases.direction[row]
            prints = (direction[:, 3] > 0.0) & ((direction[:, 0] != 0.0) | (direction[:, 1] != 0.0))
            classes = np.pad(sample.classes[row], pad, constant_values=AS_SLICED)
            errors.jump()
            errors.operate_at(sample.point)
            errors.add(path, np.stack(command), np.pad(prints, pad), classes)
        errors.finish()
        return errors.errors(), set()


def _search(trial: Trial, least: Factors, most: Factors, limit_um: float) -> PaceChoice:
    """Find the highest rung of every class at which its errors keep the limit."""

    def factor(one: int, rung: int) -> float:
        return float(least[one] * (most[one] / least[one]) ** (rung / _STEPS))

    def tried(rungs: dict[int, int]) -> dict[int, float]:
        """Return the errors over the limit by class; more than 1 is too much."""
        errors, unfit = trial({one: factor(one, rung) for one, rung in rungs.items()})
        over = {one: error.rms_um / (limit_um * _allowed(one)) for one, error in errors.items()}
        return {one: math.inf if one in unfit else over.get(one, 0.0) for one in rungs}

    rungs = {one: 0 for one in most if most[one] > least[one]}
    if not rungs:
        return PaceChoice({}, reached=True)
    # What exceeds the limit even so may at least not become much worse.
    limit = {one: max(1.0, _NO_WORSE * ratio) for one, ratio in tried(rungs).items()}
    step = _STEPS // 2
    while step:
        higher = {one: rung + step for one, rung in rungs.items()}
        for one, ratio in tried(higher).items():
            if ratio <= limit[one]:
                rungs[one] = higher[one]
        step //= 2
    # The uppermost rung is one more than bisection reaches.
    rungs = {one: rung + 1 if rung == _STEPS - 1 else rung for one, rung in rungs.items()}
    for _ in range(_MENDING_ROUNDS):
        over = {one: ratio / limit[one] for one, ratio in tried(rungs).items()}
        worse = {one: ratio for one, ratio in over.items() if ratio > 1.0}
        # A class that cannot be slower suffers from what comes before it: travel.
        stuck = [ratio for one, ratio in worse.items() if rungs[one] == 0]
        if stuck and TRAVEL in rungs:
            worse[TRAVEL] = max(worse.get(TRAVEL, 0.0), *stuck)
        lower = {one: ratio for one, ratio in worse.items() if rungs[one] > 0}
        if not lower:
            break
        for one, ratio in lower.items():
            span = most[one] / least[one]
            rungs[one] = max(0, rungs[one] - (2 if math.isinf(ratio) else _rungs_down(ratio, span)))
    reached = all(ratio <= 1.0 / _AIM for ratio in tried(rungs).values())
    return PaceChoice({one: factor(one, rung) for one, rung in rungs.items()}, reached)


def _allowed(one: int) -> float:
    """Return how many budgets the errors of a class may have."""
    return _LANDING if one == TRAVEL else 1.0


def _rungs_down(ratio: float, span: float) -> int:
    """Rungs that a class above the limit must go down, if errors follow accelerations."""
    return max(1, math.ceil(_STEPS * math.log(ratio) / math.log(span)))


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


def _paces(factors: Factors) -> dict[int, Pace]:
    return {one: Pace(factor, max(factor, 1.0)) for one, factor in factors.items()}


def _name(one: int, names: Sequence[str]) -> str:
    if one == TRAVEL:
        return "travel"
    return names[one] if one >= 0 else "unnamed"
