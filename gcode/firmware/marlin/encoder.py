"""Encode a compensated command as G1 lines that make Marlin execute it.

Marlin moves in whole steps and times them in whole ticks. Vertices are on whole steps, so that its
rounding changes nothing, and far enough apart that each is executed; feedrates correspond to step
rates that it can produce, and the timing error of a segment is carried over to the next. Remaining
deviations are measured with the firmware's own planner and corrected. Linear advance is written
into the filament (docs/marlin.md).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple, cast

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from stillpath.gcode.firmware.encoding import (
    UNITS_PER_MM,
    Encoded,
    Interleaved,
    as_moves,
    encoded_piece,
    group_durations,
    interleave,
    lateness_s,
    limits_in_force,
    to_units,
)
from stillpath.gcode.firmware.marlin._block_kernels import C_FIRST_STEPS, C_MIN_RATE, L_JERK
from stillpath.gcode.firmware.marlin._encoder_kernels import (
    Blocks,
    assign_rates,
    bend_reversals,
    thin,
)
from stillpath.gcode.firmware.marlin.climbing import climb_in_long_moves
from stillpath.gcode.firmware.marlin.feeding import with_advance, with_placed_steps
from stillpath.gcode.firmware.marlin.limits import MarlinLimits
from stillpath.gcode.firmware.marlin.planner import Planner, planner_facts
from stillpath.gcode.firmware.marlin.starting import (
    StreamLevels,
    gentle_accel_mm_s2,
)
from stillpath.gcode.firmware.marlin.stream_limits import stream_limits, with_diagonals
from stillpath.gcode.firmware.planning import join_phases
from stillpath.gcode.firmware.vertices import Lattice, steps_within, vertices_on_steps
from stillpath.gcode.pieces import Piece
from stillpath.gcode.segments import Segments
from stillpath.gcode.timeline import Group, Timeline
from stillpath.gcode.types import Limits, Phases
from stillpath.models.firmware import Marlin
from stillpath.models.machine import CommandLimits

__all__ = ["MarlinEncoder"]

_DIAGONAL = 1.5
"""Speed of X and Y together above the command's for one axis."""
_CALM = 0.6
"""Share of the motors' permitted speed step; the rest is for making up lost time."""
_PASSES = 10
_DRIFT_PASSES, _DRIFT_LINES, _EARLIER = 25, 257, 0.3
"""Passes against lateness that adds up, of which the best counts; the lines over which it is
averaged, and the share of it by which lines are to end earlier in the next pass."""
_FIRST_SHARE = 0.5
"""Of a stretch's first line that is not to hold up the next: a ramp from rest takes twice as long
as the way at its final speed."""
_TIME_TOLERANCE_S = 5e-5
_BYTES_PER_LINE = 36.0
"""Length of a written line with line number, checksum and its share of the acknowledgement, and a
tenth more for the lines that set accelerations."""


class _Way(NamedTuple):
    """A way to encode a piece.

    Attributes
    ----------
    least_hz : float
        Step rate of starts from rest.
    late : bool
        The piece came late: steps of E are in moves that bear them, moves are long enough for the
        queue to stop within its own, and first lines do not hold up the ones after them.
    diagonal : bool
        X and Y together have what they bear.
    earlier : float
        Share of their lateness in the pass before by which lines are to end earlier, on average.
    """

    least_hz: float
    late: bool
    diagonal: bool = False
    earlier: float = 0.0


