"""Kernels of the Marlin encoder: vertices on whole steps, and step rates that end on time."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillpath.gcode.firmware._vertex_kernels import hop
from stillpath.gcode.firmware._writing_kernels import printed_feedrate
from stillpath.gcode.firmware.marlin._planner_kernels import parts_of_a_step
from stillpath.models.arrays import Array
from stillpath.models.jit import kernel

__all__ = ["Blocks", "assign_rates", "bend_reversals", "spread_advance", "thin"]

RUSH, RUSH_MM_S = 1.25, 10.0
"""Largest speed of a segment, as a factor of its planned one plus a constant: lost time is made up
over several segments, not by a jerk."""
_NEARLY_BACK = 0.9999


@kernel
def thin(
    steps: Any,
    begin: Any,
    end_s: Any,
    start_s: Any,
    group: Any,
    least: int,
    room: Any,
    rate: float,
    burst: float,
    corexy: bool,
    keep: Any,
) -> None:
    """Choose vertices at least `least` steps apart, and no more than the link can deliver.

    Lines arrive at `rate` per second; faster bursts use up to `burst` blocks of the queue, which
    refills afterwards.

    Parameters
    ----------
    steps : ndarray of int64, shape (n, 3)
        X Y Z of the vertices in whole steps.
    begin : ndarray of int64, shape (groups, 3)
        Where each group starts.
    end_s, group : ndarray, shape (n,)
    start_s : ndarray, shape (groups,)
        When each group starts.
    room : ndarray, shape (n,)
        Steps that a vertex should be from the one before, if more than `least`.
    keep : ndarray of bool, shape (n,)
        Filled. A vertex that is left out gives its time and filament to the next; the last of a
        stretch is always kept, and the ones before it go where it would be too near.
    """
    count = len(end_s)
    stock = burst
    i = 0
    while i < count:
        g = group[i]
        stop = i
        while stop < count and group[stop] == g:
            stop += 1
        last = -1
        for k in range(i, stop - 1):
            before_s = end_s[k - 1] if k > i else start_s[g]
            stock = min(stock + rate * (end_s[k] - before_s), burst)
            hop_steps = _hop(steps[k], steps[last] if last >= 0 else begin[g], corexy)
            far = hop_steps >= max(least, room[k])
            keep[k] = far and stock >= 1.0
            if keep[k]:
                stock -= 1.0
                last = k
        end = stop - 1
        keep[end] = True
        while last >= i:
            if _hop(steps[end], steps[last], corexy) >= least:
                break
            keep[last] = False
            last -= 1
            while last >= i and not keep[last]:
                last -= 1
        i = stop


@kernel
def bend_reversals(steps: Any, begin: Any, group: Any, wish: Any, least: int, corexy: bool) -> None:
    """Avoid exact reversals at vertices: with junction deviation the releases would stop there.

    They restart at 120 steps/s, so the first step takes 1/120 s. A sideways step at the next vertex
    avoids that, towards its intended position, or away from it where the move would otherwise have
    fewer than `least` steps and be swallowed.

    Parameters
    ----------
    steps : ndarray of int64, shape (n, 3)
        Vertices in whole steps; X and Y are edited in place.
    begin : ndarray of int64, shape (groups, 3)
    group : ndarray of int64, shape (n,)
    wish : ndarray, shape (n, 2)
        Where the vertices were meant to be, X Y in steps.
    """
    count = len(group)
    # The last two different places before vertex k; a vertex where nothing moves is no block.
    far_x, far_y, near_x, near_y, near = 0, 0, 0, 0, -1
    known = 0
    for k in range(count):
        if k == 0 or group[k] != group[k - 1]:
            near_x, near_y, near, known = begin[group[k], 0], begin[group[k], 1], -1, 1
        final = k + 1 == count or group[k + 1] != group[k]
        for _ in range(2):
            bx, by = float(steps[k, 0] - near_x), float(steps[k, 1] - near_y)
            ax, ay = float(near_x - far_x), float(near_y - far_y)
            size = np.sqrt((ax * ax + ay * ay) * (bx * bx + by * by))
            if known < 2 or size == 0.0 or ax * bx + ay * by > -_NEARLY_BACK * size:
                break
            at = near if final and near >= 0 else k
            axis = 1 if abs(bx) >= abs(by) else 0
            aside = 1 if wish[at, axis] >= steps[at, axis] else -1
            steps[at, axis] += aside
            if least > 1 and not _far_enough(steps, begin, group, at, least, corexy):
                steps[at, axis] -= 2 * aside
                if not _far_enough(steps, begin, group, at, least, corexy):
                    steps[at, axis] += aside
            near_x, near_y = (steps[at, 0], steps[at, 1]) if at == near else (near_x, near_y)
        if steps[k, 0] != near_x or steps[k, 1] != near_y:
            far_x, far_y = near_x, near_y
            near_x, near_y, near = steps[k, 0], steps[k, 1], k
            known += 1


@kernel
def spread_advance(
    wanted_mm: Any,
    keeps: Any,
    fastest_mm_s: Any,
    end_s: Any,
    group: Any,
    start_s: Any,
    lead_mm: Any,
) -> None:
    """Compute the lead of the filament at each end: as wanted, within the extruder's speed.

    Parameters
    ----------
    wanted_mm : ndarray, shape (n,)
        K times the feed.
    keeps : ndarray of bool, shape (n,)
        Moves that do not print leave it as it is, as the firmware does.
    fastest_mm_s, end_s, group : ndarray, shape (n,)
    start_s : ndarray, shape (groups,)
        When each group starts.
    lead_mm : ndarray, shape (n,)
        Output. A stretch begins and ends without lead.
    """
    count = len(end_s)
    now = before_s = 0.0
    for i in range(count):
        if i == 0 or group[i] != group[i - 1]:
            now, before_s = 0.0, start_s[group[i]]
        if not keeps[i]:
            most = fastest_mm_s[i] * max(end_s[i] - before_s, 0.0)
            now += min(max(wanted_mm[i] - now, -most), most)
        lead_mm[i] = now
        before_s = end_s[i]
    for i in range(count - 1, -1, -1):
        if i + 1 == count or group[i + 1] != group[i]:
            lead_mm[i] = 0.0
        else:
            most = fastest_mm_s[i + 1] * max(end_s[i + 1] - end_s[i], 0.0)
            lead_mm[i] = min(lead_mm[i], lead_mm[i + 1] + most)


@kernel
def _far_enough(steps: Any, begin: Any, group: Any, k: int, least: int, corexy: bool) -> bool:
    """Return whether a vertex is at least `least` steps from both neighbours."""
    first = k == 0 or group[k - 1] != group[k]
    before = begin[group[k]] if first else steps[k - 1]
    if _hop(steps[k], before, corexy) < least:
        return False
    final = k + 1 == len(group) or group[k + 1] != group[k]
    return final or _hop(steps[k + 1], steps[k], corexy) >= least


@kernel(inline=True)
def _hop(a: Any, b: Any, corexy: bool) -> Any:
    return hop(a[0] - b[0], a[1] - b[1], a[2] - b[2], corexy)


class Blocks(NamedTuple):
    """Moves as the planner makes blocks of them; arrays of shape (n,).

    Attributes
    ----------
    ours : ndarray of bool
        Segments of the stream; the others are the rests' own moves.
    steps, path_mm : ndarray
        Step events and length; 0 steps: the firmware swallows the move.
    end_s, planned_s : ndarray
        When a segment is to end, and how long it is to last.
    fastest_mm_s : ndarray
    at_once_mm_s : ndarray
        Speed that a segment may begin with whatever came before it (classic jerk), or 0.
    """

    ours: NDArray[np.bool_]
    steps: Array
    path_mm: Array
    end_s: Array
    planned_s: Array
    fastest_mm_s: Array
    at_once_mm_s: Array


@kernel
def assign_rates(
    blocks: Blocks,
    foreign_s: Array,
    correction_s: Array,
    first_steps: float,
    timer_hz: float,
    smoothing_hz: float,
    least_hz: float,
    first_share: float,
    start_s: float,
    feedrate: Array,
    predicted_s: Array,
) -> None:
    """Compute feedrates (mm/min, as printed) that reach every end on time.

    The firmware rounds the step rate up and the time of a step down to ticks; a block that starts
    at the slower speed of the one before loses part of a step (2.1) or of two (2.0). Gains and
    losses are carried over to the next segment.

    Parameters
    ----------
    foreign_s : ndarray, shape (n,)
        How long moves that are not ours take.
    correction_s : ndarray, shape (n,)
        Extra time of a block over this formula.
    first_steps : float
        Steps that have the time of a block's first one, at the speed of the block before.
    timer_hz, smoothing_hz : float
        Of the step timer; rate up to which parts of a step are timed, each in whole ticks.
    least_hz : float
        Lowest step rate; the difference to slower motion or standstill is carried over too.
    first_share : float
        Share of its time in which a stretch's first segment would be over at the rate that it gets.
    feedrate, predicted_s : ndarray, shape (n,)
        Filled.
    """
    ours, steps, path_mm, end_s, planned_s, fastest_mm_s, at_once_mm_s = blocks
    now = start_s
    before = 0.0
    late = 0.0
    for i in range(len(steps)):
        if not ours[i]:
            predicted_s[i] = foreign_s[i]
            now += foreign_s[i]
            before = 0.0
            continue
        first = i == 0 or not ours[i - 1]
        if first:
            # The stretch starts when its rest is over.
            late = now + planned_s[i] - end_s[i]
        if steps[i] == 0.0:
            feedrate[i] = printed_feedrate(60.0 * fastest_mm_s[i])
            predicted_s[i] = 0.0
            continue
        n, path = steps[i], path_mm[i]
        per_mm = n / path
        # Where it cannot keep up it may run after for a while, but must not fall to pieces.
        wanted = end_s[i] + late - now - correction_s[i]
        if first:
            # The first step from rest takes up to 1/120 s: the stretch begins after it.
            wanted = first_share * planned_s[i]
        hurried = RUSH * path / planned_s[i] + RUSH_MM_S
        least = path / min(fastest_mm_s[i], hurried)
        available = max(wanted, least)
        # The next one may begin at this one's slower speed: the share of a step that this takes is
        # time that the rest of this block does not have.
        slow_steps, slow_s = 0.0, 0.0
        if i + 1 < len(steps) and ours[i + 1] and steps[i + 1] > 0.0:
            v_next = path_mm[i + 1] / planned_s[i + 1]
            next_per_mm = steps[i + 1] / path_mm[i + 1]
            at_once = min(at_once_mm_s[i + 1], v_next)
            if v_next * available > path:
                slow_s = first_steps / (v_next * next_per_mm)
                if at_once * available > path:
                    slow_s -= first_steps / (at_once * next_per_mm)
                else:
                    slow_steps = first_steps * per_mm / next_per_mm
        rate = n / available
        ticks = 0.0
        lost = 0.0
        timer = timer_hz
        for _ in range(3):
            fine = parts_of_a_step(rate, smoothing_hz)
            timer = timer_hz / fine
            free = max(available - lost, least)
            if slow_s != 0.0:
                free = max((free + slow_s / fine) / (1.0 + slow_steps / (n * fine)), 0.5 * free)
            ticks = max(np.round(timer * free / n), 1.0)
            ticks = min(ticks, np.floor(timer / least_hz))
            # Of the rates that give these ticks, the one nearest to the intended rate.
            lowest, highest = np.floor(timer / (ticks + 1.0)) + 1.0, np.floor(timer / ticks)
            rate = min(max(np.ceil(n / free), lowest), highest)
            lost = 0.0
            entry = min(max(before, at_once_mm_s[i]), rate / per_mm)
            if before > 0.0 and entry * per_mm < rate - 1.0:
                slower = np.floor(timer / np.ceil(entry * per_mm)) - ticks
                lost = min(first_steps / fine, n) * slower / timer
        # Half a step per second below: the firmware rounds up.
        feedrate[i] = printed_feedrate(60.0 * max(rate - 0.5, 0.5 * rate) / per_mm)
        rate = np.ceil(feedrate[i] / 60.0 * per_mm - 1e-6)
        ticks = np.floor(timer / rate)
        predicted_s[i] = n * ticks / timer + lost + correction_s[i]
        now += predicted_s[i]
        if first:
            late += predicted_s[i] - planned_s[i]
        before = rate / per_mm
