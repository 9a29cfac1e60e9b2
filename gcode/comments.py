"""Handle comments: the marks of slicers and our own, which apply to the lines after them."""

from __future__ import annotations

import math

from stillpath.gcode import _slots as at
from stillpath.gcode.lexer import Command
from stillpath.gcode.slicers.marks import MarkKind, read_mark
from stillpath.gcode.state import MachineState
from stillpath.gcode.types import EventKind

__all__ = ["note_comment", "note_object"]


def note_comment(state: MachineState, command: Command) -> int:
    """Take note of a slicer's mark, and remember it for the kernel; return a kernel status."""
    i, text = state.i, command.text
    found = text.find(";")
    mark = read_mark(text[found:]) if found >= 0 else None
    kind = None if mark is None else mark.kind
    if mark is None or kind is None:
        state.remember(command, at.MEMO_EVENT, int(EventKind.HARMLESS))
    elif kind == MarkKind.STAMP:
        # What is read back has thousands of lines of ours.
        state.remember(command, at.MEMO_EVENT, int(EventKind.STAMP))
        return state.event(EventKind.STAMP)
    elif kind in (MarkKind.OFF, MarkKind.ON):
        state.hold("mark", kind == MarkKind.OFF)
    elif kind == MarkKind.LAYER:
        _note_layer(state, command, text[found : found + 7], mark.text)
    elif kind == MarkKind.Z:
        _note_height(state, mark.text)
    elif kind == MarkKind.FEATURE:
        number = state.features.number(mark.text)
        state.settle()
        i[at.I_FEATURE] = number
        state.remember(command, at.MEMO_FEATURE, number + 1)
    elif kind == MarkKind.OBJECT:
        return note_object(state, command, mark.text)
    else:
        state.remember(command, at.MEMO_EVENT, int(EventKind.HARMLESS))
    return state.event(EventKind.HARMLESS)


def note_object(state: MachineState, command: Command, name: str) -> int:
    """Begin another object, or none, at a mark by which hosts exclude.

    Moonraker, OctoPrint's plugin and RepRapFirmware go by comments. A single object is cancelled
    with the print.
    """
    i = state.i
    number, before = state.objects.number(name), int(i[at.I_OBJECT])
    state.settle()
    i[at.I_OBJECT], i[at.I_OBJECTS] = number, len(state.objects.names)
    state.remember(command, at.MEMO_OBJECT, number + 1)
    changed = number != before and i[at.I_OBJECTS] > 1
    return state.event(EventKind.OBJECT if changed else EventKind.HARMLESS)


def _note_layer(state: MachineState, command: Command, style: str, height: str) -> None:
    """Begin a layer, unless the mark is of another style or the next object's of this layer."""
    state.layer_style = state.layer_style or style
    if style == state.layer_style and not _is_same_height(state, height):
        state.settle()
        state.i[at.I_LAYER] += 1
        _note_height(state, height)
        if not height:
            state.remember(command, at.MEMO_LAYER, 0)
    elif not height:
        state.remember(command, at.MEMO_EVENT, int(EventKind.HARMLESS))


def _is_same_height(state: MachineState, text: str) -> bool:
    layer = int(state.i[at.I_LAYER])
    return bool(text and layer >= 0 and state.tables.layer_z[layer] == _height_mm(text))


def _note_height(state: MachineState, text: str) -> None:
    layer = int(state.i[at.I_LAYER])
    if layer >= 0 and text:
        state.tables.layer_z[layer] = _height_mm(text)


def _height_mm(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan
