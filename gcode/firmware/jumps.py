"""Lines before a piece that follows an object's mark."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from stillpath.gcode.firmware.encoding import UNITS_PER_MM, to_units
from stillpath.gcode.pieces import Piece

__all__ = ["jump_lines"]

_ASIDE_UNITS = 1000
"""1 um."""


def jump_lines(
    piece: Piece,
    stands: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    extruder_mm: float,
) -> bytes:
    """Return two moves that end where a piece begins, for absolute X and Y.

    A firmware that skipped the object before stands elsewhere, and gets here by the first move of X
    or Y. That must not be one of a stream, under the stream's limits. Where nothing was skipped,
    these moves go aside by a micrometre and back; on whole steps, no motor makes one.

    OctoPrint's Cancel Objects sends no line of an object, and then a G92 E by the absolute E that
    it has read; but a stream has relative E. So the E of a file with absolute E is set again.

    Parameters
    ----------
    stands : callable
        `FirmwareAdapter.stands`.
    extruder_mm : float
        The file's E where the piece begins.
    """
    begin, end = (to_units(at[0, :3]) for at in (piece.moves.start_mm, piece.moves.end_mm))
    aside = _aside(begin, end, stands)
    state = piece.modal_before
    origin = to_units(np.array(state.origin_mm[:2]))
    feed_mm_min = float(piece.moves.speed_mm_s[0]) * 60.0 / state.speed_factor
    places = ((at[:2] - origin) / UNITS_PER_MM for at in (aside, begin))
    extruder = b"G92 E%.7f\n" % extruder_mm if state.absolute_e else b""
    return extruder + b"".join(b"G1 X%.6f Y%.6f F%.3f\n" % (x, y, feed_mm_min) for x, y in places)


def _aside(
    begin: NDArray[np.int64],
    end: NDArray[np.int64],
    stands: Callable[[NDArray[np.float64]], NDArray[np.float64]],
) -> NDArray[np.int64]:
    """Return a place beside `begin`, if possible one that no motor steps to."""
    way = (end - begin)[:2]
    axis = int(np.argmax(np.abs(way)))
    toward = np.zeros((2, 3), np.int64)
    toward[0, axis], toward[1, 1 - axis] = np.where(way < 0, -1, 1)[[axis, 1 - axis]]
    # The file's own direction first, which leads to no limit. Among four, one suits both motors of
    # any kinematics.
    places = begin + _ASIDE_UNITS * np.array([*toward, -toward[1], -toward[0]])
    motors = stands(np.vstack([places, begin]) / UNITS_PER_MM)
    still = np.all(motors[:-1] == motors[-1], axis=1)
    return np.asarray(places[np.argmax(still)])
