"""Files that set the firmware's own shaper: it never works on top of compensation in silence."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from stillpath.gcode.errors import GcodeError
from stillpath.models.errors import ModelError
from stillpath.models.machine import Machine
from stillpath.models.store import load_machine
from stillpath.pipeline.result import Result
from tests.compensating import compensated
from tests.gcode.prints import polygon

EXAMPLES = Path(__file__).parents[2] / "examples" / "firmware"
HEAD = "G28\nG90\nM83\nG1 X50 Y50 Z5 F6000\n"
PART = "\n".join(polygon(6, 15)) + "\n"
BEHIND = "G1 E-1 F2100\nG28 X\nG1 X60 Y60 F6000\n"

pytestmark = pytest.mark.slow

# A line that sets the firmware's shaper, and what leaves it on and off.
SETS = {
    "klipper": "SET_INPUT_SHAPER SHAPER_FREQ_X=45 SHAPER_FREQ_Y=40 SHAPER_TYPE=ei",
    "marlin": "M593 F42 D0.1",
    "reprapfirmware": 'M593 P"zvd" F42',
}
ON = {
    "klipper": re.compile(r"SET_INPUT_SHAPER .*FREQ_X=(?!0\b)"),
    "marlin": re.compile(r"M593 .*F(?!0\b)"),
    "reprapfirmware": re.compile(r'M593 P"zvd"'),
}
OFF = {
    "klipper": re.compile(r"SET_INPUT_SHAPER SHAPER_FREQ_X=0 SHAPER_FREQ_Y=0( SMOO|$)"),
    "marlin": re.compile(r"M593 F0$"),
    "reprapfirmware": re.compile(r'M593 P"none"$'),
}


def machine_with(kind: str, **firmware: object) -> Machine:
    document = load_machine("ender3").model_dump(mode="json")
    if kind == "klipper":
        return Machine.model_validate(document)
    section = json.loads((EXAMPLES / f"{kind}.json").read_text()) | firmware
    return Machine.model_validate(document | {"firmware": section})


def by_zpetc(text: str, machine: Machine, folder: Path, cache: Path) -> tuple[Result, list[str]]:
    result, written = compensated(text, folder, cache, machine, method="zpetc")
    return result, written.decode().splitlines()


def moves_by_shaper(lines: list[str], kind: str) -> tuple[set[tuple[str, str]], str]:
    """Return under which shaper moves of a stream, and of the file, are made; and the last one."""
    shaper, place = "untouched", "file"
    found = set()
    for line in lines:
        if ON[kind].match(line):
            shaper = "on"
        elif OFF[kind].match(line):
            shaper = "off"
        elif line.startswith("; stillpath: stream "):
            place = "stream" if line.endswith("on") else "file"
        elif re.match(r"G1 .*X", line):
            found.add((place, shaper))
    return found, shaper


@pytest.mark.parametrize("kind", SETS)
@pytest.mark.parametrize("place", ["start code", "in the middle"])
def test_it_is_off_in_stretches_and_on_around_them(
    kind: str, place: str, tmp_path: Path, cache: Path
):
    text = (
        f"{SETS[kind]}\n{HEAD}{PART}{BEHIND}"
        if place == "start code"
        else f"{HEAD}{PART}{SETS[kind]} ; mine\n{PART}{BEHIND}"
    )
    result, lines = by_zpetc(text, machine_with(kind), tmp_path, cache)
    assert result.put_back == []
    under, last = moves_by_shaper(lines, kind)
    assert ("stream", "on") not in under
    assert ("stream", "off") in under
    assert last == "on"
    number = next(n for n, line in enumerate(text.splitlines(), 1) if line.startswith(SETS[kind]))
    [warning] = [line for line in result.warnings if "sets the firmware's input shaper" in line]
    assert f"{SETS[kind].split()[0]} (line {number})" in warning
    assert "off, around them as the file sets it" in warning


def test_a_machine_that_states_no_shaper_and_a_file_that_sets_one(tmp_path: Path, cache: Path):
    """Marlin: without one in the document none is switched off, but for the file's own."""
    off = {"freq_x_hz": 0.0, "freq_y_hz": 0.0}
    machine = machine_with("marlin", shaper=off)
    _, lines = by_zpetc(f"{SETS['marlin']}\n{HEAD}{PART}{BEHIND}", machine, tmp_path, cache)
    under, last = moves_by_shaper(lines, "marlin")
    assert ("stream", "on") not in under
    assert last == "on"
    _, lines = by_zpetc(f"{HEAD}{PART}{BEHIND}", machine, tmp_path, cache)
    assert not [line for line in lines if line.startswith("M593")]


