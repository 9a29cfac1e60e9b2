"""Command handlers in Python that several firmwares share."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import takewhile

from stillpath.gcode import _slots as at
from stillpath.gcode._command_kernels import execute
from stillpath.gcode.comments import note_object
from stillpath.gcode.dialect import Action, Dialect, Handler, Word
from stillpath.gcode.lexer import Command
from stillpath.gcode.state import EXTRUDER_MODE, MachineState
from stillpath.gcode.types import EventKind

__all__ = [
    "NO_ARCS",
    "NO_RETRACTION",
    "awaiting_extruder_mode",
    "cancel_object",
    "cutter",
    "hold_laser",
    "home",
    "host_command",
    "retract",
    "tool",
]

_OBJECT = re.compile(r"\s*@object(info|stop)?\b([^;]*)", re.IGNORECASE)
"""Marks that the plugin Cancel Objects puts in place of slicers' comments."""


def awaiting_extruder_mode(dialect: Dialect) -> Dialect:
    """Return how a file is read whose E has a mode that the printer was left in.

    RepRapFirmware's files begin with that of config.g, start.g or the print before; the usual
    config.g has M83 (src/GCodes/GCodes.cpp, CheckFinishedRunningConfigFile, 3.5). Klipper's begin
    with that of the print before or of a macro (klippy/extras/gcode_move.py, 2026-08).
    """
    modes = dict.fromkeys(("M82", "M83"), _extruder_mode)
    return replace(dialect, words={**dialect.words, **modes}, extruder_mode_known=False)


def _extruder_mode(state: MachineState, command: Command) -> int:
    """M82 and M83 of a file that has fed filament before."""
    state.hold(EXTRUDER_MODE, False)
    action = Action.ABSOLUTE_E if command.name == "M82" else Action.RELATIVE_E
    return int(execute(int(action), state.w, 0, state.f, state.i, state.rows, state.tables))


def home(state: MachineState, command: Command) -> int:
    """G28."""
    axes = sum(1 << k for k, axis in enumerate("XYZ") if axis in command.words) or 0b111
    state.home(axes, state.firmware.home_mm)
    kept = state.i[[at.I_KNOWN, at.I_MACROS]]
    status = state.event(EventKind.UNKNOWN)
    state.settle()
    state.i[[at.I_KNOWN, at.I_MACROS]] = kept
    return status


def no_arc(state: MachineState, command: Command) -> int:
    """G2 and G3 where the machine states no arcs: skipped, unless a macro has that name."""
    state.warn(
        f"{command.name}: this machine draws no arcs (firmware.arcs), so the printer skips the "
        "move; slice without arcs, or correct the machine"
    )
    return state.event(state.dialect.otherwise(command.name))


def no_retraction(state: MachineState, command: Command) -> int:
    """G10 and G11 where the machine states no retraction: skipped, or a macro."""
    if set(command.words) <= {"G"}:  # Klipper keeps the name among the words
        state.warn(
            f"{command.name}: this machine has no retraction of its own (firmware.retraction), so "
            "the printer skips the line unless it is a macro; switch firmware retraction off in "
            "the slicer, or correct the machine"
        )
    return state.event(state.dialect.otherwise(command.name))


