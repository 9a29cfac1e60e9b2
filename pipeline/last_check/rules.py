"""What each firmware reads and skips, as far as the last check must know.

Sources: Klipper klippy/gcode.py and klippy/extras/gcode_move.py, 2026-08; Marlin
Marlin/src/gcode/parser.cpp, queue.cpp and gcode.cpp, bugfix-2.1.x; RepRapFirmware
src/GCodes/GCodeBuffer/StringParser.cpp and GCodes2.cpp, 3.5. Commands that might move the head are
not listed as harmless: after them nothing is compared until the file names a position.
"""

from __future__ import annotations

from dataclasses import dataclass

from stillpath.models.firmware import Firmware, Klipper, Marlin, RepRapFirmware

__all__ = ["Rules", "rules_of"]

_EVERYWHERE = frozenset(
    b"G4 G10 G11 M20 M27 M31 M42 M73 M75 M76 M77 M78 M104 M105 M106 M107 M108 M110 M113 "
    b"M114 M115 M117 M118 M119 M140 M141 M142 M143 M145 M149 M150 M155 M190 M191 M200 M201 M202 "
    b"M203 M204 M205 M207 M211 M220 M221 M250 M300 M301 M302 M304 M355 M400 M486 M500 M503 M555 "
    b"M566 M572 M593 M862.1 M862.2 M862.3 M862.4 M862.5 M862.6 M900 M906 M907".split()
)
"""Waiting, heating, fans, messages, limits, the firmware's shapers and pressure advance."""
_KLIPPER = frozenset(
    b"SET_VELOCITY_LIMIT SET_PRESSURE_ADVANCE SET_INPUT_SHAPER SET_RETRACTION EXCLUDE_OBJECT_START "
    b"EXCLUDE_OBJECT_END EXCLUDE_OBJECT_DEFINE SET_FAN_SPEED SET_HEATER_TEMPERATURE "
    b"TEMPERATURE_WAIT TURN_OFF_HEATERS SET_PRINT_STATS_INFO SET_DISPLAY_TEXT RESPOND SET_PIN "
    b"SET_LED M109".split()
)
_MARLIN = frozenset(
    b"M3 M4 M5 M16 M17 M85 M92 M109 M208 M209 M412 M413 M493 M494 M496 M603".split()
)
_REPRAPFIRMWARE = frozenset(b"M3 M4 M5 M17 M92 M101 M103 M116 M563 M568 M581".split())
_ARCS = frozenset((b"G2", b"G3"))


@dataclass(frozen=True, slots=True, eq=False)
class Rules:
    """Parsing rules of a firmware.

    Attributes
    ----------
    harmless : frozenset of bytes
        Commands that change neither position, modes nor F.
    folds_case, leading_zeros : bool
        ``g1`` is G1; ``G01`` is G1, and the command ends with its number (Klipper's name extends
        to the next letter).
    ignores_subcodes : bool
        G90.5 is G90 (Marlin).
    inches : bool
        G20 changes the unit.
    arcs : frozenset of bytes
        Commands of arcs.
    positioning_sets_extruder : bool
        G90 and G91 apply to E too (Marlin).
    relative_rules_extruder : bool
        After G91 E is relative whatever M82 said (Klipper).
    divides_extruder : bool
        Each segment of an arc gets a part of E, as if that were relative (Klipper).
    bare_set_position : bool
        G92 without words sets all to 0 (Klipper).
    skips_low_feed : bool
        An F of 0 or less is skipped (Marlin).
    restores : bool
        SAVE_GCODE_STATE and RESTORE_GCODE_STATE (Klipper).
    stacks : bool
        M120 and M121 (RepRapFirmware).
    checks_sums : bool
        A line with a wrong checksum is dropped (RepRapFirmware).
    exponents : bool
        An E right after a digit belongs to the number (RepRapFirmware).
    several : bool
        A line may hold several commands, and conditions (RepRapFirmware).
    longest : int
        Length of a command up to which it is certainly read.
    relative_e : float
        Initial mode of E: 1 relative, 0 absolute, nan unknown.
    """

    harmless: frozenset[bytes]
    folds_case: bool = True
    leading_zeros: bool = True
    ignores_subcodes: bool = False
    inches: bool = False
    arcs: frozenset[bytes] = frozenset()
    positioning_sets_extruder: bool = False
    relative_rules_extruder: bool = False
    divides_extruder: bool = False
    bare_set_position: bool = False
    skips_low_feed: bool = False
    restores: bool = False
    stacks: bool = False
    checks_sums: bool = False
    exponents: bool = False
    several: bool = False
    longest: int = 250
    relative_e: float = 0.0


def rules_of(firmware: Firmware) -> Rules:
    """Return the parsing rules of a machine's firmware."""
    arcs = _ARCS if firmware.arcs else frozenset()
    if isinstance(firmware, Klipper):
        return Rules(
            harmless=_EVERYWHERE | _KLIPPER,
            leading_zeros=False,
            arcs=arcs,
            relative_rules_extruder=True,
            divides_extruder=True,
            bare_set_position=True,
            restores=True,
        )
    if isinstance(firmware, Marlin):
        return Rules(
            harmless=_EVERYWHERE | _MARLIN,
            folds_case=firmware.case_insensitive,
            ignores_subcodes=True,
            inches=firmware.inch_mode,
            arcs=arcs,
            positioning_sets_extruder=True,
            skips_low_feed=True,
            longest=firmware.max_cmd_size - 1,
        )
    assert isinstance(firmware, RepRapFirmware)
    return Rules(
        harmless=_EVERYWHERE | _REPRAPFIRMWARE,
        inches=True,
        arcs=arcs,
        stacks=True,
        checks_sums=True,
        exponents=True,
        several=True,
        relative_e=float("nan"),
    )
