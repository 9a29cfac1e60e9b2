"""Choose vertices on whole motor steps whose rounding disturbs the printer's motion least.

A place on whole steps is up to half a step off the command. The time at which the motion passes it
is free, though, so only the distance across the path matters, and of the places around a moving
command one is usually close. Where none is, errors alternate, so that the printer's response to
them cancels. Where the firmware executes only moves of some steps or more, vertices must be left
out.

The error of a segment excites the printer long after it, so a whole stretch is solved as one
shortest path (Viterbi, 1967) over times and places, each with the printer's state. Of the paths
that end at about the same time, only the best few are continued.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillpath.models.arrays import Array, Ints
from stillpath.models.jit import kernel

__all__ = [
    "MOST_PLACES",
    "Places",
    "Response",
    "Rules",
    "choose_vertices",
    "hop",
    "list_places",
    "nearly_back",
]

MOST_PLACES = 13
"""Candidate places of a vertex in slow motion; elsewhere `_PLACES`."""
_PLACES = 8
_BESIDE = 2
"""Largest distance of the former from the nearest one, in steps of X and Y together."""
_REACH = 2.0
"""Largest shift in time of a vertex, in samples."""
_WAYS = 4
"""Paths continued from a vertex."""
_LOOK_BACK, _LOOK_BACK_SLOW = 2, 4
"""Earlier vertices that a segment may come from, counted from the nearest that is far enough."""
_LONG, _LONGEST = 25.0, 1000.0
"""Samples. Segments longer than the first are tried only if there is none shorter, and longer than
the second never: the command then moves by less than 0.1 mm/s."""
_SHORT = 0.5
_NEARLY_BACK = 0.9999
_JOLT = 20.0
"""Samples. Cost of excess speed steps; large, so that they are avoided where possible."""
_GENTLE = 0.2
"""Cost, in fast motion, of a speed step beyond gentle ramps, relative to one beyond all ramps."""
_SEEN = 0.1
"""Weight of a squared error itself, relative to that of the printer's response."""
_ALONG = 0.1
"""Weight of squares along the path relative to those across it, which show on a part."""
_FAR = 1.2
"""The excess of a squared error over this, in steps of X, counts whatever its direction."""


class Places(NamedTuple):
    """Places on whole steps to choose a vertex from; the first and the last vertex have one.

    Attributes
    ----------
    place : ndarray of int64, shape (n, MOST_PLACES, 2)
    at : ndarray, shape (n, MOST_PLACES)
        When, in samples.
    counts : ndarray of int64, shape (n,)
        Number of places.
    slow : ndarray of bool, shape (n,)
        A vertex or one beside it is nearer to its neighbour than the least steps of a move.
    """

    place: Ints
    at: Array
    counts: Ints
    slow: NDArray[np.bool_]


class Rules(NamedTuple):
    """Constraints on moves.

    Attributes
    ----------
    least : int
        Least distance of vertices in steps.
    unit : ndarray, shape (2,)
        Length of a step of X and of Y, in steps of X.
    step : ndarray, shape (2,)
        By how much the step rates of X and Y (of a CoreXY's motors), in steps per sample, may step
        at a vertex; more is made to cost much.
    spare : float
        Steps within a segment that rounding may add to that.
    bend : ndarray, shape (3,)
        Acceleration in steps of X per sample^2. A step of speed is a ramp, or a bend, within the
        shorter of two segments; what does not fit is made to cost as much. Then a gentle
        acceleration, beyond which it is to cost something, too, where a motor makes more steps per
        sample than the third number.
    """

    least: int
    unit: Array
    step: Array
    spare: float
    bend: Array
    corexy: bool


class Response(NamedTuple):
    """The printer's response to an error e, for X and for Y.

    It is direct e + sum of Re(weight x), x <- pole x + e.

    Attributes
    ----------
    pole, weight : ndarray, shape (2, 2 order)
        Real and imaginary parts take turns.
    direct : ndarray, shape (2,)
    energy : ndarray, shape (2, 2 order, 2 order)
        Energy of the future response of the states, as a quadratic form of their parts.
    """

    pole: Array
    weight: Array
    direct: Array
    energy: Array


