"""Write our lines among those of the original, keeping track of the printer's state.

Lines of the original are written byte for byte. Whatever the stream needs different (limits, modes,
firmware shaper) is set before its first line, and restored before any line that may depend on it.
"""

from __future__ import annotations

import copy
import re
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from stillpath.gcode.errors import GcodeError
from stillpath.gcode.firmware._writing_kernels import format_moves
from stillpath.gcode.firmware.base import FirmwareAdapter, changed_limits
from stillpath.gcode.firmware.encoding import Encoded, to_units
from stillpath.gcode.firmware.jumps import jump_lines
from stillpath.gcode.firmware.line_reader import (
    AXES,
    EXTRUSION,
    FEED,
    POSITIONING,
    SET_POSITION,
    STANDS,
    LineReader,
)
from stillpath.gcode.firmware.marking import ends_at_mark, file_text
from stillpath.gcode.firmware.modes import WrittenModes, event_places, feed_line, written_modes
from stillpath.gcode.firmware.planning import stops
from stillpath.gcode.firmware.shaper_switch import ShaperSwitch
from stillpath.gcode.firmware.written_extruder import WrittenExtruder
from stillpath.gcode.pieces import LeftOut, Piece, VerbatimPart
from stillpath.gcode.types import EventKind, Limits, ModalState

__all__ = ["StreamWriter"]

_BYTES_PER_LINE = 96
_LEVEL, _EVENT, _REST = range(3)
_MAY_SET_SHAPER = (EventKind.UNKNOWN, EventKind.SHAPER)


