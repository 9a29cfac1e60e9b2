"""From a compensated command to the G1 lines that make Klipper execute it.

Klipper re-plans every line. Under limits far above the motion's own the re-planned motion is the
written one but for small losses at speed steps; these are predicted by their law, taken off the
feedrate, and what the law misses is measured with the firmware's own planner and corrected in a
second pass (docs/emission.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gcode.firmware.klipper._encoder_kernels import assign_speeds, merge_still
from gcode.firmware.klipper.planner import plan_moves
from gcode.pieces import Piece
from gcode.segments import Segments
from gcode.timeline import Group, Timeline
from gcode.types import Limits, Moves, Phases
from models.machine import Klipper, Machine

__all__ = ["Encoded", "KlipperEncoder"]

STREAM_ACCEL_MM_S2 = 300_000.0
"""The acceleration that the stream runs under: high enough for the losses to be small, low enough
that a command of somebody else that slips in is no disaster (docs/emission.md)."""
STREAM_CORNER_MM_S = 500.0

_UNITS_PER_MM = 1e6
_PASSES = 4
_TIME_TOLERANCE_S = 2e-6


@dataclass(frozen=True, slots=True)
class Encoded:
    """A piece as it will be written.

    Attributes
    ----------
    position : ndarray of int64, shape (n, 4)
        End of every move in 1e-6 mm: our segments and the rests' own moves, in order.
    begin : ndarray of int64, shape (4,)
    row : ndarray of int64, shape (n,)
        Row of the piece for a rest's own move, -1 for a segment of ours.
    feedrate_mm_min : ndarray, shape (n,)
    start_s : ndarray, shape (n,)
        When each move begins, counted as on the timeline.
    group_start_s : ndarray, shape (groups,)
        When each group begins; rests move the groups behind them a little.
    row_start_s : ndarray, shape (rows of the piece,)
        When each original move begins on the timeline.
    rest_s : ndarray, shape (groups,)
        How long each rest takes.
    phases : Phases
        The firmware's plan of the moves.
    """

    position: NDArray[np.int64]
    begin: NDArray[np.int64]
    row: NDArray[np.int64]
    feedrate_mm_min: NDArray[np.float64]
    start_s: NDArray[np.float64]
    group_start_s: NDArray[np.float64]
    row_start_s: NDArray[np.float64]
    rest_s: NDArray[np.float64]
    phases: Phases


class KlipperEncoder:
    """Encode pieces for one machine.

    Parameters
    ----------
    machine : Machine
    decimals : int
        Decimals of X, Y and Z; the last point of every stretch keeps all the file's digits.
    """

    def __init__(self, machine: Machine, *, decimals: int = 3) -> None:
        self._firmware: Klipper = machine.firmware
        self._grid = 10 ** (6 - decimals)
        self._velocity = machine.command.velocity_mm_s
        self.limits = Limits(
            velocity_mm_s=self._velocity,
            accel_mm_s2=STREAM_ACCEL_MM_S2,
            square_corner_velocity_mm_s=STREAM_CORNER_MM_S,
            minimum_cruise_ratio=0.0,
        )

    def rest_durations(self, piece: Piece, timeline_groups: Sequence[Group]) -> NDArray[np.float64]:
        """First guess of the rests' durations: their own moves between stretches of the stream."""
        rows = np.full(len(piece.moves), -1)
        for group in timeline_groups:
            if group.rest:
                rows[group.first : group.last] = np.arange(group.first, group.last)
        moves = piece.moves
        limits = self._limits_of(piece, rows)
        phases = self._plan(moves.start_mm, moves.end_mm, moves.speed_mm_s, *limits)
        return _group_durations(phases, timeline_groups)

    def encode(self, piece: Piece, timeline: Timeline, segments: Segments) -> Encoded:
        """Choose rounded positions and feedrates for the segments of a piece.

        Raises
        ------
        GcodeError
            When the firmware would refuse a move.
        """
        rows, position, end_s, group = self._interleave(piece, timeline, segments)
        begin = _integers(piece.phases.start_mm[0])
        start = np.concatenate([begin[None], position[:-1]])
        start_mm, end_mm = start / _UNITS_PER_MM, position / _UNITS_PER_MM
        ours = rows < 0
        limits_id, limits = self._limits_of(piece, rows)
        length, accel, limit, junction, stops = self._motion(start_mm, end_mm, limits_id, limits)
        speed = np.where(ours, limit, np.minimum(limit, piece.moves.speed_mm_s[rows]))

        same = np.append(False, group[1:] == group[:-1])
        planned_s = end_s - np.where(same, np.append(0.0, end_s[:-1]), timeline.start_s[group])
        correction = np.zeros(len(rows))
        feedrate, predicted = np.zeros(len(rows)), np.zeros(len(rows))
        for _ in range(_PASSES):
            assign_speeds(
                ours,
                stops,
                length,
                end_s,
                planned_s,
                speed,
                accel,
                junction,
                correction,
                float(timeline.start_s[0]),
                feedrate,
                predicted,
            )
            chosen = np.where(ours, feedrate / 60.0, speed)
            phases = self._plan(start_mm, end_mm, chosen, limits_id, limits)
            actual = phases.accel_s + phases.cruise_s + phases.decel_s
            miss = actual - predicted
            if np.max(np.abs(np.cumsum(miss))) < _TIME_TOLERANCE_S:
                break
            correction += miss
        rest_s = np.zeros(len(timeline.groups))
        np.add.at(rest_s, group[~ours], actual[~ours])
        start_s = timeline.start_s[0] + phases.t_s
        group_start_s = _group_starts(timeline, group, start_s, actual)
        return Encoded(
            position=position,
            begin=begin,
            row=rows,
            feedrate_mm_min=feedrate,
            start_s=start_s,
            group_start_s=group_start_s,
            row_start_s=_moved_rows(timeline, group_start_s),
            rest_s=rest_s,
            phases=phases,
        )

    def _interleave(
        self, piece: Piece, timeline: Timeline, segments: Segments
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64], NDArray[np.int64]]:
        """Round the segments and put the rests' own moves between them."""
        groups = timeline.groups
        position = _integers(segments.end_mm.T)
        grid = self._grid
        final = np.append(segments.group[1:] != segments.group[:-1], True)
        position[~final, :3] = grid * np.round(position[~final, :3] / grid).astype(np.int64)
        begins = _integers(timeline.group_start_mm)
        end_s, keep = segments.end_s.copy(), np.ones(len(segments), dtype=bool)
        merge_still(position, end_s, segments.group, begins, keep)

        rests = [np.arange(g.first, g.last) for g in groups if g.rest]
        rest_rows = np.concatenate(rests) if rests else np.zeros(0, np.int64)
        rest_group = np.concatenate(
            [np.full(g.last - g.first, i) for i, g in enumerate(groups) if g.rest]
            or [np.zeros(0, np.int64)]
        )
        phases = piece.phases
        following = np.minimum(rest_rows + 1, len(phases) - 1)
        rest_position = _integers(phases.start_mm[following])
        rows = np.concatenate([np.full(int(keep.sum()), -1), rest_rows])
        group = np.concatenate([segments.group[keep], rest_group])
        order = np.argsort(group, kind="stable")
        return (
            rows[order],
            np.concatenate([position[keep], rest_position])[order],
            np.concatenate([end_s[keep], np.zeros(len(rest_rows))])[order],
            group[order],
        )

    def _limits_of(
        self, piece: Piece, rows: NDArray[np.int64]
    ) -> tuple[NDArray[np.int32], list[Limits]]:
        """Limits in force at every move: the stream's, or the file's own in a rest."""
        own = rows >= 0
        used, found = np.unique(piece.moves.limits_id[rows[own]], return_inverse=True)
        limits_id = np.zeros(len(rows), np.int32)
        limits_id[own] = 1 + found
        return limits_id, [self.limits, *(piece.limits[i] for i in used)]

    def _motion(
        self,
        start_mm: NDArray[np.float64],
        end_mm: NDArray[np.float64],
        limits_id: NDArray[np.int32],
        limits: Sequence[Limits],
    ) -> tuple[
        NDArray[np.float64],
        NDArray[np.float64],
        NDArray[np.float64],
        NDArray[np.float64],
        NDArray[np.bool_],
    ]:
        """Length, acceleration, speed and junction limit of every move, and which are E alone.

        Rules: klippy/toolhead.py, klippy/kinematics/extruder.py, 2026-08.
        """
        firmware = self._firmware
        planner, extruder = firmware.planner, firmware.extruder
        travel = end_mm - start_mm
        length = np.sqrt(np.sum(travel[:, :3] ** 2, axis=1))
        stops = length == 0.0
        length = np.where(stops, np.abs(travel[:, 3]), length)
        safe = np.where(length > 0.0, length, 1.0)
        climb = np.abs(travel[:, 2]) / safe
        ratio = travel[:, 3] / safe
        accel = np.array([x.accel_mm_s2 for x in limits])[limits_id]
        limit = np.array([x.velocity_mm_s for x in limits])[limits_id]
        corner = np.array([x.square_corner_velocity_mm_s for x in limits])[limits_id]
        with np.errstate(divide="ignore"):
            accel = np.minimum(accel, planner.max_z_accel_mm_s2 / climb)
            limit = np.minimum(limit, planner.max_z_velocity_mm_s / climb)
            alone = (travel[:, 0] == 0.0) & (travel[:, 1] == 0.0)
            pull = np.where(alone | (ratio < 0.0), np.abs(ratio), 0.0)
            accel = np.minimum(accel, extruder.max_extrude_only_accel_mm_s2 / pull)
            limit = np.minimum(limit, extruder.max_extrude_only_velocity_mm_s / pull)
            junction = np.full(len(length), np.inf)
            step = np.abs(np.diff(ratio))
            junction[1:] = extruder.instantaneous_corner_velocity_mm_s / step
            unit = travel[:, :3] / safe[:, None]
            cosine = np.clip(np.sum(unit[1:] * unit[:-1], axis=1), -1.0, 1.0)
            tangent = np.sqrt((1.0 + cosine) / np.maximum(1.0 - cosine, 1e-12))
            reach = np.minimum(length[1:] * accel[1:], length[:-1] * accel[:-1])
            junction[1:] = np.minimum(junction[1:], np.sqrt(0.5 * reach * tangent))
            half = np.sqrt(0.5 * (1.0 + cosine))
            turn = np.sqrt((np.sqrt(2.0) - 1.0) * half / np.maximum(1.0 - half, 1e-12))
            junction[1:] = np.minimum(junction[1:], turn * np.minimum(corner[1:], corner[:-1]))
        junction[0] = 0.0
        return length, accel, limit, junction, stops

    def _plan(
        self,
        start_mm: NDArray[np.float64],
        end_mm: NDArray[np.float64],
        speed_mm_s: NDArray[np.float64],
        limits_id: NDArray[np.int32],
        limits: Sequence[Limits],
    ) -> Phases:
        n = len(speed_mm_s)
        zeros, none = np.zeros(n, np.int32), np.full(n, -1, np.int32)
        count = np.arange(n, dtype=np.int64)
        moves = Moves(
            start_mm=start_mm,
            end_mm=end_mm,
            speed_mm_s=speed_mm_s,
            limits_id=limits_id,
            modal_id=zeros,
            known=np.full(n, 7, np.uint8),
            line=count + 1,
            byte_start=count,
            byte_end=count + 1,
            layer=none,
            feature=none,
            object_id=none,
        )
        return plan_moves(moves, limits, self._firmware)


