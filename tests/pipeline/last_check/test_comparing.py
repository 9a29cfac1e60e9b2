"""Written files that are good pass the last check, and damage in one place does not."""

from __future__ import annotations

import io
import pickle
import random
import re
from pathlib import Path

import pytest

from stillpath.cli.main import run
from stillpath.gcode.firmware.registry import adapter
from stillpath.gcode.firmware.writing import StreamWriter
from stillpath.gcode.pieces import VerbatimPart
from stillpath.models.machine import Machine
from stillpath.models.store import load_machine
from stillpath.pipeline.compensate import compensate_file
from stillpath.pipeline.last_check.comparing import LastCheck
from stillpath.pipeline.last_check.errors import LastCheckError
from stillpath.pipeline.options import Options
from stillpath.pipeline.result import LastCheckFigures
from stillpath.service.jobs.problems import problem_of
from tests.compensating import compensated
from tests.fuzz.machines import machine_of

ROOT = Path(__file__).parents[3]
EXAMPLES = sorted((ROOT / "examples").glob("*.gcode"))
PRINT = """\
; a small print
G28
G90
M82
G92 E0
G1 X50 Y50 Z0.2 F6000
;LAYER:0
G1 X90 E1 F3000
G1 Y90 E2
M106 S100
G1 X50 E3
G1 Y50 E4
M204 S700
G1 E3.2 F2100
G1 Z0.6 F720
G1 X70 Y60 F9000
G1 Z0.2 F720
G1 E4 F2100
G1 X90 E5 F3000
M105
G1 Y80 E6
G92 E0
G1 X60 E1
G4 P100
M83
G1 Y60 E1
M73 P50 R1
G1 X80 Y70 E1
G91
G1 Z1
G90
G1 X55 Y55 E.5
M117 bye
G1 X50 Y52 E.1
G1 E-1 F2100
M140 S0
"""
MODES = (b"M82\n", b"M83\n", b"G90\n", b"G91\n")
KINDS = ("klipper", "marlin", "reprapfirmware")


def check(
    original: bytes, written: bytes, machine: Machine, part: int = 1 << 20
) -> LastCheckFigures:
    firmware = adapter(machine)
    checked = LastCheck(
        io.BytesIO(),
        io.BytesIO(original),
        machine,
        firmware.step_mm,
        2.0 * firmware.shortest_move_mm,
    )
    for start in range(0, len(written), part):
        checked.write(written[start : start + part])
    return checked.finish()


@pytest.fixture(scope="module", params=KINDS)
def good(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory, cache: Path
) -> tuple[Machine, bytes]:
    """A machine, and what the print becomes for it."""
    machine = machine_of(request.param)
    folder = tmp_path_factory.mktemp(request.param)
    folder.mkdir(exist_ok=True)
    _, written = compensated(PRINT, folder, cache, machine, method="shaper:mzv")
    assert written.count(b"stream on") >= 2
    return machine, written


def test_a_good_file_passes_in_parts_of_any_size(good: tuple[Machine, bytes]) -> None:
    machine, written = good
    whole = check(PRINT.encode(), written, machine)
    assert whole.kept_lines > 15
    assert whole.compared_lines > 7
    for part in (1, 7, 1000):
        assert check(PRINT.encode(), written, machine, part) == whole


def own_lines(written: bytes) -> list[int]:
    """Indices of lines of the original in the written file: those that are not of ours."""
    original = {line for line in PRINT.encode().splitlines() if line[:1] != b";"}
    return [k for k, line in enumerate(written.splitlines()) if line in original]


def test_every_line_of_the_original_is_missed(good: tuple[Machine, bytes]) -> None:
    machine, written = good
    lines = written.splitlines(keepends=True)
    kept = own_lines(written)
    assert len(kept) > 15
    for k in kept:
        if lines[k] in (b"G90\n", b"M83\n", b"M82\n", b"G92 E0\n"):
            continue  # ours may be the same line at the same place
        if lines[k] == b"G1 X50 Y50 Z0.2 F6000\n":
            continue  # it comes from where nobody knows: perhaps a stream stands for it
        with pytest.raises(LastCheckError, match=r"line \d+ of the original"):
            check(PRINT.encode(), b"".join(lines[:k] + lines[k + 1 :]), machine)


def damaged(lines: list[bytes], k: int, how: str) -> bytes | None:
    """Return the file with damage in one line, where it means something; None: it does not."""
    line = lines[k]
    words = dict(re.findall(rb"([XYZEF])(-?[\d.]+)", line))
    letter = how[:1].encode()
    if how == "twice":
        if line != b"G1 E-1 F2100\n":
            return None  # absolute words say the same twice
        return b"".join([*lines[: k + 1], *lines[k:]])
    if how == "M83":
        changed = {b"M82\n": b"M83\n", b"M83\n": b"M82\n", b"G90\n": b"G91\n"}.get(line)
    elif letter in words and re.match(rb"G1 |G92 ", line) and not line.startswith(b"G92 X"):
        value = float(words[letter]) + (300.0 if how == "F" else 0.5)
        changed = re.sub(letter + rb"-?[\d.]+", letter + b"%.5f" % value, line, count=1)
    else:
        changed = None
    return None if changed is None else b"".join([*lines[:k], changed, *lines[k + 1 :]])


def test_damage_of_our_own_lines_is_found(good: tuple[Machine, bytes]) -> None:
    """Filament of every line counts; of places the last before the file's own lines go on."""
    machine, written = good
    lines = written.splitlines(keepends=True)
    kept = set(own_lines(written))
    ours = [k for k in range(len(lines)) if k not in kept and lines[k].startswith(b"G1 ")]
    found = 0
    for k in random.Random(3).sample(ours, 80):
        bad = damaged(lines, k, "E")
        if bad is not None:
            found += 1
            with pytest.raises(LastCheckError, match="filament fed is"):
                check(PRINT.encode(), bad, machine)
    assert found > 20
    ends = [k for k in range(len(lines)) if lines[k].startswith(b"; stillpath: stream off")]
    for letter in "XY":
        at = max(k for k in ours if k < ends[0] and b" %c" % ord(letter) in lines[k])
        bad = damaged(lines, at, letter)
        assert bad is not None
        with pytest.raises(LastCheckError, match=r"[xy] is .* mm, in the original .* differ by"):
            check(PRINT.encode(), bad, machine)


@pytest.mark.parametrize("how", ["Z", "E", "F", "twice"])
def test_damage_of_shared_lines_is_found(good: tuple[Machine, bytes], how: str) -> None:
    machine, written = good
    lines = written.splitlines(keepends=True)
    made = [damaged(lines, k, how) for k in own_lines(written)]
    for bad in made:
        if bad is not None:
            with pytest.raises(LastCheckError):
                check(PRINT.encode(), bad, machine)
    assert sum(bad is not None for bad in made) > 0


def test_wrong_modes_are_found(good: tuple[Machine, bytes]) -> None:
    machine, written = good
    lines = written.splitlines(keepends=True)
    found, harmless = 0, 0
    for k in range(len(lines)):
        bad = damaged(lines, k, "M83")
        if bad is None:
            continue
        try:
            check(PRINT.encode(), bad, machine)
        except LastCheckError:
            found += 1
        else:
            harmless += 1
            until = next((n for n in range(k + 1, len(lines)) if lines[n] in MODES), len(lines))
            depends = b" E" if lines[k] in MODES[:2] else b" "
            assert lines[k] in lines[k + 1 : until + 1] or not any(
                depends in line for line in lines[k + 1 : until] if line.startswith(b"G1 ")
            )
    assert found >= 5
    assert harmless <= found


def test_a_file_that_ends_too_early_is_found(good: tuple[Machine, bytes]) -> None:
    machine, written = good
    end = written.rindex(b"M140 S0")
    with pytest.raises(LastCheckError, match=r"missing \('M140 S0'\)"):
        check(PRINT.encode(), written[:end], machine)
    with pytest.raises(LastCheckError, match=r"G1 X1 Y1.*the end of the file"):
        check(PRINT.encode(), written + b"G1 X1 Y1\n", machine)


def test_what_it_cannot_follow_is_said(tmp_path: Path, cache: Path) -> None:
    text = PRINT.replace("M117 bye\n", "PARK_SOMEWHERE\nG1 E.1\nG1 Y52 E.1\n")
    result, _ = compensated(text, tmp_path, cache, machine_of("klipper"), method="shaper:mzv")
    assert result.last_check is not None
    homing, parking = result.last_check.not_compared
    assert homing.startswith("from line 2 up to line")
    assert "filament and modes only" in homing
    assert "(G28)" in homing
    assert "(PARK_SOMEWHERE)" in parking


