"""Carry out the lines that the kernel hands back (`at.HANDBACK`): whatever is not plain.

A line is split here (`gcode.lexer`), and each of its commands goes to a handler in Python or, with
its numbers read, to the kernel.
"""

from __future__ import annotations

from stillpath.gcode import _slots as at
from stillpath.gcode._command_kernels import execute
from stillpath.gcode.commands import hold_laser
from stillpath.gcode.comments import note_comment
from stillpath.gcode.dialect import Action
from stillpath.gcode.errors import GcodeError
from stillpath.gcode.lexer import Command, further_words, odd_numbers, split_line
from stillpath.gcode.meta import META_WORDS, expression_line, held_back, meta_command
from stillpath.gcode.state import MachineState
from stillpath.gcode.types import KEPT, EventKind

__all__ = ["SPARE_ROWS", "carry_out", "carry_out_line", "refuse_or_skip"]

SPARE_ROWS = 8
"""As many as a handler in Python may write for one command."""
_BOM = b"\xef\xbb\xbf"
_BOM_16 = (b"\xff\xfe", b"\xfe\xff")
_LONGEST_COMMAND = 65_536
_MOTION_OF = {Action.MOVE: 1, Action.ARC_CW: 2, Action.ARC_CCW: 3}
"""The G that a line without one repeats."""


def carry_out_line(state: MachineState) -> int:
    """Carry out the line in hand; return a kernel status.

    Raises
    ------
    GcodeError
        For a line that the firmware would reject.
    """
    i, dialect = state.i, state.dialect
    if max(int(i[at.I_MOVES]), int(i[at.I_EVENTS])) + SPARE_ROWS > state.rows.room:
        i[at.I_NEED] = SPARE_ROWS
        return at.FULL
    raw = _raw_line(state)
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
    start = int(i[at.I_POS]) + _skipped(raw, b"Nn" if dialect.fold_case else b"N")
    state.span = start, int(i[at.I_END]) - raw.endswith(b"\n")
    commands = _split(state, text)
    if len(commands) > 1:
        state.remembers = False  # the effect of one command is not that of the line
        status = _several(state, commands)
        state.remembers = True
        return status
    (command,) = commands
    if not command.name and not (command.words and dialect.modal_words):
        return note_comment(state, command)
    return carry_out(state, command)


def carry_out(state: MachineState, command: Command) -> int:
    """Carry out a command of the line in hand; return a kernel status.

    Raises
    ------
    GcodeError
        For a value that the firmware would reject.
    """
    dialect = state.dialect
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
        return _classic(state, word, name, command)
    if isinstance(word, EventKind):
        if word == EventKind.UNKNOWN:
            state.called(name)
        state.remember(command, at.MEMO_EVENT, int(word))
        return state.event(word)
    return word(state, command)


def refuse_or_skip(state: MachineState, status: int) -> int:
    """Raise the error of the line in hand that a kernel found, unless the firmware skips the line.

    Parameters
    ----------
    status : int
        An ``ERROR_`` of `gcode._slots`.

    Returns
    -------
    int
        Kernel status of the skipped line.

    Raises
    ------
    GcodeError
    """
    i, f, dialect = state.i, state.f, state.dialect
    if status == at.ERROR_ARC_CENTER and dialect.bad_arcs_pass:
        state.warn(f"{dialect.title} passes over an arc without a centre")
        return state.event(EventKind.MODE)
    value, limit = float(f[at.F_ERROR]), float(f[at.F_ERROR + 1])
    axis = "XYZE"[int(i[at.I_ERROR_AXIS])]
    message = _MESSAGES[status].format(axis=axis, value=value, limit=limit, firmware=dialect.title)
    raise GcodeError(
        message, line=int(i[at.I_LINE]), text=_raw_line(state).decode("utf-8", "replace")
    )


def _split(state: MachineState, text: str) -> list[Command]:
    try:
        return split_line(text, state.dialect)
    except GcodeError as error:
        raise GcodeError(error.message, line=int(state.i[at.I_LINE]), text=error.text) from None


def _several(state: MachineState, commands: list[Command]) -> int:
    """Execute the commands of one line, which stays whole, so its moves are not replaced.

    Nor may modes and limits that it sets be held back: they end a stream.
    """
    i = state.i
    before = state.f.copy(), i.copy()
    events, moves = int(i[at.I_EVENTS]), int(i[at.I_MOVES])
    kinds = {EventKind.HARMLESS}
    for command in commands:
        i[at.I_EVENTS] = events
        status = carry_out(state, command)
        if status >= at.ERROR_INCHES:
            status = refuse_or_skip(state, status)
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


def _together(kinds: set[EventKind]) -> EventKind:
    """Return the combined effect of the commands of a line."""
    told = kinds - {EventKind.HARMLESS}
    if EventKind.UNKNOWN in told or (EventKind.SHAPER in told and len(told) > 1):
        # A line that sets the shaper is repeated after streams, but this one does more.
        return EventKind.UNKNOWN
    # Where the motion stops, modes and what the printer keeps are the file's.
    stopping = told - {EventKind.MODE, EventKind.LIMITS, EventKind.STATE}
    return max(stopping or told, default=EventKind.HARMLESS)


def _classic(state: MachineState, action: Action, name: str, command: Command) -> int:
    """Execute a kernel command with numbers parsed in Python."""
    dialect = state.dialect
    if Action.MOVE <= action <= Action.ARC_CCW:
        odd = dialect.odd_move
        if action == Action.MOVE and odd is not None:
            handled = odd(state, command)
            if handled >= 0:
                return handled
        state.i[at.I_MOTION] = _MOTION_OF[action]
        for given, read in odd_numbers(command):
            how = f"reads it as {read}" if read else "passes it over"
            state.warn(f"{given} is not a number, and {dialect.title} {how}; correct it")
    needed = dialect.needed.get(name, "")
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
        return _as_it_is(state, action, mask)
    return execute(int(action), state.w, mask, state.f, state.i, state.rows, state.tables)


def _as_it_is(state: MachineState, action: Action, mask: int) -> int:
    """Execute a move whose line must stay; where X, Y, Z and E rest, something else moves."""
    i = state.i
    kept, events = int(i[at.I_KEPT]), int(i[at.I_EVENTS])
    state.settle()
    i[at.I_KEPT] = KEPT
    status = execute(int(action), state.w, mask, state.f, i, state.rows, state.tables)
    state.settle()
    i[at.I_KEPT] = kept
    if i[at.I_EVENTS] > events and state.rows.tiny[at.E_KIND, events] == EventKind.MODE:
        state.rows.tiny[at.E_KIND, events] = EventKind.STOP
    return int(status)


def _raw_line(state: MachineState) -> bytes:
    """Return the line in hand with its newline, without a byte order mark."""
    i = state.i
    raw = state.buffer[int(i[at.I_POS]) : int(i[at.I_END])].tobytes()
    if i[at.I_LINE] == 1 and raw.startswith(_BOM):
        raw = raw[len(_BOM) :]
    elif i[at.I_LINE] == 1 and raw.startswith(_BOM_16):
        raise GcodeError("the file is UTF-16, which no printer reads; save it as UTF-8", line=1)
    return raw


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
