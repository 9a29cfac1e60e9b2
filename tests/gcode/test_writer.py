"""The written file, read as the machine reads it: every original line finds its own state."""

from __future__ import annotations

import gzip
import re
from pathlib import Path

import numpy as np
import pytest

from stillpath.gcode.interpreter import Interpreter
from stillpath.gcode.types import EventKind
from stillpath.models.firmware.klipper import FirmwareShaper
from stillpath.models.machine import Machine
from stillpath.models.shaper_pulses import shaper_pulses
from stillpath.models.store import load_machine
from stillpath.pipeline.result import Result
from tests.compensating import compensated
from tests.gcode.cutting import HEAD
from tests.gcode.prints import made_up_print, polygon
from tests.gcode.states import differences, states, tagged

OFF = b"; stillpath: stream off"
TURN = "\n".join(polygon(8, 20)) + "\n"
ROUND = "G1 X120 Y100 F6000\n" + TURN


@pytest.fixture(scope="module")
def machine() -> Machine:
    return load_machine("ender3")


class Pipeline:
    def __init__(self, folder: Path, cache: Path, machine: Machine) -> None:
        self.folder, self.cache, self.machine = folder, cache, machine
        self.result: Result | None = None

    def __call__(self, data: bytes | str, machine: Machine | None = None) -> bytes:
        self.result, written = compensated(data, self.folder, self.cache, machine or self.machine)
        return written


@pytest.fixture
def pipeline(tmp_path: Path, cache: Path, machine: Machine) -> Pipeline:
    return Pipeline(tmp_path, cache, machine)


def check(pipeline: Pipeline, text: str | bytes) -> list[bytes]:
    """Compensate; every line must find its state, and no piece may be reverted."""
    original = tagged(text.encode() if isinstance(text, str) else text)
    written = pipeline(original)
    assert differences(original, written, pipeline.machine) == []
    assert pipeline.result is not None
    assert pipeline.result.put_back == []
    return written.splitlines()


# The strongest check


@pytest.mark.parametrize("seed", range(6))
def test_made_up_prints(pipeline: Pipeline, seed: int) -> None:
    original = tagged(made_up_print(seed))
    assert differences(original, pipeline(original), pipeline.machine) == []


@pytest.mark.parametrize("seed", range(8))
def test_wild_prints(pipeline: Pipeline, seed: int) -> None:
    """Modes, factors, G92 and macros in the middle of it."""
    original = tagged(made_up_print(seed, wild=True))
    assert differences(original, pipeline(original), pipeline.machine) == []


@pytest.mark.shared
@pytest.mark.parametrize(
    "name",
    [
        "klipper_excludeobj_multi",
        pytest.param("cura_ender3_gear24", marks=pytest.mark.slow),
        "ps_ender3_gear24_absE",
    ],
)
def test_real_prints(pipeline: Pipeline, shared_dir: Path, name: str) -> None:
    data = gzip.decompress((shared_dir / "corpus" / "own" / f"{name}.gcode.gz").read_bytes())
    original = tagged(b"".join(data.splitlines(keepends=True)[:5000]))
    assert differences(original, pipeline(original), pipeline.machine) == []


def test_the_check_sees_what_it_should(pipeline: Pipeline, machine: Machine) -> None:
    original = tagged((HEAD + ROUND + "G1 E-1 F2100\nM400\nG1 X1 Y1 F3000\nG28\n").encode())
    written = pipeline(original)
    assert differences(original, written, machine) == []
    for old, new, word in (
        (b"G1 E-1 F2100", b"G1 E-1 F2000", "became"),
        (b"SET_VELOCITY_LIMIT VELOCITY=500 ACCEL=5000", b"SET_VELOCITY_LIMIT ACCEL=4000", "limits"),
        (b"of the original\n", b"of the original\nM82\n", "modal"),
        (b"G28 ;#", b"G1 E1 ;#", "became"),
    ):
        assert old in written
        found = differences(original, written.replace(old, new), machine)
        assert any(word in problem for problem in found), (old, found)


# One thing at a time


def test_limits_are_raised_and_restored(pipeline: Pipeline) -> None:
    lines = check(pipeline, HEAD + "M204 S1300\n" + ROUND + "M400\nG1 X10 F3000\nG28\n")
    on = lines.index(b"; stillpath: stream on")
    assert lines[on + 1].startswith(b"SET_INPUT_SHAPER")
    raised = [k for k, line in enumerate(lines) if line.startswith(b"SET_VELOCITY_LIMIT")]
    assert b"ACCEL=20000" in lines[raised[0]]
    off = [k for k, line in enumerate(lines) if line.startswith(OFF)][1]
    stop = next(k for k, line in enumerate(lines) if line.startswith(b"M400"))
    last = [k for k in raised if k < stop][-1]
    assert last < off < stop
    assert b"ACCEL=1300 " in lines[last]


@pytest.mark.parametrize(
    "line",
    ["M204 P700 T900", "SET_VELOCITY_LIMIT SQUARE_CORNER_VELOCITY=3 VELOCITY=90"],
)
def test_limit_changes_are_held_back(pipeline: Pipeline, line: str) -> None:
    lines = check(pipeline, HEAD + ROUND + f"{line}\n" + TURN + "M400\nG1 X10 F3000\n")
    assert any(x.startswith(f"; stillpath, held back: {line}".encode()) for x in lines)


@pytest.mark.parametrize(
    "change",
    ["M82\nG92 E0", "M220 S80", "G1 F2400"],
)
def test_modes_between_figures(pipeline: Pipeline, change: str) -> None:
    """Changes at a rest, and the file goes on in them."""
    back = "M83\n" if "M82" in change else ""
    tail = f"G1 E-1 F2100\n{change}\nG1 E-1\n{back}" + ROUND + "G1 E1\nM400\nG1 E1\nG1 X10\nG28\n"
    check(pipeline, HEAD + ROUND + tail)


def test_relative_files(pipeline: Pipeline) -> None:
    text = HEAD + "G91\nG1 X20 Y3 E1 F3000\nG1 X-4 Y9 E.5\nG1 E-1 F2100\nG1 X9\nG1 E1\n"
    check(pipeline, text + "G1 X-9 Y9 E1\nG1 Z1 F600\nG1 X5 F3000\nM400\nG1 X2 Y2\nG90\nG1 X50\n")


def test_move_of_no_length_in_mid_motion(pipeline: Pipeline) -> None:
    check(pipeline, HEAD + ROUND + ROUND + "M400\nG1 X10 F3000\n")


def test_origin_moves(pipeline: Pipeline) -> None:
    """G92 X at a stand: the file's zero moves, the machine does not jump."""
    text = HEAD + ROUND + "M400\nG92 X20\nG1 X30 Y60 E1\nG1 X30 Y80 E1\nG92 E0\nM400\nG1 X5 Y70\n"
    check(pipeline, text)


def test_modal_f_is_restored(pipeline: Pipeline) -> None:
    """Raw lines without F after a piece run at the file's F, not at the stream's."""
    text = (
        HEAD + ROUND + "G1 F1234\nG1 X90 Y90 E1\nM400\nEXCLUDE_OBJECT_START NAME=a\n"
        "G1 X90.05\nG28\n"
    )
    original = tagged(text.encode())
    written = pipeline(original)
    after = {s.text.split(b" ;#")[0]: s for s in states(written, pipeline.machine)}
    assert after[b"G1 X90.05"].speed_mm_s == pytest.approx(1234 / 60, rel=1e-6)
    assert not after[b"G1 X90.05"].stream


def test_rest_lines_without_f(pipeline: Pipeline) -> None:
    check(
        pipeline, HEAD + ROUND + "G1 F2100\nG1 E-1\nG1 Z6\n" + ROUND + "G1 F900\nG1 E1\nG1 X9 Y9\n"
    )


