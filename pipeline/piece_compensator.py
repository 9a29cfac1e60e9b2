"""Compensate a piece of a print: from its planned path to command, segments and timed moves."""

from __future__ import annotations

import contextlib

import numpy as np
from numpy.typing import NDArray

from stillpath.compensation.base import Compensator, DesignError
from stillpath.compensation.cautious import Caution
from stillpath.compensation.defaults import DT_S
from stillpath.compensation.registry import compensator
from stillpath.compensation.scheduled import DESIGN_STEP
from stillpath.gcode.errors import GcodeError
from stillpath.gcode.firmware.encoding import Encoded
from stillpath.gcode.firmware.planning import intended
from stillpath.gcode.firmware.registry import adapter
from stillpath.gcode.pieces import Piece
from stillpath.gcode.segments import ErrorFilter, Segments, fit_segments
from stillpath.gcode.timeline import Group, Timeline, build_timeline, group_rows
from stillpath.gcode.types import Phases
from stillpath.models.machine import Machine
from stillpath.models.operating import BLEND_STEP, OperatingGrid, machine_at
from stillpath.models.plants import plant_set
from stillpath.models.schedule import EMPTY, OperatingPoint
from stillpath.pipeline.caution import design_mode, set_or_nominal
from stillpath.pipeline.compensated_piece import CompensatedPiece, Unfit, deviation
from stillpath.pipeline.filament import feed_evenly, retract_along
from stillpath.pipeline.following import follow_tolerance_mm, strayed
from stillpath.pipeline.measuring._peak_kernels import peaks
from stillpath.pipeline.measuring.reference_shaper import BestShaper
from stillpath.pipeline.motion_limits import MotionLimits, TooAbrupt
from stillpath.pipeline.options import COARSE_UM, Options
from stillpath.pipeline.standing import Standing

__all__ = ["PieceCompensator"]

_REST_TOLERANCE_S = 5e-3
_ROUNDS = 2
_STEP_SHARE = 0.3
"""Share of what motors bear by which speeds step from segment to segment: M220 may double it."""
_COARSE_GRID_MM = 1e-3
"""Three decimals do for a coarse fit: files are 5 % smaller."""
_ACCEL_SHARES = (1.0, 0.8, 0.6, 0.5)
"""Shares of the largest acceleration, tried in turn where a motor's speed step is too large."""
_ROUNDING_S = (2e-3, 4e-3, 8e-3)
"""Half-widths of the moving mean that rounds corners, tried in turn where they are too sharp."""