@pytest.mark.parametrize("kind", KINDS)
def test_many_streams_without_a_line_that_stays(kind: str, tmp_path: Path, cache: Path) -> None:
    """After each stream the same moves come again, and nothing but their number tells them."""
    square = "G1 X70 Y50 E1\nG1 Y70 E1\nG1 X50 E1\nG1 Y50 E1\n"
    parts = f"; STILLPATH_OFF\n{square}; STILLPATH_ON\n{square}"
    data = ("G28\nM83\nG90\nG1 X50 Y50 Z.2 F6000\n" + 5 * parts).encode()
    machine = machine_of(kind)
    result, written = compensated(data, tmp_path, cache, machine, method="shaper:mzv")
    assert written.count(b"; stillpath: stream off") >= 5
    assert result.last_check is not None
    assert result.last_check.compared_lines >= 20
    end = written.rindex(b"; stillpath: stream off, line")
    line = written.index(b"G1 X70 Y50 E1\n", end) if kind == "klipper" else end
    twice = written[:line] + b"G1 X70 Y50 E1\n" + written[line:]
    with pytest.raises(LastCheckError):
        check(data, twice, machine)


@pytest.mark.parametrize(("path", "kind"), list(zip(EXAMPLES, KINDS, strict=True)), ids=KINDS)
def test_examples_pass(path: Path, kind: str, tmp_path: Path, cache: Path) -> None:
    data = b"".join(path.read_bytes().splitlines(keepends=True)[:1500])
    result, written = compensated(data, tmp_path, cache, machine_of(kind), method="shaper:mzv")
    assert result.last_check is not None
    assert result.last_check.kept_lines > 20
    assert result.last_check.compared_lines > 1
    assert check(data, written, machine_of(kind)) == result.last_check