class _Search(NamedTuple):
    """The best paths to every place so far.

    Attributes
    ----------
    cost : ndarray, shape (n, MOST_PLACES)
        Cost of the best path to a place, initially infinite.
    rank : ndarray, shape (n, MOST_PLACES)
        The cost plus that of the remaining response, initially infinite.
    came : ndarray of int64, shape (n, MOST_PLACES)
        Vertex and place from which the best path comes, or -1.
    states : ndarray, shape (n, MOST_PLACES, 4 order)
        The printer's states there, X before Y.
    ways : ndarray of int64, shape (n, _WAYS)
        Places from which paths continue, the best first.
    n_ways : ndarray of int64, shape (n,)
        Their number, initially 0.
    x, kept : ndarray, shapes (4 order,) and (_WAYS,)
        Work space.
    """

    cost: Array
    rank: Array
    came: Ints
    states: Array
    ways: Ints
    n_ways: Ints
    x: Array
    kept: Array


@kernel(inline=True)
def hop(dx: Any, dy: Any, dz: Any, corexy: bool) -> Any:
    """Return the largest number of steps of a motor."""
    across = abs(dx) + abs(dy) if corexy else max(abs(dx), abs(dy))
    return max(across, abs(dz))


@kernel(inline=True)
def nearly_back(ax: float, ay: float, bx: float, by: float) -> bool:
    """Return whether move b goes straight back along the preceding move a."""
    dot = ax * bx + ay * by
    return dot < 0.0 and dot * dot >= _NEARLY_BACK**2 * (ax * ax + ay * ay) * (bx * bx + by * by)


