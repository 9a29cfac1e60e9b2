"""G-code as read by Marlin and its relatives: Prusa's Buddy firmware and Bambu's.

Sources: docs/dialects.md, which also says what was not read in a firmware's own source.

What a build may lack is as the machine's document says. A word that the build lacks although the
file uses it is `EventKind.UNKNOWN`: file and document contradict each other.
"""

from __future__ import annotations

from dataclasses import replace

from stillpath.gcode.commands import (
    NO_ARCS,
    NO_RETRACTION,
    cancel_object,
    cutter,
    home,
    host_command,
    retract,
)
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
from stillpath.gcode.firmware.marlin import commands
from stillpath.gcode.firmware.marlin.bambu import BAMBU
from stillpath.gcode.firmware.marlin.prusa import PRUSA
from stillpath.gcode.types import EventKind
from stillpath.gcode.workspaces import machine_space, move_to_saved, save_place, select_workspace
from stillpath.models.firmware import Marlin

__all__ = ["marlin"]

BAMBU_LINE = 4096

MOTION: dict[str, Word] = {
    "G0": Action.MOVE,
    "G1": Action.MOVE,
    "G4": Action.DWELL,
    "G21": Action.MILLIMETRES,
    "G28": home,
    "G90": Action.ABSOLUTE,
    "G91": Action.RELATIVE,
    "G92": Action.SET_POSITION,
    "M82": Action.ABSOLUTE_E,
    "M83": Action.RELATIVE_E,
    "M200": commands.filament_area,
    "M220": commands.speed_factor,
    "M221": commands.extrude_factor,
    "M486": cancel_object,
    "T": commands.tool,
    "@": host_command,
}

ARCS: dict[str, Word] = {
    "G2": Action.ARC_CW,
    "G3": Action.ARC_CCW,
}

OPTIONS: dict[str, dict[str, Word]] = {
    # Field of the machine's firmware section: words that the build has only with it.
    "inch_mode": {"G20": Action.INCHES},
    "cnc_planes": {"G17": Action.PLANE_XY, "G18": Action.PLANE_XZ, "G19": Action.PLANE_YZ},
    "cnc_workspaces": {
        "G53": machine_space,
        **words("G54 G55 G56 G57 G58 G59 G59.1 G59.2 G59.3", select_workspace),
        "G92.1": commands.reset_origin,
    },
    "bezier_curves": {"G5": Action.CURVE},
    "saved_positions": {"G60": save_place, "G61": move_to_saved},
    "motion_modes": {"G80": commands.end_motion_mode},
}

RETRACTION: dict[str, Word] = {
    "G10": retract,
    "G11": retract,
    "M207": commands.retract_settings,
    "M208": commands.retract_settings,
    "M209": commands.not_modelled(
        EventKind.HARMLESS, "moves of the extruder alone may turn into retractions of the firmware"
    ),
}

LIMITS: dict[str, Word] = {
    "M201": commands.axis_limits("accel_{axis}_mm_s2"),
    "M203": commands.axis_limits("feedrate_{axis}_mm_s"),
    "M204": commands.accelerations,
    "M205": commands.corners_and_least_speeds,
    "M900": commands.linear_advance,
}

_MOVED = commands.not_modelled(
    EventKind.UNKNOWN, "from here on the position is not known until the printer homes"
)