class PieceCompensator:
    """Compensate pieces one after another with one method.

    Parameters
    ----------
    shaper : BestShaper, optional
        The tuned frequencies, for `shaper:NAME` of the same type.
    caution : Caution, optional
        Mixture of `fbf` and a shaper.
    """

    def __init__(
        self,
        machine: Machine,
        options: Options,
        shaper: BestShaper | None = None,
        caution: Caution | None = None,
    ) -> None:
        self._machine = machine
        self.compensator = _designed(machine, options, shaper, caution)
        fit_share = 1.0 if caution is None else caution.fit_share
        self._tolerance_mm = 1e-3 * options.tolerance_um * fit_share
        firmware = adapter(machine)
        self.encoder = firmware.encoder()
        self._step_mm = firmware.step_mm
        self._limits = MotionLimits(machine, firmware.step_mm)
        self._follow_mm = follow_tolerance_mm(firmware, options.tolerance_um)
        self._filter = _error_filter(machine)
        # A shaper ends after the plan by itself.
        ends_with_plan = options.vibration == "fbf" and not self.compensator.tail_s
        self._standing = Standing(machine, DT_S) if ends_with_plan else None
        self._grid = OperatingGrid(machine, step=DESIGN_STEP, blend_step=BLEND_STEP)
        self._level: OperatingPoint | None = None

    def compensate(self, piece: Piece, point: OperatingPoint = EMPTY) -> CompensatedPiece:
        """Return the piece with its command.

        Parameters
        ----------
        point : OperatingPoint
            Operating point; only matters with schedules.

        Raises
        ------
        Unfit
            If no command within the machine's limits is found, or the firmware would refuse it.
        """
        try:
            if self._machine.schedules:
                self._operate_at(point)
            return self._with_fallbacks(piece)
        except (DesignError, GcodeError) as error:
            raise Unfit(str(error)) from error

    def _with_fallbacks(self, piece: Piece) -> CompensatedPiece:
        """Compensate a piece, more gently where its command asks too much of the motors.

        Tried in turn: less acceleration; full acceleration, with motion that may stray briefly from
        the command; rounder corners; only the acceleration that the path itself needs. If all of
        them fail, the first refusal is raised.
        """
        refusals: list[TooAbrupt | DesignError] = []
        for share in _ACCEL_SHARES:
            if not self.compensator.ease(share):
                raise refusals[0]
            try:
                return self._compensate_once(piece)
            except TooAbrupt as error:
                refusals.append(error)
            except DesignError as error:
                # With less acceleration it does not follow the path.
                refusals.append(error)
                break
        self.compensator.ease(1.0)
        with contextlib.suppress(TooAbrupt, DesignError):
            return self._compensate_once(piece, briefly=True)
        for rounding_s in _ROUNDING_S:
            with contextlib.suppress(TooAbrupt, DesignError):
                return self._compensate_once(piece, rounding_s)
        if self.compensator.ease(0.0):
            with contextlib.suppress(TooAbrupt, DesignError):
                return self._compensate_once(piece)
        first = refusals[0]
        if isinstance(first, DesignError):
            raise DesignError(f"{first}{self._limits.asked_too_much(piece)}") from first
        raise first

    def _operate_at(self, point: OperatingPoint) -> None:
        self.compensator.operate_at(point)
        level = self._grid.level(point)
        if level != self._level:
            self._level = level
            nodes = self._grid.at_level(level)
            here = machine_at(self._machine, nodes[len(nodes) // 2])
            self._filter = _error_filter(here)
            if self._standing is not None:
                self._standing = Standing(here, DT_S)

    def _compensate_once(
        self, piece: Piece, rounding_s: float = 0.0, *, briefly: bool = False
    ) -> CompensatedPiece:
        """Compensate the path, or its moving mean over `rounding_s` on either side.

        With `briefly` the motion may stray from its command for a moment (`pipeline.following`).
        """
        phases = intended(piece.phases, piece.moves.start_mm, piece.moves.end_mm, self._step_mm)
        groups = group_rows(phases)
        resting = np.array([group.rest for group in groups])
        rest_s = self.encoder.rest_durations(piece, groups)
        feeds = phases.direction[:, 3] > 0.0
        lead_s, tail_s = self._standing_s(phases, groups, rounding_s)
        # The duration of a rest depends slightly on the speeds around it: iterate until consistent.
        for _ in range(_ROUNDS):
            timeline = build_timeline(phases, groups, rest_s, DT_S, lead_s=lead_s, tail_s=tail_s)
            extruding = timeline.moving & feeds[timeline.row]
            command = self._command(timeline, phases, extruding, rounding_s)
            self._limits.check_travel(command[:2], timeline.row, piece)
            self._limits.check_motors(command[:2])
            step_mm, bend_mm = peaks(command)
            segments, encoded = self._fit(piece, timeline, command, bend_mm)
            change = np.max(np.abs(encoded.rest_s - rest_s)[resting], initial=0.0)
            if change < _REST_TOLERANCE_S:
                break
            rest_s = np.where(resting, encoded.rest_s, rest_s)
        # Vertices are rounded to samples, and moved where they would coincide.
        at = np.rint(encoded.start_s / DT_S).astype(np.int64)
        row = timeline.row[np.minimum(at, len(timeline.row) - 1)]
        self._limits.check_travel(encoded.position[:, :2].T / 1e6, row, piece)
        # Not asked by type: `compensation.ripple` is slow to import and seldom needed.
        keeps_ripple = getattr(self.compensator, "keeps_ripple", False)
        peak_mm = (step_mm, bend_mm)
        made = CompensatedPiece(
            timeline, command, extruding, segments, encoded, *peak_mm, keeps_ripple=keeps_ripple
        )
        gap_mm = deviation(made, encoded.phases)
        reason = strayed(gap_mm, extruding, self._follow_mm, briefly=briefly)
        if reason is not None:
            raise TooAbrupt(
                f"planned by the firmware's rules, {reason}{self._limits.remedy(piece)}"
            )
        return made

    def _command(
        self,
        timeline: Timeline,
        phases: Phases,
        extruding: NDArray[np.bool_],
        rounding_s: float,
    ) -> NDArray[np.float64]:
        """Return the command of X Y Z E, shape (4, n); Z is as planned."""
        path = timeline.position_mm
        wanted = _mean(path[:2], round(rounding_s / DT_S))
        xy_mm = self.compensator.compensate(wanted, extruding, timeline.rests)
        command = np.concatenate([xy_mm, path[2:]])
        retract_along(command, timeline, phases)
        feed_evenly(command, extruding)
        return command

    def _standing_s(
        self, phases: Phases, groups: list[Group], rounding_s: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the standing time before and after each group."""
        made = self.compensator
        lead_s, tail_s = (
            np.full(len(groups), one + rounding_s) for one in (made.lead_s, made.tail_s)
        )
        if self._standing is None:
            return lead_s, tail_s
        begin_s, end_s = self._standing.of(phases, groups)
        return lead_s + begin_s, tail_s + end_s

    def _fit(
        self, piece: Piece, timeline: Timeline, command: NDArray[np.float64], bend_mm: float
    ) -> tuple[Segments, Encoded]:
        """Return segments and moves, finer where a motor's speed step would be too large."""
        limits = self._limits
        tolerance = self._tolerance_mm
        # The command's own speed may change by more within a sample.
        step_mm_s = max(bend_mm / timeline.dt_s, _STEP_SHARE * limits.speed_step_mm_s)
        for _ in range(3):
            grid_mm = max(
                self.encoder.grid_mm, _COARSE_GRID_MM if tolerance >= 1e-3 * COARSE_UM else 0.0
            )
            segments = fit_segments(
                timeline,
                command,
                tolerance,
                self._filter,
                step_mm_s=step_mm_s,
                feed_step_mm_s=self.encoder.feed_step_mm_s,
                grid_mm=grid_mm,
                ends=timeline.starts(piece.marked_rows),
            )
            limits.keep_inside(segments, grid_mm)
            encoded = self.encoder.encode(piece, timeline, segments)
            if len(encoded.row) == 0:
                line = int(piece.moves.line[0])
                raise Unfit(f"line {line}: all moves round to zero at the resolution of a file")
            step, change = limits.speed_steps(encoded.phases)
            if step <= limits.speed_step_mm_s and change <= limits.speed_change_mm_s:
                return segments, encoded
            tolerance *= 0.5
        raise TooAbrupt(
            f"a motor's speed would step by {step:.0f} mm/s between two segments, and change by "
            f"{change:.0f} mm/s within a millisecond; the machine allows "
            f"{limits.speed_step_mm_s:.0f} and {limits.speed_change_mm_s:.0f} mm/s "
            "(command.speed_step_mm_s, accel_mm_s2)"
        )


def _designed(
    machine: Machine, options: Options, shaper: BestShaper | None, caution: Caution | None
) -> Compensator:
    if options.vibration == "fbf":

        def design(robust: str) -> Compensator:
            settings = {"basis": options.basis, "along": options.along, "robust": robust}
            return compensator(options.method, machine, DT_S, **settings, caution=caution)

        if options.robust == "auto":
            mode = design_mode(machine, budget=options.budget_um is not None)
            return set_or_nominal(mode, design)
        return design(options.robust)
    if shaper is not None and options.vibration == f"shaper:{shaper.type}":
        hz = {"fx_hz": shaper.fx_hz, "fy_hz": shaper.fy_hz}
        return compensator(options.method, machine, DT_S, **hz)
    return compensator(options.method, machine, DT_S)


def _mean(path_mm: NDArray[np.float64], reach: int) -> NDArray[np.float64]:
    """Return the moving mean over `reach` samples on either side, shape (2, n), ends held."""
    if reach == 0:
        return path_mm
    padded = np.pad(path_mm, ((0, 0), (reach + 1, reach)), mode="edge")
    # Relative to the start: sums of large numbers would lose digits.
    total = np.cumsum(padded - path_mm[:, :1], axis=1)
    width = 2 * reach + 1
    return np.asarray(path_mm[:, :1] + (total[:, width:] - total[:, :-width]) / width)


def _error_filter(machine: Machine) -> ErrorFilter:
    return ErrorFilter([plant_set(machine.axes[a], DT_S).nominal for a in ("x", "y")])
