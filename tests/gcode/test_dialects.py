"""What each firmware makes of the same text: cases worked out by hand from the firmwares' sources.

The sources are named in docs/dialects.md and at the head of the modules under test.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from stillpath.gcode.errors import GcodeError
from stillpath.gcode.interpreter import Interpreter
from stillpath.gcode.types import KEPT, EventKind, ProgramBlock
from stillpath.models.firmware import FirmwareFacts, Klipper, Marlin, RepRapFirmware
from stillpath.models.firmware.klipper import PlannerLimits
from stillpath.models.machine import Machine

HOMED = {"homed_at_start": True, "home_mm": (0.0, 0.0, 0.0)}
BUILD = {
    **dict.fromkeys(
        (
            *("inch_mode", "cnc_planes", "cnc_workspaces", "bezier_curves", "saved_positions"),
            "arc_circles",
        ),
        True,
    ),
    **HOMED,
}
FIRMWARES: dict[str, FirmwareFacts] = {
    "klipper": Klipper(**HOMED),
    "marlin": Marlin(**BUILD),
    "marlin-2.0": Marlin(**BUILD, variant="2.0"),
    "marlin-stock": Marlin(**HOMED),
    "marlin-loose": Marlin(
        **BUILD, motion_modes=True, case_insensitive=True, paren_comments=True, max_cmd_size=128
    ),
    "prusa": Marlin(**BUILD, variant="prusa"),
    "bambu": Marlin(**BUILD, variant="bambu"),
    "reprapfirmware": RepRapFirmware(**HOMED),
}
FAMILY = ("marlin", "marlin-2.0", "prusa", "bambu")
LARGE = ("marlin", "marlin-2.0", "bambu")  # with all options built in


@pytest.fixture
def read(golden_machine: Machine):
    def reader(text: str, name: str, **facts: object) -> tuple[ProgramBlock, Interpreter]:
        firmware = FIRMWARES[name].model_copy(update=facts)
        machine = golden_machine.model_copy(update={"firmware": firmware})
        interpreter = Interpreter(machine, strict_bounds=False)
        blocks = [*interpreter.push(text.encode()), *interpreter.flush()]
        assert len(blocks) == 1
        return blocks[0], interpreter

    return reader


def same(names: tuple[str, ...], *row: float) -> dict[str, tuple[float, ...]]:
    return dict.fromkeys(names, row)


ALL = ("klipper", *FAMILY, "reprapfirmware")
CASES = {
    # text: where the machine is afterwards (x y z e), per firmware
    "exponents": (
        "M83\nG1 X1e-1 F600\n",
        {"klipper": (1, 0, 0, -1), **same(FAMILY, 1, 0, 0, 0), "reprapfirmware": (0.1, 0, 0, 0)},
    ),
    "G90 after M83": (
        "M83\nG90\nG1 X1 E1 F600\nG1 X2 E1\n",
        {**same(("klipper", "reprapfirmware"), 2, 0, 0, 2), **same(FAMILY, 2, 0, 0, 1)},
    ),
    "G91 after M82": (
        "M82\nG91\nG1 X1 E1 F600\nG1 X1 E1\n",
        {**same(("klipper", *FAMILY), 2, 0, 0, 2), "reprapfirmware": (2, 0, 0, 1)},
    ),
    "M82 after G91": (
        "G91\nM82\nG1 X1 E1 F600\nG1 X1 E1\n",
        {"klipper": (2, 0, 0, 2), **same((*FAMILY, "reprapfirmware"), 2, 0, 0, 1)},
    ),
    "bare G92": (
        "G1 X5 F600\nG92\nG1 X1\n",
        {"klipper": (6, 0, 0, 0), **same((*FAMILY, "reprapfirmware"), 1, 0, 0, 0)},
    ),
    "G92 moves the origin, or the machine": (
        "G1 X5 F600\nG92 X0\nG1 X1\n",
        {**same(("klipper", *FAMILY), 6, 0, 0, 0), "reprapfirmware": (1, 0, 0, 0)},
    ),
    "repeated words": (
        "G1 X5 X6 F600\n",
        {**same(("klipper", *FAMILY), 6, 0, 0, 0), "reprapfirmware": (5, 0, 0, 0)},
    ),
    "two commands on a line": (
        "G91 G1 X5 F600\nG1 X1\n",
        {
            # Klipper and Marlin read G91 with odd words.
            **same(("klipper", *FAMILY), 1, 0, 0, 0),
            "reprapfirmware": (6, 0, 0, 0),
        },
    ),
    "lower case": (
        "g1 x5 f600\n",
        {**same(("klipper", "reprapfirmware"), 5, 0, 0, 0), **same(FAMILY, 0, 0, 0, 0)},
    ),
    "lower-case line number": (
        "n5 G1 X5 F600\nn6 M204 P900\nn6 M204 P900\n",
        {
            **same(("klipper", "reprapfirmware", "marlin-loose"), 5, 0, 0, 0),
            **same(FAMILY, 0, 0, 0, 0),
        },
    ),
    "leading zeros": (
        "G01 X5 F600\n",
        {"klipper": (0, 0, 0, 0), **same((*FAMILY, "reprapfirmware"), 5, 0, 0, 0)},
    ),
    "line number and checksum": ("N3 G1 X5 F600*54\nN4;G1 X7\n", same(ALL, 5, 0, 0, 0)),
    "wrong checksum": (
        "N3 G1 X5 F600*1\n",
        {**same(("klipper", *FAMILY), 5, 0, 0, 0), "reprapfirmware": (0, 0, 0, 0)},
    ),
    "inches": (
        "G20\nG1 X1 E1 F60\nG21\nG1 Y1\n",
        {**same((*LARGE, "reprapfirmware"), 25.4, 1, 0, 25.4), **same(("prusa",), 1, 1, 0, 1)},
    ),
    "indentation and comments do not count": (
        " " * 300 + "G1 X5 F600 ;" + "c" * 300 + "\n;" + "c" * 300 + "\n",
        {"reprapfirmware": (5, 0, 0, 0)},
    ),
    "retraction of Simplify3D": (
        "M83\nG1 X1 E1 F600\nM103\nG11\nM103\nM101\n",
        {"reprapfirmware": (1, 0, 0, 1)},
    ),
    "flow": (
        "M83\nM221 S50\nG1 X1 E2 F600\nG1 E2\n",
        {**same(("klipper", *FAMILY), 1, 0, 0, 2), "reprapfirmware": (1, 0, 0, 3)},
    ),
    "flow without a number": (
        "M83\nM221 S50\nM221 X0 Y0 Z0\nG1 X1 E2 F600\n",
        {"klipper": (1, 0, 0, 2), **same((*FAMILY, "reprapfirmware"), 1, 0, 0, 1)},
    ),
    "F0": ("G1 X1 F600\nG1 X2 F0\n", same(FAMILY, 2, 0, 0, 0)),
    "a word without a number": ("G1 X Y5 F600\n", same(FAMILY, 0, 5, 0, 0)),
    "full circle": ("G1 X10 F600\nG2 I-5\n", same(ALL, 10, 0, 0, 0)),
    "helix with turns": ("G17\nG1 X10 F600\nG3 Z4 I-5 J0 P1\n", same(FAMILY, 10, 0, 4, 0)),
    "arc with R": ("G1 X10 F600\nG2 X0 R5\n", same((*FAMILY, "reprapfirmware"), 0, 0, 0, 0)),
    "arc without centre": ("G1 X10 F600\nG2 X0 Y3\nG1 X8\n", same(FAMILY, 8, 0, 0, 0)),
    "curve": ("G5 X10 Y0 I0 J5 P0 Q5 F600\n", same(LARGE, 10, 0, 0, 0)),
    "workspaces": (
        "G54\nG1 X1 F600\nG92 X0\nG1 X1\nG55\nG1 X1\nG54\nG1 X2\nG53 G1 X4\nG1 X5\n",
        same(LARGE, 6, 0, 0, 0),
    ),
    "G53 where G92 has shifted native space": (
        "G1 X5 F600\nG92 X0\nG53 G1 X4\nG1 X5\n",
        same(LARGE, 10, 0, 0, 0),
    ),
    "the workspace in use": ("G10 L2 P0 X10\nG1 X1 F600\n", {"reprapfirmware": (11, 0, 0, 0)}),
    "full circle in a workspace": (
        "G10 L2 P1 X3 Y2\nM83\nG1 X126.194 Y87.576 F600\nG3 X126.194 Y87.576 I.5 E2\n",
        {"reprapfirmware": (129.194, 89.576, 0, 2)},
    ),
    "workspaces of RepRapFirmware": (
        "G10 L2 P2 X10\nG55\nG1 X1 F600\nG53 G1 X3\nG1 X2\n",
        {"reprapfirmware": (12, 0, 0, 0)},
    ),
    "saved place": (
        "G1 X3 Y4 F600\nG60 S1\nG1 X9 Y9\nG61 S1 X Y0.5\n",
        same(LARGE, 3, 4.5, 0, 0),
    ),
    "saved place of RepRapFirmware": (
        "G1 X3 Y4 F600\nG60 S1\nG1 X9 Y9\nG1 R1 X0 Y0.5\n",
        {"reprapfirmware": (3, 4.5, 0, 0)},
    ),
    "homing leaves a workspace's origin": (
        "G10 L2 P1 X10 Z2\nG1 X1 F600\nG28\nG1 X1\nG28 Z\nG1 X2 Z0\n",
        {"reprapfirmware": (12, 0, 2, 0)},
    ),
    "retraction and back": ("M83\nG1 X1 E1 F600\nG10\nG10\nG11\n", same(ALL, 1, 0, 0, 1)),
    "a return that gives back less": (
        "M83\nM207 S2 R-1.5\nG1 X1 E5 F600\nG10\nG11\n",
        {"reprapfirmware": (1, 0, 0, 3.5)},
    ),
    "retraction of each tool": (
        "M83\nT0\nG1 X1 E5 F600\nG10\nT1\nG10\nG11\nG11\n",
        # Klipper's T1 is a macro, and may give back what was retracted.
        same(("klipper", "marlin", "reprapfirmware"), 1, 0, 0, 4.2),
    ),
    "volumetric": (
        f"M83\nM200 D2\nG1 X1 E{math.pi} F600\n",
        same((*FAMILY, "reprapfirmware"), 1, 0, 0, 1),
    ),
    "volumetric whatever the unit": (
        f"M83\nM200 D2\nG20\nG21\nG1 X1 E{math.pi} F600\n",
        same((*FAMILY, "reprapfirmware"), 1, 0, 0, 1),
    ),
    "a line that is too long": (
        "G1 X5 F600" + " " * 90 + "Y7\n",
        {
            **same(("klipper", "bambu", "reprapfirmware"), 5, 7, 0, 0),
            **same(("marlin", "marlin-2.0", "prusa"), 5, 0, 0, 0),
            "marlin-loose": (5, 7, 0, 0),
        },
    ),
    "a build that takes all": (
        "g1 x5 f600 (Y9)\nX6\nG80\nX7\n",
        {"marlin-loose": (6, 0, 0, 0), "marlin": (0, 0, 0, 0)},
    ),
    "blanks and subcodes": ("G  1 X5 F600\nG1.5 X6\n", same(FAMILY, 6, 0, 0, 0)),
    "G10 with a tool": ("G10 P0 S200\nG1 X1 F600\n", {"reprapfirmware": (1, 0, 0, 0)}),
    "modes saved": ("M120\nG91\nM121\nG1 X5 F600\nG1 X6\n", {"reprapfirmware": (6, 0, 0, 0)}),
    "a plane saved": (
        "M120\nG18\nM121\nG1 X10 F600\nG2 Y10 J5\n",
        {"reprapfirmware": (10, 10, 0, 0)},
    ),
    "CNC mode": ("M453\nG1 X5 (out) Y2 F600\nX7\n", {"reprapfirmware": (7, 2, 0, 0)}),
    "a command after quoted text": (
        'M117 "G1 X9" G1 X1 F600\nM117 G1 X9 "G1 X9"\n',
        {"reprapfirmware": (1, 0, 0, 0)},
    ),
    "NUL ends what is read": ("G1 X5\0 Y3 F600\nG1\0\0X7\n\0G1 Z1\n", same(FAMILY, 5, 0, 0, 0)),
    "NUL ends a line": (
        "G1 X5 F600\0 Y3\nG1 X6\0\0G1 Y1\n\0\0\n\0G1 Z1\n",
        {"reprapfirmware": (6, 1, 1, 0)},
    ),
}  # fmt: skip


@pytest.mark.parametrize(
    ("case", "name"), [(case, name) for case, (_, ends) in CASES.items() for name in ends]
)
def test_where_it_ends(case: str, name: str, read) -> None:
    text, ends = CASES[case]
    _, interpreter = read(text, name)
    assert interpreter.position_mm == pytest.approx(ends[name], abs=1e-9)


@pytest.mark.parametrize(
    ("line", "name", "words"),
    [
        ("G1 X F600", "reprapfirmware", "not a number"),
        ("G1 X10 F600\nG2 X0 R4", "reprapfirmware", "too short"),
        ("G2 I5 R0", "reprapfirmware", "where it begins"),
        ("G1 X10 F600\nG2 X5 Y7 I-5", "reprapfirmware", "off its circle"),
        ("G1 X1 F0", "reprapfirmware", "feedrate"),
        ("G1 X5 F600" + " " * 300 + "Y7", "reprapfirmware", "aborts the print"),
        ("EXCLUDE_OBJECT_DEFINE NAME=" + "a" * 300, "reprapfirmware", "aborts the print"),
        ("G1 X10 F600\nG2 I-5 P1", "marlin-2.0", "divides by zero"),
        ("G2 I5 P101", "marlin", "100"),
        ("G60 S6", "reprapfirmware", "line 1: G60 S6 is refused.*places 0 to 5; use one"),
        ("G1 X5 F600\rG1 X9", "marlin", "line 1.* carriage return.*LF"),
        ("G28\nM106 S9\r\nM106 S0\r M82", "marlin", "line 3.* carriage return"),
        ("; fan\rM106 S9", "reprapfirmware", "carriage return"),
    ],
)
def test_lines_that_a_firmware_would_not_execute_are_refused(
    line: str, name: str, words: str, read
) -> None:
    with pytest.raises(GcodeError, match=words):
        read(line + "\n", name)


@pytest.mark.parametrize(("name", "circles"), [("marlin-stock", 1), ("marlin", 2), ("klipper", 1)])
def test_p_of_an_arc_is_for_builds_that_have_it(read, name: str, circles: int) -> None:
    """OrcaSlicer writes G3 with P1 for a lift of one turn, for every firmware."""
    block, _ = read("G1 X10 F600\nG3 Z.4 I-5 J0 P1\n", name)
    way = np.diff(block.moves.end_mm[:, :2], axis=0)
    assert np.hypot(*way.T).sum() == pytest.approx(circles * 10 * math.pi, rel=2e-2)


@pytest.mark.parametrize("line", ["G1 X5 F600\r\r", "\rG1 X5 F600", "G1 X5 F600 ; a\rb"])
def test_carriage_returns_that_end_no_command(line: str, read) -> None:
    for name in ("klipper", "marlin", "reprapfirmware"):
        block, _ = read(line + "\n", name)
        assert len(block.moves) == 1


def test_r_one_per_cent_too_short(read) -> None:
    for name in ("marlin", "reprapfirmware"):
        block, _ = read("G1 X10 F600\nG2 X0 R4.97\n", name)
        # A half circle about the middle: clockwise from +x goes through -y.
        assert block.moves.end_mm[1:, 1].min() == pytest.approx(-5.0, abs=0.02)


@pytest.mark.parametrize(
    ("name", "sign"),
    [("klipper", 1), ("marlin", -1), ("marlin-2.0", -1), ("reprapfirmware", -1)],
)
def test_direction_in_the_zx_plane(name: str, sign: int, read) -> None:
    """Clockwise from +x: Klipper counts from X to Z, everybody else from Z to X."""
    block, _ = read("G18\nG1 X10 F600\nG2 X0 I-5 K0\n", name)
    z = block.moves.end_mm[1:, 2]
    assert np.abs(z).max() == pytest.approx(5.0, abs=0.05)
    assert np.sign(z[len(z) // 2]) == -sign


def test_pieces_of_arcs(read) -> None:
    counts = {}
    for name in ("klipper", "marlin", "marlin-2.0", "reprapfirmware"):
        block, _ = read("G1 X10 F6000\nG2 I-5\n", name)
        counts[name] = len(block.moves) - 1
    # 31.4 mm around: floor of 1 mm; at least 72 in a circle; sqrt(8 * 5 * 0.005) = 0.447 mm.
    assert counts == {"klipper": 31, "marlin": 72, "marlin-2.0": 72, "reprapfirmware": 71}


@pytest.mark.parametrize(("feed", "pieces"), [(6000, 35), (600, 157), (60, 314)])
def test_pieces_of_arcs_of_a_buddy(read, feed: int, pieces: int) -> None:
    """Its own rule: sqrt(8 * 5 * 0.02) = 0.894 mm, at least 50 a second, at least .1 mm.

    They were cut as Marlin cuts them, and a circle of 10 mm was planned a quarter too fast.
    """
    block, _ = read(f"G1 X10 F{feed}\nG2 I-5\n", "prusa")
    assert len(block.moves) - 1 == pieces


def test_marlin_limits_follow_the_file(read) -> None:
    text = "M201 X1000 E5000\nM203 X300\nM204 P1500 T2500\nM205 X8 B0 J0.02\nM204 S700\n"
    block, _ = read(text, "marlin")
    after = block.limits[block.events.limits_id[-1]]
    assert (after.accel_x_mm_s2, after.accel_e_mm_s2, after.feedrate_x_mm_s) == (1000, 5000, 300)
    assert (after.print_accel_mm_s2, after.travel_accel_mm_s2) == (700, 700)
    # Junction deviation is built in, so X is passed over.
    assert (after.min_segment_time_us, after.junction_deviation_mm) == (0, 0.02)
    assert after.jerk_x_mm_s == block.limits[0].jerk_x_mm_s
    block, _ = read("M205 X8 Y7 B0 J0.02\n", "marlin", junction="classic_jerk")
    after = block.limits[block.events.limits_id[-1]]
    assert (after.jerk_x_mm_s, after.jerk_y_mm_s, after.min_segment_time_us) == (8, 7, 0)
    assert after.junction_deviation_mm == block.limits[0].junction_deviation_mm
    block, _ = read("M203 X300 S1\n", "reprapfirmware")
    assert block.limits[block.events.limits_id[-1]].speed_x_mm_s == 300
    block, _ = read("M201 X77\nM900 K0.3\nM501\nG4\n", "marlin")
    assert block.limits[block.events.limits_id[-1]] == block.limits[0]
    assert block.limits[block.events.limits_id[1]].linear_advance_k_s == 0.3
    block, _ = read(
        "M203 X18000 I60\nM566 X600 P1\nM205 X20\nM204 P900\nM205 X4\n", "reprapfirmware"
    )
    after = block.limits[block.events.limits_id[-1]]
    assert (after.speed_x_mm_s, after.min_speed_mm_s, after.jerk_policy) == (300, 1, 1)
    assert (after.jerk_x_mm_s, after.max_jerk_x_mm_s, after.print_accel_mm_s2) == (4, 10, 900)
    assert block.limits[block.events.limits_id[2]].jerk_x_mm_s == 10


def test_reprapfirmware_takes_no_limit_below_its_least(read) -> None:
    """As its own code did on a PC (3.6-dev, 2024-10): Z .2 mm in .4025 s after the first line."""
    # PrusaSlicer's "Marlin" means mm/s, which this firmware reads as mm/min: .2 mm/s. M203 I is .5.
    lines = ["M203 X200 Z12 E120", "M203 I6", "M203 Z12", "M203 Z0 I3", "M203 X-5", "M203 Z12"]
    block, _ = read("\n".join(lines) + "\n", "reprapfirmware")
    found = [block.limits[k] for k in block.events.limits_id]
    assert [one.speed_z_mm_s for one in found] == pytest.approx([0.5, 0.5, 0.2, 0.05, 0.05, 0.2])
    assert [one.min_speed_mm_s for one in found] == pytest.approx([0.5, 0.1, 0.1, 0.05, 0.05, 0.05])
    assert found[0].speed_x_mm_s == pytest.approx(200 / 60)
    assert found[0].speed_e_mm_s == 2.0
    assert found[4].speed_x_mm_s == pytest.approx(0.05)
    block, _ = read("M201 X0 Y300\nM204 P0 T900\nM203 I0\n", "reprapfirmware")
    after = block.limits[block.events.limits_id[-1]]
    assert (after.accel_x_mm_s2, after.accel_y_mm_s2) == (0.1, 300)
    assert (after.print_accel_mm_s2, after.travel_accel_mm_s2) == (0.1, 900)
    assert after.min_speed_mm_s == 0.01


@pytest.mark.parametrize(
    ("line", "field"),
    [
        ("M201 X20", "accel_x_mm_s2"),
        ("M203 X20", "feedrate_x_mm_s"),
        ("M204 P20", "print_accel_mm_s2"),
        ("M205 S20", "min_feedrate_mm_s"),
    ],
)
def test_repeated_limits_are_read_in_the_units_in_force(line: str, field: str, read) -> None:
    for units in (("G21", "G20", "G21"), ("G20", "G21", "G20")):
        block, _ = read("".join(f"{unit}\n{line}\n" for unit in units), "marlin")
        found = [getattr(block.limits[k], field) for k in block.events.limits_id[1::2]]
        assert found == pytest.approx([20 if unit == "G21" else 508 for unit in units])


@pytest.mark.parametrize("name", ["marlin", "reprapfirmware", "klipper"])
def test_repeated_lines_do_the_same_again(name: str, read) -> None:
    """The kernel remembers what a line did; the second time it goes the same way."""
    text = "M204 P900 T800\n;TYPE:a\nG1 X{0} F600\nM204 P700 T600\n;TYPE:b\nG1 X{1}\n"
    block, interpreter = read("".join(text.format(2 * k + 1, 2 * k + 2) for k in range(3)), name)
    moves = block.moves
    assert moves.feature.tolist() == [0, 1] * 3
    assert [block.limits[k] for k in moves.limits_id[:2]] * 3 == [
        block.limits[k] for k in moves.limits_id
    ]
    assert interpreter.feature_names == ["a", "b"]


def test_g4_lasts_as_each_firmware_reads_it(read) -> None:
    def dwell(text: str, name: str) -> list[float]:
        return read(text, name)[0].events.dwell_s.tolist()

    assert dwell("G4 P500\nG4 S2\nG4 S1 P5\nG4\n", "klipper") == [0.5, 0, 0.005, 0]
    for name in ("marlin", "reprapfirmware"):
        assert dwell("G4 P500\nG4 S2\nG4 S1 P5\nG4\n", name) == [0.5, 2, 1, 0]
    block, _ = read("G4\n", "reprapfirmware")
    assert block.events.kind[0] == EventKind.HARMLESS


def test_a_change_of_tools_makes_the_position_unknown(read) -> None:
    block, _ = read("G1 X1 F600\nT1\nG1 X2\nT0\nG1 X3\n", "marlin")
    assert block.moves.tool.tolist() == [0, 1, 0]
    assert block.events.kind.tolist() == [EventKind.UNKNOWN] * 2
    # The print before may have ended with another tool.
    assert read("T0\nT0\n", "marlin")[0].events.kind.tolist() == [EventKind.UNKNOWN, EventKind.STOP]
    parked = read("T0\nP0 S1 L2\nT0 S1\n", "prusa")[0].events.kind.tolist()
    assert parked == [EventKind.UNKNOWN] * 3
    assert read("T0\n", "reprapfirmware")[0].events.kind.tolist() == [EventKind.UNKNOWN]
    assert read("T1000\nG1 X1 F60\n", "bambu")[0].moves.tool.tolist() == [0]


CLASSES = {
    "M593 F40": {"marlin": EventKind.SHAPER, "reprapfirmware": EventKind.SHAPER},
    "M975 S1": {"bambu": EventKind.SHAPER, "marlin": EventKind.UNKNOWN},
    "M624 AQAAAAAAAAA=": {"bambu": EventKind.OBJECT},
    "M572 S0.03": {"prusa": EventKind.STOP},
    "M74 W150": {"prusa": EventKind.SHAPER},
    "M900 K0.05": {
        **dict.fromkeys(("marlin", "prusa", "bambu"), EventKind.STOP),
        "klipper": EventKind.HARMLESS,
    },
    "M204.2 K0.5": {"bambu": EventKind.UNKNOWN},
    "M900 K0": {"marlin": EventKind.LIMITS},  # as it is already: no stop
    "M495 X F10 T100": {"marlin": EventKind.HARMLESS},  # set, not begun
    "M496": {"marlin": EventKind.HARMLESS},
    "M900 K0.05 T1": {"marlin": EventKind.STOP},
    "M900 K0 T1": {"marlin": EventKind.LIMITS},
    "M221 S90 T1": {"marlin": EventKind.HARMLESS},
    "M7": {"marlin": EventKind.STOP},
    "M102": {"marlin": EventKind.HARMLESS},  # Simplify3D's, beside M101 and M103
    "M102 S-6": {"marlin": EventKind.UNKNOWN},
    "G28.5": {"marlin": EventKind.UNKNOWN},
    "M1234": {
        "marlin": EventKind.HARMLESS,
        "bambu": EventKind.UNKNOWN,
        "reprapfirmware": EventKind.UNKNOWN,  # sys/M1234.g may be there
    },
    "EXCLUDE_OBJECT_START NAME=a": dict.fromkeys(("marlin", "reprapfirmware"), EventKind.HARMLESS),
    **{
        line: {"marlin": EventKind.UNKNOWN}
        for line in ("M23 other.gco", "M401", "M493 S1", "M495 X S", "M1000", "M28 log.gco")
    },
    **{line: {"prusa": EventKind.UNKNOWN} for line in ("P0 S1 L2 D0", "M958 X1", "M9150", "G65")},
    **{line: {"marlin-stock": EventKind.UNKNOWN} for line in ("G20", "G18", "G54", "G5 X1", "G60")},
    **{line: {"marlin-stock": EventKind.HARMLESS} for line in ("G17", "G80", "g1 X5")},
    **{
        line: {"reprapfirmware": EventKind.UNKNOWN}
        for line in ("T-1", "T R1", "T{1}", "M109 S200", "M24", "G10 L1 P0 X1", "M28 a.g")
    },
    **{
        line: {"reprapfirmware": EventKind.STOP}
        for line in (
            *("M17", "M906 X800", "M913 X50", "G17", "M302 P1", "M92 X80", "M190 S{var.bed}"),
            *("G10 L2 P1 X5", "G10 L20 Z0", "M592 D0 A0.01"),
        )
    },
    "M218 T1 X20 Y0.1": {"marlin": EventKind.HARMLESS},
    "M206": {"marlin": EventKind.HARMLESS},
    "M567 P0 E0.5:0.5": {"reprapfirmware": EventKind.HARMLESS},
    "G10 L20 P2": {"reprapfirmware": EventKind.HARMLESS},
    # Held back in a stream, a further word would be lost.
    "M201 X500": dict.fromkeys(("marlin", "reprapfirmware"), EventKind.LIMITS),
    "M201 X500 F50": {"marlin": EventKind.STATE},
    "M566 X300 U300": {"reprapfirmware": EventKind.STATE},
    "SET_VELOCITY_LIMIT ACCEL=500 ACCEL_TO_DECEL=200": {"klipper": EventKind.LIMITS},
    "SET_VELOCITY_LIMIT ACCEL=500 Z_ACCEL=100": {"klipper": EventKind.STATE},
    # OctoPrint's, and its plugins'.
    **{line: dict.fromkeys(ALL, EventKind.UNKNOWN) for line in ("@pause", "N5 @OCTOLAPSE TAKE")},
    "@Objectinfo a X1 Y2": dict.fromkeys(ALL, EventKind.HARMLESS),
    "M107": {"reprapfirmware": EventKind.HARMLESS},
    "M600": {"marlin": EventKind.UNKNOWN, "reprapfirmware": EventKind.UNKNOWN},
    "M500": {"marlin": EventKind.UNKNOWN, "reprapfirmware": EventKind.HARMLESS},
    "G1 X5 H1": {"reprapfirmware": EventKind.UNKNOWN},
    "M116": {"reprapfirmware": EventKind.STOP, "marlin": EventKind.HARMLESS},
    "G92 E0": {"marlin": EventKind.MODE, "reprapfirmware": EventKind.MODE},
    "G92 X5": {"marlin": EventKind.MODE, "reprapfirmware": EventKind.UNKNOWN},
    "M117 G1 X5 ; text": dict.fromkeys(ALL, EventKind.HARMLESS),
    "M106 S255 ; G1": dict.fromkeys(ALL, EventKind.HARMLESS),
}


@pytest.mark.parametrize(
    ("line", "name", "known"),
    [
        ("T1", "marlin", 7),
        ("M218 T1 X20", "marlin", 7),
        ("M206 Z-0.1", "marlin", 3),
        ("M852 S0.002", "marlin", 7),
        ("M206 X1 Y1", "reprapfirmware", 4),
        ("G10 P1 X20 Y0.1", "reprapfirmware", 7),
        ("T1\nG10 P1 Z-0.1", "reprapfirmware", 7),
        ("M569 P0 D3", "reprapfirmware", 7),
        ("M561", "reprapfirmware", 7),
        ('M375 P"heightmap.csv"', "reprapfirmware", 7),
        ("M556 S100 X0.1", "reprapfirmware", 7),
        ("M350 X16", "reprapfirmware", 0),
    ],
)
def test_the_next_coordinates_tell_the_place(read, line: str, name: str, known: int) -> None:
    """Offsets of tools, a bent bed: coordinates still count from the same place."""
    text = f"G28\nT0\nG1 X9 Y9 Z1 F600\n{line}\nG1 X8 Y8 Z2\nG1 X7 Y7 Z1\n"
    assert read(text, name)[0].moves.known[-1] == known


def test_the_offset_of_another_tool_moves_nothing(read) -> None:
    """RepRapFirmware's G10 of a tool that is not in use."""
    block, _ = read("T0\nG1 X9 F600\nG10 P1 X5\nG10 P0 X5\nG10 X5\n", "reprapfirmware")
    unknown, stop = EventKind.UNKNOWN, EventKind.STOP
    assert block.events.kind.tolist() == [unknown, stop, unknown, unknown]


