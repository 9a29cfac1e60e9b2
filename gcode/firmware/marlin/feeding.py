"""The filament of a stream: linear advance, and steps of E in moves that they do not slow down."""

from __future__ import annotations

from dataclasses import replace
from typing import cast

import numpy as np
from numpy.typing import NDArray

from stillpath.gcode.errors import GcodeError
from stillpath.gcode.firmware.advance import feed_at_ends
from stillpath.gcode.firmware.marlin._encoder_kernels import spread_advance
from stillpath.gcode.firmware.marlin._feed_kernels import place_steps
from stillpath.gcode.firmware.marlin.limits import MarlinLimits, advance_speed_mm_s
from stillpath.gcode.pieces import Piece
from stillpath.gcode.segments import Segments
from stillpath.gcode.timeline import Timeline
from stillpath.models.firmware import Marlin

__all__ = ["with_advance", "with_placed_steps"]

_MOST_FEED = 3.0
"""Filament per mm of path above which the firmware sees a retraction, without linear advance."""


def with_advance(
    firmware: Marlin, piece: Piece, timeline: Timeline, segments: Segments, *, whole: bool
) -> Segments:
    """Return segments with linear advance in their filament.

    The firmware's own would be lost: it acts during a block's ramps, and those of a stream last a
    fraction of a step.

    Parameters
    ----------
    whole : bool
        Put E on whole steps: where it has the most steps, times depend on its rounding, and a
        stream may start at any E.

    Raises
    ------
    GcodeError
        If linear advance would exceed the extruder's speed limit.
    """
    limits = cast(list[MarlinLimits], piece.limits)
    k_s = np.array([x.linear_advance_k_s for x in limits])
    if firmware.linear_advance is False or not np.any(k_s):
        return segments
    classic = firmware.junction == "classic_jerk"
    fastest = np.array([advance_speed_mm_s(x, classic_jerk=classic) for x in limits])
    if firmware.linear_advance is None:
        _check_advance(piece, k_s, fastest)
    row, feed_mm_s, prints = feed_at_ends(piece, timeline, segments)
    prints &= piece.phases.direction[row, 3] <= _MOST_FEED
    which = piece.moves.limits_id[row]
    end_mm, lead_mm = segments.end_mm.copy(), np.zeros(len(segments))
    spread_advance(
        k_s[which] * feed_mm_s,
        ~prints,
        fastest[which],
        segments.end_s,
        segments.group,
        timeline.start_s,
        lead_mm,
    )
    led_mm = end_mm[3] + lead_mm
    if whole:
        begin_mm = timeline.group_start_mm[segments.group, 3]
        per_mm = firmware.steps_per_mm.e
        led_mm = begin_mm + np.round((led_mm - begin_mm) * per_mm) / per_mm
    end_mm[3] = np.where(segments.final, end_mm[3], led_mm)
    return replace(segments, end_mm=end_mm)


def with_placed_steps(
    timeline: Timeline, segments: Segments, per_mm: float, accel_mm_s2: float, *, corexy: bool
) -> Segments:
    """Return segments whose vertices are on whole steps of E, where moves bear a step.

    Parameters
    ----------
    per_mm : float
        Steps of E, counted from the start of each stretch, whatever E the stream starts at.
    accel_mm_s2 : float
        Acceleration with which turns are to be passed.
    """
    end_mm = segments.end_mm.copy()
    for group, rows in segments.stretches():
        place_mm = np.vstack([timeline.group_start_mm[group], end_mm[:, rows].T])
        takes_s = np.diff(np.append(timeline.start_s[group], segments.end_s[rows]))
        way_mm = np.diff(place_mm[:, :3], axis=0)
        speed_mm_s = np.hypot(*way_mm[:, :2].T) / takes_s
        if corexy:
            way_mm[:, :2] = way_mm[:, :2] @ np.array([[1.0, 1.0], [1.0, -1.0]])
        wish = per_mm * (place_mm[:, 3] - place_mm[0, 3])
        whole = place_steps(way_mm, speed_mm_s, wish, 1.0 / per_mm, accel_mm_s2)
        end_mm[3, rows][:-1] = place_mm[0, 3] + whole[1:-1] / per_mm
    return replace(segments, end_mm=end_mm)


def _check_advance(piece: Piece, k_s: NDArray[np.float64], fastest: NDArray[np.float64]) -> None:
    """Refuse moves that the firmware, but not the plan, would slow down for linear advance."""
    limits = cast(list[MarlinLimits], piece.limits)
    own = np.array([(x.accel_x_mm_s2, x.accel_y_mm_s2, x.print_accel_mm_s2) for x in limits])
    which, direction = piece.moves.limits_id, piece.phases.direction
    xy = np.abs(direction[:, :2])
    moves = piece.phases.prints & (direction[:, 3] <= _MOST_FEED)
    largest = np.min(own[which, :2] / np.maximum(xy, 1e-9), axis=1)
    accel = np.minimum(largest, own[which, 2])
    advance = np.where(moves, k_s[which] * direction[:, 3] * accel, 0.0)
    over = advance > 1.001 * fastest[which]
    if np.any(over):
        row = int(np.argmax(over))
        raise GcodeError(
            f"linear advance (M900 K{k_s[which[row]]:g}) would drive the extruder by "
            f"{advance[row]:.1f} mm/s, more than its jerk of {fastest[which[row]]:.1f} mm/s: a "
            "firmware that has it accelerates less, which is planned where the machine says "
            "linear_advance true; for one without it say false",
            line=int(piece.moves.line[row]),
        )
