"""Klipper's commands that Python handles.

Sources: klippy/extras/gcode_move.py, firmware_retraction.py, exclude_object.py, klippy/toolhead.py
(cmd_M204, cmd_SET_VELOCITY_LIMIT), 2026-08.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from stillpath.gcode import _slots as at
from stillpath.gcode.lexer import Command
from stillpath.gcode.state import MachineState, Saved
from stillpath.gcode.types import EventKind
from stillpath.models.firmware import Klipper

__all__ = [
    "acceleration",
    "activate_extruder",
    "exclude_object",
    "gcode_offset",
    "limit_macro",
    "perhaps_macro",
    "reset_velocity_limit",
    "restore_state",
    "save_state",
    "set_retraction",
    "tool",
    "tuning_tower",
    "velocity_limit",
]

_LIMITS: dict[str, tuple[str, Callable[[float], bool], str]] = {
    "VELOCITY": ("velocity_mm_s", lambda v: v > 0.0, "above 0"),
    "ACCEL": ("accel_mm_s2", lambda v: v > 0.0, "above 0"),
    "SQUARE_CORNER_VELOCITY": ("square_corner_velocity_mm_s", lambda v: v >= 0.0, "at least 0"),
    "MINIMUM_CRUISE_RATIO": (
        "minimum_cruise_ratio",
        lambda v: 0.0 <= v < 1.0,
        "at least 0 and below 1",
    ),
    "ACCEL_TO_DECEL": ("accel_to_decel_mm_s2", lambda v: v > 0.0, "above 0"),
}
"""Parameters of SET_VELOCITY_LIMIT: what they set, which values are allowed, and that in words."""
_CAPPED = ("velocity_mm_s", "accel_mm_s2")
_MOST_STATES = 1000
_COMMANDS = ("M593", "M900")
"""Words of other firmwares that some forks have as commands, of which printer.cfg says nothing."""


def velocity_limit(state: MachineState, command: Command, *, capped: bool = False) -> int:
    """SET_VELOCITY_LIMIT; `capped`: up to the speed and acceleration of printer.cfg."""
    given = state.extended(command)
    old = _is_older(state)
    passed_over = "MINIMUM_CRUISE_RATIO" if old else "ACCEL_TO_DECEL"
    values = {}
    for key, (field, allows, allowed) in _LIMITS.items():
        if key in given and key != passed_over:
            values[field] = state.number(given[key], key, command)
            if not allows(values[field]):
                raise state.problem(f"{key}={given[key]} must be {allowed}", command)
    if "ACCEL_TO_DECEL" in given and not old and "MINIMUM_CRUISE_RATIO" not in given:
        state.warn(
            "ACCEL_TO_DECEL is not followed (Klipper ignores it since 2025-08-11): on an older one "
            "short moves have other speeds; if yours is from before 2024-03, put its "
            "max_accel_to_decel at firmware.planner.max_accel_to_decel_mm_s2 of the machine"
        )
    # Kalico has further ones, of Z; held back in a stream they would be lost.
    further = given.keys() - _LIMITS.keys()
    kind = EventKind.STATE if further else EventKind.LIMITS
    return state.set_limits(command, _held(state, values) if capped else values, kind=kind)


def perhaps_macro(state: MachineState, command: Command) -> int:
    """Another firmware's word, which Klipper passes over; many printers have a macro for it.

    Where the macros are known it is none, but M900 may be a command.

    Creality's M205 sets the corner velocity, their M900 pressure advance, and the M300 of Klipper's
    own examples waits (CrealityOfficial/K1_Series_Klipper, config/*/gcode_macro.cfg, 2024;
    Klipper3d/klipper, config/printer-sunlu-t3-2022.cfg, 2026-08). Anycubic's and Elegoo's Klippers
    have M900 as a command, Elegoo's M593 too (ANYCUBIC-3D/Kobra3, elegooofficial/CentauriCarbon,
    2025).
    """
    facts = state.firmware
    known = isinstance(facts, Klipper) and facts.macros_known and command.name not in _COMMANDS
    if state.i[at.I_KNOWN] & 3 == 3 and facts.unknown_commands != "skip" and not known:
        state.note(
            f"{command.name} in the middle of the print: Klipper passes over it, but if yours has "
            "a macro or a command of that name, as many makers' printers have, it sets limits or "
            f"waits in the middle of a stream; put {command.name} among the machine's macros "
            "(firmware section) if it has one, or else among harmless_macros"
        )
    return state.event(EventKind.HARMLESS)


def limit_macro(state: MachineState, command: Command, *, kind: EventKind) -> int:
    """M203 and M205 where the machine names a macro of it: the speed, and the corner velocity.

    M203 sets the smaller of X and Y, M205 X, or else Y. So do all of 79 printers' that were looked
    at (Creality's K1, K2 and Ender-3 V3, Elegoo's Neptune 4, Klippain; 2023 to 2026), and no more.
    One whose body is not known (kind UNKNOWN) may do more, as any macro.
    """
    given = state.numbers(command, "XY")
    values = {}
    if command.name == "M203":
        speed_mm_s = min(given.values(), default=0.0)
        values = {"velocity_mm_s": speed_mm_s} if speed_mm_s > 0.0 else {}
    elif (corner_mm_s := given.get("X", given.get("Y", -1.0))) >= 0.0:
        values = {"square_corner_velocity_mm_s": corner_mm_s}
    if kind == EventKind.UNKNOWN:
        state.settle()
        state.macro_ran = True
    return state.set_limits(command, values, kind=kind)


def reset_velocity_limit(state: MachineState, _command: Command) -> int:
    """RESET_VELOCITY_LIMIT of Kalico, or a macro: the limits of printer.cfg."""
    state.settle()
    row = state.initial_limits
    state.f[at.F_LIMITS : at.F_LIMITS + len(row)] = row
    state.note_limits()
    state.macro_ran = True
    return state.event(EventKind.UNKNOWN)


def acceleration(
    state: MachineState, command: Command, *, capped: bool = False, halved: bool = False
) -> int:
    """M204: S, or else the smaller of P and T; P or T alone are passed over.

    `halved`: a macro, which sets half of it for ACCEL_TO_DECEL too.
    """
    given = state.numbers(command, "SPT")
    accel = given.get("S")
    if accel is None and "P" in given and "T" in given:
        accel = min(given["P"], given["T"])
    if accel is None:
        return state.set_limits(command, {})
    if not at.MIN_VALUE <= accel <= at.MAX_VALUE:
        raise state.problem(f"the value {accel:g} is out of range; it must be above 0", command)
    values = {"accel_mm_s2": accel}
    if halved and _is_older(state):
        values["accel_to_decel_mm_s2"] = 0.5 * accel
    return state.set_limits(command, _held(state, values) if capped else values)


def set_retraction(state: MachineState, command: Command) -> int:
    """SET_RETRACTION."""
    if state.retraction is None:
        return state.event(state.dialect.otherwise(command.name))
    given = state.extended(command)
    changed = {}
    for key, field in (("RETRACT_LENGTH", "length_mm"), ("UNRETRACT_EXTRA_LENGTH", "extra_mm")):
        if key in given:
            changed[field] = state.at_least(given[key], key, 0.0, command)
    for key, field in (("RETRACT_SPEED", "speed_mm_s"), ("UNRETRACT_SPEED", "return_speed_mm_s")):
        if key in given:
            changed[field] = state.at_least(given[key], key, 1.0, command)
    state.change_retraction(**changed)
    state.retracted.clear()
    return state.event(EventKind.MODE)


def gcode_offset(state: MachineState, command: Command) -> int:
    """SET_GCODE_OFFSET."""
    given = state.extended(command)
    f = state.f
    delta = np.zeros(4)
    state.settle()
    for k, axis in enumerate("XYZE"):
        if axis in given:
            offset = state.number(given[axis], axis, command)
        elif f"{axis}_ADJUST" in given:
            offset = state.number(given[f"{axis}_ADJUST"], f"{axis}_ADJUST", command)
            offset += f[at.F_HOMING + k]
        else:
            continue
        delta[k] = offset - f[at.F_HOMING + k]
        f[at.F_BASE + k] += delta[k]
        f[at.F_HOMING + k] = offset
    state.note_modal()
    if not _flag(state, given, command):
        return state.event(EventKind.MODE)
    f[at.F_LAST : at.F_LAST + 4] += delta
    return _travel_at(state, given, command)


def save_state(state: MachineState, command: Command) -> int:
    """SAVE_GCODE_STATE."""
    key = state.extended(command).get("NAME", "default")
    if key not in state.saved and len(state.saved) >= _MOST_STATES:
        raise state.problem(
            f"it saves a state under one more than {_MOST_STATES} names; use a name again", command
        )
    state.saved[key] = Saved(state.f.copy(), state.i.copy())
    return state.event(EventKind.STATE)


def restore_state(state: MachineState, command: Command) -> int:
    """RESTORE_GCODE_STATE."""
    given = state.extended(command)
    key = given.get("NAME", "default")
    if key not in state.saved:
        if not state.macro_ran:
            raise state.problem(f"no state {key!r} was saved; SAVE_GCODE_STATE it first", command)
        state.warn(
            f"RESTORE_GCODE_STATE NAME={key}: a macro may have saved it; from here on the position "
            "is not known until the printer homes"
        )
        state.forget(origin=True)
        return state.event(EventKind.UNKNOWN)
    saved = state.saved[key]
    f, i = state.f, state.i
    state.settle()
    for slot in (at.I_ABS_XYZ, at.I_ABS_E, at.I_ORIGIN_KNOWN):
        i[slot] = saved.i[slot]
    for first, count in (
        (at.F_BASE, 4),
        (at.F_HOMING, 4),
        (at.F_SPEED, 3),  # speed, its factor, extrude factor
    ):
        f[first : first + count] = saved.f[first : first + count]
    f[at.F_BASE + 3] += f[at.F_LAST + 3] - saved.f[at.F_LAST + 3]
    state.note_modal()
    if not _flag(state, given, command):
        return state.event(EventKind.STATE)
    f[at.F_LAST : at.F_LAST + 3] = saved.f[at.F_LAST : at.F_LAST + 3]
    return _travel_at(state, given, command)


def exclude_object(state: MachineState, command: Command) -> int:
    """EXCLUDE_OBJECT_START and EXCLUDE_OBJECT_END."""
    number = -1
    if command.name == "EXCLUDE_OBJECT_START":
        number = state.objects.number(state.extended(command).get("NAME", "").upper())
    state.settle()
    state.i[at.I_OBJECT] = number
    state.remember(command, at.MEMO_MARKED, number + 1)
    return state.event(EventKind.OBJECT)


def tool(state: MachineState, command: Command) -> int:
    """T: a macro, if there is any."""
    if command.name[1:].isdigit() and int(command.name[1:]) < 100:
        state.settle()
        state.i[at.I_TOOL] = int(command.name[1:])
    kind = state.dialect.otherwise(command.name)
    state.macro_ran = state.macro_ran or kind == EventKind.UNKNOWN
    return state.event(kind)


def tuning_tower(state: MachineState, _command: Command) -> int:
    """TUNING_TOWER: from here on it runs a command in the first printing move of every height.

    That would be within a stream, whose limits and shaper are not to be changed
    (klippy/extras/tuning_tower.py).
    """
    state.warn(
        "TUNING_TOWER changes a setting at every height; what follows stays as sliced, so that it "
        "is that setting which is tested"
    )
    state.hold("TUNING_TOWER", True)
    return state.event(EventKind.UNKNOWN)


def activate_extruder(state: MachineState, command: Command) -> int:
    """ACTIVATE_EXTRUDER: E counts from 0 again, at 100 %."""
    name = state.extended(command).get("EXTRUDER", "").lower().removeprefix("extruder")
    f = state.f
    state.settle()
    if not name or (name.isdigit() and int(name) < 100):
        state.i[at.I_TOOL] = int(name or 0)
    f[at.F_EXTRUDE_FACTOR] = 1.0
    f[at.F_BASE + 3] = f[at.F_LAST + 3]
    state.note_modal()
    return state.event(EventKind.UNKNOWN)


def _is_older(state: MachineState) -> bool:
    """Tell whether there is ACCEL_TO_DECEL, and no ratio: before 2024-03 (klippy/toolhead.py)."""
    limits = dict(zip(state.limits_names, state.initial_limits, strict=True))
    return bool(limits["accel_to_decel_mm_s2"])


def _held(state: MachineState, values: Mapping[str, float]) -> dict[str, float]:
    """Return limits as a firmware takes them that goes no higher than its configuration."""
    most = dict(zip(state.limits_names, state.initial_limits, strict=True))
    return {
        name: min(value, most[name]) if name in _CAPPED else value for name, value in values.items()
    }


def _travel_at(state: MachineState, given: Mapping[str, str], command: Command) -> int:
    """MOVE=1: go to F_LAST at MOVE_SPEED."""
    f = state.f
    speed_before = f[at.F_SPEED]
    if "MOVE_SPEED" in given:
        speed = state.number(given["MOVE_SPEED"], "MOVE_SPEED", command)
        if speed <= 0:
            raise state.problem(f"MOVE_SPEED={given['MOVE_SPEED']} must be above 0", command)
        f[at.F_SPEED] = speed
    status = state.travel_to_kept()
    f[at.F_SPEED] = speed_before
    return status


def _flag(state: MachineState, given: Mapping[str, str], command: Command) -> bool:
    try:
        return bool(int(given.get("MOVE", "0")))
    except ValueError:
        raise state.problem(f"MOVE={given['MOVE']} must be 0 or 1", command) from None