def test_a_place_that_is_told_is_no_motion(read) -> None:
    """RepRapFirmware's G92 X: figures must not take it for a jump of the machine."""
    block, _ = read("G28\nG1 X10 F600\nG92 X50\nG1 X51\n", "reprapfirmware")
    assert block.events.kind[-1] == EventKind.UNKNOWN
    assert block.moves.known.tolist() == [7, 7]
    assert block.moves.start_mm[1, 0] == 50.0
    # It passes over workspaces (GCodes3.cpp, SetPositions).
    block, _ = read("G10 L2 P1 X3\nG1 X10 F600\nG92 X50\nG1 X51\nG1 X52\n", "reprapfirmware")
    assert block.moves.known.tolist() == [7, 6, 7]


@pytest.mark.parametrize("line", ["G1 X{var.a} F3000", "G1 H1 X-300 F3000", "G1 R1 X0 F3000"])
def test_a_feedrate_outlasts_a_line_of_unknown_end(line: str, read) -> None:
    block, _ = read(f"G1 X1 F600\n{line}\nG1 X2\nG1 X3\n", "reprapfirmware")
    assert block.moves.speed_mm_s.tolist() == [10.0, 50.0, 50.0]


def test_filament_of_a_line_of_unknown_end(read) -> None:
    block, _ = read("M82\nG1 X{var.a} E5 F600\nG1 X1\nG1 X2 E6\n", "reprapfirmware")
    assert (block.moves.end_mm - block.moves.start_mm)[:, 3].tolist() == [0.0, 1.0]