def _group_durations(phases: Phases, groups: Sequence[Group]) -> NDArray[np.float64]:
    duration = phases.accel_s + phases.cruise_s + phases.decel_s
    return np.array([duration[g.first : g.last].sum() for g in groups])


def _group_starts(
    timeline: Timeline,
    group: NDArray[np.int64],
    start_s: NDArray[np.float64],
    duration_s: NDArray[np.float64],
) -> NDArray[np.float64]:
    """When each group begins; one without moves begins where the one before ends."""
    starts = np.full(len(timeline.groups), np.nan)
    first = np.append(True, group[1:] != group[:-1])
    starts[group[first]] = start_s[first]
    for i in np.flatnonzero(np.isnan(starts)):
        earlier = np.flatnonzero(group < i)
        starts[i] = timeline.start_s[0]
        if len(earlier):
            starts[i] = start_s[earlier[-1]] + duration_s[earlier[-1]]
    return starts


def _moved_rows(timeline: Timeline, group_start_s: NDArray[np.float64]) -> NDArray[np.float64]:
    shift = group_start_s - timeline.start_s
    lengths = [group.last - group.first for group in timeline.groups]
    return timeline.row_start_s + np.repeat(shift, lengths)


def _integers(position_mm: NDArray[np.float64]) -> NDArray[np.int64]:
    return np.round(position_mm * _UNITS_PER_MM).astype(np.int64)
