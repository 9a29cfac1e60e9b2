"""What a file feeds stays the same from line to line, whatever it counts E from, and how."""

from __future__ import annotations

import math
import tempfile
from itertools import product
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.compensating import compensated
from tests.fuzz.machines import machine_of
from tests.gcode.plain_reader import is_motion, read
from tests.gcode.states import differences, tagged

KINDS = ("klipper", "marlin", "reprapfirmware")
FILAMENT_MM = 1e-4
SAID = ["M82", "M82", "M83", "M83", "G90", "G91", "G92", "T0", "T1", "M400", "G10", "G11"]
SAID += ["M221 S95", "M221 S100", "M220 S80", "M220 S100", "M204 P800 T900", "M106 S99", "G92 E0"]
STEPS = st.one_of(
    st.tuples(
        st.just("go"),
        st.sampled_from([0.05, 0.1, 0.2, 1.5]),
        st.sampled_from([0.3, 1.0, 2.0, 10.0]),
        st.sampled_from([0.05, 0.05, 0.3333337, 0.0, -0.02]),
    ),
    st.tuples(st.just("feed"), st.sampled_from([-1.0, 1.0, 2.5, -0.3333337])),
    st.tuples(st.just("set"), st.sampled_from(["0", "5", "-3", "12.5", "150.123457", ".001"])),
    st.tuples(st.just("say"), st.sampled_from(SAID)),
)
NO_NUMBER, INCHES = "no number, which only Marlin takes", "inches, which Klipper refuses"
CASES = {
    "E absolute much later": "G92 E0\nG1 X60 E2.2\nG1 Y60 E1.7\nM400\nM82\nG1 X90 E5",
    "E absolute for a while": (
        "G92 E0\nG1 X60 E2.2\nM82\nG1 Y60 E3\nG1 E2\nG1 X20\nG1 E3\nM83\nG1 X60\nM400\nG1 X65"
    ),
    "far from 0 and retracted": (
        "G92 E15\nG1 E-2\nG1 X60 E2.2\nG1 Y60 E1.7\nM400\nM82\nG1 X90 E20"
    ),
    "far from 0 and retracted by the firmware": (
        "G92 E15\nM82\nG10\nG1 X60 E17.2\nG11\nG1 Y60 E19\nM400\nG1 X90 E20"
    ),
    "twice the same word": "G92 E4 E5\nG1 X60 E2.2\nM82\nG1 E6\nG1 Y60 E8\nM400\nG1 X90 E9",
    "twice the same word, far from 0": (
        "M82\nG92 E15\nG1 X60 E16\nG1 E13 E14\nG1 Y60 E16\nM400\nG1 X90 E17"
    ),
    "an exponent": "G92 E1e1\nG1 X60 E2.2\nM82\nG1 E6\nG1 Y60 E8\nM400\nG1 X90 E9",
    NO_NUMBER: "G92 E.\nG1 X60 E2.2\nM82\nG1 E6\nG1 Y60 E8\nM400\nG1 X90 E9",
    INCHES: "G20\nG1 E-.04\nG92 E1\nG21\nM82\nG1 X60 E27\nG1 E26 F900\nG1 Y60 E28\nM400\nG1 X9 E29",
    "cubic millimetres": (
        "M200 D1.75\nG92 E30\nG1 E-1\nM200 D0\nG1 X60 E2\nM82\nG1 E10\nM400\nG1 X90 E11"
    ),
    "leading zeros": "G092 E5\nG1 X60 E2.2\nM082\nG1 E6\nG1 Y60 E8\nM400\nG1 X90 E9",
    "a new origin after G10": (
        "M82\nG92 E0\nG1 E-5\nG1 X90.3 Y90.015 E-4.9\nG1 E-5.9\nG10\nG92 E0\n"
        "G1 X90.598 Y90.045 E.015"
    ),
    "E relative and scaled, then absolute": (
        "M221 S80\nM83\nG1 X60 E1\nG1 E1\nG1 Y60 E.5\nM82\nG1 X90 E0 F3000\nG1 Y80 E3\n"
        "M400\nG1 Y60 E4"
    ),
    "a climb behind a hop of the firmware": (
        "G1 Z.6\nM207 S1 F2400 Z.3\nG10\nG1 X60 Z.65 F1200\nG1 Y60 Z.6\nG11\nG1 X90 E2"
    ),
    "a climb that begins behind a hop of the firmware": (
        "G1 Z.6\nM207 S1 F2400 Z.3\nM400\nG10\nG1 X60 Z.65 F1200\nG1 Y60 Z.6\nG11\nG1 X90 E2"
    ),
    "M220 is not for the extruder alone": "M220 S80\nG1 X60 E2.2\nG1 E-1\nG1 Y60 E1\nG1 E1\nM400",
}
START = "G28\nG90\nM83\nG1 X60 Y60 F6000\nG1 X90 E2.3\nG1 Y90 E2.1\n"


