"""Place the steps of Z in a stream that climbs, as in a vase.

The firmware moves Z by whole steps: one block climbs by a step, its neighbours do not. Junction
deviation treats that as a corner at Z's acceleration; the blocks on both sides are not slowed if
each lasts as long as Z needs for a step, sqrt(step / acceleration): 3.5 ms at 2.5 um and 200 mm/s2.
With classic jerk, Z's speed step is within its jerk if the climbing block lasts step / jerk. Every
step is therefore put where moves are longest, within a step of its ideal place, and moves that are
too short there are merged (`planner.cpp`, `_populate_block`; 2.0.8, 2.1.2.5).
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from stillpath.gcode.firmware.marlin.limits import MarlinLimits
from stillpath.gcode.segments import Segments
from stillpath.gcode.timeline import Timeline

__all__ = ["climb_in_long_moves"]

_DIP_STEPS = 0.5
"""Steps of Z by which the fit of a climb may descend."""
_SHARE, _WHOLE_MM_S2 = 0.7, 12_000.0
"""Moves with this share of the time that Z needs are kept, as merging would cost more, unless the
stream accelerates less: then the time lost where Z slows a move is not made up for any more."""


def climb_in_long_moves(
    segments: Segments,
    timeline: Timeline,
    per_mm: float,
    limits: MarlinLimits,
    *,
    classic_jerk: bool,
) -> Segments:
    """Put the steps of Z where moves are long.

    Parameters
    ----------
    segments : Segments
        Those that are to be written, with X and Y on whole steps.
    per_mm : float
        Steps of Z.

    Returns
    -------
    Segments
        Unchanged: stretches that climb by no step, or up and down, and last vertices.
    """
    weak = min(limits.accel_x_mm_s2, limits.accel_y_mm_s2) < _WHOLE_MM_S2
    share = 1.0 if weak else _SHARE
    if classic_jerk:
        least_s = share / (per_mm * limits.jerk_z_mm_s), 0.0
    else:
        least_s = (share / (per_mm * limits.accel_z_mm_s2) ** 0.5,) * 2
    z_mm, keep = segments.end_mm[2].copy(), np.ones(len(segments), np.bool_)
    for group, rows in segments.stretches():
        takes_s = np.diff(np.append(timeline.start_s[group], segments.end_s[rows]))
        wish = per_mm * np.append(timeline.group_start_mm[group, 2], z_mm[rows])
        up = 1.0 if wish[-1] >= wish[0] else -1.0
        climbs = _climbs(up * wish, takes_s)
        if climbs is not None:
            z_mm[rows][:-1] = (np.round(wish[0]) + up * np.cumsum(climbs)[:-1]) / per_mm
            keep[rows] = _joined(climbs, takes_s, *least_s)
    end_mm = np.vstack([segments.end_mm[:2], z_mm, segments.end_mm[3]])
    return Segments(segments.end_s[keep], end_mm[:, keep], segments.group[keep])


def _climbs(wish: NDArray[np.float64], takes_s: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return how many steps each move climbs; None: it is no climb."""
    begin = np.round(wish[0])
    rise = int(np.round(wish[-1]) - begin)
    highest = np.maximum.accumulate(wish)
    if rise <= 0 or np.any(highest - wish > _DIP_STEPS):
        return None
    # Speed changes where the move begins that climbs, and where the next one does.
    room_s = np.minimum(takes_s, np.append(takes_s[1:], np.inf))
    middle = 0.5 * (highest[1:] + highest[:-1]) - begin
    step = np.clip(np.floor(middle), 0, rise - 1).astype(np.int64)
    order = np.lexsort((room_s, step))
    longest = order[np.append(np.diff(step[order]) > 0, True)]
    # In a steep climb, a step that has no move is made with the next one.
    climbs = np.zeros(len(takes_s))
    climbs[longest] = np.diff(step[longest], prepend=-1)
    return climbs


def _joined(
    climbs: NDArray[np.float64], takes_s: NDArray[np.float64], least_s: float, next_s: float
) -> NDArray[np.bool_]:
    """Return which vertices stay, where moves that climb and the next ones are made long enough."""
    keep = np.ones(len(takes_s), np.bool_)
    before = -1
    for move, stop in pairwise((*np.flatnonzero(climbs).tolist(), len(takes_s))):
        first = last = move
        whole_s = takes_s[move]
        while whole_s < least_s:
            beside = [k for k in (first - 1, last + 1) if before < k < stop]
            if not beside:
                break
            shorter = min(beside, key=takes_s.__getitem__)
            keep[first - 1 if shorter < first else last] = False
            first, last = min(first, shorter), max(last, shorter)
            whole_s += takes_s[shorter]
        before = last
        whole_s = 0.0
        for after in range(last + 1, stop - 1):
            whole_s += takes_s[after]
            if whole_s >= next_s:
                break
            keep[after] = False
    return keep
