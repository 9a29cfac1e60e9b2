"""RepRapFirmware's meta commands, whose decisions are unknown before the print.

Lines of a block after ``if`` or ``while`` may be executed once, often or never. Those that do not
touch the motion are read as usual; any other remains a barrier after which the place is unknown.
Source: RepRapFirmware src/GCodes/GCodeBuffer/StringParser.cpp, 3.5.
"""

from __future__ import annotations

from stillpath.gcode import _slots as at
from stillpath.gcode.dialect import Action
from stillpath.gcode.lexer import Command
from stillpath.gcode.state import MachineState
from stillpath.gcode.types import EventKind

__all__ = ["META_WORDS", "held_back", "meta_command"]

_OPENING = ("if", "elif", "else", "while")
_HARMLESS = ("var", "global", "set", "echo", "skip")
META_WORDS = frozenset({*_OPENING, *_HARMLESS, "break", "continue", "abort"})


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
    if word == EventKind.HARMLESS:
        return state.event(EventKind.HARMLESS)
    moves = isinstance(word, Action) and word <= Action.DWELL
    state.forget(origin=not moves)
    return state.event(EventKind.UNKNOWN)


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
