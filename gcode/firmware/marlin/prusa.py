"""Commands of Prusa's Buddy firmware (MINI, MK4, XL, CORE One) where they differ from Marlin's.

Source: Prusa-Firmware-Buddy 6.x (2025), lib/Marlin/Marlin/src/gcode/gcode.cpp and
src/marlin_stubs/gcode.cpp: which words there are; the files of T, P0, M74, M572, M593, M862.6 and
M9140: what they do.
"""

from __future__ import annotations

from stillpath.gcode.dialect import Word, words
from stillpath.gcode.firmware.marlin import commands
from stillpath.gcode.types import EventKind

__all__ = ["PRUSA"]

PRUSA: dict[str, Word] = {
    # Print area, tool mapping, bedlets, filament, sensors, displays.
    **words(
        "M46 M123 M142 M147 M148 M150 M151 M170 M171 M262 M263 M264 M265 M267 M268 M330 M331 M332 "
        "M333 M334 M505 M552 M555 M556 M557 M591 M596 M650 M862.1 M862.2 M862.3 M862.4 M862.5 "
        "M862.6 M863 M864 M865 M914",
        EventKind.HARMLESS,
    ),
    # What this firmware lacks, and passes over.
    **words(
        "G5 G10 G11 G17 G18 G19 G20 G53 G54 G55 G56 G57 G58 G59 G59.1 G59.2 G59.3 G60 G61 M207 "
        "M208 M209",
        EventKind.HARMLESS,
    ),
    # Pressure advance waits for standstill when it changes.
    **words("M572 M900", EventKind.STOP),
    # The mass on the bed moves the shaper's frequency.
    **words("M74 M593", EventKind.SHAPER),
    # Parking of tools, loading, calibrations, tests, settings from the drive.
    **words("P P0", commands.park_tool),
    **words(
        "G12 G64 G65 G80 G81 G123 G124 G162 G163 G425 G426 G427 M45 M50 M340 M601 M602 M603 M604 "
        "M701 M702 M703 M704 M705 M706 M707 M708 M709 M919 M920 M930 M931 M932 M958 M959 M960 M970 "
        "M971 M972 M973 M974 M975 M976 M977 M1200 M1400 M1587 M1600 M1601 M1700 M1701 M1702 M1703 "
        "M1704 M1959 M1977 M1978 M1980 M9200 M9201 M9202",
        EventKind.UNKNOWN,
    ),
    **words(
        "M9140 M9150",
        commands.not_modelled(
            EventKind.UNKNOWN,
            "stealth mode has its own limits; those of the machine are used all the same",
        ),
    ),
}
