"""Encode a compensated command as G1 lines that make RepRapFirmware execute it.

The speed along the path is continuous in this firmware: a change of it costs time, a change of
direction costs none within the jerk limits. The stream runs under the motors' limits, so that it
may be interrupted at any line; the time of ramps is predicted to the clock. Vertices are on whole
motor steps, chosen by the printer's response. Pressure advance is written into the filament
(docs/reprapfirmware.md).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import cast

import numpy as np
from numpy.typing import NDArray

from stillpath.gcode.errors import GcodeError
from stillpath.gcode.firmware._encoding_kernels import MoveLimits
from stillpath.gcode.firmware.advance import feed_at_ends
from stillpath.gcode.firmware.encoding import (
    Encoded,
    Interleaved,
    as_moves,
    encoded_piece,
    group_durations,
    interleave,
    lateness_s,
    limits_in_force,
)
from stillpath.gcode.firmware.reprapfirmware._encoder_kernels import assign_speeds, keep_apart
from stillpath.gcode.firmware.reprapfirmware.limits import RepRapLimits
from stillpath.gcode.firmware.reprapfirmware.planner import RepRapPlanner
from stillpath.gcode.firmware.vertices import Lattice, steps_within, vertices_on_steps
from stillpath.gcode.pieces import Piece
from stillpath.gcode.segments import Segments
from stillpath.gcode.timeline import Group, Timeline
from stillpath.gcode.types import Limits, Phases
from stillpath.models.firmware import RepRapFirmware
from stillpath.models.machine import CommandLimits

__all__ = ["STEEPEST", "RepRapEncoder", "stream_limits", "with_diagonals"]

STEEPEST = 0.01
"""Steepest climb of a stream on top of the bed mesh's slope; Z's limits are raised for both."""
STREAM_E_ACCEL_MM_S2 = 60_000.0
"""High enough that pressure advance never limits X and Y."""
_CORNER, _RAMP = 0.47, 0.375
"""Shares of the motors' permitted step of speed: for a corner, and for a ramp of 1 ms on CoreXY."""
LEAST_SPEED_MM_S = 0.01
"""Lowest minimum speed that the firmware accepts; it speeds up slower moves."""
_E_JERK_SHARE = 2.0
"""Multiple of the extruder's own jerk: between acceleration and deceleration the firmware's own
pressure advance steps by twice the jerk."""
_DIAGONAL = 1.5
"""Ratio of a CoreXY motor's speed to the path's, and of the changes of Z's direction."""
_PASSES = 4
_RING_SHARE = 0.5
"""Share of half the ring in which late pieces are to be able to stop."""
_BEHIND_MM, _TRAVEL_BEHIND_MM = 0.04, 0.12
"""Lag, with and without filament, from which a piece is not on time."""
_AHEAD_MM = 0.2
"""Lead from which it is not: corrections that do not settle send it ahead of its times."""
_EXACT_S = 2e-6
_LEAST_S = 0.025
"""As `prepare_least_s` of today's firmware; with an older one, too, lines must be read in time."""
_POLL_S = 2e-3
"""The firmware checks every 2 ms whether moves are to be frozen."""
_SPARSE = 1.3
"""Planned duration of half a ring relative to what the firmware needs."""
_SLOW_MM_S, _SLOW_MM = 10.0, 0.1
"""Segments slower than this are at most this long, unless their neighbours are as fast: a peak of
speed of less than a tenth is cut off, which costs up to a tenth of the segment's length."""