REFUSED = {(kind, NO_NUMBER) for kind in KINDS if kind != "marlin"} | {("klipper", INCHES)}


@pytest.mark.parametrize(
    ("kind", "name"), [case for case in product(KINDS, CASES) if case not in REFUSED]
)
def test_the_printer_feeds_what_the_file_feeds(kind: str, name: str, cache: Path) -> None:
    check(START + CASES[name] + "\n", kind, cache, reverts=False)


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=15)
@given(steps=st.lists(STEPS, min_size=10, max_size=60))
def test_filament_of_any_print(kind: str, cache: Path, steps: list[tuple]) -> None:
    text = Print(kind).text(steps)
    written = check(text, kind, cache)
    before, after = (read(data, kind).extruded_mm for data in (text.encode(), written))
    for tool in {*before, *after}:
        assert after[tool] == pytest.approx(before[tool], abs=FILAMENT_MM)


@pytest.mark.parametrize("change", ["M221 S80", "G92 E40", "G10\nG11", "G1 E2e0 F900\nG1E1.7"])
def test_absolute_e_of_reprapfirmware(change: str, cache: Path) -> None:
    """Most of its versions go on from the last absolute E, whatever a stream has fed since."""
    e = 40.0 if "G92" in change else 1.7
    text = START.replace("M83", "M82\nG92 E0").replace("E2.1", "E3.1")
    text += f"G1 E1.7 F2100\nG1 Z.6\n{change}\nG1 X60 F6000\nG1 E{e + 1.4} F2100\nG1 Y60 E{e + 3}\n"
    text += f"M400\nG1 X90 E{e + 4}\nG1 E{e + 3} F2100\nM83\nG1 Y90 E1\nM400\nG1 E-1\n"
    written = check(text, "reprapfirmware", cache, reverts=False)
    assert b"M83" in written
    for how in (False, True):
        before, after = (
            read(data, "reprapfirmware", relative_moves_count=how).extruded_mm[0]
            for data in (text.encode(), written)
        )
        assert after == pytest.approx(before, abs=FILAMENT_MM)


@pytest.mark.parametrize(
    "between", ["", "M82", "M400", "G4 P20", "M486 S1", "G92 E3.4\nM82", "G10\nG11"]
)
def test_a_pause_of_reprapfirmware_finds_e_as_it_was(between: str, cache: Path) -> None:
    """It reads moves again that waited, but not the M82 or M83 before them."""
    text = START.replace("M83", "M82\nG92 E0").replace("E2.1", "E4.4")
    text += f"G1 E3.4 F2100\nG1 Z.6\n{between}\nG1 X60 F6000\n{between}\nG1 Z.3\nG1 E4.4 F2100\n"
    text += f"G1 Y60 E6.5\nG1 Z.4\n{between}\nG1 X90 E8.6\n{between}\nG1 Y90 E10.7\nG1 E9 F900\n"
    written = check(text, "reprapfirmware", cache, reverts=False)
    assert written.count(b"stream on") >= 2
    mode, waits = b"M82", False
    for line in written.splitlines():
        code = line.split(b";")[0].strip()
        if code in (b"M82", b"M83"):
            assert code == mode or not waits, line
            mode = code
        elif code.startswith((b"G4", b"M400", b"M572", b"M593")):
            waits = False
        elif is_motion(code):
            waits = True