@pytest.mark.parametrize(
    ("kind", "written"),
    [("ei", b"ei"), ("MZV (n=4, t=1.0)", b"mzv(n=4,t=1.0)"), ("smooth_ei", b"smooth_ei")],
)
def test_shaper_of_the_machine_is_restored(
    pipeline: Pipeline, machine: Machine, kind: str, written: bytes
) -> None:
    shaper = FirmwareShaper(type_x=kind, freq_x_hz=51.5, freq_y_hz=39)
    firmware = machine.firmware.model_copy(update={"shaper": shaper})
    known = machine.model_copy(update={"firmware": firmware})
    lines = pipeline(HEAD + ROUND + "G28\nM84\n", known).splitlines()
    calls = [k for k, line in enumerate(lines) if line.startswith(b"SET_INPUT_SHAPER")]
    assert len(calls) == 2
    words = lines[calls[1]].split(b" ")
    assert words[1:3] == [b"SHAPER_TYPE_X=" + written, b"SHAPER_FREQ_X=51.5"]
    # Smoothers of Kalico and others take no notice of SHAPER_FREQ_X=0.
    smooth = written.startswith(b"smooth_")
    assert (b"SMOOTHER_FREQ_X=0" in lines[calls[0]].split()) is smooth
    assert (b"SMOOTHER_FREQ_X=51.5" in words) is smooth
    assert calls[1] < len(lines) - 1 - lines[::-1].index(b"G28")
    assert pipeline.result is not None
    assert not any("shaper" in warning for warning in pipeline.result.warnings)


_CORNER = "SET_VELOCITY_LIMIT SQUARE_CORNER_VELOCITY=5"


@pytest.mark.parametrize("corner", [f"{_CORNER}\n", f"{_CORNER} Z_ACCEL=300\n", "M205 X5 Y5\n"])
def test_the_shaper_is_not_switched_for_travel(
    pipeline: Pipeline, machine: Machine, corner: str
) -> None:
    """Klipper stands still for every SET_INPUT_SHAPER: times say how long, and there are few."""
    shaper = FirmwareShaper(type_x="ei(0.05)", freq_x_hz=51.5, type_y="mzv", freq_y_hz=39)
    facts = {"shaper": shaper, "limit_macros": ("M205",)}
    firmware = machine.firmware.model_copy(update=facts)
    known = machine.model_copy(update={"firmware": firmware, "pressure_advance_s": 0.05})
    # As Orca writes for each feature.
    marks = f"EXCLUDE_OBJECT_END NAME=a\n{corner}EXCLUDE_OBJECT_START NAME=a\nG1 X130 Y90 F9000\n"
    text = HEAD + ROUND + 5 * (marks + ROUND) + "G28\n"
    written = pipeline(text, known)
    assert differences(text.encode(), written, known) == []
    assert written.count(b"SET_INPUT_SHAPER") == 2
    assert pipeline.result is not None
    result = pipeline.result
    # Klipper's macros must know that the shaper is off there.
    limits = re.findall(
        rb"SQUARE_CORNER_VELOCITY=(\S+) [^\n]*\n[^\n]*\n.*stream off, line [^\n]*\nEXCLUDE", written
    )
    assert limits == 5 * [b"5.0000005"]
    assert len(re.findall(b"%bSET_[^\n]*=5.0000005 " % corner.encode(), written)) == 5
    assert written.rindex(b"SQUARE_CORNER_VELOCITY=5 ") < written.rindex(b"SET_INPUT_SHAPER")
    # Off and on: each stands for the times ahead before and after it. With advance those are 20 ms
    # each; without, the shaper's longer side where it is on, and a millisecond where it is off.
    without = known.model_copy(update={"pressure_advance_s": 0.0})
    pipeline(text, without)
    reaches_s = []
    for kind, f_hz in (("ei", 51.5), ("mzv", 39.0)):
        weights, delays_s = shaper_pulses(kind, f_hz)
        middle_s = float(weights @ delays_s)
        reaches_s.append(max(middle_s, float(delays_s[-1]) - middle_s))
    window_s = max(reaches_s)
    assert result.time_s - pipeline.result.time_s == pytest.approx(
        2 * (0.04 - window_s - 1e-3), abs=5e-4
    )
    assert 0.0 < result.left_alone_s < 0.2 * result.time_s
    assert result.left_alone_extruding_s == 0.0