def test_limits_of_kalico_are_reset(read) -> None:
    text = "SET_VELOCITY_LIMIT ACCEL=500\nG1 X1 F600\nRESET_VELOCITY_LIMIT\nG1 X2\n"
    block, _ = read(text, "klipper")
    accels = [block.limits[k].accel_mm_s2 for k in block.moves.limits_id]
    assert accels == [500.0, FIRMWARES["klipper"].planner.max_accel_mm_s2]


@pytest.mark.parametrize("line", CLASSES)
def test_each_firmware_takes_a_line_for_its_own_kind_of_event(line: str, read) -> None:
    for name, kind in CLASSES[line].items():
        assert read(f"{line}\n", name)[0].events.kind.tolist() == [kind], name


def test_meta_commands_are_barriers(read) -> None:
    block, interpreter = read(
        'G1 X1 F600\nif move.axes[0].homed\n  G1 X50\n  G91\n  M117 yes\necho "hi"\n'
        "G1 X2\nG1 X{var.a}\nG28\nG1 X3\n",
        "reprapfirmware",
    )
    assert block.moves.end_mm[:, 0].tolist() == [1, 2, 3]
    assert block.moves.known.tolist() == [7, 0, 7]
    unknown, harmless = EventKind.UNKNOWN, EventKind.HARMLESS
    assert block.events.kind.tolist() == [*3 * [unknown], *2 * [harmless], *2 * [unknown]]
    assert any("conditional" in text for text in interpreter.warnings)
    # What a pause or a macro does, it does under a condition.
    for text in ("if true\n  M25\n  M400\n", 'M98 P"a.g" A{var.a}\n'):
        block, _ = read(f"{text}G1 X1 Y1 F600\nG1 X2\n", "reprapfirmware")
        assert block.moves.known.tolist() == [0, 3]
    assert any("expression" in text for text in interpreter.warnings)


