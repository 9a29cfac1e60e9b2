"""Compute how long Klipper stands still for a command that flushes step generation.

Steps are generated ahead of their motion, by the look-ahead of input shaper and pressure advance.
SET_INPUT_SHAPER flushes them all: the next move starts later by the look-ahead before the command
plus that after it; behind several commands at one rest, by that before the first plus that after
the last (Klipper before 2024: the longest before any of them). So does a SET_PRESSURE_ADVANCE that
changes the time over which the extruder's speed is averaged, which is 0 without pressure advance.
Klipper before 2025-09-03, and Kalico, flush for every SET_PRESSURE_ADVANCE: their machines name it
among their ``stopping_macros``, or have a ``max_accel_to_decel_mm_s2``, which only a Klipper before
2024-03 has.

Sources: klippy/toolhead.py (flush_step_generation, _calc_print_time), klippy/extras/
motion_queuing.py, klippy/extras/input_shaper.py, klippy/kinematics/extruder.py
(_set_pressure_advance), 2026-08.
"""

from __future__ import annotations

import math
import re

from stillpath.gcode import _slots as at
from stillpath.gcode.lexer import Command
from stillpath.gcode.state import MachineState
from stillpath.gcode.types import EventKind
from stillpath.models.errors import ModelError
from stillpath.models.firmware import Klipper
from stillpath.models.shaper_pulses import SHAPERS, shaper_pulses

__all__ = ["pressure_advance", "shaper"]

_LEAST_S = 1e-3
_MOST_SMOOTH_S = 0.2
_MOST_REACH_S = 1.0
_KINDS = tuple(SHAPERS)
_SET = ("ADVANCE ", "SMOOTH_TIME ")
_MAY_STOP = (
    "SET_PRESSURE_ADVANCE in the middle of the print: Klipper before 2025-09, as most vendors' is, "
    "and Kalico stop there, and streams with them; if yours is one of these, put "
    "SET_PRESSURE_ADVANCE among the machine's stopping_macros (firmware section)"
)
_EXTRUDER = re.compile(r"extruder(\d{0,2})")


def pressure_advance(state: MachineState, command: Command) -> int:
    """SET_PRESSURE_ADVANCE: stands still where an extruder's smooth time changes, or always."""
    given = state.extended(command)
    before_s = _ahead_s(state)
    extruder = int(state.i[at.I_TOOL])
    if "EXTRUDER" in given:
        found = _EXTRUDER.fullmatch(given["EXTRUDER"])
        if found is None:
            # An [extruder_stepper]'s may change or not.
            return _flush(state, EventKind.STOP, before_s)
        extruder = int(found[1] or 0)
    smooth_s = _extruder_smooth_s(state, extruder)
    again = f"ADVANCE {extruder}" in state.settings
    for key in ("ADVANCE", "SMOOTH_TIME"):
        if key in given:
            state.settings[f"{key} {extruder}"] = _number(given[key])
    if _extruder_smooth_s(state, extruder) == smooth_s and not _always_stops(state, command):
        if again and state.i[at.I_KNOWN] & 3 == 3:
            state.warn(_MAY_STOP)
        return state.event(EventKind.HARMLESS)
    return _flush(state, EventKind.STOP, before_s)


def shaper(state: MachineState, command: Command) -> int:
    """SET_INPUT_SHAPER: stands still for the look-ahead before plus that after it."""
    given = state.extended(command)
    before_s = _ahead_s(state)
    for axis in "XY":
        kind, f_hz, damping = _shaper(state, axis)
        kind = given.get(f"SHAPER_TYPE_{axis}", given.get("SHAPER_TYPE", kind)).lower()
        if f"SHAPER_FREQ_{axis}" in given:
            f_hz = _number(given[f"SHAPER_FREQ_{axis}"])
        if f"DAMPING_RATIO_{axis}" in given:
            damping = _number(given[f"DAMPING_RATIO_{axis}"])
        state.settings[f"shaper {axis}"] = float(_KINDS.index(_modelled(kind)))
        state.settings[f"f_hz {axis}"] = f_hz
        state.settings[f"damping {axis}"] = damping
    return _flush(state, EventKind.SHAPER, before_s)


