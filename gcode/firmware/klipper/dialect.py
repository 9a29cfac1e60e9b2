"""The effect of every command of a Klipper machine on the motion, in one table.

Facts: Klipper's command handlers as of 2026-08 (klippy/extras/*.py): which of them flush the
look-ahead queue, which only attach to it (fans, heaters, pressure advance), which move.

NATIVE commands do the same on every machine. Words that slicers write for other firmwares (FOREIGN)
are passed over, unless they are among the machine's ``macros``. Names in neither table are macros,
or unknown: they may do anything, unless the machine says ``unknown_commands: skip``; Klipper passes
over what it lacks without a stop.
"""

from __future__ import annotations

import re
from functools import partial

from stillpath.gcode.commands import (
    NO_ARCS,
    NO_RETRACTION,
    cancel_object,
    home,
    host_command,
    retract,
)
from stillpath.gcode.dialect import NEEDED, Action, Dialect, Word, words
from stillpath.gcode.firmware.klipper import commands, flushing
from stillpath.gcode.types import EventKind
from stillpath.models.firmware import Klipper

__all__ = ["FOREIGN", "klipper"]

KERNEL_WORDS: dict[str, Word] = {
    "G0": Action.MOVE,
    "G1": Action.MOVE,
    "G4": Action.DWELL,
    "G20": Action.REFUSED,
    "G90": Action.ABSOLUTE,
    "G91": Action.RELATIVE,
    "G92": Action.SET_POSITION,
    "M82": Action.ABSOLUTE_E,
    "M83": Action.RELATIVE_E,
    "M220": Action.SPEED_FACTOR,
    "M221": Action.EXTRUDE_FACTOR,
}

ARC_WORDS: dict[str, Word] = {
    "G2": Action.ARC_CW,
    "G3": Action.ARC_CCW,
    "G17": Action.PLANE_XY,
    "G18": Action.PLANE_XZ,
    "G19": Action.PLANE_YZ,
}

PYTHON_WORDS: dict[str, Word] = {
    "G28": home,
    "M486": cancel_object,
    "T": commands.tool,
    "@": host_command,
    "ACTIVATE_EXTRUDER": commands.activate_extruder,
    "SET_VELOCITY_LIMIT": commands.velocity_limit,
    "RESET_VELOCITY_LIMIT": commands.reset_velocity_limit,
    "SET_GCODE_OFFSET": commands.gcode_offset,
    "SAVE_GCODE_STATE": commands.save_state,
    "RESTORE_GCODE_STATE": commands.restore_state,
    "EXCLUDE_OBJECT_START": commands.exclude_object,
    "EXCLUDE_OBJECT_END": commands.exclude_object,
    "SET_INPUT_SHAPER": flushing.shaper,
    "SET_PRESSURE_ADVANCE": flushing.pressure_advance,
    "TUNING_TOWER": commands.tuning_tower,
}

CAPPED_WORDS: dict[str, Word] = {
    "SET_VELOCITY_LIMIT": partial(commands.velocity_limit, capped=True),
}

RETRACTION_WORDS: dict[str, Word] = {
    "G10": retract,
    "G11": retract,
    "SET_RETRACTION": commands.set_retraction,
}

NATIVE: dict[str, Word] = {
    # Read back, messages, displays: the motion does not notice.
    **words(
        "G21 M20 M23 M27 M73 M104 M105 M106 M107 M110 M114 M115 M117 M118 M140 "
        "ECHO HELP STATUS RESPOND SET_DISPLAY_TEXT SET_DISPLAY_GROUP GET_POSITION "
        "GET_RETRACTION QUERY_ADC QUERY_FILAMENT_SENSOR SET_FILAMENT_SENSOR SET_IDLE_TIMEOUT "
        "SET_HEATER_TEMPERATURE TURN_OFF_HEATERS SET_TEMPERATURE_FAN_TARGET SET_FAN_SPEED "
        "SET_PIN SET_LED SET_LED_TEMPLATE SET_PRINT_STATS_INFO "
        "SET_GCODE_VARIABLE SAVE_VARIABLE EXCLUDE_OBJECT_DEFINE "
        "BED_MESH_OUTPUT BED_MESH_MAP",
        EventKind.HARMLESS,
    ),
    # Come to rest, wait, go on from the same place. SET_SERVO asked for the time of the last move
    # until 2024-07-30, as it does in most vendors' versions (klippy/extras/servo.py).
    **words(
        "M400 M109 M119 M190 M191 TEMPERATURE_WAIT QUERY_ENDSTOPS ACCELEROMETER_MEASURE SET_SERVO",
        EventKind.STOP,
    ),
    # Homing, probing, motors off, transforms, other tools: the place or the state is lost.
    **words(
        "M18 M84 M112 PROBE PROBE_CALIBRATE PROBE_ACCURACY Z_TILT_ADJUST QUAD_GANTRY_LEVEL "
        "BED_MESH_CALIBRATE BED_MESH_PROFILE BED_MESH_CLEAR BED_MESH_OFFSET "
        "BED_TILT_CALIBRATE BED_SCREWS_ADJUST "
        "SCREWS_TILT_CALCULATE DELTA_CALIBRATE MANUAL_PROBE MANUAL_STEPPER FORCE_MOVE "
        "SET_KINEMATIC_POSITION STEPPER_BUZZ SET_STEPPER_ENABLE SET_DUAL_CARRIAGE "
        "SYNC_EXTRUDER_MOTION SET_EXTRUDER_ROTATION_DISTANCE SET_SKEW "
        "SKEW_PROFILE TEST_RESONANCES SHAPER_CALIBRATE MEASURE_AXES_NOISE "
        "PID_CALIBRATE SDCARD_PRINT_FILE SDCARD_RESET_FILE SDCARD_LOOP_BEGIN SDCARD_LOOP_END "
        "SDCARD_LOOP_DESIST M24 M25 M26 PAUSE RESUME CLEAR_PAUSE CANCEL_PRINT RESTART "
        "FIRMWARE_RESTART SAVE_CONFIG UPDATE_DELAYED_GCODE SAVE_DUAL_CARRIAGE_STATE "
        "RESTORE_DUAL_CARRIAGE_STATE SYNC_STEPPER_TO_EXTRUDER SET_EXTRUDER_STEP_DISTANCE "
        "SET_Z_THERMAL_ADJUST SET_TMC_CURRENT SET_TMC_FIELD INIT_TMC DUMP_TMC "
        "EXCLUDE_OBJECT EXCLUDE_OBJECT_RESET",
        EventKind.UNKNOWN,
    ),
}