@pytest.mark.parametrize(
    ("line", "known"),
    [
        ("G10 P0 S{var.t} R{var.t}", 7),
        ("M109 S{var.t}", 7),
        ('M593 P"zvd" F{var.f}', 7),
        ("M204 P{var.a} T{var.a}", 3),
        ("M207 S{var.l}", 3),
        ("G10 P0 X{var.x}", 0),
        ("G92 X{var.x}", 0),
    ],
)
def test_an_expression_leaves_coordinates_alone_that_its_line_does_not_set(
    line: str, known: int, read
) -> None:
    text = f"G28\nT0\nG1 X9 Y9 Z1 F600\n{line}\nG1 X8 Y8\nG1 X7 Y7\n"
    assert read(text, "reprapfirmware")[0].moves.known[-1] == known


@pytest.mark.parametrize("line", ["M572 D0 S{var.k}", "if global.petg\n  M572 D0 S0.06"])
def test_moves_wait_for_a_pressure_advance_that_is_a_number(line: str, read) -> None:
    """A stream's filament holds it."""
    text = f"G28\nT0\n{line}\nG28\nG1 X9 Y9 Z1 F600\nM572 S0.1\nG1 X8 Y8\n"
    block, interpreter = read(text, "reprapfirmware")
    assert (block.moves.known & 8).tolist() == [8, 0]
    assert any("M572 under a condition" in text for text in interpreter.warnings)