def test_a_file_with_a_fault_is_not_delivered(
    tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A fault of the writer that nothing else would see: it loses a line of the file."""
    whole = StreamWriter.verbatim

    def faulty(self: StreamWriter, verbatim: VerbatimPart, extruder_mm: float) -> bytes:
        return whole(self, verbatim, extruder_mm).replace(b"M140 S0\n", b"")

    monkeypatch.setattr(StreamWriter, "verbatim", faulty)
    source, target = tmp_path / "in.gcode", tmp_path / "out.gcode"
    source.write_bytes(PRINT.encode())
    target.write_bytes(b"kept")
    with pytest.raises(LastCheckError) as caught:
        compensate_file(source, target, load_machine("ender3"), Options(), cache_dir=cache)
    assert "please report it with the file, and print the original" in str(caught.value)
    assert target.read_bytes() == b"kept"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in.gcode", "out.gcode"]

    caught.value.stream_line = 7
    again = pickle.loads(pickle.dumps(caught.value))
    assert again.stream_line == 7
    told = problem_of(again)
    assert (told["status"], told["title"]) == (500, "The last check failed")
    assert told["detail"] == str(caught.value)
    assert told["line"] == PRINT.count("\n")

    command = ["compensate", str(source), "-o", str(target), "--machine", "ender3"]
    assert run(command) == 1
    assert "stillpath: error: the last check refuses" in capsys.readouterr().err
    assert target.read_bytes() == b"kept"


BLANKS = """\
G28
M83
G1 X60 Y145 Z0.28 F5000 ;to the side \t
G1 X60 Y20 F1500 E12 ;a line\x20
G1 Z2 F3000 ;Move Z up\x20
G1 E-1 F1800 \t
G1 X80 Y20 F6000
G1 X80 Y60 E2
"""
RETRACTED = """\
G28
M82
G1 X117.575 Y125.912 E118.67659 F1500
G1 X117.495 Y126.33 E118.69074
G10 X117.425 Y125.912 E118.69352
G1 X117.498 Y125.015 E118.69934
G1 X115.557 Y124.761 E118.76445
G1 X115.396 Y125.644 E118.7943
G1 X114.774 Y124.437 E118.84481
G1 X114.277 Y124.231 E3.4
G1 X113.745 Y124.01 E118.88186
"""
SLOW_FLOW = """\
M82
M221 S0.001
G1 X121.614 Y122.875 E320.84525
G1 X120.976 Y123.519 E320.81484
G1 X121.778 Y121.56 E320.89035
G0 X118.639 Y120.626
G0 X118.878 Y120.807
G1 F1800 X118.606 Y121.167 E320.665
M105
G1 X118.38 Y122.034 E320.69506
"""
OUR_OWN_F = """\
M83
G1 X115.552 Y116.6 E.00452\rM204 S800
G1 X133.932 Y100.66 E1.24601
G1 X133.932 Y100.66 E1.24601
G1M204 S600
G1 F1500
G1 X89.282 Y114.409 E.63564
"""
OUR_OWN_LIMITS = """\
G28 G90
G0 F9000 X111.255 Y116.123
G0 F9000 X111.255 Y116.123
M205 J.013 B20000
G0 X112.28 Y115.529 G0 X112.28 Y115.529 M900 K.05
T0\rG1 X117.217 Y118.922 E159.26582
"""
UNKNOWN_BEFORE = """\
M83
RESTORE_GCODE_STATE NAME=s MOVE=1 MOVE_SPEED=50
G1 X100 Y100.0 E0.01021
G90
G01 X100.068 Y101.409 E0.00734
M400
G01 X100.0
G01 X100 E0.18624
G1X113.806Y101.6E0.35175F1800
G01E0.00349
G3 X101.2 Y101.10904 I0.674 J0.278 E.05
"""
EXPRESSION = """\
G1 X2.121 Y2.121
G1 X1.928 Y2.298
{global.x}
G1
G1 X-0.261 Y2.989
G1 X-0.521 Y2.954 G1 X-0.776 Y2.898
"""
NO_TEXT = """\
M83
G1 X100 Y100 F3000
G1 X110 Y100 E.5
M118 P0 said G1 X105
G1 X110 Y100 E.5
G1 X110 Y110 E.5
M117 "said" G1 X105
G1 X110 Y110 E.5
G1 X110 Y100 E.5
"""
ODD_SHAPER = """\
M82
GM593 P"none"
G28
G1 X60 Y50 F6000
G1 X80 Y60 E1 F3000
M11
G1 X70 Y80 E2
"""
REPEATED = (
    "G28\nM83\nG1 X138 Y110 F2400\nG1 X127.478 Y120.501 E.51697\nG1 X127.478 Y120.501 E.516=7\n"
    + 3 * ("G1 X138.727 Y109.816 E.5085\n" + 3 * "G1 X127.478 Y120.501 E.51697\n")
    + "M105\n"
)

SHORT = (
    "G28\nM83\nG1 X100 Y100 F2400\nG1 X104 Y100 E.1\nG1 X104 Y104 E.1\n"
    "G1 X104 Y104.001 E.00003\nG1 X103.999 Y104.002 E.00004\nG1 X103.999 Y104.002 E.00004\n"
    "G1 X103.998 Y104.002 E.00004\nG1 X103.995 Y104 E.00017\nG1 X103 Y103.6 E.03\nG1 X98 E.1\n"
    "M105\n"
)

FILAMENT = """\
G28
G90
M83
G1 X100 Y100 Z1 F6000
G1 X99.946 Y98 F1800
g1X99.924Y99.80280E0.16935
G1Y100.900E0.01378
G1 Y101 E0.04448
G1 X99.085 Y99.926
G21 ; said
G1 X99.770 Y100.02734 E0.03980 F18000
N11 G1 X100.932 Y99 E0.03921 F6000
M83
N13 G91
SAVE_GCODE_STATE NAME=s
g1X98.93533
G0 X100.84841 Y100.046 E0.11527 F600
G92 X10 Y10
G3 X99.89373 Y89.5 R0.100 E.05
G1 X99.596 Y100.04945
M82
G1 X100.18970 Y71.9 E-0.67651
G1 X101.0 F6000
G0 X0.0000001 F6000
G3 X99.555 Y100.0 I0.542 J-0.915 E.05
M204 P1 T1
G1X101.65129Y99.972
G01X100.0Y99.965E0.36068F30
G01 X99.581 Y98.75430 F1800
M220 S80
; TYPE:External perimeter
g1 X97 Y101.022 E0.43523
G1X100.64044Y102.24233E-0.31294
; LAYER_CHANGE
"""

SUBCODE = """\
G28
G90
M82
G1 X50 Y50 F6000
G1 X90 E1
G0.837 E0.5
G1 Y90 E2
G1 X50 E3
"""
CONDITION = SUBCODE.replace("G0.837 E0.5", "if {x}\n G1 F7200") + "G1 Y50 E4\n"


LIFTED = """\
M204 S3000
G1 X{0} Y100 F9000
G1 Z.2
G1 E.75 F1800
M204 S1000
G1 X{1} Y100 E.5 F2400
G1 X{1} Y{2} E.005
M204 S3000
G1 E-.75 F3000
G1 Z.6 F18000
"""
LIFTED_AGAIN = (
    "G28\nM83\nG1 Z.2 F6000\nG1 X90 Y100\nG1 E-.75 F3000\nG1 Z.6\n"
    + "".join(LIFTED.format(100 + 5 * k, 110 + 5 * k, y) for y in (100.1, 104) for k in range(3))
    + "G1 X50 Y50\nM105\n"
)


FEED_AFTER_REPEATED = """\
G28
M82
G1 X50 Y50 Z.2 F6000
G1 X50.01 Y50 E1
G1 X50.01 Y50 E1
G1 F1500
G1 X70 Y60 E2
M105
"""

FILAMENT_AFTER_REPEATED = """\
G28
M82
G1 X50 Y50 Z.2 F6000
G1 X50 Y50.005 F6000
G1 X50 Y50
G1 X50.01 Y50 E5
G1 X50 Y50 E6
G1 X50 Y50
G1 X60 Y80 E8
G1 X60 Y80 E9
G1 X50 Y50 E10
M105
"""

LAYER_AGAIN = (
    "G28\nM82\nG92 E0\nG1 Z.2 F600\n"
    + "".join(
        f"G1 Z{z} F600\nG1 X100 Y100 F9000\nG1 X115 Y100 E{10 * z + 1} F6000\n"
        f"G1 X115 Y115 E{10 * z + 1.5}\nG1 X100 Y115 E{10 * z + 2}\nG1 X100 Y100 E{10 * z + 2.5}\n"
        for z in (0.2, 0.4, 0.6)
    )
    + "G92 E0\nM84\n"
)


@pytest.mark.parametrize(
    ("kind", "text"),
    [
        # A layer begins with a move to where the head stands already.
        pytest.param("klipper", LAYER_AGAIN, id="layer again"),
        # A retraction is the one waited for, though those before it might have moved X and Y.
        pytest.param("marlin", LIFTED_AGAIN, id="lifted again"),
        # Filament is counted anew at a line between two streams.
        pytest.param("marlin", FILAMENT, id="filament"),
        # A line that stands still moves what the short one before it left.
        pytest.param("marlin", SHORT, id="short"),
        # F or filament alone, after lines of one text of which nobody knows which moved.
        pytest.param("marlin", FEED_AFTER_REPEATED, id="F after repeated"),
        pytest.param("marlin", FEED_AFTER_REPEATED.replace("G1 F", "G0 F"), id="F of G0"),
        pytest.param("marlin", FILAMENT_AFTER_REPEATED, id="filament after repeated"),
        # Several lines of one text, and nobody knows which of them moved.
        pytest.param("marlin", REPEATED, id="repeated"),
        # G10 retracts, whatever words it has: they say nothing of where E is.
        pytest.param("marlin", RETRACTED, id="words of G10"),
        # What E says is a hundred thousand times what is fed.
        pytest.param("reprapfirmware", SLOW_FLOW, id="slow flow"),
        # Repeated as the file's own line for the shaper.
        pytest.param("reprapfirmware", ODD_SHAPER, id="odd shaper"),
        # What follows a text moves too.
        pytest.param("reprapfirmware", NO_TEXT, id="no text"),
        # Lines of the file with the text of ours, after others of which nobody knows.
        pytest.param("klipper", OUR_OWN_F, id="our own F"),
        pytest.param("klipper", OUR_OWN_LIMITS, id="our own limits"),
        pytest.param("reprapfirmware", EXPRESSION, id="expression"),
        # What was fed is known before a line that stands still, but not since when.
        pytest.param("marlin", UNKNOWN_BEFORE, id="unknown before"),
        # Marlin passes over the point and what is after it: this retracts.
        pytest.param("marlin", SUBCODE, id="subcode"),
        # Nobody knows which speed it is afterwards.
        pytest.param("reprapfirmware", CONDITION, id="condition"),
        # Profiles have blanks behind the comments of their start code.
        pytest.param("klipper", BLANKS, id="blanks"),
        pytest.param("marlin", BLANKS, id="blanks in Marlin"),
    ],
)
def test_what_files_of_chance_found(kind: str, text: str, tmp_path: Path, cache: Path) -> None:
    result, _ = compensated(text, tmp_path, cache, machine_of(kind), method="shaper:mzv")
    assert not any("internal error" in piece.reason for piece in result.put_back)
    assert result.pieces > len(result.put_back)
    assert result.last_check is not None
    assert result.last_check.kept_lines > 2