def retract(state: MachineState, command: Command) -> int:
    """G10 and G11: a move of E, and a hop of Z, that the G-code's coordinates do not see.

    RepRapFirmware has them as M103 and M101 too. Repeated ones are passed over. Behind a macro,
    which may retract, the first one may be no repeated one: it counts as a move, where streams
    rest. Z is lifted after the retraction and lowered before filament comes back (Marlin
    fwretract.cpp 2.0.x; RepRapFirmware GCodes.cpp RetractFilament 3.5).
    """
    facts = state.retraction
    if facts is None:
        return state.event(state.dialect.otherwise(command.name))
    retracting = command.name in ("G10", "M103")
    has_macros = state.dialect.extended_commands or state.dialect.expressions
    tool = 0 if state.dialect.extended_commands else int(state.i[at.I_TOOL])
    macros = int(state.i[at.I_MACROS]) if has_macros else 0
    certain = state.retracted_at.get(tool, 0) == macros
    if certain and retracting == state.retracted.get(tool, False):
        return state.event(EventKind.MODE)
    f = state.f
    scaled = state.dialect.retraction_scaled
    factor = f[at.F_EXTRUDE_FACTOR] if scaled else 1.0
    if retracting:
        length, speed = -facts.length_mm, facts.speed_mm_s
    else:
        length, speed = facts.length_mm + facts.extra_mm, facts.return_speed_mm_s
    steps = [(3, round(length, 5) * factor, speed)]
    if state.dialect.extended_commands:
        speed_mm_s = max(1, int(speed * 60)) / 60.0
        steps = [(3, steps[0][1], speed_mm_s)]
    hop = facts.hop_mm if retracting else -state.hop_mm
    if hop:
        steps.insert(len(steps) if retracting else 0, (2, hop, state.firmware.fastest_z_mm_s))
    speed_before = f[at.F_SPEED]
    status = at.DONE
    state.settle()
    for axis, distance, speed in steps:
        f[at.F_SPEED] = speed * (f[at.F_SPEED_FACTOR] * 60.0 if scaled else 1.0)
        f[at.F_LAST + axis] += distance
        step_status = state.travel()
        if step_status > at.DONE:
            return step_status
        status = min(status, step_status)
        f[at.F_BASE + axis] += distance
    f[at.F_SPEED] = speed_before
    if hop:
        state.hop_mm = max(0.0, state.hop_mm + hop)
        # A shifted origin of Z: the G-code's Z stays what it was.
        state.note_modal()
    state.retracted[tool], state.retracted_at[tool] = retracting, macros
    return state.moved(status)


def cancel_object(state: MachineState, command: Command) -> int:
    """M486: S opens an object, S-1 closes it."""
    # Behind A is a name.
    if "S" in takewhile(lambda letter: letter[0] != "A", command.words):
        number = command.words["S"]
        closing = number.startswith("-") or not number
        state.settle()
        state.i[at.I_OBJECT] = -1 if closing else state.objects.number(number)
    return state.event(EventKind.OBJECT)


def host_command(state: MachineState, command: Command) -> int:
    """@ and a word: OctoPrint pauses, or a plugin of it moves the head or excludes an object."""
    found = _OBJECT.match(command.text)
    if found is None:
        state.macro_ran = True
        return state.event(EventKind.UNKNOWN)
    if found[1] is not None and found[1].lower() == "info":
        return state.event(EventKind.HARMLESS)
    return note_object(state, command, "" if found[1] else found[2].strip())


def cutter(kind: EventKind) -> Handler:
    """Return a handler of M3, M4 and M5: a spindle or a laser on, and off.

    Where moves set a laser's power (with S, after Marlin's I, in RepRapFirmware's M452), G0
    switches it off and G1 leaves it on. A stream has G1 alone, and stands still at its ends. So
    nothing is replaced until M5 (Marlin src/gcode/gcode.cpp, get_destination_from_command,
    2.1.x; RepRapFirmware GCodes.cpp, DoStraightMove, 3.6.0-beta.1).
    """

    def handle(state: MachineState, command: Command) -> int:
        state.cutter_on = state.laser_mode or command.name != "M5"
        if command.name == "M5":
            state.hold("laser", False)
        elif state.laser_mode or "I" in command.words:
            hold_laser(state)
        return state.event(kind)

    return handle


def hold_laser(state: MachineState) -> None:
    """Let moves stay as they are until the laser is off."""
    state.warn("from here on a laser's moves stay as they are, with the travel between them")
    state.hold("laser", True)


def tool(state: MachineState, command: Command) -> int:
    """T: another tool, or the one that is in use already."""
    digits = command.name[1:]
    if not digits.isdigit():
        reports = state.dialect.expressions and not command.words and "{" not in command.text
        if not digits and reports:
            return state.event(EventKind.HARMLESS)  # T alone reports
        state.tool_known = False
        return state.event(EventKind.UNKNOWN)
    number = int(digits)
    same = state.tool_known and number == int(state.i[at.I_TOOL])
    if same and not state.dialect.extended_commands:
        return state.event(EventKind.STOP)
    state.settle()
    if number < 100:  # larger ones are words of the printer, not tools
        state.i[at.I_TOOL] = number
        state.tool_known = True
    return state.event(EventKind.UNKNOWN)


NO_ARCS: dict[str, Word] = {"G2": no_arc, "G3": no_arc}
NO_RETRACTION: dict[str, Word] = {"G10": no_retraction, "G11": no_retraction}