@pytest.mark.parametrize(
    ("line", "known"),
    [
        ("G28", 3),
        ("T0", 3),
        ("M109 S200", 3),
        ("G10 P0 S200", 3),
        ("M190 S60", 3),
        ("G92 X5", 0),
        ("G10 P0 X5", 0),
        ("G91", 0),
    ],
)
def test_a_condition_leaves_coordinates_alone_that_its_lines_do_not_set(
    line: str, known: int, read
) -> None:
    """Start codes home where the printer is not homed, and fetch a tool where none is in use."""
    text = f"G28\nG1 X9 Y9 Z1 F600\nif !move.axes[0].homed\n  {line}\nG1 X8 Y8\nG1 X7 Y7\n"
    block, _ = read(text, "reprapfirmware")
    assert block.moves.known.tolist() == [7, 0, known]
    assert block.events.kind.tolist() == [EventKind.UNKNOWN] * 3


@pytest.mark.parametrize(
    ("before", "line", "known"),
    [
        ("M83", "M83", 3),
        ("M83", "G92 E0", 3),
        ("M83", "G90", 3),
        ("M83", "G21", 3),
        ("M83", "M82", 0),
        ("M82", "M83", 0),
        ("M82", "G92 E0", 0),
        ("M83", "G92 E0 X0", 0),
        ("G91", "G90", 0),
    ],
)
def test_a_mode_that_is_in_force_needs_no_condition(
    before: str, line: str, known: int, read
) -> None:
    text = f"G28\nG1 X9 Y9 Z1 F600\n{before}\nif true\n  {line}\nG90\nG1 X8 Y8\nG1 X7 Y7\n"
    assert read(text, "reprapfirmware")[0].moves.known[-1] == known


