"""The written file: our lines among those of the original, with the printer's state kept right.

Lines that are not ours leave byte for byte. Whatever the stream needs different (limits, firmware
shaper, modes) is set before its first line and put back before any line that could depend on it.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gcode.firmware.klipper._encoder_kernels import format_moves
from gcode.firmware.klipper.encoder import Encoded
from gcode.pieces import Passage, Piece
from gcode.types import EventKind, Limits, ModalState
from models.machine import Machine

__all__ = ["KlipperWriter"]

IN_STREAM_MARK_MM_S = 5e-7
"""Added to the square corner velocity while the file's own moves run inside a stream."""
_BYTES_PER_LINE = 96
_MOVE = re.compile(rb"^\s*(?:N\d+\s*)?G[01](?![0-9])", re.IGNORECASE)
_FEED = re.compile(rb"F\s*[-+.\d]", re.IGNORECASE)
_SET_POSITION = re.compile(rb"^\s*(?:N\d+\s*)?G92(?!\d)")
_POSITIONING = re.compile(rb"^\s*(?:N\d+\s*)?G9[01](?!\d)")
_EXTRUSION = re.compile(rb"^\s*(?:N\d+\s*)?M8[23](?!\d)")
_E_WORD = re.compile(rb"E\s*([-+]?[\d.]+)", re.IGNORECASE)
_LEAST_GAP_MM = 1e-7
_STOP = b"G4 P0 ; stand still\n"


@dataclass(frozen=True, slots=True)
class _Modes:
    """Modal states of a piece's written moves: states[i] holds from move first[i] on."""

    first: NDArray[np.int64]
    states: list[ModalState]

    def at(self, move: int) -> ModalState:
        return self.states[int(np.searchsorted(self.first, move, "right")) - 1]


