"""Workspaces (G53 to G59.3) and saved places (G60, G61).

Sources: Marlin Marlin/src/gcode/geometry/G53-G59.cpp and Marlin/src/gcode/feature/pause/G60.cpp,
G61.cpp, 2.1.x; RepRapFirmware src/GCodes/GCodes.cpp, 3.6 (G53 holds for its line, G54 is the
workspace at power-on).
"""

from __future__ import annotations

from collections.abc import Mapping

from stillpath.gcode import _slots as at
from stillpath.gcode.handback import carry_out
from stillpath.gcode.lexer import Command, split_line
from stillpath.gcode.state import MachineState, Saved
from stillpath.gcode.types import KEPT, EventKind

__all__ = ["machine_space", "move_to_saved", "save_place", "select_workspace", "set_workspace"]


def workspace_number(name: str) -> int:
    """Return 0 to 8 for G54 to G59.3."""
    whole, _, part = name[1:].partition(".")
    return int(whole) - 54 + int(part or 0)


def select_workspace(state: MachineState, command: Command) -> int:
    """G54 to G59.3."""
    number = workspace_number(command.name)
    if not 0 <= number <= 8:
        return state.event(EventKind.HARMLESS)
    _select(state, number)
    return state.event(EventKind.MODE)


def set_workspace(state: MachineState, number: int, place: dict[int, float]) -> None:
    """Give a workspace its origin, in machine coordinates of axes 0 to 2."""
    x, y, z = _shift(state) if number == state.workspace else state.workspaces.get(number, _NONE)
    shift = [place.get(0, x), place.get(1, y), place.get(2, z)]
    state.workspaces[number] = (shift[0], shift[1], shift[2])
    if number == state.workspace:
        _set_shift(state, state.workspaces[number])


def machine_space(state: MachineState, command: Command) -> int:
    """G53: what follows on the line is in the machine's own coordinates.

    On a line of its own Marlin leaves the workspace; for RepRapFirmware it does nothing.
    """
    begin = command.text.upper().find("G53") + 3
    rest = split_line(command.text[begin:], state.dialect)
    native = -1
    if not rest[0].name:
        if state.dialect.expressions:
            return state.event(EventKind.HARMLESS)
        if state.workspace != native:
            _select(state, native)
        return state.event(EventKind.MODE)
    before, shift = state.workspace, _shift(state)
    moves = int(state.i[at.I_MOVES])
    # In Marlin, what G92 has shifted in native space stays.
    _set_shift(state, _NONE if before != native else shift)
    status = carry_out(state, rest[0])
    _set_shift(state, shift)
    # The line does more than move, and must stay.
    state.settle()
    state.rows.tiny[at.M_KNOWN, moves : int(state.i[at.I_MOVES])] &= KEPT
    return status


def save_place(state: MachineState, command: Command) -> int:
    """G60."""
    slot = _slot(state.numbers(command, "S"))
    if state.dialect.expressions and slot > _LAST_RESTORE_POINT:
        raise state.problem(
            f"G60 S{slot} is refused by {state.dialect.title}, which has places 0 to "
            f"{_LAST_RESTORE_POINT}; use one of them",
            command,
        )
    state.saved[f"G60 {slot}"] = Saved(state.f.copy(), state.i.copy())
    return state.event(EventKind.STATE)


def move_to_saved(state: MachineState, command: Command) -> int:
    """G61 of Marlin: go back to X Y Z as they were, each as far off as its word says."""
    given = state.numbers(command, "SXYZF")
    saved = state.saved.get(f"G60 {_slot(given)}")
    if saved is None:
        state.warn("nothing was saved with G60; the firmware passes G61 over")
        return state.event(EventKind.HARMLESS)
    axes = [k for k, axis in enumerate("XYZ") if axis in command.words]
    f = state.f
    if "E" in command.words:
        f[at.F_BASE + 3] += f[at.F_LAST + 3] - saved.f[at.F_LAST + 3]
    if not axes:
        # All axes, in an order of the firmware's choice.
        return state.event(EventKind.UNKNOWN)
    for k in axes:
        offset = given.get("XYZ"[k], 0.0) * f[at.F_UNIT_MM]
        f[at.F_LAST + k] = saved.f[at.F_LAST + k] + offset
    speed_before = f[at.F_SPEED]
    if given.get("F", 0.0) > 0.0:
        f[at.F_SPEED] = given["F"] * f[at.F_UNIT_MM] * f[at.F_SPEED_FACTOR]
    status = state.travel_to_kept()
    f[at.F_SPEED] = speed_before
    return status


_NONE = (0.0, 0.0, 0.0)
_LAST_RESTORE_POINT = 5
"""RepRapFirmware's NumVisibleRestorePoints is 6."""


def _slot(given: Mapping[str, float]) -> int:
    """Return the number of a saved place, as Marlin limits it to a byte."""
    return int(min(max(given.get("S", 0.0), 0.0), 255.0))


def _shift(state: MachineState) -> tuple[float, float, float]:
    x, y, z = (state.f[at.F_BASE + k] - state.f[at.F_HOMING + k] for k in range(3))
    return float(x), float(y), float(z)


def _set_shift(state: MachineState, shift: tuple[float, float, float]) -> None:
    state.settle()
    for k in range(3):
        state.f[at.F_BASE + k] = state.f[at.F_HOMING + k] + shift[k]
    state.note_modal()


def _select(state: MachineState, number: int) -> None:
    if state.workspace >= 0:
        state.workspaces[state.workspace] = _shift(state)
    if number != state.workspace:
        state.workspace = number
        _set_shift(state, state.workspaces.get(number, _NONE))