STEPS: dict[str, Word] = {
    # Temperatures, fans, messages, settings: without effect on the motion.
    **words(
        "G80 M16 M17 M20 M27 M29 M30 M31 M33 M34 M42 M73 M75 M76 M77 M78 M85 M86 M87 M100 M104 "
        "M105 M106 M107 M108 M110 M113 M115 M117 M118 M119 M120 M121 M122 M123 M126 M127 M128 M129 "
        "M140 M141 M142 M143 M145 M149 M150 M151 M154 M155 M163 M164 M165 M166 M202 M210 M211 M218 "
        "M250 M255 M256 M260 M261 M280 M281 M282 M300 M301 M302 M304 M305 M309 M355 M380 M381 M403 "
        "M404 M405 M406 M407 M412 M413 M414 M430 M485 M503 M504 M511 M512 M540 M550 M552 M553 M554 "
        "M569 M575 M587 M591 M603 M672 M710 M851 M862.1 M862.2 M862.3 M862.4 M862.5 M862.6 M871 "
        "M876 M906 M907 M908 M909 M910 M911 M912 M913 M914 M919 M951 M1003 M3426 M7219",
        EventKind.HARMLESS,
    ),
    # The machine stops, waits, and continues from the same place. M114 stops in some builds only.
    **words(
        "M7 M8 M9 M10 M11 M12 M80 M109 M114 M190 M191 M192 M193 M240 M290 M293 M294 M303 M400 M872",
        EventKind.STOP,
    ),
    # Homing, probing, parking, pauses, motors off, other files, tests: the place or the state is
    # lost.
    **words(
        "G6 G12 G26 G27 G29 G30 G31 G32 G33 G34 G35 G38 G42 G76 G425 "
        "M0 M1 M18 M21 M22 M23 M24 M25 M26 M28 M32 M43 M48 M81 M84 M111 M112 M125 M217 M226 M306 "
        "M360 M361 M362 M363 M364 M401 M402 M410 M420 M421 M422 M423 M425 M510 M592 M600 M601 M602 "
        "M605 M606 M701 M702 M704 M705 M706 M707 M708 M709 M852 M860 M861 M862 M863 M864 M865 M866 "
        "M867 M868 M869 M915 M916 M917 M918 M928 M936 M955 M956 M957 M958 M959 M970 M971 M972 M973 "
        "M974 M975 M976 M977 M993 M994 M995 M997 M999 M1000 M1001 M1002 M1004 M1005 "
        # M500 stores the current limits and shaper permanently; M524 aborts the print.
        "M500 M524",
        EventKind.UNKNOWN,
    ),
    # The coordinates count from somewhere else.
    **words(
        "G92.2 G92.3 G92.4 G92.5 G92.6 G92.7 G92.8 G92.9 M350 M351 M416 M428 M665 "
        "M666 M810 M811 M812 M813 M814 M815 M816 M817 M818 M819 M820",
        _MOVED,
    ),
    **words("M501 M502", commands.reset_limits),
    "M102": commands.bed_distance_sensor,
    "M206": commands.home_offset,
    "M808": commands.not_modelled(
        EventKind.UNKNOWN, "a part of the file repeats; it is read as if it were there once"
    ),
    "M92": commands.not_modelled(EventKind.HARMLESS, "steps per mm are taken from the machine"),
    **words("M3 M4 M5", cutter(EventKind.STOP)),
    "M593": EventKind.SHAPER,
    # Fixed-time motion has a planner and shapers of its own.
    **words(
        "M493 M494",
        commands.not_modelled(EventKind.UNKNOWN, "fixed-time motion is not modelled"),
    ),
    # AnkerMake's: another set of limits, S-curve on or off.
    "M4899": commands.not_modelled(EventKind.UNKNOWN, "the limits that it sets are not known"),
    "M495": commands.resonance_test,
    "M496": EventKind.HARMLESS,
}


def _optional(firmware: Marlin) -> dict[str, Word]:
    """Return the words of the build's options, those that it lacks as barriers."""
    table: dict[str, Word] = {}
    for option, found in OPTIONS.items():
        lacking = commands.not_modelled(
            EventKind.UNKNOWN,
            f"the build lacks it, as the machine says; if it does not, set {option} in the "
            "machine's firmware section",
        )
        table |= found if getattr(firmware, option) else dict.fromkeys(found, lacking)
    if not firmware.cnc_planes:
        table["G17"] = EventKind.HARMLESS
    if not firmware.motion_modes:
        table["G80"] = EventKind.HARMLESS
    return table


def marlin(firmware: Marlin) -> Dialect:
    """Return how Marlin, or a relative of it, reads G-code on a machine."""
    skipped = firmware.unknown_commands == "skip"
    if firmware.variant == "bambu" and "unknown_commands" not in firmware.model_fields_set:
        skipped = False  # undocumented words may do anything

    def otherwise(_name: str) -> EventKind:
        return EventKind.HARMLESS if skipped else EventKind.UNKNOWN

    table = {
        **({} if firmware.arcs else NO_ARCS),
        **({} if firmware.retraction else NO_RETRACTION),
        **STEPS,
        **LIMITS,
        **{name.upper(): EventKind.STOP for name in firmware.stopping_macros},
        **{name.upper(): EventKind.HARMLESS for name in firmware.harmless_macros},
        **MOTION,
        **_optional(firmware),
        **(ARCS if firmware.arcs else {}),
        **(RETRACTION if firmware.retraction else {}),
        **{"prusa": PRUSA, "bambu": BAMBU}.get(firmware.variant, {}),
        **({"M493": EventKind.SHAPER} if firmware.ft_motion else {}),
    }
    made = Dialect(
        name="marlin",
        title="Marlin",
        words=table,
        otherwise=otherwise,
        raw_text=frozenset({"M16", "M23", "M28", "M30", "M117", "M118", "M928"}),
        fold_case=firmware.case_insensitive,
        paren_comments=firmware.paren_comments,
        modal_words=firmware.motion_modes,
        ignores_subcodes=True,
        longest_command=firmware.max_cmd_size - 1,
        cut_long_commands=True,
        extruder=ExtruderRule.FOLLOWS_AXES,
        arc_circles=firmware.arc_circles,
        arc=ArcRule.MARLIN_2_0 if firmware.variant == "2.0" else ArcRule.MARLIN_2_1,
        dwell=DwellRule.S_OR_P,
        origin=OriginRule.OFFSET,
        factor_default=False,
        retraction_scaled=False,
        zero_feed_passes=True,
        bad_words_pass=True,
        bad_arcs_pass=True,
        tool_at_start=False,
    )
    if firmware.variant == "prusa":
        return replace(made, name="prusa", title="Prusa Buddy")
    if firmware.variant == "bambu":
        # Its lines may be longer: BambuStudio writes M73 and M1002 lines beyond 96 characters.
        return replace(made, name="bambu", title="Bambu", longest_command=BAMBU_LINE)
    return made