FOREIGN: dict[str, Word] = {
    # Words of other firmwares that slicers write into every file.
    **words(
        "G17 G18 G19 G26 M3 M4 M5 M17 M72 M74 M75 M76 M77 M80 M81 M92 M108 M113 M126 M127 M141 "
        "M142 M145 M149 M150 M155 M200 M202 M206 M207 M208 M209 M211 M218 M301 M302 M303 "
        "M304 M355 M420 M500 M501 M502 M503 M556 M557 M558 M566 M569 M571 M573 M574 M579 M581 "
        "M582 M584 M587 M595 M605 M620 M621 M622 M623 M624 M625 M710 M851 M862.1 M862.2 M862.3 "
        "M862.4 M862.5 M862.6 M906 M907 M913 M914 M950 M960 M970.3 M971 M973 M974 M975 M981 M982 "
        "M983 M1002 G92.1 G60 M861 M863 M864 M865 M221.1 M142.1",
        EventKind.HARMLESS,
    ),
    # The same, but printers have macros of these names, which set limits or wait.
    **words("M201 M203 M205 M300 M572 M593 M900", commands.perhaps_macro),
}

MACROS: dict[str, Word] = {
    name: partial(commands.limit_macro, kind=EventKind.UNKNOWN) for name in ("M203", "M205")
}
"""What is known of macros with another firmware's word for a name, if a machine names them."""
LIMIT_MACROS: dict[str, Word] = {
    name: partial(commands.limit_macro, kind=EventKind.LIMITS) for name in MACROS
}

_NAME = re.compile(r"^[A-Z_][A-Z0-9_.]*$")


def klipper(firmware: Klipper) -> Dialect:
    """Return how Klipper reads G-code on a machine.

    Parameters
    ----------
    firmware : Klipper
        Names its macros and says what an unknown name does.
    """
    skipped = firmware.unknown_commands == "skip"
    macros = {name.upper() for name in firmware.macros}
    acceleration = partial(
        commands.acceleration, capped=firmware.limits_capped, halved="M204" in macros
    )

    def otherwise(name: str) -> EventKind:
        # A name that no macro can have is passed over with a message.
        harmless = skipped or not _NAME.match(name)
        return EventKind.HARMLESS if harmless else EventKind.UNKNOWN

    table = {
        **({} if firmware.arcs else NO_ARCS),
        **({} if firmware.retraction else NO_RETRACTION),
        **FOREIGN,
        **{name: MACROS.get(name, EventKind.UNKNOWN) for name in sorted(macros)},
        **{str(name): LIMIT_MACROS[name] for name in firmware.limit_macros},
        **NATIVE,
        **{name.upper(): EventKind.STOP for name in firmware.stopping_macros},
        **{name.upper(): EventKind.HARMLESS for name in firmware.harmless_macros},
        **KERNEL_WORDS,
        **(ARC_WORDS if firmware.arcs else {}),
        **PYTHON_WORDS,
        "M204": acceleration,
        **(CAPPED_WORDS if firmware.limits_capped else {}),
        **(RETRACTION_WORDS if firmware.retraction else {}),
    }
    return Dialect(
        name="klipper",
        title="Klipper",
        words=table,
        otherwise=otherwise,
        extended_commands=True,
        needed={**NEEDED, "G2": "XYZEFRIJK", "G3": "XYZEFRIJK", "G4": "P"},
    )
