"""RepRapFirmware's commands that Python handles.

Sources: RepRapFirmware src/GCodes/GCodes.cpp, GCodes2.cpp, GCodes3.cpp and
src/Movement/Move2.cpp, 3.5 and 3.6.0-beta.2 (2024-11).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stillpath.gcode import _slots as at
from stillpath.gcode._motion_kernels import set_feed
from stillpath.gcode.commands import retract
from stillpath.gcode.commands import tool as other_tool
from stillpath.gcode.lexer import Command
from stillpath.gcode.state import MachineState, Saved
from stillpath.gcode.types import EventKind
from stillpath.gcode.workspaces import set_workspace

__all__ = [
    "acceleration",
    "accelerations",
    "define_tool",
    "extrude_factor",
    "heat_and_wait",
    "jerk",
    "jerk_below_ceiling",
    "machine_mode",
    "pop_state",
    "pressure_advance",
    "push_state",
    "retract_or_offsets",
    "retract_settings",
    "select_plane",
    "special_move",
    "speeds",
    "tool",
]

_MODES = (at.I_ABS_XYZ, at.I_ABS_E, at.I_PLANE)
_MOST_PUSHED = 10
_LEAST_ACCEL_MM_S2, _LEAST_SPEED_MM_S = 0.1, 0.01
"""What the firmware takes a lower value for: MinimumAcceleration and AbsoluteMinFeedrate."""


def accelerations(state: MachineState, command: Command) -> int:
    """M201, in mm/s2."""
    given = state.numbers(command, "XYZE")
    values = {f"accel_{k.lower()}_mm_s2": max(v, _LEAST_ACCEL_MM_S2) for k, v in given.items()}
    return state.set_limits(command, values, kind=state.limits_kind(command, "XYZE"))


def speeds(state: MachineState, command: Command) -> int:
    """M203, in mm/min, with S1 in mm/s; I is the slowest that a move may be.

    No limit is taken lower than that, I of the same line first.
    """
    given = state.numbers(command, "XYZEIS")
    unit = 1.0 if given.pop("S", 0.0) == 1.0 else 1.0 / 60.0
    values = {}
    least = state.limit("min_speed_mm_s")
    own = "I" in given
    if own:
        least = values["min_speed_mm_s"] = max(given.pop("I") * unit, _LEAST_SPEED_MM_S)
    values |= {f"speed_{k.lower()}_mm_s": max(v * unit, least) for k, v in given.items()}
    # Without I it depends on the I before, so it is not remembered.
    kind = state.limits_kind(command, "XYZEIS")
    return state.set_limits(command, values, remember=own, kind=kind)


def acceleration(state: MachineState, command: Command) -> int:
    """M204: P of printing moves, T of others, S of both."""
    given = state.numbers(command, "SPT")
    values = {}
    for letter, names in (
        ("S", ("print_accel_mm_s2", "travel_accel_mm_s2")),
        ("P", ("print_accel_mm_s2",)),
        ("T", ("travel_accel_mm_s2",)),
    ):
        if letter in given:
            values.update(dict.fromkeys(names, max(given[letter], _LEAST_ACCEL_MM_S2)))
    return state.set_limits(command, values)


def jerk(state: MachineState, command: Command) -> int:
    """M566: jerk and its ceiling in mm/min, and between which moves it holds."""
    given = state.numbers(command, "XYZEP")
    values = {"jerk_policy": float(int(given.pop("P")))} if "P" in given else {}
    for letter, value in given.items():
        field = f"jerk_{letter.lower()}_mm_s"
        values[field] = values[f"max_{field}"] = max(value / 60.0, 0.1)
    return state.set_limits(command, values, kind=state.limits_kind(command, "XYZEP"))


def jerk_below_ceiling(state: MachineState, command: Command) -> int:
    """M205: jerk in mm/s, up to the ceiling that M566 has set."""
    values = {}
    for letter, value in state.numbers(command, "XYZE").items():
        field = f"jerk_{letter.lower()}_mm_s"
        values[field] = min(max(value, 0.1), state.limit(f"max_{field}"))
    # What it does depends on the ceiling, so it is not remembered.
    kind = state.limits_kind(command, "XYZE")
    return state.set_limits(command, values, remember=False, kind=kind)


def pressure_advance(state: MachineState, command: Command) -> int:
    """M572: S in seconds, D which extruders, by default those of the tool in use.

    It waits for standstill, and a stream has it off like the shaper. Tool n is taken to have
    extruder n.
    """
    given = state.numbers(command, "S")
    if given.get("S", -1.0) < 0.0:
        return state.event(EventKind.HARMLESS)
    used = str(state.i[at.I_TOOL])
    extruders = command.words.get("D", used).strip("{}").split(":")
    state.settings.update((f"advance {extruder}", given["S"]) for extruder in extruders)
    values = {}
    if used in extruders:
        values = {"pressure_advance_s": given["S"]}
        state.hold("pressure advance", False)
    return state.set_limits(command, values, remember=False, kind=EventKind.SHAPER)


def tool(state: MachineState, command: Command) -> int:
    """T: another tool, whose extruder has a pressure advance of its own."""
    found = other_tool(state, command)
    row, column = state.initial_limits, state.limits_names.index("pressure_advance_s")
    key = f"advance {state.i[at.I_TOOL]}"
    state.f[at.F_LIMITS + column] = state.settings.get(key, row[column])
    state.note_limits()
    return found


def extrude_factor(state: MachineState, command: Command) -> int:
    """M221: S in per cent, of the extruder D or of the tool in use."""
    given = state.numbers(command, "SD")
    if "S" not in given or given.get("D", float(state.i[at.I_TOOL])) != float(state.i[at.I_TOOL]):
        return state.event(EventKind.HARMLESS)
    if not at.MIN_VALUE <= given["S"] <= at.MAX_VALUE:
        raise state.problem(
            f"the value {given['S']:g} is out of range; it must be above 0", command
        )
    f = state.f
    state.settle()
    factor = given["S"] / 100.0
    e_value = (f[at.F_LAST + 3] - f[at.F_BASE + 3]) / f[at.F_EXTRUDE_FACTOR]
    f[at.F_BASE + 3] = f[at.F_LAST + 3] - e_value * factor
    f[at.F_EXTRUDE_FACTOR] = factor
    state.note_modal()
    return state.event(EventKind.MODE)


def retract_or_offsets(state: MachineState, command: Command) -> int:
    """G10: alone a retraction; with words the offsets and temperatures of a tool or workspace."""
    words = command.words
    if "L" in words and state.numbers(command, "L").get("L") != 1.0:
        return _workspace(state, command)
    if any(axis in words for axis in "XYZUVWABCD"):
        number = state.numbers(command, "P").get("P", float(state.i[at.I_TOOL]))
        other = state.tool_known and number != float(state.i[at.I_TOOL])
        # Of the tool in use they move the origin; the next coordinates tell the place again.
        return state.event(EventKind.STOP if other else EventKind.UNKNOWN)
    if any(letter in words for letter in "LPRS"):
        return state.event(EventKind.HARMLESS)
    return retract(state, command)


def _workspace(state: MachineState, command: Command) -> int:
    """G10 L2 (origin in machine coordinates) and L20 (the tool is at these coordinates).

    They wait for standstill (GCodes3.cpp, GetSetWorkplaceCoordinates, 3.5); P0 is the one in use.
    """
    given = state.numbers(command, "LPXYZ")
    kind = int(given.get("L", 0.0))
    number = int(given.get("P", 0.0) or state.workspace + 1.0) - 1
    if kind not in (2, 20) or not 0 <= number <= 8:
        raise state.problem("G10 L must be 1, 2 or 20, and P from 0 to 9", command)
    f = state.f
    place = {}
    for k, axis in enumerate("XYZ"):
        if axis in given:
            value = given[axis] * float(f[at.F_UNIT_MM])
            place[k] = value if kind == 2 else float(f[at.F_LAST + k]) - value
            if kind == 20 and not state.i[at.I_KNOWN] >> k & 1:
                state.i[at.I_ORIGIN_KNOWN] &= ~(1 << k)
    if not place:
        return state.event(EventKind.HARMLESS)
    set_workspace(state, number, place)
    return state.event(EventKind.STOP)


def retract_settings(state: MachineState, command: Command) -> int:
    """M207: S length, R extra on return, F and T feedrates of both ways, Z hop."""
    if state.retraction is None:
        return state.event(state.dialect.otherwise(command.name))
    given = state.numbers(command, "SRFTZP")
    if given.get("P", float(state.i[at.I_TOOL])) != float(state.i[at.I_TOOL]):
        return state.event(EventKind.HARMLESS)
    changes = {}
    if "S" in given:
        changes["length_mm"] = max(given["S"], 0.0)
    if "R" in given:
        length_mm = changes.get("length_mm", state.retraction.length_mm)
        changes["extra_mm"] = max(given["R"], -length_mm)
    if "F" in given:
        # One speed for both unless T follows; 60 mm/min is the least.
        changes["speed_mm_s"] = changes["return_speed_mm_s"] = max(given["F"], 60.0) / 60.0
    if "T" in given:
        changes["return_speed_mm_s"] = max(given["T"], 60.0) / 60.0
    if "Z" in given:
        changes["hop_mm"] = max(given["Z"], 0.0)
    state.change_retraction(**changes)
    return state.event(EventKind.MODE)


def special_move(state: MachineState, command: Command) -> int:
    """G0 and G1 with H (endstops, single motors) or R (from a saved place)."""
    given = state.numbers(command, "HRXYZF")
    if "F" in given:
        status = set_feed(state.f, state.i, given["F"])
        if status != at.OK:
            return int(status)
    if given.get("H", 0.0) != 0.0:
        state.forget()
        return state.event(EventKind.UNKNOWN)
    if "R" not in command.words:
        return -1
    saved = state.saved.get(f"G60 {int(given['R'])}")
    if saved is None or "E" in command.words:
        # Where the printer paused or changed tools last.
        state.forget()
        return state.event(EventKind.UNKNOWN)
    f = state.f
    for k, axis in enumerate("XYZ"):
        if axis in given:
            f[at.F_LAST + k] = saved.f[at.F_LAST + k] + given[axis] * f[at.F_UNIT_MM]
    return state.moved(state.travel())


def select_plane(state: MachineState, command: Command) -> int:
    """G17, G18 and G19 wait for standstill."""
    state.settle()
    state.i[at.I_PLANE] = int(command.name[1:]) - 17
    return state.event(EventKind.STOP)


def heat_and_wait(state: MachineState, _command: Command) -> int:
    """M109 fetches a tool where none is in use."""
    return state.event(EventKind.STOP if state.tool_known else EventKind.UNKNOWN)


def define_tool(state: MachineState, _command: Command) -> int:
    """M563 may take away the tool that is in use."""
    state.tool_known = False
    return state.event(EventKind.UNKNOWN)


def machine_mode(state: MachineState, command: Command) -> int:
    """M451 printer, M452 laser, M453 CNC: the latter two leave out the G of repeated moves."""
    state.dialect = replace(
        state.dialect,
        modal_words=command.name != "M451",
        paren_comments=command.name == "M453",
    )
    state.dialect.set_rules(state.i)
    state.laser_mode = state.cutter_on = command.name == "M452"
    state.hold("laser", False)
    return state.event(EventKind.STOP)


def push_state(state: MachineState, command: Command) -> int:
    """M120."""
    depth = int(state.settings.get("pushed", 0.0))
    if depth >= _MOST_PUSHED:
        raise state.problem("M120 without M121; the firmware's stack overflows", command)
    state.saved[f"M120 {depth}"] = Saved(state.f.copy(), state.i.copy())
    state.settings["pushed"] = depth + 1.0
    return state.event(EventKind.STATE)


def pop_state(state: MachineState, _command: Command) -> int:
    """M121: the modes, the plane, the units and F of the matching M120."""
    depth = int(state.settings.get("pushed", 0.0)) - 1
    if depth < 0:
        state.warn("M121 without M120 is ignored")
        return state.event(EventKind.HARMLESS)
    saved = state.saved[f"M120 {depth}"]
    state.settings["pushed"] = float(depth)
    state.settle()
    for slot in _MODES:
        state.i[slot] = saved.i[slot]
    f = state.f
    scale = f[at.F_SPEED_FACTOR] / saved.f[at.F_SPEED_FACTOR]
    f[at.F_SPEED] = saved.f[at.F_SPEED] * scale
    f[[at.F_UNIT_MM, at.F_UNIT_E_MM]] = saved.f[np.array([at.F_UNIT_MM, at.F_UNIT_E_MM])]
    state.note_modal()
    return state.event(EventKind.STATE)
