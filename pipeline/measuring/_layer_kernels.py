"""Kernels that turn measured samples into points of a layer, wrapped by `layers`."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillpath.models.arrays import Array, Ints
from stillpath.models.jit import kernel

__all__ = [
    "BEND",
    "COUNT",
    "HEIGHT",
    "LAYER",
    "LINE",
    "MOVE",
    "PEN_X",
    "PEN_Y",
    "PREVIOUS_X",
    "PREVIOUS_Y",
    "SAMPLES",
    "SPARE",
    "UNKNOWN",
    "Columns",
    "Points",
    "Samples",
    "State",
    "follow",
]

PEN_X, PEN_Y, PREVIOUS_X, PREVIOUS_Y, SPARE, BEND, HEIGHT = range(7)
"""Indices of the floats of `follow`: last point, last sample, points allowed by the text so far,
angle turned since the last point, height of extrusion."""
COUNT, MOVE, SAMPLES, LAYER, LINE = range(5)
"""Indices of its integers: points of the tile, current move, samples since the last point, layer of
the tile (after a return: the next one), last line whose bytes were counted."""

UNKNOWN = 65535
_MOST = 65534
_UNITS_PER_MM = 1e4
_SHORTEST_MM, _LONGEST_MM = 0.2, 5.0
"""Least and largest distance of points along an edge."""
_CHANGE_MM, _CHANGE_SHARE = 2e-3, 0.5
"""A stretch ends where the error changes by more than both this and this share of its maximum."""
_SAGITTA_MM, _TURN = 0.02, 0.35
"""Chords of an arc form one stretch while it stays this straight."""
_SAME_HEIGHT_MM = 0.04


class Samples(NamedTuple):
    """Measured motion: positions, heights, extrusion, rows of the moves, errors by channel."""

    xy: Array
    z: Array
    extruding: NDArray[np.bool_]
    row: Ints
    error: Array


class Columns(NamedTuple):
    """Columns of `gcode.types.Moves`."""

    start: Array
    end: Array
    line: Ints
    byte_start: Ints
    byte_end: Ints
    layer: NDArray[np.int32]
    feature: NDArray[np.int32]


class State(NamedTuple):
    """State of `follow` between calls.

    Attributes
    ----------
    place, number : ndarray
        See above.
    high, low, recent : ndarray, shape (channels,)
        Largest and smallest error since the last point, and the last one.
    tally : ndarray, shape (2 channels + 1,)
        Sums of squares and largest values of extruding samples, and their number.
    """

    place: Array
    number: Ints
    high: Array
    low: Array
    recent: Array
    tally: Array


class Points(NamedTuple):
    """Points of a tile, with spare capacity."""

    xyz: NDArray[np.float32]
    line: NDArray[np.uint32]
    error: NDArray[np.uint16]
    feature: NDArray[np.int32]
    on: NDArray[np.uint8]


@kernel(allocates=False)
def follow(
    samples: Samples,
    begin: int,
    moves: Columns,
    first: int,
    until: int,
    point_bytes: float,
    state: State,
    points: Points,
) -> int:
    """Add the points of samples to a tile until it is full or the next one begins.

    Parameters
    ----------
    samples : Samples
        `row` is an index into the moves.
    begin : int
        First sample to process.
    first, until : int
        Number in the file of the first of the moves; moves before `until` end after the samples.
    point_bytes : float
        Size of a point.

    Returns
    -------
    int
        The sample to continue with; -1 when done.
    """
    xy, z, extruding, row, error = samples
    start, end, line, byte_start, byte_end, layer, _ = moves
    place, number, high, low, recent, tally = state
    channels, count, room = error.shape[0], error.shape[1], points.line.shape[0]
    for i in range(begin, count + 1):
        last = i == count
        target = until if last else first + row[i]
        while number[MOVE] < target:
            k = number[MOVE] - first
            dx, dy = end[k, 0] - start[k, 0], end[k, 1] - start[k, 1]
            if line[k] != number[LINE]:
                number[LINE] = line[k]
                place[SPARE] += (byte_end[k] - byte_start[k]) / point_bytes
            if dx != 0.0 or dy != 0.0:
                if layer[k] != number[LAYER] or number[COUNT] + 2 > room:
                    number[LAYER] = layer[k]
                    return i
                bend = False
                if k + 1 < len(line) and line[k + 1] == line[k]:
                    ex, ey = end[k + 1, 0] - start[k + 1, 0], end[k + 1, 1] - start[k + 1, 1]
                    place[BEND] += abs(math.atan2(dx * ey - dy * ex, dx * ex + dy * ey))
                    cx, cy = end[k, 0] - place[PEN_X], end[k, 1] - place[PEN_Y]
                    chord = math.sqrt(cx * cx + cy * cy)
                    bend = chord * place[BEND] < 8.0 * _SAGITTA_MM and place[BEND] < _TURN
                if not bend:
                    if number[SAMPLES] == 0:
                        for c in range(channels):
                            high[c] = recent[c] if last else max(recent[c], error[c, i])
                    on = end[k, 3] > start[k, 3]
                    _add(end[k, 0], end[k, 1], end[k, 2], k, on, moves, state, points)
            number[MOVE] += 1
        if last:
            break
        k = row[i]
        if layer[k] != number[LAYER] or number[COUNT] + 2 > room:
            number[LAYER] = layer[k]
            return i
        if extruding[i]:
            if layer[k] < 0 and abs(z[i] - place[HEIGHT]) > _SAME_HEIGHT_MM:
                return i
            place[HEIGHT] = z[i]
            for c in range(channels):
                tally[c] += error[c, i] * error[c, i]
                tally[channels + c] = max(tally[channels + c], error[c, i])
            tally[2 * channels] += 1.0
        feeds = end[k, 3] > start[k, 3] and (end[k, 0] != start[k, 0] or end[k, 1] != start[k, 1])
        if feeds and number[SAMPLES] > 0 and place[SPARE] >= 1.0:
            dx, dy = place[PREVIOUS_X] - place[PEN_X], place[PREVIOUS_Y] - place[PEN_Y]
            way = dx * dx + dy * dy
            if way > _SHORTEST_MM * _SHORTEST_MM:
                another = way > _LONGEST_MM * _LONGEST_MM
                for c in range(channels):
                    top = max(high[c], error[c, i])
                    least = min(low[c], error[c, i])
                    if top - least > max(_CHANGE_MM, _CHANGE_SHARE * top):
                        another = True
                if another:
                    x, y = place[PREVIOUS_X], place[PREVIOUS_Y]
                    _add(x, y, z[i], k, True, moves, state, points)
        for c in range(channels):
            value = error[c, i]
            high[c] = max(high[c], value) if number[SAMPLES] else value
            low[c] = min(low[c], value) if number[SAMPLES] else value
            recent[c] = value
        number[SAMPLES] += 1
        place[PREVIOUS_X], place[PREVIOUS_Y] = xy[0, i], xy[1, i]
    return -1


@kernel(inline=True, allocates=False)
def _add(
    x: float, y: float, z: float, k: int, on: bool, moves: Columns, state: State, points: Points
) -> None:
    """End a stretch at x y."""
    place, number, high = state.place, state.number, state.high
    at = number[COUNT]
    points.xyz[0, at], points.xyz[1, at], points.xyz[2, at] = x, y, z
    points.line[at] = moves.line[k]
    for c in range(len(high)):
        points.error[c, at] = min(int(high[c] * _UNITS_PER_MM + 0.5), _MOST)
    points.feature[at] = moves.feature[k]
    points.on[at] = 1 if on else 0
    number[COUNT] = at + 1
    number[SAMPLES] = 0
    place[SPARE] -= 1.0
    place[PEN_X], place[PEN_Y], place[BEND] = x, y, 0.0
