"""Commands of Bambu's firmware where they differ from Marlin's.

The firmware is closed. What its words do is told by the comments in the G-code that BambuStudio 2.3
writes; a word that nobody explains is a barrier.
"""

from __future__ import annotations

from stillpath.gcode.dialect import Word, words
from stillpath.gcode.firmware.marlin import commands
from stillpath.gcode.types import EventKind

__all__ = ["BAMBU"]

_CONDITIONAL = commands.not_modelled(
    EventKind.UNKNOWN,
    "the printer may skip what follows up to the closing word; its place is not known",
    origin=False,
)

BAMBU: dict[str, Word] = {
    # Cameras, sensors, chamber, claims of what the printer is doing.
    **words(
        "G392 M73.2 M104.1 M141 M142 M145 M211 M302 M412 M622.1 M960 M963 M964 M969 "
        "M971 M972 M973 M981 M991 M1002 M1003 M1004 M1007 M1008 M1010 M1015 M1019 M1020 M1021",
        EventKind.HARMLESS,
    ),
    # Pressure advance: Marlin waits for standstill when it changes.
    "M900": EventKind.STOP,
    # A factor of all accelerations.
    "M204.2": commands.not_modelled(EventKind.UNKNOWN, "the factor of accelerations is taken as 1"),
    **words("M974 M975", EventKind.SHAPER),
    **words("M624 M625", EventKind.OBJECT),
    # Conditional blocks and changes of filament.
    **words("M620 M620.1 M620.3 M620.10 M620.11 M620.15 M621 M622 M623 M628 M629", _CONDITIONAL),
    # Calibrations, parking, shaking.
    **words(
        "G29.1 G29.2 G29.3 G29.4 G29.5 G29.8 G39 G39.1 G39.3 G39.4 G150 G150.1 G150.2 G150.3 G383 "
        "M970 M970.2 M970.3 M982 M982.2 M983 M983.1 M983.3 M983.4 M984 M985",
        EventKind.UNKNOWN,
    ),
}