def test_limits_under_a_condition_leave_coordinates_alone(read) -> None:
    text = "G28\nG1 X9 Y9 Z1 F600\nif true\n  M204 P500 T500\nG1 X8 Y8\nG1 X7 Y7\n"
    block, interpreter = read(text, "reprapfirmware")
    assert block.moves.known.tolist() == [7, 0, 3]
    assert any("M204 under a condition" in text for text in interpreter.warnings)


def test_saved_places_are_as_many_as_the_firmware_has(read) -> None:
    text = "".join(f"G60 S{slot}\n" for slot in range(300))
    assert len(read(text, "marlin")[1].state.saved) == 256


def test_marlin_hops_with_its_firmware_retraction(read) -> None:
    block, _ = read("M83\nM207 S1 F1800 Z0.4\nG1 X1 Z1 F600\nG10\nG1 X2\nG11\nG1 X3 Z1\n", "marlin")
    assert block.moves.end_mm[:, 2].tolist() == pytest.approx([1, 1, 1.4, 1.4, 1, 1, 1])
    assert block.moves.end_mm[:, 3].tolist() == pytest.approx([0, -1, -1, -1, -1, 0, 0])
    assert block.moves.speed_mm_s[1] == pytest.approx(30)


def test_lines_in_inches_stay_as_they_are(read) -> None:
    block, _ = read("G1 X1 F600\nG20\nG1 X1\nG21\nG1 X1\n", "marlin")
    assert (block.moves.known & 8).tolist() == [0, 8, 0]


