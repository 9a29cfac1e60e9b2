"""Lines of ours among the file's: the mark of a stream, and the state behind skipped objects."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from stillpath.gcode.firmware.base import StreamCommands
from stillpath.gcode.firmware.line_reader import AXES, SET_POSITION, LineReader
from stillpath.gcode.firmware.modes import feed_line
from stillpath.gcode.pieces import VerbatimPart
from stillpath.gcode.types import EventKind, Limits

__all__ = ["ends_at_mark", "file_text"]

_UNITS = re.compile(rb"\s*(?:N\d+\s*)?(?:G2[01]|M200)(?!\d)", re.IGNORECASE)

Inserted = Iterator[tuple[int, bytes]]
"""Places in the bytes of a part, and the lines that come there."""

_LIMITS = (EventKind.LIMITS, EventKind.STATE)


def file_text(
    verbatim: VerbatimPart,
    commands: StreamCommands,
    extruder_mm: float | None,
    *,
    marked: bool,
    behind_mark: bool,
) -> bytes:
    """Return the text of a part, with lines of ours in it where they are needed.

    Parameters
    ----------
    extruder_mm : float, optional
        The file's E where the part begins; None: there was no stream yet.
    marked : bool
        Limits are in force with the mark of a stream.
    behind_mark : bool
        The part begins behind an object's mark, and no move in between.
    """
    inserted = list(_mark_lines(verbatim, commands)) if marked else []
    if extruder_mm is not None and not _changes_units(verbatim):
        in_force = commands.in_stream if marked else _as_it_is
        inserted += _behind_skipped(verbatim, commands, extruder_mm, in_force, behind_mark)
    parts, done = [], 0
    for place, lines in sorted(inserted):
        parts += [verbatim.text[done:place], lines]
        done = place
    return b"".join([*parts, verbatim.text[done:]])


def ends_at_mark(verbatim: VerbatimPart) -> bool:
    """Return whether no move stands behind the last mark by which a host skips objects."""
    return bool(np.any(_host_marks(verbatim) == len(verbatim.moves)))


def _changes_units(verbatim: VerbatimPart) -> bool:
    """Return whether lines of ours, in millimetres, may be read otherwise in a part."""
    rows = np.flatnonzero(verbatim.events.kind == EventKind.STATE).tolist()
    return any(_UNITS.match(verbatim.line(verbatim.events, row)) for row in rows)


def _mark_lines(verbatim: VerbatimPart, commands: StreamCommands) -> Inserted:
    """Yield the limits with the mark of a stream, behind the file's lines that remove it."""
    events = verbatim.events
    for row in np.flatnonzero(np.isin(events.kind, _LIMITS)).tolist():
        line = verbatim.line(events, row)
        if line.endswith(b"\n") and commands.unmarks(line):
            own = verbatim.limits[int(events.limits_id[row])]
            end = int(events.byte_end[row]) - verbatim.text_offset
            yield end, commands.limits(commands.in_stream(own))


def _behind_skipped(
    verbatim: VerbatimPart,
    commands: StreamCommands,
    extruder_mm: float,
    in_force: Callable[[Limits], Limits],
    behind_mark: bool,
) -> Inserted:
    """Yield what a file with absolute E relies on, before its moves behind objects' marks.

    OctoPrint's Cancel Objects sends no line of an object, the end of a stream included, and then a
    G92 E by the absolute E that it has read; but a stream has relative E.
    """
    moves = verbatim.moves
    marks = np.append(_host_marks(verbatim), np.zeros(int(behind_mark), np.int64))
    absolute = np.array([state.absolute_e for state in verbatim.modal], bool)
    rows = np.unique(marks[marks < len(moves)])
    rows = rows[absolute[moves.modal_id[rows]]]
    if not len(rows):
        return
    reader = LineReader(commands)
    file_mm = _file_extruder(verbatim, commands, reader, extruder_mm)
    for row in rows.tolist():
        state = verbatim.modal[int(moves.modal_id[row])]
        lines = commands.limits(in_force(verbatim.limits[int(moves.limits_id[row])]))
        lines += b"G90\nM82\n" if state.absolute_xyz else b"G91\nM82\n"
        lines += b"" if np.isnan(file_mm[row]) else b"G92 E%.7f\n" % file_mm[row]
        lines += _file_feed(verbatim, commands, reader, row)
        yield int(moves.byte_start[row]) - verbatim.text_offset, lines


def _file_feed(
    verbatim: VerbatimPart, commands: StreamCommands, reader: LineReader, row: int
) -> bytes:
    """Return the line that sets the F of the first move from a row on, if there is any.

    G10 and G11 have speeds of their own, and leave F as it is.
    """
    moves = verbatim.moves
    for k in range(row, len(moves)):
        code = verbatim.line(moves, k).split(b";", 1)[0]
        if reader.is_move(code):
            alone = commands.factors_need_axes and not AXES.search(code)
            factor = 1.0 if alone else verbatim.modal[int(moves.modal_id[k])].speed_factor
            return feed_line(float(moves.speed_mm_s[k]) * 60.0 / factor)
    return b""


def _file_extruder(
    verbatim: VerbatimPart, commands: StreamCommands, reader: LineReader, extruder_mm: float
) -> NDArray[np.float64]:
    """Return what the file takes for E before each move; NaN: that is not known (a bare G92)."""
    moves, events = verbatim.moves, verbatim.events
    fed_mm = np.zeros(len(moves))
    for row in np.flatnonzero(moves.end_mm[:, 3] != moves.start_mm[:, 3]).tolist():
        code = verbatim.line(moves, row).split(b";", 1)[0]
        # G10 and G11 leave E as it is, whatever words they have.
        if reader.is_move(code) and reader.extruder_word(code) is not None:
            alone = commands.factors_need_axes and not AXES.search(code)
            factor = 1.0 if alone else verbatim.modal[int(moves.modal_id[row])].extrude_factor
            fed_mm[row] = (moves.end_mm[row, 3] - moves.start_mm[row, 3]) / factor
    counted_mm = np.append(0.0, np.cumsum(fed_mm)[:-1])
    file_mm = extruder_mm + counted_mm
    end = len(moves)
    for event in reversed(range(len(events))):
        code = verbatim.line(events, event).split(b";", 1)[0]
        word, row = reader.extruder_word(code), int(events.move_index[event])
        if row < end and SET_POSITION.match(code) and (word is not None or not AXES.search(code)):
            set_mm = math.nan if word is None else word
            file_mm[row:end] = set_mm + counted_mm[row:end] - counted_mm[row]
            end = row
    return file_mm


def _host_marks(verbatim: VerbatimPart) -> NDArray[np.int64]:
    """Return which moves marks stand before; the firmware's own leave state and E as they are."""
    events = verbatim.events
    rows = np.flatnonzero(events.kind == EventKind.OBJECT).tolist()
    hosts = [row for row in rows if verbatim.line(events, row).lstrip().startswith((b"@", b";"))]
    return events.move_index[hosts]


def _as_it_is(limits: Limits) -> Limits:
    return limits