@pytest.mark.parametrize(
    ("kind", "line", "whose"),
    [
        ("klipper", "SET_INPUT_SHAPER SHAPER_FREQ_X=45 ; SHAPER_FREQ_Y=40", " of Y"),
        ("klipper", "set_input_shaper shaper_freq_y=45", " of X"),
        ("klipper", "SET_INPUT_SHAPER SHAPER_TYPE=ei", ""),
        ("klipper", SETS["klipper"], None),
        ("marlin", "M593 X F42", " of Y"),
        ("marlin", "M593 Z F42", ""),
    ],
)
def test_an_axis_whose_shaper_nobody_states_is_told(
    kind: str, line: str, whose: str | None, tmp_path: Path, cache: Path
):
    """What a stream switched off there cannot be set again: only the printer knows what it was."""
    machine = machine_with(kind, shaper=None)
    result, lines = by_zpetc(f"{line}\n{HEAD}{PART}{BEHIND}", machine, tmp_path, cache)
    assert lines.count(line) > 1
    told = [w.split(" is not known")[0] for w in result.warnings if "is not known (firm" in w]
    assert told == ([] if whose is None else [f"The firmware's own input shaper{whose}"])


def test_without_one_nothing_is_said(tmp_path: Path, cache: Path):
    text = f"M572 S0.04\n{HEAD}{PART}{BEHIND}"
    for kind in SETS:
        result, _ = by_zpetc(text, machine_with(kind), tmp_path, cache)
        assert not [line for line in result.warnings if "sets the firmware's" in line]


@pytest.mark.parametrize("line", ["M493 S1 X C1 A45", "M493S2 ; S0", "M493 S1 X1 Y1 A37 B37"])
def test_fixed_time_motion_is_refused_with_line_and_remedy(line: str, tmp_path: Path, cache: Path):
    with pytest.raises(GcodeError, match=r"line 2: M493 .* on top of .*; take it out"):
        by_zpetc(f"G28\n{line}\n{PART}", machine_with("marlin"), tmp_path, cache)
    assert [path.name for path in tmp_path.iterdir()] == ["in.gcode"]


def test_ankermakes_own_limits_are_refused(tmp_path: Path, cache: Path):
    """AnkerMake's slicer sets them in its start code, and streams would come late."""
    with pytest.raises(GcodeError, match=r"line 2: M4899 .* as sliced"):
        by_zpetc(
            f"G28\nM4899 T3 ; v3 jerk and S-curve\n{PART}", machine_with("marlin"), tmp_path, cache
        )
    by_zpetc(f"M4899\n{HEAD}{PART}{BEHIND}", machine_with("marlin"), tmp_path, cache)


def test_fixed_time_motion_that_is_off_or_that_the_machine_has(tmp_path: Path, cache: Path):
    for line in ("M493 S0", "M493", "M493 V", "M495 X F20", "M496"):
        by_zpetc(f"{line}\n{HEAD}{PART}{BEHIND}", machine_with("marlin"), tmp_path, cache)
    with pytest.raises(ModelError, match="fixed-time motion"):
        by_zpetc(HEAD + PART, machine_with("marlin", ft_motion=True), tmp_path, cache)


@pytest.mark.parametrize("kind", sorted(SETS))
@pytest.mark.parametrize(
    ("settings", "kept"),
    [
        ("1 20;1 25;1 30;1 35;1 40", 2),
        ("1 20;2 25;3 30;4 35;5 40;1 20", 0),  # tools with shapers of their own
        ("1 20;1 25;1 20;1 30;1 35;1 40", 0),  # one that comes back
    ],
)
def test_a_test_of_the_firmwares_shaper_shows_the_shaper(
    tmp_path: Path, cache: Path, kind: str, settings: str, kept: int
) -> None:
    """OrcaSlicer's towers change its frequency at every layer; a stream has it off."""
    text, last = HEAD, ""
    for tool, hz in (setting.split() for setting in settings.split(";")):
        changed = f"T{tool}\n" if tool != last else ""
        text += changed + re.sub(r"(?<=[XYF])(=?)4[250]", rf"\g<1>{hz}", SETS[kind]) + "\n"
        text, last = text + "G28 X\nG1 X50 Y50 F6000\n" + PART + "G1 E-1 F2100\nG1 E1\n", tool
    result, lines = by_zpetc(text, machine_with(kind), tmp_path, cache)
    sliced = [piece for piece in result.put_back if "one setting of" in piece.reason]
    assert len(sliced) == len(result.put_back)
    assert len(sliced) == kept
    assert any("; stillpath: stream on" in line for line in lines)