def test_a_shaper_that_nobody_states_is_switched_off_again_after_a_pause(
    pipeline: Pipeline,
) -> None:
    """PAUSE of stillpath.cfg, or a macro for another tool, may have set it meanwhile."""
    # What is too steep stays as sliced but sets no shaper: Klipper need not stand for a line more.
    steep = "G1 X100 Y100 F6000\nG1 X100.1 Z5 E1 F600\nG1 X100 Z.2 F6000\n"
    written = pipeline(HEAD + ROUND + "PAUSE\n" + ROUND + steep + ROUND)
    line = rb"CORNER_VELOCITY=(\S+) [^\n]*\n[^\n]*\n.*stream off[^\n]*\n(\S+ X\S+|P)"
    # There the shaper is off: a PAUSE sent in it must find the mark, the file's own must not.
    assert re.findall(line, written) == [(b"5", b"P"), (b"5.0000005", b"G1 X100.1")]
    assert written.count(b"SET_INPUT_SHAPER SHAPER_FREQ_X=0") == 2


def test_behind_an_objects_mark_the_limits_are_marked_before_the_shaper_goes_off(
    pipeline: Pipeline,
) -> None:
    """The host waits behind that line. A PAUSE sent then would leave the shaper on at RESUME."""
    on = "SET_INPUT_SHAPER SHAPER_FREQ_X=40\n"
    text = f"{HEAD}{on}EXCLUDE_OBJECT_START NAME=a\nG1 X130 Y90 F9000\n{ROUND}"
    _, _, behind = pipeline(text).partition(on.encode())
    before = behind.partition(b"\nSET_INPUT_SHAPER SHAPER_FREQ_X=0")[0]
    assert b"; stillpath: stream on\nSET_VELOCITY_LIMIT" in before
    assert before.rpartition(b"SQUARE_CORNER_VELOCITY=")[2].startswith(b"5.0000005 ")


def test_what_stays_as_sliced_says_that_the_shaper_is_off(
    tmp_path: Path, cache: Path, machine: Machine
) -> None:
    """Else a RESUME in it would leave the shaper on, below the next stream."""
    corner = "SET_VELOCITY_LIMIT SQUARE_CORNER_VELOCITY={}\n"
    turns = "\n".join(polygon(8, 15)) + "\n"
    infill = f"G4 P1\n;TYPE:Internal infill\nG1 X115 Y100\n{turns}{corner.format(8)}{turns}"
    text = f"{HEAD};TYPE:External perimeter\n{corner.format(9)}{ROUND}{infill}"
    text += f";TYPE:External perimeter\n{ROUND}G28\n"
    _, written = compensated(text, tmp_path, cache, machine, where="visible")
    assert re.search(rb"=9\.0000005 [^\n]*\n[^\n]*\n.*stream off[^\n]*\nG4 P1\n", written)
    assert b"G4 P1\n;TYPE:Internal infill\nG1 X115 Y100\n" in written
    assert re.search(rb"\n%bSET_[^\n]*=8\.0000005 " % corner.format(8).encode(), written)


def test_shaper_of_the_file_is_restored(pipeline: Pipeline) -> None:
    line = b"SET_INPUT_SHAPER SHAPER_TYPE=mzv SHAPER_FREQ_X=48 SHAPER_FREQ_Y=37"
    written = pipeline(HEAD.encode() + line + b"\n" + ROUND.encode() + b"G28\nM84\n")
    assert written.count(line) == 2
    assert written.index(b"SHAPER_FREQ_X=0") < written.rindex(line) < written.rindex(b"G28")


def test_rests_run_under_the_limits_of_the_file(pipeline: Pipeline) -> None:
    """What we did not write must not meet our limits: retractions, hops, and after an M204."""
    rest = "G1 E-1 F2100\nG1 Z5.4 F600\nM204 S1500\nG1 Z5 F600\nG1 E1 F2100\n"
    lines = pipeline(tagged((HEAD + ROUND + rest + ROUND + "G4 P1\n").encode())).splitlines()
    assert pipeline.result is not None
    assert pipeline.result.put_back == []
    accel, seen = 0.0, {}
    for line in lines:
        if found := re.match(rb"SET_VELOCITY_LIMIT .*ACCEL=(\d+)", line):
            accel = float(found[1])
        if b";#" in line and line.startswith((b"G1 E", b"G1 Z")):
            seen[line.split(b" ;#")[0]] = accel
        elif line.startswith(b"G1 X") and b";#" not in line:
            assert accel == 20_000
    assert seen == {
        b"G1 E-1 F2100": 5000,
        b"G1 Z5.4 F600": 5000,
        b"G1 Z5 F600": 1500,
        b"G1 E1 F2100": 1500,
    }


