"""Try excerpts at other paces: their errors and durations."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillpath.compensation.cautious import Caution
from stillpath.compensation.defaults import DT_S
from stillpath.compensation.shapers import shape_xy
from stillpath.gcode.errors import GcodeError
from stillpath.gcode.firmware.planning import intended
from stillpath.gcode.firmware.registry import adapter
from stillpath.gcode.pacing import AS_SLICED, Pace, paced
from stillpath.gcode.pieces import Piece
from stillpath.gcode.sampler import sample_phases
from stillpath.models.machine import Machine
from stillpath.pipeline.compensated_piece import Unfit, as_executed
from stillpath.pipeline.measuring.reference_shaper import BestShaper
from stillpath.pipeline.measuring.set_errors import ClassError, ErrorSum, SetErrors
from stillpath.pipeline.options import Options
from stillpath.pipeline.pacing.excerpts import Excerpt
from stillpath.pipeline.piece_compensator import PieceCompensator

__all__ = ["Factors", "PaceTrials", "Tried", "compensated", "paces", "shaped"]

_STRIDE = 8
_SHAPER_REACH_S = 0.16

Factors = dict[int, float]
"""Ratio of accelerations to the file's, by class of moves."""
Motion = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_], NDArray[np.int32]]
"""Path and command (2, n), extrusion flag and class of every sample."""


@dataclass(frozen=True, slots=True)
class Tried:
    """The outcome of a trial.

    Attributes
    ----------
    errors : dict
        By class.
    unfit : set of int
        Classes in excerpts for which there is no command.
    seconds : float
        Planned duration of all excerpts.
    """

    errors: dict[int, ClassError]
    unfit: set[int]
    seconds: float


@dataclass(frozen=True, slots=True)
class _Measured:
    """One excerpt at some paces; `sums` is None where there is no command."""

    sums: dict[int, ErrorSum] | None
    seconds: float


class PaceTrials:
    """Try paces on excerpts; results of earlier trials are reused.

    Samples for which there is no command at their own pace are left out: they stay as sliced.

    Parameters
    ----------
    motion : callable
        Returns the motion of an excerpt at its new pace; raises `Unfit` where there is no command.
    """

    def __init__(
        self, excerpts: list[Excerpt], machine: Machine, motion: Callable[[Excerpt, Piece], Motion]
    ) -> None:
        self._machine, self._motion = machine, motion
        self._errors = SetErrors(machine, DT_S, stride=_STRIDE)
        self._known: dict[tuple[object, ...], _Measured] = {}
        self._excerpts = [
            (excerpt, sorted(set(excerpt.classes.tolist()) - {AS_SLICED})) for excerpt in excerpts
        ]
        fit = [self._measured(k, {}).sums is not None for k in range(len(excerpts))]
        self._used = [k for k, works in enumerate(fit) if works]

    def __call__(self, factors: Factors) -> Tried:
        """Return the outcome of these factors; a class not listed keeps its pace."""
        total: dict[int, ErrorSum] = {}
        unfit: set[int] = set()
        seconds = 0.0
        for number in self._used:
            found = self._measured(number, factors)
            seconds += found.seconds
            if found.sums is None:
                unfit.update(self._excerpts[number][1])
                continue
            for one, more in found.sums.items():
                total[one] = total[one] + more if one in total else more
        return Tried({one: added.worst for one, added in total.items()}, unfit, seconds)

    def _measured(self, number: int, factors: Factors) -> _Measured:
        excerpt, present = self._excerpts[number]
        here = {one: factors.get(one, 1.0) for one in present}
        key = (number, *here.values())
        if key not in self._known:
            self._known[key] = self._measure(excerpt, here)
        return self._known[key]

    def _measure(self, excerpt: Excerpt, factors: Factors) -> _Measured:
        seconds = excerpt.piece.phases.duration_s
        try:
            piece = paced(excerpt.piece, excerpt.classes, paces(factors), self._machine)
            seconds = piece.phases.duration_s
            path, command, extruding, classes = self._motion(excerpt, piece)
        except (Unfit, GcodeError):
            return _Measured(None, seconds)
        self._errors.begin()
        self._errors.operate_at(excerpt.point)
        self._errors.add(path, command, extruding, classes)
        self._errors.finish()
        return _Measured(self._errors.sums(), seconds)


def compensated(
    machine: Machine, options: Options, shaper: BestShaper, caution: Caution | None = None
) -> Callable[[Excerpt, Piece], Motion]:
    """Return a function that moves excerpts as they will be written.

    Parameters
    ----------
    caution : Caution, optional
        Mixture of command and shaper.

    Raises
    ------
    DesignError, ModelError
        The method cannot be designed for this machine.
    """
    work = PieceCompensator(machine, options, shaper, caution)
    step_mm = adapter(machine).step_mm

    def motion(excerpt: Excerpt, piece: Piece) -> Motion:
        work.compensator.reset(piece.phases.start_mm[0, :2])
        made = work.compensate(piece, excerpt.point)
        # The next excerpt starts with the design that worked here, as pieces do.
        work.compensator.commit()
        asked = intended(piece.phases, piece.moves.start_mm, piece.moves.end_mm, step_mm)
        planned, position, row, extruding = as_executed(made, asked, made.encoded.phases)
        return planned[:2], position[:2], extruding, excerpt.classes[row]

    return motion


def shaped(shaper: BestShaper) -> Callable[[Excerpt, Piece], Motion]:
    """Return a function that moves excerpts with the best firmware shaper."""
    pad = round(_SHAPER_REACH_S / DT_S)

    def motion(excerpt: Excerpt, piece: Piece) -> Motion:
        phases = piece.phases
        count = max(round(phases.duration_s / DT_S), 1)
        position, row = sample_phases(phases, (0.0, DT_S, count))
        path = np.pad(position[:2], ((0, 0), (pad, pad)), mode="edge")
        command = shape_xy(path, DT_S, shaper.pulses)
        classes = np.pad(excerpt.classes[row], pad, constant_values=AS_SLICED)
        return path, command, np.pad(phases.prints[row], pad), classes

    return motion


def paces(factors: Mapping[int, float]) -> dict[int, Pace]:
    """Return the paces of factors; travel keeps its speed even at lower acceleration."""
    return {one: Pace(factor, max(factor, 1.0)) for one, factor in factors.items()}