def stream_limits(
    firmware: RepRapFirmware,
    command: CommandLimits,
    mesh_slope: float = 0.0,
    *,
    corexy: bool = False,
) -> RepRapLimits:
    """Return the limits of a stream.

    X and Y keep what the motors bear, so that the stream may break off anywhere, at M220 200 % too,
    where two corners may come within a ms. What Z and the extruder may do by themselves stays,
    because a rest's own move runs on into the stream. Z follows a bed mesh, though, and is asked
    for the slope times what X and Y do.
    """
    own = RepRapLimits.of(firmware, 0.0)
    x, y = command.of("x"), command.of("y")
    # Jerk limits the step of each axis; a motor of a CoreXY makes those of both, and its ramp.
    ramp, axes = (_RAMP, 2.0) if corexy else (math.inf, math.sqrt(2.0))
    accels = [min(one.accel_mm_s2, ramp * one.speed_step_mm_s / 1e-3) for one in (x, y)]
    accel = max(accels)
    jerks = [round(_CORNER * one.speed_step_mm_s / axes, 2) for one in (x, y)]
    extruder = _E_JERK_SHARE * own.jerk_e_mm_s
    slope = mesh_slope + STEEPEST
    climb = max(own.jerk_z_mm_s, _DIAGONAL * slope * max(jerks))
    return replace(
        own,
        # A CoreXY's motors are held to it as well.
        accel_x_mm_s2=accels[0],
        accel_y_mm_s2=accels[1],
        accel_z_mm_s2=max(own.accel_z_mm_s2, slope * accel),
        accel_e_mm_s2=max(own.accel_e_mm_s2, STREAM_E_ACCEL_MM_S2),
        speed_x_mm_s=_DIAGONAL * x.velocity_mm_s,
        speed_y_mm_s=_DIAGONAL * y.velocity_mm_s,
        min_speed_mm_s=LEAST_SPEED_MM_S,
        print_accel_mm_s2=accel,
        travel_accel_mm_s2=accel,
        jerk_x_mm_s=jerks[0],
        jerk_y_mm_s=jerks[1],
        jerk_z_mm_s=climb,
        jerk_e_mm_s=extruder,
        max_jerk_x_mm_s=jerks[0],
        max_jerk_y_mm_s=jerks[1],
        max_jerk_z_mm_s=climb,
        max_jerk_e_mm_s=extruder,
        jerk_policy=1.0,
    )


def with_diagonals(limits: RepRapLimits, command: CommandLimits, *, corexy: bool) -> RepRapLimits:
    """Return limits of a stream with the acceleration that X and Y bear together.

    M204 holds along the way, M201 by axis and, on a CoreXY, by motor (`DDA.cpp`,
    `InitStandardMove`; `CoreKinematics.cpp`).
    """
    x, y = limits.accel_x_mm_s2, limits.accel_y_mm_s2
    if not corexy:
        both = math.hypot(x, y)
        return replace(limits, print_accel_mm_s2=both, travel_accel_mm_s2=both)
    most = _RAMP * command.speed_step_mm_s / 1e-3
    if command.motors is not None and command.motors.accel_mm_s2 is not None:
        most = min(most, command.motors.accel_mm_s2)
    x, y = (max(one, min(math.sqrt(2.0) * one, most)) for one in (x, y))
    return replace(limits, accel_x_mm_s2=x, accel_y_mm_s2=y)


