"""Firmwares keep an advance for each extruder; streams have it off and on again."""

from __future__ import annotations

import re
from pathlib import Path

from stillpath.models.machine import Machine
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


def marlin(variant: str) -> Machine:
    """Return a Marlin machine with linear advance, K0.03 at power-on."""
    document = machine_of("marlin").model_dump(mode="json")
    more = {"variant": variant, "linear_advance": True, "linear_advance_k_s": 0.03}
    document["firmware"] |= more
    return Machine.model_validate(document)


def moved(text: str) -> list[list[str]]:
    """Return each tool's lines, one list for every T."""
    parts = re.split(r"(?m)^(?=T\d$)", text)
    return [part.splitlines() for part in parts[1:]]


_TOOLS = (
    "G28\nG90\nM83\nG1 Z.3 F600\nT0\nM900 K0.05\nG1 X100 Y100 F6000\n"
    + _SQUARE
    + "T1\nM900 K0.1\nG1 X100 Y100 Z.3\n"
    + _SQUARE
    + "T0\nG1 X100 Y100 Z.3\n"
    + _SQUARE
)


def advances_set(lines: list[str]) -> list[str]:
    return [line for line in lines if line.startswith("M900")]


def test_marlin_goes_back_to_the_advance_of_the_tool(tmp_path: Path, cache: Path) -> None:
    _, text = compensated(_TOOLS, tmp_path, cache, marlin("2.0"), method="shaper:mzv")
    *_, last = moved(text.decode())
    assert advances_set(last) == ["M900 K0", "M900 K0.05"]


def test_where_tools_may_share_the_advance_moves_wait_for_it(tmp_path: Path, cache: Path) -> None:
    result, text = compensated(_TOOLS, tmp_path, cache, marlin("2.1"), method="shaper:mzv")
    _, second, third = moved(text.decode())
    assert advances_set(second) == ["M900 K0.1", "M900 K0", "M900 K0.1"]
    assert third[:6] == ["T0", "G1 X100 Y100 Z.3", *_SQUARE.splitlines()]
    assert any("M900 K" in warning for warning in result.warnings)
    stated = _TOOLS + "M900 K0.05\n" + _SQUARE
    _, text = compensated(stated, tmp_path, cache, marlin("2.1"), method="shaper:mzv")
    assert advances_set(moved(text.decode())[-1]) == ["M900 K0.05", "M900 K0", "M900 K0.05"]


def test_an_advance_that_is_set_by_tool_is_kept_by_tool(tmp_path: Path, cache: Path) -> None:
    stated = "M900 T1 K0.2\n" + _TOOLS.replace("M900 K0.1\n", "")
    result, text = compensated(stated, tmp_path, cache, marlin("2.1"), method="shaper:mzv")
    assert result.pieces == 3
    written = [advances_set(lines) for lines in moved(text.decode())]
    assert written[1:] == [["M900 K0", "M900 K0.2"], ["M900 K0", "M900 K0.05"]]
    # The firmware stands still where it sets it, so it does not stand in a stream.
    inside = _TOOLS.replace(_SQUARE, _SQUARE + "M900 T1 K0.07\n" + _SQUARE, 1)
    _, text = compensated(inside, tmp_path, cache, marlin("2.1"), method="shaper:mzv")
    first = moved(text.decode())[0]
    assert "M900 K0.05" in first[: first.index("M900 T1 K0.07")][-4:]


def test_settings_read_again_are_those_of_all_tools(tmp_path: Path, cache: Path) -> None:
    text = _TOOLS.replace("T0\nG1 X100", "M501\nG28\nT0\nG1 X100")
    _, written = compensated(text, tmp_path, cache, marlin("2.1"), method="shaper:mzv")
    assert advances_set(moved(written.decode())[-1]) == ["M900 K0", "M900 K0.03"]


def test_several_heads_are_told(tmp_path: Path, cache: Path) -> None:
    """All are compensated with the model of one."""

    def told(text: str) -> bool:
        result, _ = compensated(text, tmp_path, cache, method="shaper:mzv")
        return any("Tools 0, 1 print" in warning for warning in result.warnings)

    both = _TOOLS.replace("M900", ";")
    assert told(both)
    assert not told(both + "; single_extruder_multi_material = 1\n")
    assert not told(
        both.replace("T1\n", ";STILLPATH_OFF\nT1\n").replace("T0\n", ";STILLPATH_ON\nT0\n")
    )


def test_an_advance_that_neither_machine_nor_file_states_is_told(
    tmp_path: Path, cache: Path
) -> None:
    """A stream switches off what config.g has set, and nothing sets it again."""

    def told(text: str, kind: str = "reprapfirmware", advance_s: float = 0.0) -> bool:
        machine = machine_of(kind).model_copy(update={"pressure_advance_s": advance_s})
        result, _ = compensated(text, tmp_path, cache, machine, method="shaper:mzv")
        return any("pressure_advance_s" in warning for warning in result.warnings)

    silent = _PRINT.replace("M572", ";")
    assert told(silent)
    assert told(silent + "M572\n")
    assert not told(silent.replace("T0\n", "T0\nM572 D0 S0\n", 1))
    assert not told(silent, advance_s=0.03)
    assert not told(silent, kind="klipper")
