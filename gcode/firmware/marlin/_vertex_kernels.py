"""Vertices for a firmware that executes no move of fewer than some steps.

Its next move takes those steps along. Where the command is slow or turns back, the fit's vertices
lie nearer, and somebody has to choose: which of them to leave out, and where to put the others, so
that the motion leaves the command by as little as possible. Distance squared adds up over segments,
so the best choice is a shortest path (Viterbi, 1967) through every vertex at every place that is
considered for it. A way is remembered with where it came from, to judge its turns.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from models.jit import kernel

__all__ = ["choose_vertices", "hop", "nearly_back"]

_BESIDE = 2
"""A vertex is considered at its own place and up to so many strides beside it, in X and in Y."""
_LOOK_BACK = 12
"""Earlier vertices that a segment may come from, counted from the nearest that is far enough."""
_LONG_S = 0.025
_LONGEST_S = 1.0
"""Longer segments are tried only where there is none shorter, and longer ones not at all: there the
command moves by less than 0.1 mm/s."""
_NEARLY_BACK = 0.9999
_JOLT_S = 0.02
"""What makes steps of an excess of speed; large, so that there is none where that is possible."""


@kernel(inline=True)
def hop(dx: Any, dy: Any, dz: Any, corexy: bool) -> Any:
    """Count the steps of the motor that makes the most of them."""
    across = abs(dx) + abs(dy) if corexy else max(abs(dx), abs(dy))
    return max(across, abs(dz))


@kernel(inline=True)
def nearly_back(ax: float, ay: float, bx: float, by: float) -> bool:
    """Tell whether a move b goes straight back along the move a before it."""
    dot = ax * bx + ay * by
    return dot < 0.0 and dot * dot >= _NEARLY_BACK**2 * (ax * ax + ay * ay) * (bx * bx + by * by)


@kernel
def choose_vertices(
    place: Any,
    fed: Any,
    at_s: Any,
    command: Any,
    dt_s: float,
    least: int,
    y_weight: float,
    step_hz: Any,
    corexy: bool,
    keep: Any,
) -> bool:
    """Choose and move the vertices of a stretch such that all are `least` steps apart.

    Parameters
    ----------
    place : ndarray of int64, shape (n, 3)
        X Y Z in whole steps: where the stretch starts, and the fit's vertices. Those that are kept
        are edited in place; the first and the last stay.
    fed : ndarray, shape (n,)
        Filament there, in lengths that count as much as a step of X.
    at_s : ndarray, shape (n,)
    command : ndarray, shape (m, 3)
        X and Y in steps and the filament at the times 0, dt_s, ...
    y_weight : float
        What a squared step of Y counts, one of X being 1.
    step_hz : ndarray, shape (2,)
        By how much the step rates of X and Y (of a CoreXY's motors) may step at a vertex, beyond
        what rounding brings; more is made to cost much.
    keep : ndarray of bool, shape (n,)
        Filled.

    Returns
    -------
    bool
        False: there is no such choice, and nothing was done.

    Notes
    -----
    No segment goes straight back along the one before it, where vertices were moved. Vertices
    that are far enough apart anyway stay as the fit has them.
    """
    n = len(place)
    side = 2 * _BESIDE + 1
    beside = (side * side) // 2
    stride = max(1, (least + 3) // 6)
    near = _near_ones(place, least, corexy)
    cost = np.full((n, side * side), np.inf)
    came = np.full((n, side * side), -1, np.int32)
    reached = np.zeros(n, np.bool_)
    cost[0, beside], reached[0] = 0.0, True
    gap = np.empty((2, side))
    moment, origin = np.empty((3, 3)), np.empty(3)
    for k in range(1, n):
        last = k + 1 == n
        moves_k = near[k] and not last
        found = 0
        for j in range(k - 1, -1, -1):
            span_s = at_s[k] - at_s[j]
            if found > 0 and (found >= _LOOK_BACK or span_s > _LONG_S):
                break
            if found > 0 and not (near[k] or near[j + 1]):
                break
            if span_s > _LONGEST_S and j + 1 < k:
                break
            if not reached[j]:
                continue
            moves_j = near[j] and j > 0
            alone = last and j == 0  # a stretch shorter than the firmware's least
            dx, dy = place[k, 0] - place[j, 0], place[k, 1] - place[j, 1]
            dz = place[k, 2] - place[j, 2]
            slack = stride * _BESIDE * (int(moves_k) + int(moves_j))
            if not alone and hop(abs(dx) + slack, abs(dy) + slack, dz, corexy) < least:
                continue
            origin[0], origin[1], origin[2] = place[j, 0], place[j, 1], fed[j]
            u2, uw, w2 = _moments(command, origin, at_s[j], at_s[k], dt_s, moment)
            fed_gap = moment[2, 2] + (fed[k] - fed[j]) * (
                (fed[k] - fed[j]) * w2 - 2.0 * moment[2, 1]
            )
            for d in range(side * side):
                if cost[j, d] == np.inf:
                    continue
                begin = (stride * (d // side - _BESIDE), stride * (d % side - _BESIDE))
                before = came[j, d]
                ax, ay, before_s = 0.0, 0.0, 1.0
                if before >= 0 and (moves_j or moves_k):
                    i, b = before // (side * side), before % (side * side)
                    ax = float(place[j, 0] + begin[0] - place[i, 0])
                    ay = float(place[j, 1] + begin[1] - place[i, 1])
                    before_s = at_s[j] - at_s[i]
                    ax -= stride * (b // side - _BESIDE)
                    ay -= stride * (b % side - _BESIDE)
                for axis in range(2):
                    # What is squared and added is q u + p w - r, with its ends q and p.
                    q = float(begin[axis])
                    to = dx if axis == 0 else dy
                    rest = moment[axis, 2] + q * (q * u2 - 2.0 * moment[axis, 0])
                    slope = 2.0 * (q * uw - moment[axis, 1])
                    for c in range(side):
                        p = float(to + stride * (c - _BESIDE))
                        gap[axis, c] = rest + p * (slope + p * w2)
                for c in range(side * side):
                    if not moves_k and c != beside:
                        continue
                    total = cost[j, d] + fed_gap + gap[0, c // side] + y_weight * gap[1, c % side]
                    if total >= cost[k, c]:
                        continue
                    bx = dx + stride * (c // side - _BESIDE) - begin[0]
                    by = dy + stride * (c % side - _BESIDE) - begin[1]
                    if hop(bx, by, dz, corexy) < least and not alone:
                        continue
                    if ax != 0.0 or ay != 0.0:
                        if nearly_back(ax, ay, float(bx), float(by)):
                            continue
                        total += _jolt(
                            ax / before_s,
                            ay / before_s,
                            bx / span_s,
                            by / span_s,
                            1.0 / before_s + 1.0 / span_s,
                            step_hz,
                            corexy,
                        )
                        if total >= cost[k, c]:
                            continue
                    cost[k, c] = total
                    came[k, c] = j * side * side + d
                    reached[k] = True
            if reached[k]:
                found += 1
    if not reached[n - 1]:
        return False
    keep[:] = False
    k, c = n - 1, beside
    while k > 0:
        keep[k] = True
        before = came[k, c]
        place[k, 0] += stride * (c // side - _BESIDE)
        place[k, 1] += stride * (c % side - _BESIDE)
        k, c = before // (side * side), before % (side * side)
    keep[0] = True
    return True


@kernel(inline=True)
def _jolt(
    ax: float, ay: float, bx: float, by: float, rounding: float, most: Any, corexy: bool
) -> float:
    """Cost of a step of speed from a to b, steps/s, that is larger than a motor takes."""
    dx, dy = abs(bx - ax), abs(by - ay)
    if corexy:
        dx = dy = dx + dy
        rounding *= 2.0
    excess = max(dx - most[0], dy - most[1]) - rounding
    return (_JOLT_S * excess) ** 2 if excess > 0.0 else 0.0


@kernel
def _near_ones(place: Any, least: int, corexy: bool) -> Any:
    """Vertices that are too near to a neighbour, and one more on either side of them."""
    n = len(place)
    near = np.zeros(n, np.bool_)
    for k in range(1, n):
        dx, dy = place[k, 0] - place[k - 1, 0], place[k, 1] - place[k - 1, 1]
        if hop(dx, dy, place[k, 2] - place[k - 1, 2], corexy) < least:
            near[max(k - 2, 0) : k + 2] = True
    return near


@kernel(inline=True)
def _moments(
    command: Any, origin: Any, begin_s: float, end_s: float, dt_s: float, moment: Any
) -> tuple[float, float, float]:
    """Sum up over the samples of a segment: u u, u w, w w; and for each axis u r, w r, r r.

    w rises from 0 to 1, u = 1 - w, and r is the command as seen from the origin.
    """
    first = int(np.ceil(begin_s / dt_s + 1e-6))
    last = min(int(np.floor(end_s / dt_s + 1e-6)), len(command) - 1)
    u2 = uw = w2 = 0.0
    moment[:] = 0.0
    for s in range(first, last + 1):
        w = (s * dt_s - begin_s) / (end_s - begin_s)
        u = 1.0 - w
        u2 += u * u
        uw += u * w
        w2 += w * w
        for axis in range(3):
            r = command[s, axis] - origin[axis]
            moment[axis, 0] += u * r
            moment[axis, 1] += w * r
            moment[axis, 2] += r * r
    return u2, uw, w2