def _flush(state: MachineState, kind: EventKind, before_s: float) -> int:
    """Write an event that stands for the look-ahead, less what was counted at this rest."""
    known = state.settings
    # A macro may have moved.
    place, counted_s = state.moves + int(state.i[at.I_MACROS]), 0.0
    if known.get("flushed at") == place:
        first_s, counted_s = known["flushed before"], known["flushed for"]
        before_s = max(before_s, first_s) if _is_older(state) else first_s
    stands_s = max(before_s + _ahead_s(state), counted_s)
    known |= {"flushed at": place, "flushed before": before_s, "flushed for": stands_s}
    return state.event(kind, stands_s - counted_s)


def _always_stops(state: MachineState, command: Command) -> bool:
    """Return whether the machine's Klipper flushes even if nothing changes."""
    return _is_older(state) or command.name in map(str.upper, state.firmware.stopping_macros)


def _is_older(state: MachineState) -> bool:
    """Return whether the machine's Klipper is from before 2024-03."""
    firmware = state.firmware
    return isinstance(firmware, Klipper) and firmware.planner.max_accel_to_decel_mm_s2 is not None


def _ahead_s(state: MachineState) -> float:
    """Return how far ahead of the motion steps are made."""
    # Those without a line of their own are as in printer.cfg, like the one in use.
    extruders = {int(state.i[at.I_TOOL])}
    extruders |= {int(key.split()[1]) for key in state.settings if key.startswith(_SET)}
    smooth_s = max(_extruder_smooth_s(state, extruder) for extruder in extruders)
    return max(_LEAST_S, 0.5 * smooth_s, *(_reach_s(*_shaper(state, axis)) for axis in "XY"))


def _extruder_smooth_s(state: MachineState, extruder: int) -> float:
    """Return the time over which an extruder's speed is averaged; 0: it is not."""
    advance_s = state.settings.get(f"ADVANCE {extruder}", state.machine.pressure_advance_s)
    if not (advance_s > 0.0 and isinstance(state.firmware, Klipper)):
        return 0.0
    stated_s = state.firmware.extruder.pressure_advance_smooth_time_s
    return min(state.settings.get(f"SMOOTH_TIME {extruder}", stated_s), _MOST_SMOOTH_S)


def _shaper(state: MachineState, axis: str) -> tuple[str, float, float]:
    """Return an axis' shaper: type, frequency, damping; before the first line printer.cfg's."""
    known = state.settings
    if f"shaper {axis}" in known:
        kind = int(known[f"shaper {axis}"])
        return _KINDS[kind], known[f"f_hz {axis}"], known[f"damping {axis}"]
    s = state.firmware.shaper if isinstance(state.firmware, Klipper) else None
    if s is None:
        return "mzv", 0.0, 0.1
    if axis == "X":
        return _modelled(s.type_x), s.freq_x_hz, s.damping_x
    return _modelled(s.type_y), s.freq_y_hz, s.damping_y


def _modelled(kind: str) -> str:
    """Return the type without its arguments; for one without a model, one about as long."""
    name = kind.partition("(")[0].strip()
    return name if name in SHAPERS else "ei"


def _reach_s(kind: str, f_hz: float, damping: float) -> float:
    """Return how far a shaper looks ahead or back, whichever is more; 0: off, or refused."""
    if f_hz <= 0.0:
        return 0.0
    try:
        weights, delays_s = shaper_pulses(kind, f_hz, damping)
    except ModelError:
        return 0.0
    middle_s = float(weights @ delays_s)
    return min(max(middle_s, float(delays_s[-1]) - middle_s), _MOST_REACH_S)


def _number(text: str) -> float:
    """Return a number of a line that stays as sliced; Klipper would refuse invalid ones."""
    try:
        value = float(text)
    except ValueError:
        return 0.0
    return value if math.isfinite(value) else 0.0
