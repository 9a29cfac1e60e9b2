"""RepRapFirmware keeps one pressure advance for each extruder; streams have it off and on again."""

from __future__ import annotations

import re
from pathlib import Path

from tests.compensating import compensated
from tests.fuzz.machines import machine_of

_SETS = re.compile(r"M572(?: D([\d:]+))? S([\d.]+)$")
_SQUARE = "G1 X110 Y100 E.4\nG1 X110 Y110 E.4\nG1 X100 Y110 E.4\nG1 X100 Y100 E.4\n"
_PRINT = (
    "G28\nG90\nM83\nT0\nM572 S0.02\nG1 X100 Y100 Z.3 F6000\n"
    + _SQUARE
    + "T1\nG1 X100 Y100 Z.3\n"
    + _SQUARE
    + "T0\nT1\nM572 D0:1 S0.05\n"
    + _SQUARE
    + "M572 D0 S0.07\n"
    + _SQUARE
    + "T0\nG1 X100 Y100 Z.3\n"
    + _SQUARE
    + "T1\nM572 S0.01\nG1 X100 Y100 Z.3\n"
    + _SQUARE
    + "T2\n"
)


def advances(text: str, default_s: float) -> list[dict[int, float]]:
    """Return the advance of tools 0 to 2 before each tool change [s]."""
    tool, values, found = 0, dict.fromkeys(range(3), default_s), []
    for line in text.splitlines():
        if re.fullmatch(r"T\d", line):
            found.append(dict(values))
            tool = int(line[1:])
        elif (match := _SETS.match(line)) is not None:
            for extruder in (match[1] or str(tool)).split(":"):
                values[int(extruder)] = float(match[2])
    return found


def test_each_tool_keeps_its_own(tmp_path: Path, cache: Path) -> None:
    machine = machine_of("reprapfirmware")
    result, text = compensated(_PRINT, tmp_path, cache, machine, method="shaper:mzv")
    assert result.pieces - len(result.put_back) >= 5
    written = text.decode()
    assert "M572 S0\n" in written
    wanted = advances(_PRINT, machine.pressure_advance_s)
    assert len(wanted) == 7
    assert advances(written, machine.pressure_advance_s) == wanted