def test_lines_of_several_commands_are_none_of_them(read) -> None:
    """What the first one does is not remembered for the line; nor is fan or mode held back."""
    line = "M106 S1 G1 X{0}\nM106 S1 M204 P{0}\nM83 M204 P{0}\nM204 P900\n"
    text = "".join(line.format(k) for k in (10, 20, 10, 20))
    block, _ = read(text, "reprapfirmware")
    assert block.moves.end_mm[:, 0].tolist() == [10, 20, 10, 20]
    kinds = [EventKind.STATE, EventKind.STATE, EventKind.LIMITS]
    assert block.events.kind.tolist() == kinds * 4
    accels = [block.limits[k].print_accel_mm_s2 for k in block.events.limits_id]
    assert accels == [10, 10, 900, 20, 20, 900] * 2


@pytest.mark.parametrize(
    ("line", "kind"),
    [
        ('M98 P"x.g" M120', EventKind.UNKNOWN),
        ('M120 M98 P"x.g"', EventKind.UNKNOWN),
        ("M400 M120", EventKind.STOP),
        ("M120 M83", EventKind.STATE),
        ("M486 S1 M120", EventKind.OBJECT),
        ('M593 P"zvd" F40 M120', EventKind.UNKNOWN),
        ('M593 P"zvd" F40 G91', EventKind.UNKNOWN),
        ('M572 D0 S.05 M593 P"zvd" F40', EventKind.SHAPER),
    ],
)
def test_a_line_of_several_commands_does_what_the_strongest_does(read, line: str, kind: EventKind):
    """A macro stops the motion, whatever stands beside it; a shaper's line is said again."""
    block, _ = read(f"G1 X1 F600\n{line}\nG1 X2\n", "reprapfirmware")
    assert block.events.kind.tolist() == [kind]


@pytest.mark.parametrize("name", ["klipper", "marlin", "reprapfirmware"])
def test_what_a_printer_lacks_is_told(read, name: str) -> None:
    _, interpreter = read("G1 X5 F600\nG2 X9 I2\n", name, arcs=False)
    (said,) = interpreter.warnings
    assert said.startswith("line 2: G2: this machine draws no arcs (firmware.arcs)")
    assert read("G2 X4 I2\n", name)[1].warnings == []


@pytest.mark.parametrize("name", ["klipper", "marlin"])
def test_a_retraction_that_a_printer_lacks_is_told(read, name: str) -> None:
    _, interpreter = read("G1 X5 F600\nG10\nG1 X9\nG11\n", name, retraction=None)
    assert [said[:12] for said in interpreter.warnings] == ["line 2: G10:", "line 4: G11:"]
    assert read("G17\n", name, arcs=False)[0].events.kind[0] <= EventKind.MODE
    # With words it sets temperatures of tools, a macro where there is one.
    assert read("G10 P1 S200\n", name, retraction=None)[1].warnings == []


def test_temperatures_of_a_tool_move_nothing(read) -> None:
    """RepRapFirmware's G10 P, also where the machine does not say how bare ones retract."""
    block, _ = read("G10 P1 S200\nG10\n", "reprapfirmware", retraction=None)
    assert block.events.kind.tolist() == [EventKind.HARMLESS, EventKind.UNKNOWN]


@pytest.mark.parametrize("name", ALL)
def test_the_name_of_an_object_ends_none(read, name: str) -> None:
    """PrusaSlicer writes M486 A and the name; that of a MeshShape holds an S."""
    text = "M486 S3\nM486 AMeshShape id:0\nG1 X1 F600\nM486 S-1\n"
    block, _ = read(f"{text}M486 USED\nG1 X2\n", name)  # the last one is nothing that exists
    assert block.moves.object_id.tolist() == [0, -1]


def test_a_macro_of_that_name_is_the_users(read) -> None:
    macros = {"arcs": False, "retraction": None, "stopping_macros": ("G2", "G10")}
    assert read("G2 X9 I2\nG10\n", "klipper", **macros)[1].warnings == []


def test_a_word_that_printers_have_as_a_macro_is_told(read) -> None:
    """Creality's M205 sets the corner velocity, and would within a stream."""
    text = "M205 X8\nG1 X5 Y5 F600\nM205 X500\nG1 X9\nM205 X50\n"  # the first one at the start
    block, interpreter = read(text, "klipper", homed_at_start=False)
    assert block.events.kind.tolist() == [EventKind.HARMLESS] * 3
    ((said, line),) = interpreter.state.notes.items()
    assert (line, interpreter.warnings) == (3, [])
    assert said.startswith("M205 in the middle of the print")
    for fields in (
        {"macros": ("M205",)},
        {"harmless_macros": ("M205",)},
        {"unknown_commands": "skip"},
        {"macros_known": True},
    ):
        assert read(text, "klipper", **fields)[1].state.notes == {}
    # It may be a command, of which printer.cfg says nothing.
    advance = text.replace("M205 X", "M900 K")
    assert len(read(advance, "klipper", macros_known=True)[1].state.notes) == 1