class KlipperWriter:
    """Write passages and pieces in order.

    Parameters
    ----------
    machine : Machine
    limits : Limits
        What the stream runs under.
    stamp : str
        Says who processed the file; one line in header and footer.
    """

    def __init__(self, machine: Machine, limits: Limits, stamp: str) -> None:
        self._shaper = machine.firmware.shaper
        self._limits = limits
        self._limits_now = limits
        """What the printer plans with, while streaming."""
        self._stamp = stamp
        self._streaming = False
        self._shaper_off = False
        self._shaper_lines: list[bytes] = []
        self._at_rest = True
        self._modal: ModalState | None = None
        """What the printer's modes are now, where they may differ from the file's."""
        self._file_feed_mm_min = 0.0
        self._behind: tuple[Limits, ModalState] | None = None
        """What the file had set behind the last piece."""
        self.shaper_unknown = False

    def header(self) -> bytes:
        """First lines of the file."""
        return (
            f"; Processed by stillpath {self._stamp}\n"
            "; stillpath: between 'stream on' and 'stream off' the acceleration limit is raised\n"
            "; stillpath: and every move is timed: leave the speed slider at 100 %. PAUSE and\n"
            "; stillpath: CANCEL_PRINT must restore the limits first: see stillpath.cfg.\n"
        ).encode()

    def footer(self, ends_with_newline: bool) -> bytes:
        """Last lines of the file."""
        lead = b"" if ends_with_newline else b"\n"
        return lead + self._end() + f"; Processed by stillpath {self._stamp}\n".encode()

    def passage(self, passage: Passage) -> bytes:
        """Text of lines that leave as they came."""
        moves, events = passage.moves, passage.events
        lead = self._off(passage)
        for row in np.flatnonzero(events.kind == EventKind.SHAPER):
            line = passage.line_text(int(events.byte_start[row]), int(events.byte_end[row]))
            self._shaper_lines = [*self._shaper_lines[-3:], line.rstrip() + b"\n"]
        if len(moves):
            last_stop = events.move_index[events.kind >= EventKind.STOP]
            stands = len(last_stop) > 0 and int(last_stop[-1]) == len(moves)
            self._at_rest = stands or _extruder_only(passage, len(moves) - 1)
        elif np.any((events.kind >= EventKind.STOP) & (events.kind != EventKind.OBJECT)):
            self._at_rest = True
        return lead + passage.text

    def piece(self, piece: Piece, encoded: Encoded) -> bytes:
        """Text of a compensated piece."""
        parts = [self._on(piece)]
        rows, events = encoded.row, piece.events
        index = self._event_places(piece, encoded)
        modes = self._modes(piece, index)
        text, line_end, extruded = self._format(encoded, modes, index, events.kind)

        rest_rows = np.flatnonzero(rows >= 0)
        stops: list[tuple[int, int, int]] = [(int(i), 0, k) for k, i in enumerate(index)]
        stops += [(int(i), 1, int(rows[i])) for i in rest_rows]
        done = 0
        last_line = -1
        for at, kind, what in sorted(stops):
            upto = int(line_end[at - 1]) if at else 0
            if upto > done:
                parts += [self._ours(modes.at(at - 1)), text[done:upto]]
                done = upto
            if kind == 0:
                written = extruded[at - 1] if at else float(piece.moves.start_mm[0, 3])
                parts.append(self._event(piece, what, float(written)))
            elif int(piece.moves.line[what]) != last_line:
                last_line = int(piece.moves.line[what])
                parts.append(self._rest_line(piece, what))
        if len(text) > done:
            parts += [self._ours(modes.at(len(rows) - 1)), text[done:]]
        last = piece.moves.speed_mm_s[-1]
        self._file_feed_mm_min = float(last) * 60.0 / piece.modal_after.speed_factor
        self._at_rest = False
        self._behind = (piece.limits_after, piece.modal_after)
        return b"".join(parts)

    def _event_places(self, piece: Piece, encoded: Encoded) -> NDArray[np.int64]:
        """Index of the written move before which each event of the piece stands."""
        first = np.full(len(piece.moves) + 1, len(encoded.row), np.int64)
        planned = encoded.row_start_s
        place = np.searchsorted(encoded.start_s, planned - 1e-6)
        first[:-1] = np.minimum(place, len(encoded.row))
        rest = encoded.row >= 0
        first[encoded.row[rest]] = np.flatnonzero(rest)
        # An event never moves past a rest or back behind one.
        first = np.maximum.accumulate(first)
        return first[np.minimum(piece.events.move_index, len(piece.moves))]

    def _modes(self, piece: Piece, index: NDArray[np.int64]) -> _Modes:
        """Return the file's modal state at every written move."""
        changes = piece.events.kind == EventKind.MODE
        first = np.concatenate([[0], index[changes]])
        states = [piece.modal_before]
        states += [piece.modal[int(m)] for m in piece.events.modal_id[changes]]
        # Of several changes at one place the last one counts.
        last = np.append(first[1:] != first[:-1], True)
        return _Modes(first[last], [s for s, keep in zip(states, last, strict=True) if keep])

    def _format(
        self, encoded: Encoded, modes: _Modes, index: NDArray[np.int64], kinds: NDArray[np.int8]
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
            np.repeat([_integer_origin(m) for m in states], lengths, axis=0),
            buffer,
            line_end,
            extruded,
        )
        return buffer[:size].tobytes(), line_end, extruded

    def _event(self, piece: Piece, k: int, extruded_mm: float) -> bytes:
        """Text of event k of a piece; `extruded_mm` is where the extruder stands as written."""
        events = piece.events
        line = piece.line_text(int(events.byte_start[k]), int(events.byte_end[k]))
        if events.kind[k] == EventKind.LIMITS:
            return _held_back(line)
        if events.kind[k] != EventKind.MODE or self._modal is None:
            return line
        state = piece.modal[int(events.modal_id[k])]
        code = line.split(b";", 1)[0].upper()
        if _MOVE.match(code):
            # It goes where the plan is, and the command is somewhere else; a bare F is harmless.
            return _held_back(line) if re.search(rb"[XYZE]", code) else line
        if _SET_POSITION.match(code) and state.absolute_e:
            row = min(int(events.move_index[k]), len(piece.moves) - 1)
            planned = float(piece.moves.start_mm[row, 3])
            gap = (extruded_mm - planned) / state.extrude_factor
            return self._file_modes(state) + _shifted_e(line, gap)
        # Only what the line itself says changes: our own modes differ from the file's.
        if _POSITIONING.match(code):
            self._modal = replace(self._modal, absolute_xyz=state.absolute_xyz)
        elif _EXTRUSION.match(code):
            self._modal = replace(self._modal, absolute_e=state.absolute_e)
        return line

    def _rest_line(self, piece: Piece, row: int) -> bytes:
        moves = piece.moves
        line = piece.line_text(int(moves.byte_start[row]), int(moves.byte_end[row]))
        code = line.split(b";", 1)[0]
        state = piece.modal[int(moves.modal_id[row])]
        # The file's own moves run under its own limits; the mark tells stillpath.cfg that a PAUSE
        # here is in mid stream, with the shaper off.
        own = piece.limits[int(moves.limits_id[row])]
        corner = own.square_corner_velocity_mm_s + IN_STREAM_MARK_MM_S
        lead = self._limits_to(replace(own, square_corner_velocity_mm_s=corner))
        lead += self._file_modes(state)
        if _MOVE.match(code) and not _FEED.search(code):
            lead += _feed_line(float(moves.speed_mm_s[row]) * 60.0 / state.speed_factor)
        return lead + line

    def _limits_to(self, limits: Limits) -> bytes:
        if limits == self._limits_now:
            return b""
        self._limits_now = limits
        return _limits_line(limits)

    def _ours(self, state: ModalState) -> bytes:
        """Lines after which ours run under the stream's limits, X Y Z absolute and E relative."""
        assert self._modal is not None
        text = self._limits_to(self._limits)
        if not self._modal.absolute_xyz:
            text += b"G90\n"
        if self._modal.absolute_e:
            text += b"M83\n"
        self._modal = replace(state, absolute_xyz=True, absolute_e=False)
        return text

    def _file_modes(self, state: ModalState) -> bytes:
        """Lines that make the printer read as the file expects (not the feedrate)."""
        assert self._modal is not None
        text = b""
        if self._modal.absolute_xyz != state.absolute_xyz:
            text += b"G90\n" if state.absolute_xyz else b"G91\n"
        if self._modal.absolute_e != state.absolute_e:
            text += b"M82\n" if state.absolute_e else b"M83\n"
        self._modal = replace(
            self._modal, absolute_xyz=state.absolute_xyz, absolute_e=state.absolute_e
        )
        return text

    def _on(self, piece: Piece) -> bytes:
        """Lines before the first segment of a piece."""
        parts: list[bytes] = []
        if not self._at_rest:
            parts.append(_STOP)
        if not self._streaming:
            parts.append(b"; stillpath: stream on\n")
            if not self._shaper_off:
                parts.append(b"SET_INPUT_SHAPER SHAPER_FREQ_X=0 SHAPER_FREQ_Y=0\n")
                self._shaper_off = True
            parts.append(_limits_line(self._limits))
            self._limits_now = self._limits
            self._streaming = True
        if self._modal is None:
            self._modal = piece.modal_before
        return b"".join(parts)

    def _off(self, passage: Passage) -> bytes:
        """Lines that give the printer back to the file."""
        if not self._streaming:
            return self._shaper_before(passage)
        stop = b"" if self._at_rest or _extruder_only(passage, 0) else _STOP
        text = stop + self._stream_off(passage.limits_before, passage.modal_before)
        return text + self._shaper_before(passage)

    def _end(self) -> bytes:
        """Lines that give the printer back at the end of the file."""
        text = b""
        if self._streaming and self._behind is not None:
            text = (b"" if self._at_rest else _STOP) + self._stream_off(*self._behind)
        return text + self._shaper_on()

    def _stream_off(self, limits: Limits, state: ModalState) -> bytes:
        self._streaming = False
        text = _limits_line(limits) + self._file_modes(state)
        self._modal = None
        return text + _feed_line(self._file_feed_mm_min) + b"; stillpath: stream off\n"

    def _shaper_before(self, passage: Passage) -> bytes:
        """Set the firmware's shaper again before lines that move X or Y on their own."""
        travel = passage.moves.end_mm - passage.moves.start_mm
        moves_xy = bool(np.any(travel[:, :2] != 0.0))
        foreign = bool(np.any(passage.events.kind == EventKind.UNKNOWN))
        return self._shaper_on() if moves_xy or foreign else b""

    def _shaper_on(self) -> bytes:
        if not self._shaper_off:
            return b""
        self._shaper_off = False
        if self._shaper is None and not self._shaper_lines:
            self.shaper_unknown = True
            self._shaper_off = True
            return b""
        text = b""
        if self._shaper is not None:
            s = self._shaper
            text = (
                f"SET_INPUT_SHAPER SHAPER_TYPE_X={s.type_x} SHAPER_FREQ_X={s.freq_x_hz:g} "
                f"DAMPING_RATIO_X={s.damping_x:g} SHAPER_TYPE_Y={s.type_y} "
                f"SHAPER_FREQ_Y={s.freq_y_hz:g} DAMPING_RATIO_Y={s.damping_y:g}\n"
            ).encode()
        return text + b"".join(self._shaper_lines)