def test_a_file_that_ends_in_a_stream_gives_the_printer_back(pipeline: Pipeline) -> None:
    lines = pipeline(HEAD + ROUND).splitlines()
    limits = [line for line in lines if line.startswith(b"SET_VELOCITY_LIMIT")]
    assert b"ACCEL=5000 " in limits[-1]
    assert lines[-2] == b"; stillpath: stream off"
    assert sum(line.startswith(b"SET_INPUT_SHAPER") for line in lines) == 1
    assert pipeline.result is not None
    assert any("shaper" in warning for warning in pipeline.result.warnings)


def test_after_homing_the_machine_stands_still(pipeline: Pipeline) -> None:
    """A jump is no motion: what follows must not be compensated for it."""
    result = pipeline(HEAD + ROUND + "G28\n" + ROUND + "G28\n")
    assert result.count(b"; stillpath: stream on") >= 2
    assert pipeline.result is not None
    sliced, ours = (channel.extruding for channel in pipeline.result.channels[:2])
    assert ours.contour_max_um < 0.3 * sliced.contour_max_um


@pytest.mark.parametrize(
    ("between", "before", "after"),
    [
        ("M400", False, False),
        ("N7 G4 P0*4 ; M109", False, False),
        ("M109 S200", True, True),  # hot already: Klipper goes on
        ("PARK", True, True),
        ("PARK\nM400", True, False),
        ("M400\nPARK", False, True),
        ("M600\nG1 X130 Y100 Z5 F6000", True, True),
        ("SET_PRESSURE_ADVANCE ADVANCE=.05", True, True),
    ],
)
def test_the_motion_rests_between_stream_and_file_whatever_a_line_does(
    pipeline: Pipeline, machine: Machine, between: str, before: bool, after: bool
) -> None:
    firmware = machine.firmware.model_copy(update={"stopping_macros": ("PARK",)})
    known = machine.model_copy(update={"firmware": firmware})
    lines = pipeline(HEAD + ROUND + f"{between}\n" + TURN, known).splitlines()
    own = between.encode().splitlines()
    first, last = lines.index(own[0]), lines.index(own[-1])
    assert lines[first - 1].startswith(OFF)
    assert b"stream on" in lines[last + 1 + after]
    still = b"G4 P0 ; stand still"
    assert (still in lines[first - 5 : first]) == before
    assert (lines[last + 1] == still) == after


@pytest.mark.parametrize("length", ["0.0005", "0.02"])
def test_hardly_a_move_between_two_rests(pipeline: Pipeline, length: str) -> None:
    tiny = f"G1 E-1 F2100\nG1 X{120 + float(length):.4f} F6000\nG1 E1 F2100\nG1 X130 F6000\n"
    written = pipeline(HEAD + ROUND + tiny + "M400\nG1 X130.001\nM400\n")
    assert b"stream on" in written


def test_a_written_file_begins_and_ends_with_its_stamp(
    pipeline: Pipeline, machine: Machine
) -> None:
    lines = pipeline(HEAD + ROUND + "M84").splitlines()
    assert b"M84" in lines
    assert lines[0].startswith(b"; Processed by stillpath ")
    assert lines[-1] == lines[0]
    assert f"model={machine.revision}".encode() in lines[0]
    kinds = [s.kind for s in states(b"\n".join(lines), machine)]
    assert kinds[0] == kinds[-1] == EventKind.STAMP


@pytest.mark.parametrize(
    ("kept", "back"),
    [
        ("SAVE_GCODE_STATE NAME=a", "RESTORE_GCODE_STATE NAME=a"),
        ("SAVE_GCODE_STATE NAME=a", "RESTORE_GCODE_STATE NAME=a MOVE=1"),
        ("SAVE_GCODE_STATE", "G91\nG1 Z1 F600\nRESTORE_GCODE_STATE MOVE=1 MOVE_SPEED=80"),
        ("SET_GCODE_OFFSET Z_ADJUST=.05 MOVE=1", "SET_GCODE_OFFSET X_ADJUST=1 MOVE=1"),
    ],
)
def test_what_the_printer_keeps_is_the_file_s(pipeline: Pipeline, kept: str, back: str) -> None:
    """Modes, F and place: those of a stream brought back would feed wrongly."""
    text = (
        HEAD.replace("M83", "M82")
        + f"G1 X120 Y100 E1 F6000\nG1 Y120 E2\n{kept}\nG1 X100 E3\nG1 Y100 E4\n"
        + f"{back}\nG1 X90 Y110 E5\nG1 X120 E6\nG1 Y130 E7\n"
    )
    assert "M82" in text
    check(pipeline, text)


