"""Interpret bytes as moves and events by the dialect of a firmware.

`Interpreter` takes a file in chunks of any size. The kernel (`_lex_kernels.run`) executes the plain
lines; lines that it hands back are executed here. Every byte of the file belongs to exactly one
line, and every line is one event, or one or more moves, or moves followed by the event that stops
the machine.
"""

from __future__ import annotations

import copy
import re
from collections.abc import Iterator
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from stillpath.gcode import _slots as at
from stillpath.gcode._command_kernels import execute
from stillpath.gcode._lex_kernels import PADDING, run
from stillpath.gcode.commands import hold_laser
from stillpath.gcode.comments import note_comment
from stillpath.gcode.dialect import Action, Dialect
from stillpath.gcode.errors import GcodeError
from stillpath.gcode.firmware.dialects import dialect_of
from stillpath.gcode.firmware.registry import adapter
from stillpath.gcode.lexer import Command, check_line_ends, further_words, odd_numbers, split_line
from stillpath.gcode.meta import META_WORDS, expression_line, held_back, meta_command
from stillpath.gcode.state import EXTRUDER_MODE, MachineState, nobody
from stillpath.gcode.types import KEPT, EventKind, Events, Limits, ModalState, Moves, ProgramBlock
from stillpath.models.machine import Machine

__all__ = ["Interpreter"]

_BOM = b"\xef\xbb\xbf"
_BOM_16 = (b"\xff\xfe", b"\xfe\xff")
_MOVE = re.compile(rb"\s*G0*[0-3](?![\d.])", re.IGNORECASE)
_PAD = b"\n" * PADDING
_MOTION_OF = {Action.MOVE: 1, Action.ARC_CW: 2, Action.ARC_CCW: 3}
"""The G that a line without one repeats."""
_BLOCK_BYTES, _CHUNK = 1 << 17, 1 << 20
_LONGEST_LINE = 1 << 24
_LONGEST_COMMAND = 65_536
_FEWEST_ROWS, _MOST_ROWS = 1024, 32_768
_SHORT_LINE = 24  # bytes; rows are allocated for lines of about this length
_SPARE_ROWS = 8  # as many as a handler in Python may write for one command


