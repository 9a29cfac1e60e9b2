"""RepRapFirmware's meta commands and expressions, whose results are unknown before the print.

Lines of a block after ``if`` or ``while`` may be executed once, often or never. Those that do not
touch the motion are read as usual; any other remains a barrier after which the place is unknown.
Source: RepRapFirmware src/GCodes/GCodeBuffer/StringParser.cpp, 3.5.
"""

from __future__ import annotations

from stillpath.gcode import _slots as at
from stillpath.gcode._motion_kernels import set_feed
from stillpath.gcode.dialect import Action, Word
from stillpath.gcode.lexer import Command
from stillpath.gcode.state import MachineState
from stillpath.gcode.types import EventKind

__all__ = ["META_WORDS", "expression_line", "held_back", "meta_command"]

_OPENING = ("if", "elif", "else", "while")
_HARMLESS = ("var", "global", "set", "echo", "skip")
META_WORDS = frozenset({*_OPENING, *_HARMLESS, "break", "continue", "abort"})
_ADVANCE = "M572"
_SETTINGS = frozenset({"M201", "M203", "M204", "M205", "M207", "M566", _ADVANCE})
_WHATEVER_VALUES = (EventKind.HARMLESS, EventKind.STOP, EventKind.SHAPER)
"""A shaper's line is said again as it is."""
_HEATS = frozenset({"M109", "G10"})
_OFFSETS = frozenset("LXYZUVWABCD")
"""Words with which G10 sets more than temperatures."""


def meta_command(state: MachineState, command: Command) -> int:
    """Carry out ``if``, ``while``, ``var``, ``echo`` and the like as far as a reader can."""
    if command.name in _HARMLESS:
        return state.event(EventKind.HARMLESS)
    state.warn(
        "the file has conditional G-code; what it moves is not known before the print, and stays "
        "as it is"
    )
    if command.name in _OPENING:
        state.conditional_indent = _indent(command.text)
        state.i[at.I_HOLD] = 1
    return state.event(EventKind.UNKNOWN)


def expression_line(state: MachineState, word: Word, command: Command) -> int:
    """Pass a line by whose values only the firmware can work out; a move's own E and F count."""
    if isinstance(word, EventKind) and word in _WHATEVER_VALUES:
        return state.event(word)
    if _heats(command) and not isinstance(word, Action | EventKind):
        return word(state, command)
    if command.name in _SETTINGS:
        return _setting(state, command)
    if isinstance(word, Action) and word <= Action.ARC_CCW:
        stated = {k: v for k, v in command.words.items() if k in "EF" and v and v[0] not in "{:"}
        if "F" in stated:
            status = set_feed(state.f, state.i, state.number(stated["F"], "F", command))
            if status != at.OK:
                return int(status)
        if "E" in stated and ":" not in stated["E"]:
            _feed(state, state.number(stated["E"], "E", command))
    state.warn("the line holds an expression; from here on the position is not known")
    state.forget(origin=_may_shift(word))
    return state.event(EventKind.UNKNOWN)


def _setting(state: MachineState, command: Command) -> int:
    """Pass a limit or pressure advance by; a stream holds the latter, so moves wait for a number.

    Coordinates are read as before.
    """
    if command.name == _ADVANCE:
        state.warn(
            "M572 under a condition or with an expression: pressure advance is not known before "
            "the print, so moves stay as sliced from here to an M572 with a number"
        )
        state.hold("pressure advance", True)
    else:
        state.warn(
            f"{command.name} under a condition or with an expression: its values are not known "
            "before the print, and behind compensated stretches the machine's, or those of the "
            "file's other lines, are in force; write numbers"
        )
    return state.event(EventKind.UNKNOWN)


def held_back(state: MachineState, command: Command) -> int | None:
    """Handle a line of a conditional block; None: the block has ended or there is none."""
    if state.conditional_indent < 0:
        return None
    if _indent(command.text) <= state.conditional_indent:
        state.conditional_indent = -1
        state.i[at.I_HOLD] = 0
        return None
    if command.name in META_WORDS:
        harmless = command.name in _HARMLESS
        return state.event(EventKind.HARMLESS if harmless else EventKind.UNKNOWN)
    word = state.dialect.word(command.name)
    if word == EventKind.HARMLESS or _is_in_force(state, word, command):
        return state.event(EventKind.HARMLESS)
    if command.name in _SETTINGS:
        return _setting(state, command)
    if command.name[:1] == "T" and not isinstance(word, Action | EventKind):
        status = word(state, command)  # who asks for a tool under a condition has it afterwards
        state.tool_known = False
        return status
    if command.name != "G28" and not _heats(command):
        state.forget(origin=_may_shift(word))
    return state.event(EventKind.UNKNOWN)


def _is_in_force(state: MachineState, word: Word, command: Command) -> bool:
    """Return whether a command sets the mode that there is, so that nobody needs to know of it."""
    if not isinstance(word, Action):
        return False
    xyz, e = bool(state.i[at.I_ABS_XYZ]), bool(state.i[at.I_ABS_E])
    return {
        Action.ABSOLUTE: xyz,
        Action.RELATIVE: not xyz,
        Action.ABSOLUTE_E: e,
        Action.RELATIVE_E: not e,
        Action.MILLIMETRES: bool(state.f[at.F_UNIT_MM] == 1.0),
        # The place of E counts where E is absolute.
        Action.SET_POSITION: not e and command.words.keys() <= {"E"},
    }.get(word, False)


def _heats(command: Command) -> bool:
    """Return whether a command only sets temperatures, and waits for them."""
    return command.name in _HEATS and not _OFFSETS & command.words.keys()


def _may_shift(word: Word) -> bool:
    """Return whether coordinates may be read otherwise behind a command that may be executed.

    A pause or a macro leaves modes and origin, as it does without a condition.
    """
    if isinstance(word, Action):
        return word > Action.DWELL
    return not isinstance(word, EventKind)


def _feed(state: MachineState, e_value: float) -> None:
    """Set the extruder to the E of a line that is not followed as a move."""
    f = state.f
    state.settle()
    length_mm = e_value * f[at.F_UNIT_E_MM] * f[at.F_EXTRUDE_FACTOR]
    f[at.F_LAST + 3] = length_mm + f[at.F_BASE + 3 if state.i[at.I_ABS_E] else at.F_LAST + 3]
    f[at.F_TOOL + 3] = f[at.F_LAST + 3]


def _indent(text: str) -> int:
    """Return the indentation; a tab extends to the next multiple of 4."""
    width = 0
    for c in text:
        if c == " ":
            width += 1
        elif c == "\t":
            width = (width + 4) & ~3
        else:
            break
    return width