@pytest.mark.parametrize("decimals", [5, 7])
def test_retractions_far_from_zero_do_not_drift(decimals: int, cache: Path) -> None:
    """What Marlin's E is set back to has the digits of the file."""
    e, lines = 20.0, ["G28", "G90", "M82", "G92 E20", "G1 X60 Y60 Z5 F6000"]
    for k in range(150):
        e += 0.123456789 + 0.01 * math.sin(k)
        feeds = [f"G1 X{60 + 5 * (k % 2)} E{e:.{decimals}f} F9000"]
        feeds += [f"G1 E{value:.{decimals}f} F2100" for value in (e - 0.5, e)]
        lines += [*feeds, "M400"] if k % 30 == 7 else feeds
    text = "\n".join(lines) + "\n"
    before, after = (
        read(d, "marlin").extruded_mm[0] for d in (text.encode(), check(text, "marlin", cache))
    )
    # Roundings of single segments remain, and add up by chance: 40 nm is usual, 66 nm occurs.
    assert after == pytest.approx(before, abs=FILAMENT_MM)


@pytest.mark.parametrize("kind", ["marlin", "reprapfirmware"])
def test_a_climb_behind_a_hop_in_what_is_left_out(kind: str, cache: Path) -> None:
    text = START + "G1 Z.6\n;TYPE:Internal infill\nM207 S1 F2400 Z.3\nG1 X30 E2\n"
    text += ";TYPE:External perimeter\nG10\nG1 X60 Z.65 F1200\nG1 Y60 Z.6 E2\nG11\nG1 X90 E2\n"
    check(text, kind, cache, reverts=False, where="walls")


def check(text: str, kind: str, cache: Path, *, reverts: bool = True, **options: object) -> bytes:
    """Every line finds the filament, place and modes of the original."""
    data, machine = tagged(text.encode()), machine_of(kind)
    with tempfile.TemporaryDirectory() as folder:
        result, written = compensated(data, Path(folder), cache, machine, **options)
    assert reverts or all("motor steps" in part.reason for part in result.put_back)
    assert differences(data, written, machine) == []
    return written


class Print:
    """Writes E as the firmware counts it."""

    def __init__(self, kind: str) -> None:
        self._kind = kind
        self._place = [60.0, 60.0]
        self._heading = self._e = 0.0
        self._absolute_xyz = self._absolute_e = True

    def text(self, steps: list[tuple]) -> str:
        lines = ["G28", "G90", "M82", "G92 E0", "G1 X60 Y60 Z5 F3000"]
        return (
            "\n".join([*lines, *(getattr(self, f"_{name}")(*how) for name, *how in steps)]) + "\n"
        )

    def _go(self, turn: float, length: float, fed: float) -> str:
        self._heading += turn
        way = length * math.cos(self._heading), length * math.sin(self._heading)
        self._place = [a + b for a, b in zip(self._place, way, strict=True)]
        x, y = self._place if self._absolute_xyz else way
        return f"G1 X{x:.3f} Y{y:.3f}" + self._word(length * fed)

    def _feed(self, by: float) -> str:
        return "G1" + self._word(by)

    def _set(self, value: str) -> str:
        self._e = float(value)
        return f"G92 E{value}"

    def _say(self, line: str) -> str:
        if line in ("G90", "G91"):
            self._absolute_xyz = line == "G90"
            if self._kind == "marlin":
                self._absolute_e = self._absolute_xyz
        elif line in ("M82", "M83"):
            self._absolute_e = line == "M82"
        elif line == "G92" and self._kind == "klipper":
            self._place, self._e = [0.0, 0.0], 0.0
        elif line == "G92 E0":
            self._e = 0.0
        return line

    def _word(self, by: float) -> str:
        if by == 0.0:
            return ""
        self._e += by
        relative = not self._absolute_e or (self._kind == "klipper" and not self._absolute_xyz)
        return f" E{by if relative else self._e:.7f}"