class Interpreter:
    """Read G-code in pieces.

    Parameters
    ----------
    machine : Machine
        Its firmware facts and travel.
    strict_bounds : bool
        Refuse moves that leave the travel of an axis whose position is known.
    dialect : Dialect, optional
        How the file is read; None: as the machine's firmware does.

    Attributes
    ----------
    feature_names : list of str
        Names behind the `feature` column.

    Notes
    -----
    Moves that a line other than G0 to G3 and G5 makes (G10, G11, G61, RESTORE_GCODE_STATE MOVE=1,
    SET_GCODE_OFFSET MOVE=1) have no known axis: such a line does more than move, and must stay.
    All but G10 and G11 have the bit `OF_STATE`.
    """

    def __init__(
        self, machine: Machine, *, strict_bounds: bool = True, dialect: Dialect | None = None
    ) -> None:
        self.machine = machine
        dialect = dialect or dialect_of(machine.firmware)
        limits = adapter(machine).initial_limits()
        self.state = MachineState(machine, dialect, limits, strict=strict_bounds)
        if not dialect.extruder_mode_known:
            self.state.hold(EXTRUDER_MODE, True)
        self._modal: list[ModalState] = []
        self._limits: list[Limits] = []
        self._pending: list[bytes] = []
        self._pending_bytes = 0
        self._offset = 0
        self._first_move = 0
        self._text = b""

    @property
    def dialect(self) -> Dialect:
        """Rules and words in force; RepRapFirmware's modes change them."""
        return self.state.dialect

    @property
    def feature_names(self) -> list[str]:
        """Names behind the `feature` column."""
        return self.state.features.names

    @property
    def warnings(self) -> list[str]:
        """Commands that the firmware skips, or whose effect is unknown before the print."""
        return [f"line {line}: {text}" for text, line in self.state.warnings.items()]

    @property
    def macro_with_limits(self) -> tuple[str, int] | None:
        """Name and line of a macro whose limits may be meant: the file states no acceleration."""
        return None if self.state.states_acceleration else self.state.first_macro

    @property
    def position_mm(self) -> NDArray[np.float64]:
        """Where the firmware believes the tool is: x y z e, shape (4,)."""
        return self.state.f[at.F_LAST : at.F_LAST + 4].copy()

    @property
    def extruder_mm(self) -> float:
        """What the firmware takes for E: counted from the last G92, in the file's own measure."""
        f = self.state.f
        return float((f[at.F_LAST + 3] - f[at.F_BASE + 3]) / f[at.F_EXTRUDE_FACTOR])

    @property
    def known(self) -> int:
        """Bit 0..2 set: x, y, z are known."""
        return int(self.state.i[at.I_KNOWN])

    def push(self, data: bytes) -> list[ProgramBlock]:
        """Read the next bytes of the file; return the content of complete lines.

        Raises
        ------
        GcodeError
            For a line that the firmware would reject or that leaves the travel.
        """
        blocks: list[ProgramBlock] = []
        for first in range(0, len(data), _CHUNK):
            blocks += self._push(data[first : first + _CHUNK] if len(data) > _CHUNK else data)
        return blocks

    def flush(self) -> list[ProgramBlock]:
        """Interpret the rest as the last line; it may lack its newline."""
        text = b"".join((*self._pending, _PAD))
        self._pending, self._pending_bytes = [], 0
        if _MOVE.match(text):
            self.state.warn(
                "the file ends with a move and without a line end: it may have been cut off; "
                "compare its size, and copy or export it again"
            )
        return self._read(text) if len(text) > PADDING else []

    def blocks(self, file: BinaryIO) -> Iterator[ProgramBlock]:
        """Read a file from its present position to its end; errors are those of `push`."""
        while data := file.read(_BLOCK_BYTES):
            yield from self.push(data)
        yield from self.flush()

    def snapshot(self) -> Interpreter:
        """Return an independent interpreter that continues from here."""
        other = copy.copy(self)
        other.state = self.state.snapshot()
        for name in ("_modal", "_limits", "_pending"):
            setattr(other, name, getattr(self, name).copy())
        return other

    # Reading

    def _push(self, data: bytes) -> list[ProgramBlock]:
        first = data.find(b"\n") if self._pending_bytes else -1
        if self._pending_bytes + (len(data) if first < 0 else first) > _LONGEST_LINE + _CHUNK:
            raise GcodeError(
                f"the line has more than {_LONGEST_LINE} bytes; is this G-code?",
                line=int(self.state.i[at.I_LINE]),
            )
        cut = data.rfind(b"\n") + 1
        if cut == 0:
            self._pending.append(data)
            self._pending_bytes += len(data)
            return []
        text = b"".join((*self._pending, memoryview(data)[:cut], _PAD))
        self._pending = [data[cut:]] if cut < len(data) else []
        self._pending_bytes = len(data) - cut
        return self._read(text)

    def _read(self, text: bytes) -> list[ProgramBlock]:
        """Read whole lines; after them is the padding."""
        # Set only temporarily: a reference cycle would delay freeing snapshots.
        self.state.carry_out = self._command
        try:
            return self._read_lines(text)
        finally:
            self.state.carry_out = nobody

    def _read_lines(self, text: bytes) -> list[ProgramBlock]:
        state, i = self.state, self.state.i
        stop = len(text) - PADDING
        check_line_ends(text, int(i[at.I_LINE]), self.dialect)
        self._text = text
        state.buffer = np.frombuffer(text, np.uint8)
        i[at.I_POS] = 0
        i[at.I_OFFSET] = self._offset
        blocks: list[ProgramBlock] = []
        begun = 0
        self._allocate(stop)
        while True:
            status = run(state.buffer, stop, state.f, i, state.w, state.rows, state.tables)
            if status == at.HANDBACK:
                status = self._carry_out()
            if status >= at.ERROR_INCHES:
                status = self._failed(status)
            if status == at.OK:
                i[at.I_POS] = i[at.I_END]
                i[at.I_LINE] += 1
            elif status == at.GROW:
                state.grow_tables()
            elif status == at.FULL and i[at.I_MOVES] == 0 and i[at.I_EVENTS] == 0:
                self._allocate(stop - begun, int(i[at.I_NEED]))
            else:
                if status != at.DONE:
                    state.settle()
                end = int(i[at.I_POS])
                blocks.append(self._block(begun, end))
                begun = end
                if status == at.DONE:
                    break
                self._allocate(stop - begun)
        self._offset += stop
        self._text = b""
        return blocks

    def _allocate(self, size: int, need: int = 0) -> None:
        rows = max(min(size // _SHORT_LINE, _MOST_ROWS), _FEWEST_ROWS, need) + _SPARE_ROWS
        self.state.allocate(rows)

    def _block(self, begun: int, end: int) -> ProgramBlock:
        """Hand the rows over; they must be settled."""
        state, i = self.state, self.state.i
        n, m = int(i[at.I_MOVES]), int(i[at.I_EVENTS])
        self._note_tables()
        moves = state.rows.moves(n, apart=bool(i[at.I_APART]))
        events = state.rows.events(m)
        if 2 * (n + m) < state.rows.room:
            # A view of a few rows would keep the whole buffer alive.
            moves = {name: column.copy() for name, column in moves.items()}
            events = {name: column.copy() for name, column in events.items()}
        block = ProgramBlock(
            first_move=self._first_move,
            moves=Moves(**moves),
            events=Events(**events),
            limits=self._limits,
            modal=self._modal,
            text_offset=self._offset + begun,
            text=self._text[begun:end],
        )
        self._first_move += n
        if state.forget_rows():
            self._limits, self._modal = [], []
        return block

    def _note_tables(self) -> None:
        """Bring the public tables up to the kernel's."""
        i, tables = self.state.i, self.state.tables
        for row in tables.modal[len(self._modal) : int(i[at.I_N_MODAL])].tolist():
            absolute_xyz, absolute_e, speed, extrude, x, y, z = row
            self._modal.append(
                ModalState(bool(absolute_xyz), bool(absolute_e), speed, extrude, (x, y, z))
            )
        for row in tables.limits[len(self._limits) : int(i[at.I_N_LIMITS])].tolist():
            self._limits.append(self.state.limits_type.from_row(row))

    # Lines that the kernel hands back

    def _carry_out(self) -> int:
        """Carry out the line in hand; return a kernel status."""
        state, i = self.state, self.state.i
        if max(int(i[at.I_MOVES]), int(i[at.I_EVENTS])) + _SPARE_ROWS > state.rows.room:
            i[at.I_NEED] = _SPARE_ROWS
            return at.FULL
        raw = self._raw()
        text = raw.decode("utf-8", "replace")
        if text.startswith(";"):
            state.span = int(i[at.I_POS]), int(i[at.I_END]) - text.endswith("\n")
            return note_comment(state, Command("", {}, text))
        if len(text) > _LONGEST_COMMAND and len(text.split(";", 1)[0]) > _LONGEST_COMMAND:
            raise GcodeError(
                f"the command has more than {_LONGEST_COMMAND} characters; is this G-code?",
                line=int(i[at.I_LINE]),
                text=text,
            )
        start = int(i[at.I_POS]) + _skipped(raw, b"Nn" if self.dialect.fold_case else b"N")
        end = int(i[at.I_END])
        state.span = (start, end - 1 if self._text[end - 1 : end] == b"\n" else end)
        commands = self._split(text)
        if len(commands) > 1:
            state.remembers = False  # the effect of one command is not that of the line
            status = self._several(commands)
            state.remembers = True
            return status
        (command,) = commands
        if not command.name and not (command.words and self.dialect.modal_words):
            return note_comment(state, command)
        return self._command(command)

    def _split(self, text: str) -> list[Command]:
        try:
            return split_line(text, self.dialect)
        except GcodeError as error:
            raise GcodeError(
                error.message, line=int(self.state.i[at.I_LINE]), text=error.text
            ) from None

    def _raw(self) -> bytes:
        i = self.state.i
        raw = self._text[int(i[at.I_POS]) : int(i[at.I_END])]
        if i[at.I_LINE] == 1 and raw.startswith(_BOM):
            raw = raw[len(_BOM) :]
        elif i[at.I_LINE] == 1 and raw.startswith(_BOM_16):
            raise GcodeError("the file is UTF-16, which no printer reads; save it as UTF-8", line=1)
        return raw

    def _command(self, command: Command) -> int:
        state, dialect = self.state, self.dialect
        if dialect.expressions:
            held = held_back(state, command)
            if held is not None:
                return held
        if command.dropped:
            state.warn(f"the firmware drops the line: {command.dropped}")
            return state.event(EventKind.HARMLESS)
        if dialect.expressions and command.name in META_WORDS:
            return meta_command(state, command)
        name = command.name
        if not name:
            motion = int(state.i[at.I_MOTION])
            if motion < 0:
                state.warn("coordinates without a command are passed over")
                return state.event(EventKind.HARMLESS)
            name = f"G{motion}"
        word = dialect.word(name)
        if command.uncertain:
            return expression_line(state, word, command)
        if isinstance(word, Action):
            return self._classic(word, name, command)
        if isinstance(word, EventKind):
            if word == EventKind.UNKNOWN:
                state.called(name)
            state.remember(command, at.MEMO_EVENT, int(word))
            return state.event(word)
        return word(state, command)

    def _classic(self, action: Action, name: str, command: Command) -> int:
        """Execute a kernel command with numbers parsed in Python."""
        state = self.state
        if Action.MOVE <= action <= Action.ARC_CCW:
            odd = self.dialect.odd_move
            if action == Action.MOVE and odd is not None:
                handled = odd(state, command)
                if handled >= 0:
                    return handled
            state.i[at.I_MOTION] = _MOTION_OF[action]
            for given, read in odd_numbers(command):
                how = f"reads it as {read}" if read else "passes it over"
                state.warn(f"{given} is not a number, and {self.dialect.title} {how}; correct it")
        needed = self.dialect.needed.get(name, "")
        for word in command.words:
            if word[1:] in ("NAN", "INF", "INFINITY") and word[0] in needed:
                # Klipper would skip such a word; whoever wrote it meant a coordinate.
                raise state.problem(
                    f"{word[0]} is {word[1:]}, not a number; write a decimal number", command
                )
        mask = 0
        for letter, value in state.numbers(command, needed).items():
            if letter == "E" and ":" in command.words["E"]:
                # Filament of all extruders that feed this move.
                value = sum(state.number(v, "E", command) for v in command.words["E"].split(":"))
            state.w[ord(letter) - 65] = value
            mask |= 1 << (ord(letter) - 65)
        more = further_words(command) if Action.MOVE <= action <= Action.ARC_CCW else ""
        if more:
            state.warn(f"moves of other axes, extruders or lasers ({more}) stay as sliced")
            if state.cutter_on and "S" in more:
                hold_laser(state)
            return self._as_it_is(action, mask)
        return execute(int(action), state.w, mask, state.f, state.i, state.rows, state.tables)

    def _as_it_is(self, action: Action, mask: int) -> int:
        """Execute a move whose line must stay; where X, Y, Z and E rest, something else moves."""
        state, i = self.state, self.state.i
        kept, events = int(i[at.I_KEPT]), int(i[at.I_EVENTS])
        state.settle()
        i[at.I_KEPT] = KEPT
        status = execute(int(action), state.w, mask, state.f, i, state.rows, state.tables)
        state.settle()
        i[at.I_KEPT] = kept
        if i[at.I_EVENTS] > events and state.rows.tiny[at.E_KIND, events] == EventKind.MODE:
            state.rows.tiny[at.E_KIND, events] = EventKind.STOP
        return int(status)

    def _several(self, commands: list[Command]) -> int:
        """Execute the commands of one line, which stays whole, so its moves are not replaced.

        Nor may modes and limits that it sets be held back: they end a stream.
        """
        state, i = self.state, self.state.i
        before = state.f.copy(), i.copy()
        events, moves = int(i[at.I_EVENTS]), int(i[at.I_MOVES])
        kinds = {EventKind.HARMLESS}
        for command in commands:
            i[at.I_EVENTS] = events
            status = self._command(command)
            if status >= at.ERROR_INCHES:
                status = self._failed(status)
            if status != at.OK:
                state.f[:], need = before[0], int(i[at.I_NEED])
                i[:] = before[1]
                i[at.I_NEED] = need
                return status
            if i[at.I_EVENTS] > events:
                kinds.add(EventKind(int(state.rows.tiny[at.E_KIND, events])))
        worst = _together(kinds)
        i[at.I_EVENTS] = events
        for filled in (at.I_FILLED_EVENTS, at.I_LIMITED_EVENTS):
            i[filled] = min(int(i[filled]), events)
        state.settle()
        if i[at.I_MOVES] > moves:
            state.rows.tiny[at.M_KNOWN, moves : int(i[at.I_MOVES])] &= KEPT
        if worst in (EventKind.MODE, EventKind.LIMITS):
            worst = EventKind.STATE
        if i[at.I_MOVES] == moves or worst >= EventKind.STOP:
            known = int(i[at.I_KNOWN])
            state.event(worst)
            state.settle()
            i[at.I_KNOWN] = known
        return at.OK

    def _failed(self, status: int) -> int:
        """Raise the error of the current line, unless the firmware skips it."""
        state, i, f = self.state, self.state.i, self.state.f
        if status == at.ERROR_ARC_CENTER and self.dialect.bad_arcs_pass:
            state.warn(f"{self.dialect.title} passes over an arc without a centre")
            return state.event(EventKind.MODE)
        value, limit = float(f[at.F_ERROR]), float(f[at.F_ERROR + 1])
        axis = "XYZE"[int(i[at.I_ERROR_AXIS])]
        message = _MESSAGES[status].format(
            axis=axis, value=value, limit=limit, firmware=self.dialect.title
        )
        raise GcodeError(
            message, line=int(i[at.I_LINE]), text=self._raw().decode("utf-8", "replace")
        )


_MESSAGES = {
    at.ERROR_INCHES: "{firmware} has no G20 (inches); slice in millimetres",
    at.ERROR_FEED: "the feedrate F{value:g} must be above 0 and below 1e9 mm/min",
    at.ERROR_SLOW: "the speed {value:g} mm/s is below {limit:g} mm/s; raise F or M220",
    at.ERROR_TRAVEL: "{axis} {value:.3f} mm lies outside the machine's travel, which ends at "
    "{limit:.3f} mm; move the model or correct the machine's travel",
    at.ERROR_RANGE: "{axis} {value:g} is beyond {limit:g} mm; correct it",
    at.ERROR_ARC_RADIUS: "Klipper's arcs do not take R; slice with I and J",
    at.ERROR_ARC_RELATIVE: "Klipper has no arcs in relative mode; use G90 before them",
    at.ERROR_ARC_CENTER: "the arc names no centre; give I and J (G18: I K, G19: J K)",
    at.ERROR_ARC_LONG: "the arc has {value:.0f} pieces or turns, more than {limit:.0f}; correct "
    "its centre or P",
    at.ERROR_ARC_SHORT: "the arc's R is too short to reach its end; correct it",
    at.ERROR_ARC_ENDS: "the arc ends {value:.3f} mm off its circle, more than {limit:g} mm; "
    "correct its centre",
    at.ERROR_ARC_SAME: "an arc with R cannot end where it begins; give I and J",
    at.ERROR_ARC_TURNS: "this Marlin divides by zero for a clockwise circle with P1; leave P out",
    at.ERROR_POSITIVE: "the value {value:g} is out of range; it must be above 0 (P of G4: not "
    "below 0)",
}


def _skipped(raw: bytes, letters: bytes) -> int:
    """Count the bytes before the command, as the kernel does: blanks and an N word."""
    k = 0
    while raw[k : k + 1] in (b" ", b"\t", b"\r"):
        k += 1
    if raw[k : k + 1] in letters and raw[k + 1 : k + 2] in _BLANK_OR_DIGIT:
        k += 1
        while raw[k : k + 1] in _BLANK_OR_DIGIT:
            k += 1
    return k


_BLANK_OR_DIGIT = frozenset(bytes([c]) for c in b" 0123456789")


def _together(kinds: set[EventKind]) -> EventKind:
    """Return the combined effect of the commands of a line."""
    told = kinds - {EventKind.HARMLESS}
    if EventKind.UNKNOWN in told or (EventKind.SHAPER in told and len(told) > 1):
        # A line that sets the shaper is repeated after streams, but this one does more.
        return EventKind.UNKNOWN
    # Where the motion stops, modes and what the printer keeps are the file's.
    stopping = told - {EventKind.MODE, EventKind.LIMITS, EventKind.STATE}
    return max(stopping or told, default=EventKind.HARMLESS)