@pytest.mark.parametrize(
    ("line", "limits"),
    [
        ("M205 X20 Y15", (500.0, 20.0)),
        ("M205 Y15", (500.0, 15.0)),
        ("M205 B1", (500.0, 5.0)),
        ("M203 X200 Y150 Z5", (150.0, 5.0)),
        ("M203 X200", (200.0, 5.0)),
        ("M203 E25", (500.0, 5.0)),
        ("M203 X0", (500.0, 5.0)),
    ],
)
def test_a_macro_that_sets_a_limit(read, line: str, limits: tuple[float, float]) -> None:
    """As those of Creality and Elegoo do, whose files have them at each feature.

    One that only does so is held back within a stream; of another nothing more is known.
    """
    name, text = line[:4], f"G1 X5 F600\n{line}\nG1 X9\n"
    for fields, kind in (
        ({"macros": (name.lower(),)}, EventKind.UNKNOWN),
        ({"limit_macros": (name,)}, EventKind.LIMITS),
    ):
        block, interpreter = read(text, "klipper", **fields)
        after = block.limits[block.events.limits_id[-1]]
        assert (after.velocity_mm_s, after.square_corner_velocity_mm_s) == limits
        assert block.events.kind.tolist() == [kind]
        assert interpreter.state.notes == {}


def test_a_macro_m204_halves_what_short_moves_may_have(read) -> None:
    """QIDI's sets ACCEL_TO_DECEL too, which newer Klippers do not have."""
    older = PlannerLimits(max_accel_to_decel_mm_s2=9000.0)
    for planner, macros, to_decel in (
        (older, ("M204",), 1000.0),
        (older, (), 9000.0),
        (PlannerLimits(), ("M204",), 0.0),
    ):
        block, _ = read("M204 S2000\n", "klipper", planner=planner, macros=macros)
        after = block.limits[block.events.limits_id[-1]]
        assert (after.accel_mm_s2, after.accel_to_decel_mm_s2) == (2000.0, to_decel)
        assert block.events.kind.tolist() == [EventKind.LIMITS]


def test_a_limit_of_older_klippers_is_told_once(read) -> None:
    line = "SET_VELOCITY_LIMIT ACCEL=2000 ACCEL_TO_DECEL=1000"
    _, interpreter = read(f"G1 X5 F600\n{line}\n{line} ; again\n", "klipper")
    (said,) = interpreter.warnings
    assert said.startswith("line 2: ACCEL_TO_DECEL is not followed")
    # Lines for old and new Klippers, such as a stream's.
    assert read(f"{line} MINIMUM_CRUISE_RATIO=.5\n", "klipper")[1].warnings == []
    older = PlannerLimits(max_accel_to_decel_mm_s2=2000.0)
    assert read(f"{line}\n", "klipper", planner=older)[1].warnings == []


@pytest.mark.parametrize(
    ("line", "given", "how"),
    [
        ("G1 X1.2.3 Y5", "X1.2.3", "reads it as X1.2"),
        ("G1 X100,5 Y5", "X100,5", "reads it as X100"),
        ("G1 Y5 XNaN ; X5", "XNAN", "passes it over"),
        ("G1 X--5", "X--5", "passes it over"),
        ("G1 X Y5", "X", "passes it over"),
    ],
)
def test_what_is_no_number_is_told_where_it_is_read_all_the_same(
    read, line: str, given: str, how: str
) -> None:
    _, interpreter = read(f"G1 F600\n{line}\n", "marlin")
    assert interpreter.warnings == [
        f"line 2: {given} is not a number, and Marlin {how}; correct it"
    ]


def test_numbers_of_all_kinds_are_numbers(read) -> None:
    lines = "G1 X+1.5 Y.5 F600\nG1X1Y2*33\nG1 X 5 Y5.\nG1 X5 ; X1.2.3\nG0 X-.5(Y1.1.1)\n"
    assert read(lines, "marlin-loose")[1].warnings == []
    assert read("M83\nG1 X1e1 E1 F600\n", "reprapfirmware")[1].warnings == []
    of_two = "line 2: moves of other axes, extruders or lasers (E) stay as sliced"
    assert read("M83\nG1 X1e1 E1:2 F600\n", "reprapfirmware")[1].warnings == [of_two]


_BURNS = "G1 X110 S200 F1200\nG1 Y110\nG0 X140 F6000\n"


@pytest.mark.parametrize(
    ("name", "on", "stays"),
    [
        ("marlin", "M4 I\n", True),
        ("marlin", "M3 S0\n", True),
        ("marlin", "", False),  # G1 S of an old start script: no laser
        ("reprapfirmware", "M3 S0\n", True),
        ("reprapfirmware", "M452\n", True),
        ("klipper", "M3 S0\n", False),  # G0 is G1 there, whatever a macro M3 does
    ],
)
def test_travel_of_a_laser_stays(read, name: str, on: str, stays: bool) -> None:
    """G0 switches it off, which a stream's G1 does not: it would burn its way to the next line."""
    block, interpreter = read(f"G28\nG1 X1 Y1 F600\n{on}{_BURNS}", name)
    assert (block.moves.known & KEPT > 0).tolist() == [False, True, stays, stays]
    assert any("a laser's moves" in text for text in interpreter.warnings) == stays


def test_behind_a_laser_moves_are_moves_again(read) -> None:
    for on, off in (("M3 S0", "M5"), ("M3 I", "M5"), ("M452", "M451")):
        name = "reprapfirmware" if on == "M452" else "marlin"
        text = f"G1 X1 Y1 F600\n{on}\n{_BURNS}{off}\nG0 X3\nM3 S90\nG1 X5\n"
        block, _ = read(text, name)
        assert not np.any(block.moves.known[-2:] & KEPT)
    # M5 in laser mode: the next move may have a power again.
    block, _ = read(f"G1 X1 Y1 F600\nM452\nM5\n{_BURNS}", "reprapfirmware")
    assert (block.moves.known[1:] & KEPT > 0).all()
    # A user's mark outlasts M5.
    block, _ = read("G1 X1 Y1 F600\n; STILLPATH_OFF\nM3 I\nM5\nG0 X3\n", "marlin")
    assert block.moves.known[-1] & KEPT
