"""Lines before a piece that follows an object's mark."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from stillpath.gcode.firmware.encoding import UNITS_PER_MM, to_units
from stillpath.gcode.pieces import Piece

__all__ = ["jump_lines"]

_ASIDE_UNITS = 1000
"""1 um."""


def jump_lines(piece: Piece, step_mm: Sequence[float], extruder_mm: float) -> bytes:
    """Return two moves that end where a piece begins, for absolute X and Y.

    A firmware that skipped the object before stands elsewhere, and gets here by the first move of X
    or Y. That must not be one of a stream, under the stream's limits. Where nothing was skipped,
    these moves go a micrometre towards the file's own and back: no step of X or Y, but on a CoreXY
    that counts steps a motor may make one.

    OctoPrint's Cancel Objects sends no line of an object, and then a G92 E by the absolute E that
    it has read; but a stream has relative E. So the E of a file with absolute E is set again.

    Parameters
    ----------
    step_mm : sequence of float
        Of x and y, to which the firmware rounds places; 0: it does not.
    extruder_mm : float
        The file's E where the piece begins.
    """
    begin, end = (to_units(at[0, :2]) for at in (piece.moves.start_mm, piece.moves.end_mm))
    axis = int(np.argmax(np.abs(end - begin)))
    aside, step = begin.copy(), step_mm[axis] * UNITS_PER_MM
    way = int(np.sign(end - begin)[axis]) * _ASIDE_UNITS
    if step > 0.0 and round((begin[axis] + way) / step) != round(begin[axis] / step):
        way = -way
    aside[axis] += way
    state = piece.modal_before
    origin = to_units(np.array(state.origin_mm[:2]))
    feed_mm_min = float(piece.moves.speed_mm_s[0]) * 60.0 / state.speed_factor
    places = ((at - origin) / UNITS_PER_MM for at in (aside, begin))
    extruder = b"G92 E%.7f\n" % extruder_mm if state.absolute_e else b""
    return extruder + b"".join(b"G1 X%.6f Y%.6f F%.3f\n" % (x, y, feed_mm_min) for x, y in places)