class RepRapEncoder:
    """Encode pieces for one machine.

    Parameters
    ----------
    kinematics : {"cartesian", "corexy"}
    limits : RepRapLimits
        What the stream runs under.
    travel_mm : sequence of (float, float), optional
        Least and largest X, and Y.
    late_limits : RepRapLimits, optional
        What pieces run under that are late otherwise; by default `limits`.
    """

    grid_mm = 1e-3
    """Much finer than a step; the encoder itself puts vertices on steps."""
    feed_step_mm_s = math.inf

    def __init__(
        self,
        firmware: RepRapFirmware,
        kinematics: str,
        limits: RepRapLimits,
        travel_mm: Sequence[tuple[float, float]] = ((-1e6, 1e6), (-1e6, 1e6)),
        late_limits: RepRapLimits | None = None,
    ) -> None:
        self._firmware = firmware
        self._kinematics = kinematics
        self._half_ring = firmware.ring_length // 2 - 1
        self._half_ring_s = max(firmware.prepare_least_s, _LEAST_S) + _POLL_S
        """Least duration of that many moves, so that the firmware freezes the next one in time."""
        self._limits = limits
        self._late_limits = late_limits or limits
        per_mm = np.array([drive.steps_per_mm for drive in firmware.drives])
        low, high = steps_within(travel_mm, per_mm)
        self._lattice = Lattice(
            per_mm=per_mm,
            low=low,
            high=high,
            least=1,
            # Jerk limits the axes of a CoreXY, too; and what steps of X and Y add to it counts.
            corexy=False,
            speed_step_mm_s=min(limits.jerk_x_mm_s, limits.jerk_y_mm_s),
            spare_steps=0.0,
            accel_mm_s2=min(limits.accel_x_mm_s2, limits.accel_y_mm_s2),
            moves_per_s=self._half_ring / (_SPARSE * self._half_ring_s),
        )

    def rest_durations(self, piece: Piece, groups: Sequence[Group]) -> NDArray[np.float64]:
        """Return estimated durations of rests: those of the original plan."""
        return group_durations(piece.phases, groups)

    def encode(self, piece: Piece, timeline: Timeline, segments: Segments) -> Encoded:
        """Choose places, filament and feedrates for the segments of a piece.

        Raises
        ------
        GcodeError
            If segments come faster than the firmware's queue can take them.
        """
        segments = self._sparse(timeline, _split_slow(timeline, segments))
        segments = self._on_steps(timeline, segments)
        first = self._sparse(timeline, segments)
        encoded, behind_mm = self._timed(piece, timeline, first, self._limits)
        # Behind short moves the ring knows too little to stop, so they stay slow.
        for limits in dict.fromkeys((self._limits, self._late_limits)):
            if behind_mm == 0.0:
                break
            longer = self._sparse(timeline, self._with_room(timeline, segments, limits))
            other, other_mm = self._timed(piece, timeline, longer, limits)
            if other_mm < behind_mm:
                encoded, behind_mm = other, other_mm
        return encoded

    def _timed(
        self, piece: Piece, timeline: Timeline, segments: Segments, stream: RepRapLimits
    ) -> tuple[Encoded, float]:
        """Choose filament and feedrates; return also lag or lead beyond its limit [mm], or 0."""
        segments = self._advanced(piece, timeline, segments)
        moves = interleave(piece, timeline, segments, 1)
        rows = moves.row
        places_mm = moves.places_mm()
        start_mm, end_mm = places_mm[:-1], places_mm[1:]
        ours = rows < 0
        limits_id, limits = limits_in_force(piece, rows, [stream], np.zeros_like(rows))
        allowed = self._allowed(start_mm, end_mm, limits_id, limits)
        asked = np.where(ours, np.inf, piece.moves.speed_mm_s[rows])
        speed = np.minimum(allowed.speed_mm_s, asked)
        foreseen = allowed._replace(speed_mm_s=speed), moves.end_s, moves.planned_s
        begin_s, clock_hz = float(timeline.start_s[0]), self._firmware.step_clock_hz
        feedrate, predicted, missed = (np.zeros(len(rows)) for _ in range(3))
        least_s = np.inf
        for attempt in range(_PASSES):
            assign_speeds(ours, *foreseen, missed, begin_s, clock_hz, feedrate, predicted)
            chosen = np.where(ours, feedrate / 60.0, speed)
            written = as_moves(start_mm, end_mm, chosen, limits_id)
            planner = RepRapPlanner(self._firmware, self._kinematics)
            phases = planner.plan_whole(written, limits)
            # The prediction is slightly off for rests, whose moves brake for later ones, and for
            # speed peaks that are almost cut off.
            miss = phases.lasts_s - predicted
            wrong_s = float(np.max(np.abs(np.cumsum(miss)), initial=0.0))
            if wrong_s < least_s:
                best, plan, least_s = feedrate.copy(), phases, wrong_s
            if wrong_s < _EXACT_S:
                break
            missed += miss if attempt == 0 else 0.5 * miss
        self._check_rate(plan, piece)
        encoded = encoded_piece(timeline, moves, stream, best, plan)
        return encoded, _behind_mm(moves, plan)

    def _sparse(self, timeline: Timeline, segments: Segments) -> Segments:
        """Drop vertices where segments come faster than the firmware's queue can take them."""
        half = self._half_ring
        if len(segments) < half:
            return segments
        begin_s = timeline.start_s[segments.group]
        lasts = segments.end_s - _starts(timeline, segments)[0]
        total = np.cumsum(np.append(0.0, lasts))
        wanted_s = _SPARSE * self._half_ring_s
        late = np.append(total[half:] - total[:-half] < wanted_s, np.zeros(half - 1, bool))
        crowded = np.convolve(late[: len(segments)], np.ones(half))[: len(segments)] > 0.0
        if not np.any(crowded):
            return segments
        return _apart(segments, crowded, begin_s, np.full(len(segments), wanted_s / half))

    def _with_room(self, timeline: Timeline, segments: Segments, stream: RepRapLimits) -> Segments:
        """Drop vertices so that a share of half a ring is long enough to stop."""
        start_s, start_mm = _starts(timeline, segments)
        lasts_s, way_mm = segments.end_s - start_s, np.abs(segments.end_mm - start_mm)[:2]
        limits = np.array([stream.accel_x_mm_s2, stream.accel_y_mm_s2])
        if self._kinematics == "corexy":
            # A motor makes at most what both axes make.
            way_mm = np.broadcast_to(way_mm.sum(axis=0), way_mm.shape)
        braking_s = np.max((way_mm.T / limits).T, axis=0) / lasts_s
        least_s = braking_s / (2.0 * _RING_SHARE * self._half_ring)
        every = np.ones(len(segments), np.bool_)
        return _apart(segments, every, timeline.start_s[segments.group], least_s)

    def _advanced(self, piece: Piece, timeline: Timeline, segments: Segments) -> Segments:
        """Return segments with pressure advance in their filament."""
        end_mm = segments.end_mm.copy()
        rows, fed, _ = feed_at_ends(piece, timeline, segments)
        advance_s = np.array([x.pressure_advance_s for x in cast(list[RepRapLimits], piece.limits)])
        fed = np.where(segments.final, 0.0, fed)
        end_mm[3] += advance_s[piece.moves.limits_id[rows]] * fed
        return replace(segments, end_mm=end_mm)

    def _on_steps(self, timeline: Timeline, segments: Segments) -> Segments:
        """Put the vertices on whole steps of X and Y.

        Not of Z: the firmware limits corner speeds by the directions as written, and in steps a
        slow climb, as in a vase, would be flat and then too steep.
        """
        if len(segments) == 0:
            return segments
        return vertices_on_steps(self._lattice, timeline, segments)

    def _allowed(
        self,
        start_mm: NDArray[np.float64],
        end_mm: NDArray[np.float64],
        limits_id: NDArray[np.int32],
        limits: Sequence[Limits],
    ) -> MoveLimits:
        """Return the limits of every move by the planner's rules."""
        own = np.array([x.as_row() for x in limits])[limits_id]
        travel = end_mm - start_mm
        length = np.sqrt(np.sum(travel[:, :3] ** 2, axis=1))
        length = np.where(length > 0.0, length, np.abs(travel[:, 3]))
        direction = travel / np.where(length > 0.0, length, 1.0)[:, None]
        share = np.abs(direction)
        if self._kinematics == "corexy":
            # The motors' speeds are limited as well as those of the axes.
            motors = np.abs(share[:, :1] + share[:, 1:2] * np.array([1.0, -1.0]))
            share[:, :2] = np.maximum(share[:, :2], motors)
        xy = np.any(travel[:, :2] != 0.0, axis=1)
        prints = xy & (travel[:, 3] > 0.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            accel = np.min(np.where(share > 0.0, own[:, 0:4] / share, np.inf), axis=1)
            limit = np.min(np.where(share > 0.0, own[:, 4:8] / share, np.inf), axis=1)
            step = np.abs(np.diff(direction, axis=0))
            allowed = np.where(step > 0.0, own[1:, 11:15] / step, np.inf)
        accel = np.where(xy, np.minimum(accel, np.where(prints, own[:, 9], own[:, 10])), accel)
        junction = np.append(0.0, np.min(allowed, axis=1))
        # Under policy 0 nothing runs on between moves of different kind.
        kind = xy + 2 * prints + 4 * ((travel[:, 3] != 0.0) & ~prints)
        meets = np.append(False, kind[1:] != kind[:-1])
        junction[meets & (own[:, 19] == 0.0)] = 0.0
        return MoveLimits(length, accel, limit, junction)

    def _check_rate(self, phases: Phases, piece: Piece) -> None:
        """Refuse segments that come faster than the firmware's queue can handle."""
        half, least = self._half_ring, self._half_ring_s
        lasts = phases.lasts_s
        if len(lasts) <= half:
            return
        total = np.cumsum(np.append(0.0, lasts))
        spans = total[half:] - total[:-half]
        if spans.min() < least:
            raise GcodeError(
                f"{half} segments would last {1e3 * spans.min():.0f} ms, less than the "
                f"{1e3 * least:.0f} ms that the queue of {self._firmware.ring_length} moves needs; "
                "a longer queue (M595 P, firmware.ring_length) or a larger tolerance would do",
                line=int(piece.moves.line[0]),
            )


def _apart(
    segments: Segments,
    crowded: NDArray[np.bool_],
    begin_s: NDArray[np.float64],
    least_s: NDArray[np.float64],
) -> Segments:
    """Return segments without crowded ends that come too soon after the one before."""
    keep = np.ones(len(segments), np.bool_)
    keep_apart(segments.end_s, crowded, segments.final, begin_s, least_s, keep)
    return replace(
        segments,
        end_s=segments.end_s[keep],
        end_mm=segments.end_mm[:, keep],
        group=segments.group[keep],
    )


def _behind_mm(moves: Interleaved, phases: Phases) -> float:
    """Return by how much the largest lag, or lead, of a stretch exceeds what is borne, or 0."""
    places_mm = moves.places_mm()
    speed_mm_s = np.hypot(*np.diff(places_mm[:, :2], axis=0).T) / np.maximum(moves.planned_s, 1e-6)
    borne_mm = np.where(np.diff(places_mm[:, 3]) > 0.0, _BEHIND_MM, _TRAVEL_BEHIND_MM)
    lag_mm = lateness_s(moves, phases) * speed_mm_s
    over_mm = np.maximum(lag_mm - borne_mm, -lag_mm - _AHEAD_MM)
    return float(np.max(np.where(moves.row < 0, over_mm, 0.0), initial=0.0))


def _starts(
    timeline: Timeline, segments: Segments
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return times, shape (n,), and positions, shape (4, n), at which segments begin."""
    fresh = np.append(True, segments.final[:-1])
    start_s = np.where(fresh, timeline.start_s[segments.group], np.roll(segments.end_s, 1))
    start_mm = np.roll(segments.end_mm, 1, axis=1)
    start_mm[:, fresh] = timeline.group_start_mm[segments.group[fresh]].T
    return start_s, start_mm


def _split_slow(timeline: Timeline, segments: Segments) -> Segments:
    """Split slow segments whose neighbours have other speeds into short equal parts."""
    if len(segments) == 0:
        return segments
    start_s, start_mm = _starts(timeline, segments)
    lasts, way_mm = segments.end_s - start_s, segments.end_mm - start_mm
    length = np.hypot(*way_mm[:2])
    change = np.abs(np.diff(length / lasts))
    change = np.maximum(np.append(change, 0.0), np.append(0.0, change))
    slow = (length > _SLOW_MM) & (length < _SLOW_MM_S * lasts) & (change * lasts > 0.1 * _SLOW_MM)
    parts = np.where(slow, np.ceil(length / _SLOW_MM), 1.0).astype(np.int64)
    if not np.any(slow):
        return segments
    of = np.repeat(np.arange(len(parts)), parts)
    number = np.arange(len(of)) - (np.cumsum(parts) - parts)[of]
    left = 1.0 - (number + 1.0) / parts[of]
    end_s = segments.end_s[of] - left * lasts[of]
    end_mm = segments.end_mm[:, of] - left * way_mm[:, of]
    return replace(segments, end_s=end_s, end_mm=end_mm, group=segments.group[of])
