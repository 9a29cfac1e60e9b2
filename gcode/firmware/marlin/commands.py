"""Marlin's commands that Python handles.

Sources: Marlin/src/gcode: config/M200-M205.cpp, config/M220.cpp, config/M221.cpp, geometry/G92.cpp,
feature/advance/M900.cpp, feature/ft_motion/M495.cpp; which versions, and what was not read, stands
in docs/dialects.md.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from stillpath.gcode import _slots as at
from stillpath.gcode.commands import tool as other_tool
from stillpath.gcode.dialect import Handler
from stillpath.gcode.lexer import Command
from stillpath.gcode.state import MachineState
from stillpath.gcode.types import EventKind
from stillpath.models.firmware import Marlin

__all__ = [
    "accelerations",
    "axis_limits",
    "bed_distance_sensor",
    "corners_and_least_speeds",
    "end_motion_mode",
    "extrude_factor",
    "filament_area",
    "home_offset",
    "linear_advance",
    "not_modelled",
    "park_tool",
    "reset_limits",
    "reset_origin",
    "resonance_test",
    "retract_settings",
    "speed_factor",
    "tool",
]

_M205 = {
    "B": "min_segment_time_us",
    "S": "min_feedrate_mm_s",
    "T": "min_travel_feedrate_mm_s",
    "J": "junction_deviation_mm",
    "X": "jerk_x_mm_s",
    "Y": "jerk_y_mm_s",
    "Z": "jerk_z_mm_s",
    "E": "jerk_e_mm_s",
}
_M204 = {"P": "print_accel_mm_s2", "R": "retract_accel_mm_s2", "T": "travel_accel_mm_s2"}


def axis_limits(fields: str) -> Handler:
    """M201 and M203: one limit per axis.

    Parameters
    ----------
    fields : str
        Name of the limit with ``{axis}`` for x, y, z, e.
    """

    def handle(state: MachineState, command: Command) -> int:
        given = state.numbers(command, "XYZE")
        values = {}
        for letter, value in given.items():
            scaled = value * float(state.f[at.F_UNIT_MM])
            if scaled <= 0.0:
                state.warn(f"{command.name} {letter}{value:g} is not above 0 and is ignored")
                continue
            values[fields.format(axis=letter.lower())] = scaled
        return state.set_limits(command, values, kind=state.limits_kind(command, "XYZE"))

    return handle


def accelerations(state: MachineState, command: Command) -> int:
    """M204: P of moves that print, R of retractions, T of travel, S of P and T."""
    unit = float(state.f[at.F_UNIT_MM])
    values: dict[str, float] = {}
    for letter, value in state.numbers(command, "SPRT").items():
        if value <= 0.0:
            state.warn(f"M204 {letter}{value:g} is not above 0 and is ignored")
        elif letter == "S":
            values[_M204["P"]] = values[_M204["T"]] = value * unit
        else:
            values[_M204[letter]] = value * unit
    return state.set_limits(command, values)


def corners_and_least_speeds(state: MachineState, command: Command) -> int:
    """M205 with J or X Y Z E, whichever the firmware is built for."""
    unit = float(state.f[at.F_UNIT_MM])
    values: dict[str, float] = {}
    firmware = state.machine.firmware
    classic = isinstance(firmware, Marlin) and firmware.junction == "classic_jerk"
    for letter, value in state.numbers(command, "BSTXYZE" if classic else "BSTJ").items():
        if letter == "J" and not 0.01 <= value <= 0.3:
            state.warn(f"M205 J{value:g} is not between 0.01 and 0.3, and is ignored")
        elif value < 0.0:
            state.warn(f"M205 {letter}{value:g} is below 0 and is ignored")
        else:
            values[_M205[letter]] = float(int(value)) if letter == "B" else value * unit
    return state.set_limits(command, values)


def linear_advance(state: MachineState, command: Command) -> int:
    """M900: K from 0 to 10, of tool T or of the one in use.

    The firmware waits for standstill where it changes. Each tool has its own K up to 2.1.1; since
    2.1.2 they have one, unless the build has DISTINCT_E_FACTORS (module/planner.h, Marlin #24821).
    A file that sets it for another tool is taken for one of a printer that has one for each.
    """
    given = state.numbers(command, "KT")
    k = given.get("K")
    if {"L", "S"} & command.words.keys():
        # A second K to change over to (ADVANCE_K_EXTRA).
        state.warn("M900 with L or S: which K is in force is not known")
        return state.event(EventKind.UNKNOWN)
    if k is None:
        return state.event(EventKind.HARMLESS)
    if not 0.0 <= k <= 10.0:
        state.warn(f"M900 K{k:g} is not between 0 and 10, and is ignored")
        return state.event(EventKind.HARMLESS)
    used = int(state.i[at.I_TOOL])
    named = int(given.get("T", used))
    known = _advance_k_s(state, named)
    state.settings[f"advance {named}"] = k
    if named == used:
        state.settings["advance"] = k
        state.hold("linear advance", False)
    else:
        state.settings["advance by tool"] = 1.0
    if k == known:
        # No stop; but a stream has K off, and there the line would switch it on.
        return state.event(EventKind.LIMITS)
    values = {"linear_advance_k_s": k} if named == used else {}
    return state.set_limits(command, values, remember=False, kind=EventKind.STOP)


def tool(state: MachineState, command: Command) -> int:
    """T: another tool, which may have a K of its own; moves wait for M900 where it may or not."""
    found = other_tool(state, command)
    k, last = _advance_k_s(state, int(state.i[at.I_TOOL])), state.settings.get("advance")
    firmware = state.machine.firmware
    shared = (
        isinstance(firmware, Marlin)
        and firmware.variant == "2.1"
        and firmware.linear_advance is not False
        and "advance by tool" not in state.settings
    )
    # A stream that switches advance off and on again would set a wrong K for good.
    state.hold("linear advance", shared and last is not None and last != k)
    state.f[at.F_LIMITS + state.limits_names.index("linear_advance_k_s")] = k
    state.note_limits()
    return found


def speed_factor(state: MachineState, command: Command) -> int:
    """M220: S sets whole per cent, B remembers them and R brings them back."""
    f = state.f
    percent = f[at.F_SPEED_FACTOR] * 6000.0
    if "B" in command.words:
        state.settings["M220"] = percent
    if "R" in command.words:
        percent = state.settings.get("M220", 100.0)
    percent = _whole(state, command).get("S", percent)
    if percent <= 0.0:
        raise state.problem("a speed of 0 % stops the print for good; leave M220 S0 out", command)
    state.settle()
    factor = percent / 6000.0
    f[at.F_SPEED] = f[at.F_SPEED] / f[at.F_SPEED_FACTOR] * factor
    f[at.F_SPEED_FACTOR] = factor
    state.note_modal()
    return state.event(EventKind.MODE)


def extrude_factor(state: MachineState, command: Command) -> int:
    """M221: S sets whole per cent; without a number nothing (Bambu's M221 S, M221 X0 Y0 Z0)."""
    percent = _whole(state, command).get("S")
    if percent is None or _other_tool(state, state.numbers(command, "T")):
        return state.event(EventKind.HARMLESS)
    if percent <= 0.0:
        raise state.problem("a flow of 0 % cannot be followed; leave M221 S0 out", command)
    f = state.f
    state.settle()
    factor = percent / 100.0
    e_value = (f[at.F_LAST + 3] - f[at.F_BASE + 3]) / f[at.F_EXTRUDE_FACTOR]
    f[at.F_BASE + 3] = f[at.F_LAST + 3] - e_value * factor
    f[at.F_EXTRUDE_FACTOR] = factor
    state.note_modal()
    return state.event(EventKind.MODE)


def filament_area(state: MachineState, command: Command) -> int:
    """M200: E in cubic mm of a filament of diameter D; D0 or S0: in mm again."""
    given = state.numbers(command, "DS")
    if "D" not in given and "S" not in given:
        return state.event(EventKind.HARMLESS)
    diameter = given.get("D", state.firmware.hotend.filament_diameter_mm)
    on = given.get("S", diameter) != 0.0 and diameter > 0.0
    state.settle()
    area = math.pi * diameter**2 / 4.0 if on else 1.0
    f = state.f
    before = f[at.F_UNIT_E_MM]
    cubic = f[at.F_UNIT_MM] ** 3
    area_before = 1.0 if before == f[at.F_UNIT_MM] else cubic / before
    f[at.F_UNIT_E_MM] = (cubic if on else f[at.F_UNIT_MM]) / area
    # What the printer takes for E stays: as many mm as there were cubic mm, or vice versa.
    counted = f[at.F_LAST + 3] - f[at.F_BASE + 3]
    f[at.F_BASE + 3] = f[at.F_LAST + 3] - counted * area_before / area
    if on:
        state.warn("E is in cubic millimetres (M200); such moves stay as they are")
    return state.event(EventKind.MODE if f[at.F_UNIT_E_MM] == before else EventKind.STATE)


def retract_settings(state: MachineState, command: Command) -> int:
    """M207 (S length, F feedrate, Z hop) and M208 (S extra length, F feedrate)."""
    if state.retraction is None:
        return state.event(state.dialect.otherwise(command.name))
    unit = float(state.f[at.F_UNIT_MM])
    given = {letter: value * unit for letter, value in state.numbers(command, "SFZ").items()}
    names: Mapping[str, str] = {"S": "length_mm", "F": "speed_mm_s", "Z": "hop_mm"}
    if command.name == "M208":
        names = {"S": "extra_mm", "F": "return_speed_mm_s"}
    changes = {}
    for letter, name in names.items():
        if letter in given and (letter != "F" or given[letter] > 0.0):
            changes[name] = abs(given[letter]) / (60.0 if letter == "F" else 1.0)
    state.change_retraction(**changes)
    return state.event(EventKind.MODE)


def home_offset(state: MachineState, command: Command) -> int:
    """M206: the origins of the axes that it names are elsewhere; how far is not known."""
    axes = sum(1 << k for k, axis in enumerate("XYZ") if axis in command.words)
    if not axes:
        return state.event(EventKind.HARMLESS)
    named = " ".join(axis for k, axis in enumerate("XYZ") if axes >> k & 1)
    state.warn(f"M206: from here on the position of {named} is not known until the printer homes")
    state.forget(axes, origin=True)
    return state.event(EventKind.UNKNOWN)


def reset_origin(state: MachineState, _command: Command) -> int:
    """G92.1: the machine's own coordinates."""
    f = state.f
    state.settle()
    f[at.F_BASE : at.F_BASE + 3] = f[at.F_HOMING : at.F_HOMING + 3]
    state.i[at.I_ORIGIN_KNOWN] = 0b111
    state.note_modal()
    return state.event(EventKind.MODE)


def reset_limits(state: MachineState, command: Command) -> int:
    """M501 and M502: the settings that are stored, or the build's own, of all tools.

    The machine's document gives the stored ones (power-on); the build's are unknown.
    """
    if command.name == "M502":
        state.warn("M502: the build's own limits are not known; those of the machine are taken")
    row = state.initial_limits
    state.settle()
    state.f[at.F_LIMITS : at.F_LIMITS + len(row)] = row
    state.note_limits()
    state.settings = {k: v for k, v in state.settings.items() if not k.startswith("advance")}
    state.hold("linear advance", False)
    state.warn(f"{command.name}: from here on the position is not known until the printer homes")
    state.forget(origin=True)
    return state.event(EventKind.UNKNOWN)


def end_motion_mode(state: MachineState, _command: Command) -> int:
    """G80: lines without a G are passed over until the next one."""
    state.i[at.I_MOTION] = -1
    return state.event(EventKind.HARMLESS)


def park_tool(state: MachineState, _command: Command) -> int:
    """P0 of a Prusa with a tool changer: no tool is in use, and the next T fetches one."""
    state.tool_known = False
    return state.event(EventKind.UNKNOWN)


def resonance_test(state: MachineState, command: Command) -> int:
    """M495: with S an axis vibrates by itself, else the test is set or told (M496 ends it).

    Source: Marlin/src/gcode/feature/ft_motion/M495.cpp of 2025-11 (#28158), M495_M496.cpp, 2026.
    """
    if "S" not in command.words:
        return state.event(EventKind.HARMLESS)
    state.warn("M495 S: a resonance test moves an axis, also while the next lines run")
    state.forget(origin=False)
    return state.event(EventKind.UNKNOWN)


def bed_distance_sensor(state: MachineState, command: Command) -> int:
    """M102: with S it adjusts Z by the sensor, or calibrates; else it reports, if it is known.

    Simplify3D writes it alone, with its M101 and M103 (Marlin/src/gcode/probe/M102.cpp,
    bugfix-2.1.x).
    """
    if not state.numbers(command, "S"):
        return state.event(EventKind.HARMLESS)
    state.warn("M102: from here on the position is not known until the printer homes")
    state.forget(origin=True)
    return state.event(EventKind.UNKNOWN)


def not_modelled(kind: EventKind, why: str, *, origin: bool = True) -> Handler:
    """Return a handler for commands whose effect is not modelled.

    Parameters
    ----------
    why : str
        What a person is told.
    origin : bool
        For UNKNOWN: coordinates may count from somewhere else, so that they tell no place either.
    """

    def handle(state: MachineState, command: Command) -> int:
        state.warn(f"{command.name}: {why}")
        if kind == EventKind.UNKNOWN:
            state.forget(origin=origin)
        return state.event(kind)

    return handle


def _advance_k_s(state: MachineState, tool: int) -> float:
    """Return a tool's K of linear advance; before M900 the machine's [s]."""
    column = state.limits_names.index("linear_advance_k_s")
    return state.settings.get(f"advance {tool}", float(state.initial_limits[column]))


def _other_tool(state: MachineState, given: Mapping[str, float]) -> bool:
    return "T" in given and int(given["T"]) != int(state.i[at.I_TOOL])


def _whole(state: MachineState, command: Command) -> dict[str, float]:
    return {key: float(int(value)) for key, value in state.numbers(command, "S").items()}