@kernel
def list_places(
    at: Any,
    wanted: Any,
    command: Any,
    z: Any,
    least: int,
    corexy: bool,
    low: Any,
    high: Any,
    places: Places,
) -> None:
    """List for each vertex of a fit the places on whole steps to choose from, and when.

    Parameters
    ----------
    at : ndarray, shape (n,)
        Times of the start and of the vertices, in samples.
    wanted : ndarray, shape (n, 2)
        X and Y there, in steps.
    command : ndarray, shape (m, 3)
        X and Y in steps at the samples 0, 1, ...
    z : ndarray of int64, shape (n,)
    low, high : ndarray of int64, shape (2,)
        Travel of X and Y.
    places : Places
        Filled.
    """
    place, place_at, count, slow = places
    n = len(at)
    slow[:] = False
    nearest = np.round(wanted).astype(np.int64)
    for k in range(1, n):
        dx, dy = nearest[k, 0] - nearest[k - 1, 0], nearest[k, 1] - nearest[k - 1, 1]
        if hop(dx, dy, z[k] - z[k - 1], corexy) < least:
            slow[max(k - 2, 0) : k + 2] = True
    for end in (0, n - 1):
        place[end, 0] = nearest[end]
        place_at[end, 0] = at[end]
        count[end] = 1
    beside = max(1, (least + 3) // 6)
    miss = np.empty(MOST_PLACES)
    for k in range(1, n - 1):
        begin = at[k] + max(-_REACH, 0.5 * (at[k - 1] - at[k]))
        end_ = at[k] + min(_REACH, 0.5 * (at[k + 1] - at[k]))
        x, y = _at(command, end_)
        x0, y0 = _at(command, begin)
        vx, vy = (x - x0) / (end_ - begin), (y - y0) / (end_ - begin)
        got = 0
        if slow[k]:
            for i in range(-_BESIDE, _BESIDE + 1):
                for j in range(abs(i) - _BESIDE, _BESIDE - abs(i) + 1):
                    x, y = nearest[k, 0] + beside * i, nearest[k, 1] + beside * j
                    if x < low[0] or x > high[0] or y < low[1] or y > high[1]:
                        continue
                    when, _ = _passing(command, x, y, at[k], begin, end_, vx, vy)
                    place[k, got, 0], place[k, got, 1] = x, y
                    place_at[k, got] = when
                    got += 1
            count[k] = got
            continue
        # Along the way, twice a step; half of the places on either side of it.
        left = right = 0
        tries = min(int(2.0 * (end_ - begin) * np.sqrt(vx * vx + vy * vy)) + 1, 24)
        for i in range(tries + 1):
            t = begin + (end_ - begin) * i / tries
            x0, y0 = _at(command, t)
            for corner in range(4):
                x, y = int(np.floor(x0)) + corner // 2, int(np.floor(y0)) + corner % 2
                if x < low[0] or x > high[0] or y < low[1] or y > high[1]:
                    continue
                known = False
                for c in range(got):
                    known = known or (place[k, c, 0] == x and place[k, c, 1] == y)
                if known:
                    continue
                when, far = _passing(command, x, y, t, begin, end_, vx, vy)
                on_left = far >= 0.0
                to = got
                if (left if on_left else right) == _PLACES // 2:
                    worst = abs(far)
                    to = -1
                    for c in range(got):
                        if (miss[c] >= 0.0) == on_left and abs(miss[c]) > worst:
                            worst, to = abs(miss[c]), c
                    if to < 0:
                        continue
                else:
                    got += 1
                    left, right = left + int(on_left), right + int(not on_left)
                place[k, to, 0], place[k, to, 1] = x, y
                place_at[k, to], miss[to] = when, far
        count[k] = got


@kernel
def choose_vertices(
    places: Places,
    z: Any,
    command: Any,
    heading: Any,
    rules: Rules,
    response: Response,
    chosen: Any,
) -> bool:
    """Choose the vertices of a stretch and their places.

    Parameters
    ----------
    places : Places
        From `list_places`.
    z : ndarray of int64, shape (n,)
    command : ndarray, shape (m, 3)
        X and Y in steps and the filament at the samples 0, 1, ..., in lengths that count as much as
        a step of X.
    heading : ndarray, shape (m, 2)
        The path's direction there, a unit vector.
    chosen : ndarray of int64, shape (n,)
        Filled: the number of the vertex' place, -1 where it is left out.

    Returns
    -------
    bool
        False: there is no such choice.

    Notes
    -----
    No segment goes straight back along the one before it in a slow place.
    """
    n, width = len(places.place), 2 * response.pole.shape[1]
    search = _Search(
        np.full((n, MOST_PLACES), np.inf),
        np.full((n, MOST_PLACES), np.inf),
        np.full((n, MOST_PLACES), -1, np.int64),
        np.zeros((n, MOST_PLACES, width)),
        np.zeros((n, _WAYS), np.int64),
        np.zeros(n, np.int64),
        np.empty(width),
        np.empty(_WAYS),
    )
    return _follow(places, z, command, heading, rules, response, search, chosen)


@kernel(allocates=False)
def _follow(
    places: Places,
    z: Any,
    command: Any,
    heading: Any,
    rules: Rules,
    response: Response,
    search: _Search,
    chosen: Any,
) -> bool:
    """See `choose_vertices`."""
    place, place_at, count, slow = places
    least, unit, step, spare, bend, corexy = rules
    pole, weight, direct, energy = response
    cost, rank, came, states, ways, n_ways, x, kept = search
    n, order = len(place), pole.shape[1] // 2
    width, gentle = 4 * order, bend[1] / bend[0]
    cost[0, 0] = rank[0, 0] = 0.0
    n_ways[0] = 1
    for k in range(1, n):
        last = k + 1 == n
        look_back = _LOOK_BACK_SLOW if slow[k] or slow[k - 1] else _LOOK_BACK
        found = 0
        kept[:] = np.inf
        for j in range(k - 1, -1, -1):
            span = place_at[k, 0] - place_at[j, 0]
            if found > 0 and (found >= look_back or span > _LONG):
                break
            if span > _LONGEST and j + 1 < k:
                break
            alone = last and j == 0  # a stretch shorter than the firmware's least
            careful = slow[k] or slow[j]
            some = False
            for way in range(n_ways[j]):
                d = ways[j, way]
                if cost[j, d] >= kept[_WAYS - 1]:
                    some = True
                    continue
                i = came[j, d]
                from_x, from_y, begin = place[j, d, 0], place[j, d, 1], place_at[j, d]
                fed = _fed(command, begin)
                ax, ay, rate_x, rate_y, rounding, lasts = 0.0, 0.0, 0.0, 0.0, 0.0, np.inf
                if i >= 0:
                    h, b = i // MOST_PLACES, i % MOST_PLACES
                    ax, ay = float(from_x - place[h, b, 0]), float(from_y - place[h, b, 1])
                    lasts = begin - place_at[h, b]
                    rounding = 1.0 / lasts
                    rate_x, rate_y = ax * rounding, ay * rounding
                for c in range(count[k]):
                    bx, by = float(place[k, c, 0] - from_x), float(place[k, c, 1] - from_y)
                    span = place_at[k, c] - begin
                    far = alone or hop(bx, by, z[k] - z[j], corexy) >= least
                    if span < _SHORT or not far:
                        continue
                    # Skip paths that would not be continued.
                    total, most = cost[j, d], min(rank[k, c], kept[_WAYS - 1])
                    if total >= most:
                        some = True
                        continue
                    if careful and nearly_back(ax, ay, bx, by):
                        continue
                    some = True
                    per = 1.0 / span
                    jump = spare * (per + rounding)
                    dx, dy = bx * per - rate_x, by * per - rate_y
                    total += _jolt(dx, dy, jump, step, corexy)
                    # From standstill, the mean speed of a ramp is half its final speed.
                    room = bend[0] * (min(span, lasts) if i >= 0 else 0.5 * span)
                    total += _crowded(dx * unit[0], dy * unit[1], room)
                    if gentle < 1.0 and _fastest(bx, by, rate_x, rate_y, per, corexy) > bend[2]:
                        most_gentle = gentle * room
                        total += _GENTLE * _crowded(dx * unit[0], dy * unit[1], most_gentle)
                    if last:
                        total += _jolt(bx * per, by * per, spare * per, step, corexy)
                        total += _crowded(
                            bx * per * unit[0], by * per * unit[1], 0.5 * bend[0] * span
                        )
                    for q in range(width):
                        x[q] = states[j, d, q]
                    s = int(np.ceil(begin + 1e-6))
                    end = min(int(np.floor(place_at[k, c] + 1e-6)), len(command) - 1)
                    fed_per = (_fed(command, place_at[k, c]) - fed) * per
                    while s <= end and total < most:
                        t = s - begin
                        response_along = error_along = square = 0.0
                        for axis in range(2):
                            start, leg = (from_x, bx) if axis == 0 else (from_y, by)
                            error = start + leg * per * t - command[s, axis]
                            said = direct[axis] * error
                            for r in range(0, 2 * order, 2):
                                q = 2 * order * axis + r
                                re, im = x[q], x[q + 1]
                                said += weight[axis, r] * re - weight[axis, r + 1] * im
                                x[q] = pole[axis, r] * re - pole[axis, r + 1] * im + error
                                x[q + 1] = pole[axis, r] * im + pole[axis, r + 1] * re
                            said, error = said * unit[axis], error * unit[axis]
                            total += said * said + _SEEN * error * error
                            square += error * error
                            response_along += heading[s, axis] * said
                            error_along += heading[s, axis] * error
                        along = response_along * response_along + _SEEN * error_along * error_along
                        total += max(square - _FAR, 0.0) - (1.0 - _ALONG) * along
                        gap = fed + fed_per * t - command[s, 2]
                        total += gap * gap
                        s += 1
                    later = 0.0
                    if total < most:
                        for axis in range(2):
                            square = 0.0
                            for r in range(2 * order):
                                part = 0.0
                                for q in range(2 * order):
                                    part += energy[axis, r, q] * x[2 * order * axis + q]
                                square += part * x[2 * order * axis + r]
                            counts = 1.0 - (1.0 - _ALONG) * heading[end, axis] ** 2
                            later += counts * unit[axis] ** 2 * square
                    if total + later < most:
                        _keep(kept, rank[k, c], total + later)
                        cost[k, c], rank[k, c] = total, total + later
                        came[k, c] = j * MOST_PLACES + d
                        for q in range(width):
                            states[k, c, q] = x[q]
            found += int(some)
        # The best path first, so that the others of a vertex are rejected early.
        for way in range(_WAYS):
            best = -1
            for c in range(count[k]):
                taken = False
                for w_ in range(way):
                    taken = taken or ways[k, w_] == c
                if not taken and rank[k, c] < np.inf and (best < 0 or rank[k, c] < rank[k, best]):
                    best = c
            if best < 0:
                break
            ways[k, way] = best
            n_ways[k] = way + 1
    if n_ways[n - 1] == 0:
        return False
    chosen[:] = -1
    k, c = n - 1, 0
    while k > 0:
        chosen[k] = c
        before = came[k, c]
        k, c = before // MOST_PLACES, before % MOST_PLACES
    chosen[0] = 0
    return True


@kernel(inline=True)
def _keep(kept: Any, old: float, new: float) -> None:
    """Replace an older, larger rank, or the largest one; ranks stay sorted."""
    at = len(kept) - 1
    for i in range(len(kept)):
        if kept[i] == old:
            at = i
            break
    while at > 0 and kept[at - 1] > new:
        kept[at] = kept[at - 1]
        at -= 1
    kept[at] = new


@kernel(inline=True)
def _jolt(dx: float, dy: float, rounding: float, most: Any, corexy: bool) -> float:
    """Cost of a step of speed, steps per sample, that is larger than a motor takes."""
    dx, dy = abs(dx), abs(dy)
    if corexy:
        dx = dy = dx + dy
        rounding *= 2.0
    excess = max(dx - most[0], dy - most[1]) - rounding
    return (_JOLT * excess) ** 2 if excess > 0.0 else 0.0


@kernel(inline=True)
def _crowded(dx: float, dy: float, most: float) -> float:
    """Cost of a speed step, in steps of X per sample, for which there is too little time."""
    excess = np.sqrt(dx * dx + dy * dy) - most
    return (_JOLT * excess) ** 2 if excess > 0.0 else 0.0


@kernel(inline=True)
def _fastest(bx: float, by: float, rx: float, ry: float, per: float, corexy: bool) -> float:
    """Largest step rate of a motor in a segment and in the one before it."""
    bx, by, rx, ry = abs(bx) * per, abs(by) * per, abs(rx), abs(ry)
    return max(bx + by, rx + ry) if corexy else max(bx, by, rx, ry)


@kernel(inline=True)
def _at(command: Any, t: float) -> tuple[float, float]:
    """Interpolate X and Y between samples."""
    k = min(max(int(t), 0), len(command) - 2)
    w = t - k
    return (
        command[k, 0] + w * (command[k + 1, 0] - command[k, 0]),
        command[k, 1] + w * (command[k + 1, 1] - command[k, 1]),
    )


@kernel(inline=True)
def _fed(command: Any, t: float) -> float:
    """Interpolate the filament between samples."""
    k = min(max(int(t), 0), len(command) - 2)
    return float(command[k, 2] + (t - k) * (command[k + 1, 2] - command[k, 2]))


@kernel(inline=True)
def _passing(
    command: Any, x: float, y: float, t: float, begin: float, end: float, vx: float, vy: float
) -> tuple[float, float]:
    """When the command, about v at t, is nearest to a place; how far, to the left above 0."""
    square = vx * vx + vy * vy
    x0, y0 = _at(command, t)
    # In very slow motion, the nearest time is meaningless.
    if square > 0.0025:
        t = min(max(t + ((x - x0) * vx + (y - y0) * vy) / square, begin), end)
    x0, y0 = _at(command, t)
    far = np.sqrt((x - x0) ** 2 + (y - y0) ** 2)
    return t, far if vx * (y - y0) - vy * (x - x0) >= 0.0 else -far