def _held_back(line: bytes) -> bytes:
    return b"; stillpath, held back: " + line


def _shifted_e(line: bytes, gap_mm: float) -> bytes:
    """Return a G92 line whose E is larger by `gap_mm`: the extruder is that far ahead."""
    code, mark, comment = line.partition(b";")
    word = _E_WORD.search(code)
    if word is None or abs(gap_mm) < _LEAST_GAP_MM:
        return line
    value = f"E{float(word.group(1)) + gap_mm:.7f}".encode()
    return code[: word.start()] + value + code[word.end() :] + mark + comment


def _limits_line(limits: Limits) -> bytes:
    # ACCEL_TO_DECEL is what Klipper before 2024-03 reads instead of MINIMUM_CRUISE_RATIO.
    to_decel = limits.accel_mm_s2 * (1.0 - limits.minimum_cruise_ratio)
    return (
        f"SET_VELOCITY_LIMIT VELOCITY={limits.velocity_mm_s:.10g} ACCEL={limits.accel_mm_s2:.10g} "
        f"ACCEL_TO_DECEL={to_decel:.10g} "
        f"SQUARE_CORNER_VELOCITY={limits.square_corner_velocity_mm_s:.10g} "
        f"MINIMUM_CRUISE_RATIO={limits.minimum_cruise_ratio:.10g}\n"
    ).encode()


def _feed_line(feedrate_mm_min: float) -> bytes:
    digits = f"{feedrate_mm_min:.5f}".rstrip("0").rstrip(".")
    return f"G1 F{digits}\n".encode()


def _integer_origin(state: ModalState) -> NDArray[np.int64]:
    return np.round(np.array(state.origin_mm) * 1e6).astype(np.int64)


def _extruder_only(passage: Passage, row: int) -> bool:
    """Whether a move of the passage stops the machine before and after itself."""
    moves, events = passage.moves, passage.events
    if len(moves) == 0:
        return bool(np.any((events.kind >= EventKind.STOP) & (events.kind != EventKind.OBJECT)))
    if row == 0 and np.any(
        (events.move_index == 0)
        & (events.kind >= EventKind.STOP)
        & (events.kind != EventKind.OBJECT)
    ):
        return True
    travel = moves.end_mm[row] - moves.start_mm[row]
    return bool(travel[0] == 0.0 and travel[1] == 0.0 and travel[2] == 0.0)