def test_filament_adds_up(pipeline: Pipeline, machine: Machine) -> None:
    """Rounding of thousands of E words does not gather."""
    body = ROUND + (TURN + "G1 E-1 F2100\nG1 E1\n") * 30
    ends = []
    for data in ((HEAD + body).encode(), pipeline(HEAD + body)):
        reader = Interpreter(machine)
        reader.push(data)
        ends.append(reader.position_mm)
    np.testing.assert_allclose(ends[1], ends[0], atol=1e-5)


def cancelling(lines: list[bytes], name: bytes, *, after: int) -> list[bytes]:
    """What OctoPrint's Cancel Objects sends: of an object no line, then the E that it has read."""
    sent, skips, ended, tracks, e, seen, active = [], False, False, False, b"0", 0, b""
    for line in lines:
        if found := re.match(rb"@Object (\S+)", line):
            active = found[1]
            skips, ended = skips and active == name, skips and active != name
        if line.startswith((b"@", b";")):
            continue
        seen += active == name
        skips = skips or (active == name and seen > after)
        tracks = line == b"M82" or (tracks and line != b"M83")
        if ended and tracks:
            sent.append(b"G92 E" + e)
        ended = False
        if not skips:
            sent.append(line)
        elif tracks and (found := re.match(rb"G[01] .*E([\d.]+)", line)):
            e = found[1]
    return sent


@pytest.mark.parametrize("after", [0, 60])
@pytest.mark.parametrize("lift", ["", "G1 Z6 E{6} F600\n"])
def test_an_object_that_octoprint_skips_leaves_absolute_filament_right(
    pipeline: Pipeline, machine: Machine, after: int, lift: str
) -> None:
    """From its beginning, or from the middle of a stream on, in a file that is a metre in."""
    figure = f"@Object {{0}}\n{lift}G1 X{{1}} Y{{1}} F6000\nG1 E{{2}} F2400\n"
    figure += "G1 X{3} E{4} F3600\nG1 Y{3} E{5}\n"
    text = "@Object z\n" + HEAD.replace("M83", "M82\nG92 E1000")
    text += figure.format("a", 80, 1001, 100, 1002, 1003, 1000.5)
    text += figure.format("b", 120, 1004, 150, 1005, 1006, 1003.5) + "G28 X\n"
    lines = check(pipeline, text)
    sent = b"\n".join(cancelling(lines, b"a", after=after)) + b"\n"
    moves = [b.moves for b in Interpreter(machine).push(sent)]
    assert max(np.abs(m.end_mm - m.start_mm)[:, 3].max() for m in moves if len(m)) <= 1.001


@pytest.mark.parametrize("height", ["", "G1 Z.3\n"])
def test_a_height_that_the_file_leaves_alone_is_not_named(pipeline: Pipeline, height: str) -> None:
    """Off the grid, or unknown after a start macro: naming it would drive the nozzle there."""
    text = (
        "START_PRINT\nG90\nM83\n" + height + "G1 X50 Y50 F6000\n"
        "SET_GCODE_OFFSET Z_ADJUST=0.009174993 MOVE=1 MOVE_SPEED=5\n"
        "G1 X80 Y50 E1 F6000\nG1 X80 Y90 E1\nG1 E-1 F2100\nG1 X50 F6000\nG1 E1 F2100\nM400\n"
    )
    lines = check(pipeline, text)
    assert any(line.startswith(b"; stillpath: stream on") for line in lines)
    named = [line for line in lines if re.match(rb"G1 .*Z", line)]
    assert [line.split(b" ;#")[0] for line in named] == height.encode().splitlines()
