"""G-code as read by RepRapFirmware 3.

Sources: docs/dialects.md, which also says what was not read in the firmware's own source.
"""

from __future__ import annotations

from stillpath.gcode.commands import NO_ARCS, cancel_object, cutter, home, host_command, retract
from stillpath.gcode.dialect import (
    Action,
    ArcRule,
    Dialect,
    DwellRule,
    ExtruderRule,
    OriginRule,
    Word,
    words,
)
from stillpath.gcode.firmware.marlin.commands import (
    filament_area,
    home_offset,
    not_modelled,
    reset_limits,
)
from stillpath.gcode.firmware.reprapfirmware import commands
from stillpath.gcode.types import EventKind
from stillpath.gcode.workspaces import machine_space, save_place, select_workspace
from stillpath.models.firmware import RepRapFirmware

__all__ = ["reprapfirmware"]

LONGEST_COMMAND = 255

MOTION: dict[str, Word] = {
    "G0": Action.MOVE,
    "G1": Action.MOVE,
    "G4": Action.DWELL,
    "G10": commands.retract_or_offsets,
    "G20": Action.INCHES,
    "G21": Action.MILLIMETRES,
    "G28": home,
    "G53": machine_space,
    **words("G54 G55 G56 G57 G58 G59 G59.1 G59.2 G59.3", select_workspace),
    "G60": save_place,
    "G90": Action.ABSOLUTE,
    "G91": Action.RELATIVE,
    "G92": Action.SET_POSITION,
    "M82": Action.ABSOLUTE_E,
    "M83": Action.RELATIVE_E,
    "M120": commands.push_state,
    "M121": commands.pop_state,
    "M200": filament_area,
    "M220": Action.SPEED_FACTOR,
    "M221": commands.extrude_factor,
    "M451": commands.machine_mode,
    "M452": commands.machine_mode,
    "M453": commands.machine_mode,
    "M486": cancel_object,
    "T": commands.tool,
    "@": host_command,
}

ARCS: dict[str, Word] = {
    "G2": Action.ARC_CW,
    "G3": Action.ARC_CCW,
    **words("G17 G18 G19", commands.select_plane),
}

RETRACTION: dict[str, Word] = {
    **words("G11 M101 M103", retract),
    "M207": commands.retract_settings,
}

LIMITS: dict[str, Word] = {
    "M201": commands.accelerations,
    "M203": commands.speeds,
    "M204": commands.acceleration,
    "M205": commands.jerk_below_ceiling,
    "M566": commands.jerk,
    "M572": commands.pressure_advance,
}

STEPS: dict[str, Word] = {
    # Temperatures, fans, messages, settings: the motion does not notice.
    **words(
        "G31 M20 M21 M22 M27 M29 M30 M36 M36.1 M38 M39 M42 M73 M80 M85 M102 M104 M105 M106 "
        "M107 M108 M110 M111 M114 M115 M117 M118 M119 M122 M140 M141 M143 M144 M201.1 M202 M260 "
        "M261 M280 M292 M300 M301 M304 M305 M307 M308 M309 M374 M404 M407 M408 M409 M450 M470 M471 "
        "M472 M500 M503 M540 M550 M551 M552 M553 M554 M555 M557 M558 M564 M567 M568 M570 M571 M573 "
        "M575 M576 M581 M586 M586.4 M587 M587.1 M587.2 M588 M589 M591 M672 M851 M905 M911 M912 "
        "M915 M929 M950 M955 M956 M998",
        EventKind.HARMLESS,
    ),
    # Come to rest, wait, go on from the same place.
    **words(
        "M17 M116 M150 M190 M191 M290 M302 M303 M400 M577 M578 M592 M595 M598 M906 M913 M917 M918",
        EventKind.STOP,
    ),
    **words("M3 M4", cutter(EventKind.HARMLESS)),
    "M5": cutter(EventKind.STOP),
    "M109": commands.heat_and_wait,
    # Homing, probing, macros, pauses, motors off, other files and queues, events, what bends the
    # bed or the axes: the place or the state is lost, and the next coordinates tell it.
    **words(
        "G27 G29 G30 G32 G38 G38.2 G38.3 G38.4 G38.5 M0 M1 M2 M18 M23 M24 M25 M26 M28 M32 M37 M81 "
        "M84 M98 M99 M112 M125 M208 M226 M291 M375 M376 M401 M402 M425 M505 M556 M559 M560 M561 "
        "M562 M569 M569.1 M569.2 M569.3 M569.4 M569.5 M569.6 M569.7 M569.8 M569.9 M574 M582 M585 "
        "M594 M596 M597 M599 M600 M601 M606 M673 M701 M702 M703 M916 M951 M952 M953 M954 M957 M970 "
        "M970.1 M970.2 M970.3 M997 M999",
        EventKind.UNKNOWN,
    ),
    # The coordinates count from somewhere else.
    **words(
        "G68 G69 G93 G94 M350 M579 M584 M665 M666 M667 M669 M671 M674 M675",
        not_modelled(
            EventKind.UNKNOWN, "from here on the position is not known until the printer homes"
        ),
    ),
    **words("M501 M502", reset_limits),
    "M206": home_offset,
    "M563": commands.define_tool,
    "M92": not_modelled(EventKind.STOP, "steps per mm are taken from the machine"),
    "M593": EventKind.SHAPER,
}


def reprapfirmware(firmware: RepRapFirmware) -> Dialect:
    """Return how RepRapFirmware reads G-code on a machine."""
    skipped = firmware.unknown_commands == "skip"

    def otherwise(name: str) -> EventKind:
        # G1234 may be a macro of the printer, sys/G1234.g; other letters are no commands.
        macro = name[:1] in ("G", "M") and len(name) > 1
        return EventKind.UNKNOWN if macro and not skipped else EventKind.HARMLESS

    table = {
        **({} if firmware.arcs else NO_ARCS),
        **STEPS,
        **LIMITS,
        **{name.upper(): EventKind.STOP for name in firmware.stopping_macros},
        **{name.upper(): EventKind.HARMLESS for name in firmware.harmless_macros},
        **MOTION,
        **(ARCS if firmware.arcs else {}),
        **(RETRACTION if firmware.retraction else {}),
    }
    return Dialect(
        name="reprapfirmware",
        title="RepRapFirmware",
        words=table,
        otherwise=otherwise,
        raw_text=frozenset({"M23", "M28", "M30", "M32", "M36", "M117"}),
        quoted_text=True,
        expressions=True,
        one_command=False,
        first_wins=True,
        exponents=True,
        longest_command=LONGEST_COMMAND,
        extruder=ExtruderRule.APART,
        arc=ArcRule.REPRAP,
        dwell=DwellRule.S_OR_P_OR_NOTHING,
        origin=OriginRule.POSITION,
        factor_default=False,
        factors_need_axes=True,
        retraction_scaled=False,
        tool_at_start=False,
        odd_words="HR",
        odd_move=commands.special_move,
        start_speed_mm_s=50.0,
    )