class MarlinEncoder:
    """Encode pieces for one machine.

    Parameters
    ----------
    travel_mm : sequence of (float, float), optional
        Least and largest X, and Y.
    """

    def __init__(
        self,
        firmware: Marlin,
        command: CommandLimits,
        *,
        corexy: bool,
        mesh_slope: float = 0.0,
        travel_mm: Sequence[tuple[float, float]] = ((-1e6, 1e6), (-1e6, 1e6)),
    ) -> None:
        self._firmware = firmware
        self._command = command
        self._fastest_mm_s = max(command.of(axis).velocity_mm_s for axis in ("x", "y"))
        self._mesh_slope = mesh_slope
        self._corexy = corexy
        scale = firmware.steps_per_mm
        self._scale = np.array([scale.x, scale.y, scale.z, scale.e])
        rate = firmware.max_segments_per_s
        if firmware.link == "serial":
            rate = min(rate, firmware.baud_rate / 10.0 / _BYTES_PER_LINE)
        self._rate = rate
        facts = planner_facts(firmware, corexy=corexy)
        self._least_hz = float(facts[C_MIN_RATE])
        by_deviation = firmware.junction == "deviation"
        # With classic jerk a move starts at the jerk's speed, without a slow first step.
        self._start_hz = self._least_hz if by_deviation else np.inf
        axis_limits = [command.of(axis) for axis in ("x", "y")]
        if all(
            gentle_accel_mm_s2(one, self._start_hz) == gentle_accel_mm_s2(one, np.inf)
            for one in axis_limits
        ):
            self._start_hz = np.inf
        self._turns_by_feed = by_deviation and firmware.small_segment_junctions
        self._first_steps = float(facts[C_FIRST_STEPS])
        self._ahead = firmware.block_buffer_size - 3
        self._burst = 0.5 * firmware.block_buffer_size
        low, high = steps_within(travel_mm, self._scale)
        self._lattice = Lattice(
            per_mm=self._scale,
            low=low,
            high=high,
            least=firmware.min_steps_per_segment,
            corexy=corexy,
            speed_step_mm_s=_CALM * command.speed_step_mm_s,
            spare_steps=1.0,
            accel_mm_s2=command.accel_mm_s2,
            moves_per_s=rate,
            fast_mm_s=command.speed_step_mm_s,
        )

    grid_mm = 1e-3
    """Much finer than a step; the encoder itself puts vertices on steps."""
    feed_step_mm_s = math.inf

    def rest_durations(self, piece: Piece, groups: Sequence[Group]) -> NDArray[np.float64]:
        """Return estimated durations of rests: those of the original plan."""
        return group_durations(piece.phases, groups)

    def encode(self, piece: Piece, timeline: Timeline, segments: Segments) -> Encoded:
        """Choose vertices on whole steps, and feedrates.

        Raises
        ------
        GcodeError
            If linear advance would exceed the extruder's speed limit.
        """
        own = cast(MarlinLimits, piece.limits_before)
        limits = stream_limits(own, self._command, self._mesh_slope)
        # The motors' full acceleration is better than a late piece. Where that does not help, what
        # each corner costs adds up faster than its corrections settle.
        ways = [
            _Way(self._start_hz, late=False),
            _Way(self._start_hz, late=True),
            _Way(np.inf, late=True),
            _Way(np.inf, late=True, earlier=_EARLIER),
            # Last, as starts after a break ask more of the motors.
            _Way(self._start_hz, late=True, diagonal=True),
            _Way(np.inf, late=True, diagonal=True),
            _Way(np.inf, late=True, diagonal=True, earlier=_EARLIER),
        ]
        vertices: dict[float, Segments] = {}
        placed: dict[tuple[float, bool], Interleaved] = {}
        for way in dict.fromkeys(ways):
            least_hz, place = way.least_hz, (way.least_hz, way.late)
            if least_hz not in vertices:
                vertices[least_hz] = self._vertices(timeline, segments, least_hz)
            if place not in placed:
                wish = vertices[least_hz]
                placed[place] = self._moves(piece, timeline, wish, limits, way)
            encoded, on_time = self._in_one_way(piece, timeline, placed[place], limits, way)
            if on_time:
                break
        return encoded

    def _moves(
        self, piece: Piece, timeline: Timeline, wish: Segments, limits: MarlinLimits, way: _Way
    ) -> Interleaved:
        """Return all moves, ours on whole steps."""
        places = way.late and self._turns_by_feed
        on_steps = self._on_steps(timeline, wish, limits, way)
        segments = with_advance(self._firmware, piece, timeline, on_steps, whole=not places)
        if places:
            accel = gentle_accel_mm_s2(self._command, way.least_hz)
            segments = with_placed_steps(
                timeline, segments, self._scale[3], accel, corexy=self._corexy
            )
        moves = interleave(piece, timeline, segments, 1)
        return self._where_the_file_says(piece, timeline, moves)

    def _in_one_way(
        self, piece: Piece, timeline: Timeline, moves: Interleaved, limits: MarlinLimits, way: _Way
    ) -> tuple[Encoded, bool]:
        """Encode in one way; return also whether the motion keeps up."""
        begin_s = float(timeline.start_s[0])
        speed = np.where(moves.row < 0, self._fastest_mm_s, piece.moves.speed_mm_s[moves.row])
        if way.diagonal:
            limits = with_diagonals(limits, self._command, corexy=self._corexy)
        levels = StreamLevels(
            moves,
            limits,
            self._command,
            least_hz=way.least_hz,
            ahead=self._ahead,
            corexy=self._corexy,
            steps_placed=way.late and self._turns_by_feed,
        )
        correction_s = np.zeros(len(moves.row))
        while True:
            in_force = limits_in_force(piece, moves.row, levels.limits, levels.level)
            feedrate, phases = self._rates(moves, begin_s, speed, correction_s, way, *in_force)
            raised = levels.raise_late(phases)
            if not np.any(raised):
                break
            correction_s[raised] = 0.0
        in_stream = levels.limits, levels.level
        encoded = encoded_piece(timeline, moves, in_stream, feedrate, phases)
        return _begun_late(encoded, moves, timeline), levels.keep_up(phases)

    def _rates(
        self,
        moves: Interleaved,
        begin_s: float,
        speed_mm_s: NDArray[np.float64],
        correction: NDArray[np.float64],
        way: _Way,
        limits_id: NDArray[np.int32],
        limits: Sequence[Limits],
    ) -> tuple[NDArray[np.float64], Phases]:
        """Return feedrates that keep the segments' times, and the firmware's plan of them."""
        ours, places = moves.row < 0, moves.places_mm()
        start_mm, end_mm = places[:-1], places[1:]
        steps, path = self._blocks(start_mm, end_mm)
        fastest = np.where(ours, _DIAGONAL * speed_mm_s, speed_mm_s)
        phases = self._plan(start_mm, end_mm, fastest, limits_id, limits)
        actual = phases.lasts_s
        at_once = self._at_once(start_mm, end_mm, path, limits_id, limits)
        blocks = Blocks(ours, steps, path, moves.end_s, moves.planned_s, fastest, at_once)
        feedrate, predicted, early_s = np.zeros((3, len(ours)))
        earlier, first_share = way.earlier, _FIRST_SHARE if way.late else 1.0
        best: tuple[float, NDArray[np.float64], Phases] = (np.inf, feedrate, phases)
        for attempt in range(_DRIFT_PASSES if earlier else _PASSES):
            blocks = blocks._replace(end_s=moves.end_s - early_s)
            assign_rates(
                blocks,
                actual,
                correction,
                self._first_steps,
                self._firmware.step_timer_hz,
                self._firmware.step_smoothing_hz,
                self._least_hz,
                first_share,
                begin_s,
                feedrate,
                predicted,
            )
            chosen = np.where(ours, feedrate / 60.0, fastest)
            phases = self._plan(start_mm, end_mm, chosen, limits_id, limits)
            actual = phases.lasts_s
            miss = actual - predicted
            if earlier:
                late_s = lateness_s(moves, phases, after_first=True)
                off = float(np.max(np.abs(late_s) * np.where(ours, feedrate, 0.0), initial=0.0))
                if off < best[0]:
                    best = off, feedrate.copy(), phases
            if np.max(np.abs(np.cumsum(miss)), initial=0.0) < _TIME_TOLERANCE_S:
                break
            # Rates are quantised: a full correction would oscillate.
            correction[ours] += miss[ours] * (1.0 if attempt == 0 else 0.7)
            if earlier and attempt > 0:
                drift_s = uniform_filter1d(late_s, _DRIFT_LINES)
                early_s += np.where(ours, earlier * drift_s, 0.0)
        return best[1:] if earlier else (feedrate, phases)

    def _where_the_file_says(
        self, piece: Piece, timeline: Timeline, moves: Interleaved
    ) -> Interleaved:
        """Return moves with ends of stretches, and rests, at the file's positions, not on steps.

        The firmware rounds them to the same steps, and filament adds up exactly.
        """
        own = piece.moves.end_mm
        position = moves.position.copy()
        rests = moves.row >= 0
        position[rests] = to_units(own[moves.row[rests]])
        last = np.append(moves.group[1:] != moves.group[:-1], True) & ~rests
        ends = own[[timeline.groups[g].last - 1 for g in moves.group[last]]]
        meant = position[last] / UNITS_PER_MM
        same = np.round(ends * self._scale) == np.round(meant * self._scale)
        same[:, 3] = True
        position[last] = np.where(same, to_units(ends), position[last])
        return replace(moves, position=position, begin=to_units(piece.moves.start_mm[0]))

    def _vertices(self, timeline: Timeline, segments: Segments, least_hz: float) -> Segments:
        """Put the vertices of a fit on whole steps."""
        if len(segments) == 0:
            # X and Y of the whole piece move by less than a step.
            return segments
        gentle = gentle_accel_mm_s2(self._command, least_hz)
        lattice = replace(self._lattice, fast_accel_mm_s2=gentle)
        return vertices_on_steps(lattice, timeline, segments)

    def _on_steps(
        self, timeline: Timeline, wish: Segments, limits: MarlinLimits, way: _Way
    ) -> Segments:
        """Leave out vertices that would be swallowed, and place the steps of a climb."""
        if len(wish) == 0:
            return wish
        scale = self._scale[:3]
        steps = np.round(wish.end_mm[:3].T * scale).astype(np.int64)
        begin = np.round(timeline.group_start_mm[:, :3] * scale).astype(np.int64)
        keep, room = np.ones(len(wish), np.bool_), np.zeros(len(wish))
        if way.late:
            gentle = gentle_accel_mm_s2(self._command, way.least_hz)
            room = self._room_to_stop(wish, timeline, gentle)
        thin(
            steps,
            begin,
            wish.end_s,
            timeline.start_s,
            wish.group,
            self._lattice.least,
            room,
            self._rate,
            self._burst,
            self._corexy,
            keep,
        )
        steps, group, end_mm = steps[keep], wish.group[keep], wish.end_mm[:, keep]
        if self._firmware.junction == "deviation":
            places = end_mm[:2].T * scale[:2]
            bend_reversals(steps, begin, group, places, self._lattice.least, self._corexy)
        chosen = Segments(wish.end_s[keep], end_mm, group)
        inner = ~chosen.final
        end_mm[:2, inner] = (steps[inner, :2] / scale[:2]).T
        classic = self._firmware.junction == "classic_jerk"
        return climb_in_long_moves(chosen, timeline, scale[2], limits, classic_jerk=classic)

    def _room_to_stop(
        self, wish: Segments, timeline: Timeline, accel_mm_s2: float
    ) -> NDArray[np.float64]:
        """Return how many steps each move should have so that the queue is long enough to stop."""
        room = np.zeros(len(wish))
        for group, rows in wish.stretches():
            place_mm = np.vstack([timeline.group_start_mm[group], wish.end_mm[:, rows].T])
            takes_s = np.diff(np.append(timeline.start_s[group], wish.end_s[rows]))
            way_mm = np.diff(place_mm[:, :3], axis=0)
            speed_mm_s = np.hypot(*way_mm[:, :2].T) / takes_s
            rate = np.max(self._motors(way_mm * self._scale[:3]), axis=1) / takes_s
            room[rows] = speed_mm_s * rate / (2.0 * accel_mm_s2 * (self._ahead - 1))
        return room

    def _blocks(
        self, start_mm: NDArray[np.float64], end_mm: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return step events and length of every move's block, as in the planner."""
        travel = np.round(end_mm * self._scale) - np.round(start_mm * self._scale)
        x_mm, y_mm, z_mm, e_mm = (travel / self._scale).T
        motors = self._motors(travel)
        least = self._firmware.min_steps_per_segment
        path = np.sqrt(x_mm**2 + y_mm**2 + z_mm**2)
        path = np.where(np.max(motors[:, :3], axis=1) >= least, path, np.abs(e_mm))
        steps = np.max(motors, axis=1)
        steps = np.where((steps >= least) & (path > 0.0), steps, 0.0)
        return steps, np.where(path > 0.0, path, 1.0)

    def _at_once(
        self,
        start_mm: NDArray[np.float64],
        end_mm: NDArray[np.float64],
        path_mm: NDArray[np.float64],
        limits_id: NDArray[np.int32],
        limits: Sequence[Limits],
    ) -> NDArray[np.float64]:
        """Return the speed with which each move may begin: by classic jerk its safe speed, or 0."""
        if self._firmware.junction != "classic_jerk":
            return np.zeros(len(path_mm))
        jerk = np.array([one.as_row()[L_JERK : L_JERK + 4] for one in limits])[limits_id]
        motors = self._motors(end_mm - start_mm)
        return np.asarray(path_mm * np.min(jerk / np.maximum(motors, 1e-9), axis=1))

    def _motors(self, travel: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return how far each motor turns for a travel, (n, 4), in its unit."""
        motors = np.abs(travel)
        if self._corexy:
            x, y = travel[:, :2].T
            motors[:, 0], motors[:, 1] = np.abs(x + y), np.abs(x - y)
        return motors

    def _plan(
        self,
        start_mm: NDArray[np.float64],
        end_mm: NDArray[np.float64],
        speed_mm_s: NDArray[np.float64],
        limits_id: NDArray[np.int32],
        limits: Sequence[Limits],
    ) -> Phases:
        planner = Planner(self._firmware, corexy=self._corexy)
        moves = as_moves(start_mm, end_mm, speed_mm_s, limits_id)
        return join_phases([planner.push_moves(moves, limits), planner.flush()])


def _begun_late(encoded: Encoded, moves: Interleaved, timeline: Timeline) -> Encoded:
    """Begin stretches later by the extra time of their first step from rest."""
    ours, phases = moves.row < 0, encoded.phases
    first = ours & np.append(True, ~ours)[:-1]
    delay_s = np.zeros(len(timeline.groups))
    delay_s[moves.group[first]] = (phases.lasts_s - moves.planned_s)[first]
    counts = [group.last - group.first for group in timeline.groups]
    return replace(
        encoded,
        group_start_s=encoded.group_start_s + delay_s,
        row_start_s=encoded.row_start_s + np.repeat(delay_s, counts),
    )