class StreamWriter:
    """Write verbatim parts and pieces in order.

    Parameters
    ----------
    stamp : str
        Version and options; one line in header and footer.
    """

    def __init__(self, firmware: FirmwareAdapter, stamp: str) -> None:
        self._stream_commands = firmware.stream_commands()
        self._lines = LineReader(self._stream_commands)
        self._extruder_alone_stops = firmware.extruder_alone_stops
        self._stands = firmware.stands
        self._limits_now: Limits | None = None
        """The planner's limits while streaming."""
        self._stamp = stamp
        self._streaming = False
        self._shaper = ShaperSwitch(self._stream_commands)
        self._extruder = WrittenExtruder(self._stream_commands)
        self._marked: Limits | None = None
        """The file's limits, in force with the mark of a stream because the shaper stays off."""
        self._at_rest = True
        self._modal: ModalState | None = None
        """The printer's modes, where they may differ from the file's."""
        self._absolute_e = False
        """The piece has absolute E."""
        self._file_feed_mm_min = 0.0
        self._behind: tuple[Limits, ModalState] | None = None
        """What the file had set after the last piece."""
        self._behind_mark = False
        """No move came since an object's mark."""

    def snapshot(self) -> StreamWriter:
        """Return a copy that writes on from here, while this one stays as it is.

        It is for one piece: what the file's own lines set is shared.
        """
        twin = copy.copy(self)
        twin._shaper, twin._extruder = copy.copy(self._shaper), copy.copy(self._extruder)
        return twin

    def shaper_warnings(self) -> Iterator[str]:
        """Yield warnings about the firmware's shaper, and about those that the file itself sets."""
        yield from self._shaper.warnings()

    def leading(self, piece: Piece, extruder_mm: float) -> bytes:
        """Return lines that take time before a piece's stream, often none; as in `piece`.

        They switch the shaper off. After an object's mark they are all before the stream.
        """
        if piece.after_mark:
            return self.snapshot()._lead(piece, extruder_mm)
        return b"" if self._streaming else self._shaper.off_lines()

    def header(self) -> bytes:
        """Return lines that say who processed the file, and what to note."""
        notes = "".join(f"; stillpath: {note}\n" for note in self._stream_commands.notes)
        return self.footer() + notes.encode()

    def footer(self) -> bytes:
        """Return the line that says who processed the file."""
        return f"; Processed by stillpath {self._stamp}\n".encode()

    def end(self, ends_with_newline: bool, extruder_mm: float) -> bytes:
        """Return lines that restore the printer's state at the end of the file; often none."""
        text = self._end(extruder_mm)
        return text if ends_with_newline or not text else b"\n" + text

    def verbatim(self, verbatim: VerbatimPart, extruder_mm: float) -> bytes:
        """Return the text of unchanged lines, with our own lines before them if needed.

        Parameters
        ----------
        extruder_mm : float
            The printer's E after everything written so far.

        Raises
        ------
        GcodeError
            For a line that must not stand in a file with a stream.
        """
        moves, events = verbatim.moves, verbatim.events
        file_mm = extruder_mm + self._extruder.zero_mm if self._behind is not None else None
        lead = self._off(verbatim, extruder_mm)
        if self._marked is not None:
            self._marked = verbatim.limits_after
        for row in np.flatnonzero(np.isin(events.kind, _MAY_SET_SHAPER)).tolist():
            line = verbatim.line(events, row)
            conflict = self._stream_commands.conflict(line)
            if conflict is not None:
                raise GcodeError(conflict, line=int(events.line[row]))
            if events.kind[row] != EventKind.SHAPER or self._lines.is_move(line.split(b";", 1)[0]):
                continue  # a line that also moves cannot be repeated
            self._shaper.set_by_file(line, int(events.line[row]))
        if len(moves) or np.any(stops(events)):
            self._at_rest = self._rests(verbatim, at_end=True)
        where = {"marked": self._marked is not None, "behind_mark": self._behind_mark}
        self._behind_mark = ends_at_mark(verbatim) or (self._behind_mark and not len(moves))
        return lead + file_text(verbatim, self._stream_commands, file_mm, **where)

    def shaper_test(self, piece: Piece) -> str | None:
        """Return why a piece seems to belong to a test of the firmware's shaper, or None."""
        return self._shaper.test(piece)

    def piece(self, piece: Piece, encoded: Encoded, extruder_mm: float) -> bytes:
        """Return the text of a compensated piece; `extruder_mm` as in `verbatim`."""
        self._extruder.reads(extruder_mm)
        used = np.unique(piece.moves.modal_id).tolist()
        self._absolute_e = any(piece.modal[k].absolute_e for k in used)
        limits, level = encoded.limits, encoded.level
        parts = [self._on(piece, limits[level[0]], extruder_mm)]
        rows, events = encoded.row, piece.events
        index = event_places(piece, encoded)
        modes = written_modes(piece, encoded, index)
        text, line_end, extruded = self._format(encoded, modes, index, events.kind)

        kinds = events.kind.tolist()
        rest_rows = np.flatnonzero(rows >= 0)
        # What stands before the text of written move `at`: other limits first, then the file's
        # events, then a rest's own line.
        order = [(int(i), _LEVEL, 0) for i in 1 + np.flatnonzero(np.diff(level))]
        order += [(int(i), _EVENT, k) for k, i in enumerate(index)]
        order += [(int(i), _REST, int(rows[i])) for i in rest_rows]
        done = 0
        last_line = -1
        for at, kind, what in sorted(order):
            upto = int(line_end[at - 1]) if at else 0
            if upto > done:
                parts += [
                    self._enter_stream_state(limits[level[at - 1]], modes.at(at - 1)),
                    text[done:upto],
                ]
                done = upto
            written = float(extruded[at - 1] if at else piece.moves.start_mm[0, 3])
            if kind == _EVENT:
                parts.append(self._event(piece, what, kinds[what], written))
            elif kind == _REST and int(piece.moves.line[what]) != last_line:
                last_line = int(piece.moves.line[what])
                parts.append(self._rest_line(piece, what, written))
        if len(text) > done:
            parts += [
                self._enter_stream_state(limits[level[-1]], modes.at(len(rows) - 1)),
                text[done:],
            ]
        last = piece.moves.speed_mm_s[-1]
        self._file_feed_mm_min = float(last) * 60.0 / piece.modal_after.speed_factor
        self._at_rest = self._behind_mark = False
        self._behind = (piece.limits_after, piece.modal_after)
        return b"".join(parts)

    def _format(
        self,
        encoded: Encoded,
        modes: WrittenModes,
        index: NDArray[np.int64],
        kinds: NDArray[np.int8],
    ) -> tuple[bytes, NDArray[np.int64], NDArray[np.float64]]:
        n = len(encoded.row)
        fresh = np.zeros(n + 1, dtype=bool)
        fresh[index[kinds == EventKind.MODE]] = True
        fresh[0] = True
        lengths = np.diff(np.append(modes.first, n))
        states = modes.states
        buffer = np.empty(n * _BYTES_PER_LINE + 16, np.uint8)
        line_end, extruded = np.empty(n, np.int64), np.empty(n)
        size = format_moves(
            encoded.position,
            encoded.begin,
            encoded.row >= 0,
            fresh,
            encoded.feedrate_mm_min,
            np.repeat([m.extrude_factor for m in states], lengths),
            np.repeat([m.speed_factor for m in states], lengths),
            np.repeat([to_units(np.array(m.origin_mm)) for m in states], lengths, axis=0),
            buffer,
            line_end,
            extruded,
        )
        return buffer[:size].tobytes(), line_end, extruded

    def _event(self, piece: Piece, k: int, kind: int, extruded_mm: float) -> bytes:
        """Return the text of event k of a piece; `extruded_mm` is the extruder as written."""
        events = piece.events
        line = piece.line(events, k)
        if kind == EventKind.LIMITS:
            return _held_back(line)
        if kind != EventKind.MODE or self._modal is None:
            return line
        state = piece.modal[int(events.modal_id[k])]
        code = line.split(b";", 1)[0].upper()
        if self._lines.is_move(code):
            # It would move to the plan, but the command is elsewhere; a bare F is harmless.
            return _held_back(line) if re.search(rb"[XYZEIJK]", code) else line
        if SET_POSITION.match(code):
            row = min(int(events.move_index[k]), len(piece.moves) - 1)
            planned = float(piece.moves.start_mm[row, 3])
            # As it is spelt: not every firmware reads small letters.
            value_mm = self._lines.extruder_word(line.split(b";", 1)[0])
            if value_mm is None:
                return line
            ahead_mm = (extruded_mm - planned) / state.extrude_factor
            return line + self._extruder.set_by_file(value_mm, ahead_mm)
        # Only what the line itself says changes: our own modes differ from the file's.
        if POSITIONING.match(code):
            self._modal = replace(self._modal, absolute_xyz=state.absolute_xyz)
            if self._stream_commands.positioning_sets_extruder:
                self._modal = replace(self._modal, absolute_e=state.absolute_e)
        elif EXTRUSION.match(code):
            self._modal = replace(self._modal, absolute_e=state.absolute_e)
        return line

    def _rest_line(self, piece: Piece, row: int, extruded_mm: float) -> bytes:
        moves = piece.moves
        line = piece.line(moves, row)
        code = line.split(b";", 1)[0]
        state = piece.modal[int(moves.modal_id[row])]
        # The file's own moves run under its own limits.
        own = piece.limits[int(moves.limits_id[row])]
        lead = self._limits_to(self._stream_commands.in_stream(own))
        lead += self._file_modes(state)
        moves_on = self._lines.is_move(code)
        # Not G10 and G11, whatever words they have: they do not change E.
        ends = self._lines.extruder_word(code) if state.absolute_e and moves_on else None
        alone = self._stream_commands.factors_need_axes and not AXES.search(code)
        if ends is not None:
            fed = float(moves.end_mm[row, 3]) - extruded_mm
            factor = 1.0 if alone else state.extrude_factor
            lead += self._extruder.file_again(ends - fed / factor)
            self._extruder.reads(ends)
        elif moves_on:
            fed = float(moves.end_mm[row, 3] - moves.start_mm[row, 3])
            self._extruder.fed(fed, state.extrude_factor)
        if moves_on and not FEED.search(code):
            factor = 1.0 if alone else state.speed_factor
            lead += feed_line(float(moves.speed_mm_s[row]) * 60.0 / factor)
        return lead + line

    def _limits_to(self, limits: Limits) -> bytes:
        if limits == self._limits_now:
            return b""
        before, self._limits_now = self._limits_now, limits
        return changed_limits(self._stream_commands, before, limits)

    def _enter_stream_state(self, limits: Limits, modes: ModalState) -> bytes:
        """Return lines that set the stream's limits and modes."""
        text = self._limits_to(limits) + self._file_modes(modes)
        self._modal = modes
        return text + self._extruder.streams(absolute=self._absolute_e)

    def _file_modes(self, state: ModalState) -> bytes:
        """Return lines that restore the file's modes (except the feedrate)."""
        assert self._modal is not None
        now = self._modal
        if (now.absolute_xyz, now.absolute_e) == (state.absolute_xyz, state.absolute_e):
            return b""
        text = b""
        absolute_e = now.absolute_e
        if now.absolute_xyz != state.absolute_xyz:
            text += b"G90\n" if state.absolute_xyz else b"G91\n"
            if self._stream_commands.positioning_sets_extruder:
                absolute_e = state.absolute_xyz
        if absolute_e != state.absolute_e:
            text += b"M82\n" if state.absolute_e else b"M83\n"
        self._modal = replace(now, absolute_xyz=state.absolute_xyz, absolute_e=state.absolute_e)
        return text

    def _on(self, piece: Piece, limits: Limits, extruder_mm: float) -> bytes:
        """Return the lines before the first segment of a piece."""
        if self._streaming:
            return self._lead(piece, extruder_mm)
        self._limits_now = limits
        return self._lead(piece, extruder_mm) + self._stream_commands.limits(limits)

    def _lead(self, piece: Piece, extruder_mm: float) -> bytes:
        """Return those of them that still move under the file's limits, or stand."""
        parts: list[bytes] = []
        counts = piece.modal_before.absolute_e and self._stream_commands.replays
        if not self._at_rest and (counts or not piece.after_mark):
            parts.append(self._stream_commands.stand_still)
        if self._modal is None:
            self._modal = piece.modal_before
        if not self._streaming:
            parts.append(b"; stillpath: stream on\n")
            if piece.after_mark:
                parts.append(self._jump(piece, extruder_mm))
            parts.append(self._shaper.off())
            if piece.after_mark:
                # Klipper waits longer if it has to stand before it switches its shaper off.
                parts.append(self._stream_commands.stand_still)
            self._marked = None
            self._streaming = True
        return b"".join(parts)

    def _jump(self, piece: Piece, extruder_mm: float) -> bytes:
        """Return lines to where a piece begins, behind an object's mark."""
        own = piece.limits_before
        if self._shaper.is_off or (self._stream_commands.marks and self._shaper.off_lines()):
            # A pause behind the line that switches it off must find the mark, too.
            own = self._stream_commands.in_stream(own)
        text = self._stream_commands.limits(own)
        text += self._file_modes(replace(piece.modal_before, absolute_xyz=True, absolute_e=False))
        return text + jump_lines(piece, self._stands, extruder_mm)

    def _off(self, verbatim: VerbatimPart, extruder_mm: float) -> bytes:
        """Return lines that restore the file's state."""
        shaper, limits = self._shaper_before(verbatim), verbatim.limits_before
        begins = self._shaper.is_off and self._marked is None
        stays = self._stream_commands.marks or isinstance(verbatim, LeftOut)
        if begins and (stays or self._shaper.is_known):
            self._marked, limits = limits, self._stream_commands.in_stream(limits)
        if not self._streaming:
            marking = limits is not verbatim.limits_before
            return (self._stream_commands.limits(limits) if marking else self._unmarked()) + shaper
        counts = verbatim.modal_before.absolute_e and self._stream_commands.replays
        rests = self._at_rest or (self._rests(verbatim) and not counts)
        stop = b"" if rests else self._stream_commands.stand_still
        line_note = b", line %d of the original" % verbatim.first_line
        text = stop + self._stream_off(limits, verbatim.modal_before, extruder_mm, line_note)
        return text + shaper

    def _unmarked(self) -> bytes:
        """Return lines that remove the mark of a stream once the shaper is on again."""
        if self._marked is None or self._shaper.is_off:
            return b""
        limits, self._marked = self._marked, None
        return self._stream_commands.limits(limits)

    def _rests(self, verbatim: VerbatimPart, *, at_end: bool = False) -> bool:
        """Return whether the machine certainly stands before a part, or after it."""
        moves, events = verbatim.moves, verbatim.events
        edge, nearest = (len(moves), -1) if at_end else (0, 0)
        stop_rows = np.flatnonzero(stops(events) & (events.move_index == edge))
        if len(stop_rows):
            line = verbatim.line(events, int(stop_rows[nearest]))
            return STANDS.match(line) is not None
        if len(moves) == 0:
            return False
        travel = moves.end_mm[nearest] - moves.start_mm[nearest]
        return self._extruder_alone_stops and not np.any(travel[:3])

    def _end(self, extruder_mm: float) -> bytes:
        """Lines that give the printer back at the end of the file."""
        text = b""
        if self._streaming and self._behind is not None:
            text = b"" if self._at_rest else self._stream_commands.stand_still
            text += self._stream_off(*self._behind, extruder_mm, b"")
        shaper = self._shaper.on(self._behind[0]) if self._behind is not None else b""
        return text + self._unmarked() + shaper

    def _stream_off(
        self, limits: Limits, state: ModalState, extruder_mm: float, line_note: bytes
    ) -> bytes:
        self._streaming = False
        text = self._stream_commands.limits(limits) + self._file_modes(state)
        text += self._extruder.file_again(extruder_mm + self._extruder.zero_mm)
        self._modal = None
        mark = b"; stillpath: stream off" + line_note + b"\n"
        return text + feed_line(self._file_feed_mm_min) + mark

    def _shaper_before(self, verbatim: VerbatimPart) -> bytes:
        """Set the firmware's shaper again before lines that print on their own.

        Firmwares stand still for it. Travel between two streams, as after an object mark, is not
        worth that: the next stream compensates its vibration. Nor are sections left out on request,
        but their filament is the slicer's and needs the firmware's pressure advance.
        """
        prints = bool(np.any(verbatim.moves.prints))
        # A line that sets part of the shaper must find the other parts unchanged.
        foreign = bool(np.any(np.isin(verbatim.events.kind, _MAY_SET_SHAPER)))
        aside = isinstance(verbatim, LeftOut)  # between streams again and again
        restores = self._shaper.is_known or (
            self._marked is not None and not self._stream_commands.marks
        )
        if foreign or (prints and not aside and restores):
            return self._shaper.on(verbatim.limits_before)
        return self._shaper.advance_on(verbatim.limits_before) if prints and aside else b""


def _held_back(line: bytes) -> bytes:
    return b"; stillpath, held back: " + line
