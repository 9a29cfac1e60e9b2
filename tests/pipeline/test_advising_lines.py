"""Lines of advice among any lines, and the shaper that they set: without a pipeline."""

from __future__ import annotations

import io

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stillpath.compensation.shapers import shape, shaper_pulses
from stillpath.gcode.errors import GcodeError
from stillpath.gcode.firmware.registry import adapter
from stillpath.gcode.interpreter import Interpreter
from stillpath.gcode.types import EventKind, Limits, Moves
from stillpath.models.firmware import Klipper, Marlin, RepRapFirmware
from stillpath.models.firmware.marlin import MarlinShaper
from stillpath.models.machine import Machine
from stillpath.models.schedule import EMPTY
from stillpath.models.shaping import OFF, AxisShaper, Shaping
from stillpath.models.store import load_machine
from stillpath.pipeline.advising.advice import Advice, Bound
from stillpath.pipeline.advising.inserting import MARK, AdviceWriter, write_advised
from stillpath.pipeline.advising.messages import shaper_warnings
from stillpath.pipeline.advising.removing import remove_advice
from stillpath.pipeline.measuring.points import MotionSamples
from stillpath.pipeline.shaping import ShapedMotion

OURS = Shaping(AxisShaper("zv", 41.0), AxisShaper("zv", 31.0))
ADVICE = Advice(
    {0: Bound(2400.0, 2400.0), 1: Bound(3100.0)},
    [(-1, OURS), (2, Shaping(AxisShaper("zv", 41.0), AxisShaper("zv", 30.0)))],
)

LINES = st.sampled_from(
    [
        *(";TYPE:External perimeter", ";TYPE:Perimeter", ";TYPE:Bridge infill", ";LAYER_CHANGE"),
        *("M204 S900", "SET_VELOCITY_LIMIT ACCEL=5200"),
        *("SET_VELOCITY_LIMIT SQUARE_CORNER_VELOCITY=7", "SET_INPUT_SHAPER SHAPER_FREQ_X=50"),
        *("MACRO", "G4 P10", "G92 E0", "; a remark", "", "G1 X10 Y10 E1 F3000", "G1 X20 Y15 E1"),
        *("G1 X15 E1", "G1 X50 Y50 F9000", "G1 Z.6", "G1 E-.8"),
    ]
)


def klipper() -> Machine:
    """A Klipper machine that knows no shaper of its own."""
    return load_machine("ender3")


def written(data: bytes, machine: Machine, advice: Advice) -> bytes:
    reader, firmware = Interpreter(machine), adapter(machine)
    adviser = firmware.adviser(reader.dialect)
    writer = AdviceWriter(adviser, advice, reader.feature_names, firmware.initial_limits(), "test")
    out = io.BytesIO()
    write_advised(io.BytesIO(data), out, reader, writer)
    return out.getvalue()


def printed(data: bytes, machine: Machine) -> list[tuple[str, int, Limits, Shaping]]:
    """Feature, layer, limits and shaper of every move that prints, as the firmware reads it."""
    reader = Interpreter(machine)
    adviser = adapter(machine).adviser(reader.dialect)
    shaping, found = Shaping(), []
    for block in [*reader.push(data), *reader.flush()]:
        rows: list[tuple[int, bool, int]] = []
        events, moves = block.events, block.moves
        rows += [(int(b), False, k) for k, b in enumerate(events.byte_start)]
        rows += [(int(b), True, k) for k, b in enumerate(moves.byte_start)]
        for start, is_move, k in sorted(rows):
            if is_move:
                way = moves.end_mm[k] - moves.start_mm[k]
                if np.any(way[:2] != 0.0) and way[3] > 0.0:
                    name = reader.feature_names[moves.feature[k]] if moves.feature[k] >= 0 else ""
                    limits = block.limits[moves.limits_id[k]]
                    found.append((name, int(moves.layer[k]), limits, shaping))
            elif events.kind[k] == EventKind.SHAPER:
                at = start - block.text_offset
                line = block.text[at : int(events.byte_end[k]) - block.text_offset].decode()
                shaping = adviser.read_shaper(line, shaping)
    return found


@settings(max_examples=25)
@given(lines=st.lists(LINES, max_size=40), ends=st.sampled_from(["", "\n", "\r\n"]))
def test_any_file(lines: list[str], ends: str) -> None:
    machine = klipper()
    data = ("\n".join(["G28", "M83", "G1 X5 Y5 E1 F600", *lines]) + ends).encode()
    out = written(data, machine, ADVICE)
    assert b"".join(x for x in out.splitlines(keepends=True) if MARK not in x) == data
    before, after = printed(data, machine), printed(out, machine)
    assert len(before) == len(after)
    # What stands in a line without an end cannot have ours after it; it is the last one.
    whole = len(after) if ends else len(after) - 1
    reader = Interpreter(machine)
    reader.push(data)
    reader.flush()
    names = reader.feature_names
    for own, ours in zip(before[:whole], after[:whole], strict=True):
        name, layer, limits, _ = own
        bound = ADVICE.bounds.get(names.index(name)) if name and layer >= 1 else None
        wanted = bound.of(limits.accel_mm_s2) if bound else limits.accel_mm_s2
        assert ours[2].accel_mm_s2 == wanted
        assert ours[2].square_corner_velocity_mm_s == limits.square_corner_velocity_mm_s
        assert ours[3] == OURS or (layer >= 2 and ours[3] in [s for _, s in ADVICE.shapers])


def test_every_firmwares_words_are_read_as_they_are_written() -> None:
    base = klipper()
    found = {}
    fixed_time = [Marlin(ft_motion=True, ft_motion_version=version) for version in (1, 2)]
    for firmware in (Klipper(), *fixed_time, Marlin(), RepRapFirmware()):
        machine = base.model_copy(update={"firmware": firmware})
        firmware_adapter = adapter(machine)
        adviser = firmware_adapter.adviser(Interpreter(machine).dialect)
        for kind in adviser.shapers:
            x = AxisShaper(kind, 41.5)
            wanted = Shaping(x, x if adviser.same_for_both else AxisShaper(kind, 30.2, 0.05))
            read = Shaping()
            for line in adviser.shaper_lines(wanted):
                read = adviser.read_shaper(line.decode() + " ; stillpath advise", read)
            assert read == wanted
        lines = adviser.accel_lines(2345.0)
        assert any(adviser.sets_accel(line.decode()) for line in lines)
        limits = firmware_adapter.initial_limits()
        block = Interpreter(machine).push(b"\n".join([*lines, b"G1 X10 F600", b""]))[-1]
        now = block.limits[block.moves.limits_id[-1]]
        assert now == adviser.with_accel(limits, 2345.0)
        found[firmware.kind, adviser.shapers] = True
    assert len(found) == 4


def test_a_smoother_is_set_by_its_own_frequency() -> None:
    """Kalico's pass over SHAPER_FREQ, also where the machine's own is set again."""
    machine = klipper()
    adviser = adapter(machine).adviser(Interpreter(machine).dialect)
    wanted = Shaping(AxisShaper("smooth_ei", 61.5), AxisShaper("mzv", 40.0))
    (line,) = adviser.shaper_lines(wanted)
    assert line.count(b"SMOOTHER_FREQ") == line.count(b" SMOOTHER_FREQ_X=61.5 ") == 1
    read = line.decode().replace(" SHAPER_FREQ_X=61.5", " SHAPER_FREQ_X=50")
    assert adviser.read_shaper(read, Shaping()) == wanted


def test_a_build_that_shapes_x_alone_keeps_the_line_of_x() -> None:
    """It passes over the Y of M593, and takes that line for X."""
    firmware = Marlin(shaper=MarlinShaper(freq_x_hz=40.0))
    machine = klipper().model_copy(update={"firmware": firmware})
    adviser = adapter(machine).adviser(Interpreter(machine).dialect)
    wanted = Shaping(AxisShaper("zv", 44.4), AxisShaper("zv", 31.3, 0.05))
    assert adviser.shaper_lines(wanted) == (b"M593 Y F31.3 D0.05", b"M593 X F44.4 D0.1")


@pytest.mark.parametrize(
    ("version", "lines", "own"),
    [
        (1, [b"M493 X8 Y5 A44.4 B31.3 I0.1 J0.05"], "M493 S1 X1 Y1 A37 B38 I.2"),
        (
            2,
            [b"M493 X C8 A44.4 I0.1", b"M493 Y C5 A31.3 I0.05"],
            "M493 S1 XY C1 A37 I.2\nM493 Y A38 I.1",
        ),
    ],
)
def test_m493_of_both_versions(version: int, lines: list[bytes], own: str) -> None:
    firmware = Marlin(ft_motion=True, ft_motion_version=version)
    machine = klipper().model_copy(update={"firmware": firmware})
    adviser = adapter(machine).adviser(Interpreter(machine).dialect)
    wanted = Shaping(AxisShaper("mzv", 44.4), AxisShaper("ei", 31.3, 0.05))
    assert list(adviser.shaper_lines(wanted)) == lines
    found = wanted
    for line in own.split("\n"):
        found = adviser.read_shaper(line, found)
    y_damping = {1: 0.05, 2: 0.1}[version]
    assert found == Shaping(AxisShaper("zv", 37.0, 0.2), AxisShaper("zv", 38.0, y_damping))


def test_m593_of_a_buddy_names_the_type() -> None:
    """T is the type, and F0 or Z leaves the others; all of them were read as ZV of both axes."""
    machine = klipper().model_copy(update={"firmware": Marlin(variant="prusa")})
    adviser = adapter(machine).adviser(Interpreter(machine).dialect)
    found = OFF
    for line in ("M593 X T3 F60", "M593 Y F40.6 D.05", "M593 Z F30"):
        found = adviser.read_shaper(line, found)
    assert found == Shaping(AxisShaper("ei", 60.0), AxisShaper("mzv", 40.6, 0.05))
    assert adviser.read_shaper("M593 X T1 F50", found).unknown_types == ["zvd"]
    assert not adviser.read_shaper("M593 T2 F0", found).is_on


def test_a_shaper_that_nobody_stated_is_warned_of() -> None:
    """A Buddy has its own, and the figures of its file were those of a printer with none."""
    said = shaper_warnings([], none_known=True, stated=False, left=False)
    assert "rings less than these figures" in said[-1]
    assert len(shaper_warnings([], none_known=True, stated=True, left=False)) == 1


@pytest.mark.parametrize("kind", ["zv", "ei", "3hump_ei"])
def test_twin_of_the_shapers_stream(kind: str) -> None:
    rng = np.random.default_rng(3)
    steps = np.zeros((2, 3000))
    steps[:, 300:2500] = rng.normal(size=(2, 2200))
    path = np.cumsum(steps, axis=1)
    shaping = Shaping(AxisShaper(kind, 44.4), AxisShaper("mzv", 31.3))
    stream, found = ShapedMotion(1e-3), []
    for first, last in ((0, 1), (1, 700), (700, 2000), (2000, 3000)):
        found += [s for s, _ in stream.push(motion(path[:, first:last]), shaping, EMPTY)]
    found += [s for s, _ in stream.flush()]
    command = np.concatenate([s.executed_mm for s in found], axis=1)
    wanted = [
        shape(row, 1e-3, shaper_pulses(s.type, s.f_hz, s.damping))
        for row, s in zip(path, (shaping.x, shaping.y), strict=True)
    ]
    np.testing.assert_allclose(command, wanted, atol=1e-9)
    np.testing.assert_array_equal(np.concatenate([s.path_mm for s in found], axis=1), path)


def test_without_a_shaper_the_command_is_the_path() -> None:
    path = np.random.default_rng(1).normal(size=(2, 500))
    stream = ShapedMotion(1e-3)
    parts = [*stream.push(motion(path), Shaping(), EMPTY), *stream.flush()]
    np.testing.assert_array_equal(np.concatenate([s.executed_mm for s, _ in parts], axis=1), path)


def motion(path: np.ndarray) -> MotionSamples:
    n = path.shape[1]
    none = np.zeros(0)
    moves = Moves(*[none] * len(Moves.__dataclass_fields__))
    return MotionSamples(path, path, np.zeros(n), np.zeros(n, bool), np.zeros(n, np.int64), moves)


@pytest.mark.parametrize(
    ("own", "left"),
    [
        ("", True),
        ("SET_INPUT_SHAPER SHAPER_TYPE_X=ei SHAPER_FREQ_X=44", True),
        ("SET_INPUT_SHAPER SHAPER_FREQ_X=44 SHAPER_FREQ_Y=40", True),
        ("SET_INPUT_SHAPER SHAPER_TYPE=ei SHAPER_FREQ_X=44 SHAPER_FREQ_Y=40", False),
    ],
)
def test_a_shaper_that_nobody_can_put_back(own: str, left: bool) -> None:
    machine = klipper()
    reader, firmware = Interpreter(machine), adapter(machine)
    adviser, names = firmware.adviser(reader.dialect), reader.feature_names
    writer = AdviceWriter(adviser, ADVICE, names, firmware.initial_limits(), "test")
    for block in reader.push(f"M83\n{own}\nG1 X5 E1 F600\n".encode()):
        writer.block(block)
    assert (own.encode() in writer.end(), writer.shaper_left) == (True, left)


def test_nothing_is_quicker_where_the_file_says_off() -> None:
    head = b"M83\nM204 S900\n;LAYER_CHANGE\n;LAYER_CHANGE\n;TYPE:Perimeter\n"
    off = b"; STILLPATH_OFF\nG1 X50 F9000\n; STILLPATH_ON\n"
    data = head + b"G1 X5 E1 F600\n" + off + b"G1 X70\nG1 X90 E1\n"
    out = written(data, klipper(), Advice({0: Bound(2400.0)}))
    accel, found = 0.0, {}
    for line in out.split(b"\n"):
        if b"ACCEL=" in line:
            accel = float(line.split(b"ACCEL=")[1].split()[0])
        found[line] = accel
    assert found[b"G1 X50 F9000"] == 900.0
    assert found[b"G1 X5 E1 F600"] == found[b"G1 X90 E1"] == 2400.0


def test_an_object_may_be_left_out_with_all_its_lines() -> None:
    machine = klipper().model_copy(update={"firmware": Marlin(variant="bambu")})
    adviser = adapter(machine).adviser(Interpreter(machine).dialect)
    head = "M83\nM204 P900\n;LAYER_CHANGE\n;LAYER_CHANGE\n;TYPE:Outer wall\n"
    data = head + "".join(f"M624 {k}\nG1 X{k} E1 F600\nM625\n" for k in (1, 2, 3))
    out = written(data.encode(), machine, Advice({0: Bound(2400.0, 2400.0)})).decode()
    for k in (1, 2, 3):
        before, rest = out.split(f"M624 {k}\n")
        skipped = before + rest.split("M625\n", 1)[1]
        found = printed(skipped.encode(), machine)
        assert [adviser.accel_mm_s2(limits) for _, _, limits, _ in found] == [2400.0, 2400.0]


def test_lines_with_several_commands() -> None:
    machine = klipper().model_copy(update={"firmware": RepRapFirmware()})
    ours = Shaping(AxisShaper("mzv", 41.0), AxisShaper("mzv", 41.0))
    head = b"M83\n;LAYER_CHANGE\n;LAYER_CHANGE\n;TYPE:External perimeter\nG1 X5 E1 F600\n"
    lines = [
        b"M572 D0 S0.04",
        b"M204 P500 M572 D0 S0.05",
        b"M204 P500 M400",
        b"G1 X20 M204 P700",
        b"M204 P700 M106 S1",
        b"M593 F40 G1 X50",
    ]
    data = head + b"".join(line + b"\nG1 X%d E1\n" % k for k, line in enumerate(lines))
    out = written(data, machine, Advice({0: Bound(2400.0, 2400.0)}, [(-1, ours)]))
    moves = printed(out, machine)
    assert len(moves) == 1 + len(lines)
    adviser = adapter(machine).adviser(Interpreter(machine).dialect)
    assert {adviser.accel_mm_s2(limits) for _, _, limits, _ in moves} == {2400.0}
    # Of what the file sets only the shaper comes back, no move and no pressure advance.
    behind = [x for x in out.splitlines() if b"own shaper" in x]
    assert [x.split(b" ;")[0] for x in behind] == [b'M593 P"none"', b"M593 F40"]


ENDS = st.sampled_from([b"\n", b"\r\n", b"\n\r\n", b"\r", b""])
TEXTS = st.one_of(
    LINES.map(str.encode),
    st.sampled_from(
        [
            *(b";TYPE:External perimeter \xb5m", b"; stillpath"),
            *(b"; advised by hand: ; Stillpath Advise", b"M117 50% ; stillpath", b"\xff\xfe\x00"),
            *(b"\t ", b"N7 G1 X12 E1*99", b"T1", b"M500"),
            *(b"G1 X30 E1 ; \xe2\x80\xa8 a line separator", b"G1 X31\x0bE1\x0c"),
        ]
    ),
    st.binary(max_size=12),
)


@settings(max_examples=25)
@given(
    begun=st.sampled_from([b"", b"\xef\xbb\xbf", b"\r\n", b";FLAVOR:Marlin\r\n"]),
    parts=st.lists(st.tuples(TEXTS, ENDS), max_size=25),
    firmware=st.sampled_from(
        [Klipper(), Marlin(shaper=MarlinShaper(freq_x_hz=40.0)), RepRapFirmware()]
    ),
)
def test_any_bytes_come_back(
    tmp_path_factory: pytest.TempPathFactory,
    begun: bytes,
    parts: list[tuple[bytes, bytes]],
    firmware: Klipper | Marlin | RepRapFirmware,
) -> None:
    data = begun + b"".join(text + end for text, end in [(b"M83", b"\n"), *parts])
    machine = klipper().model_copy(update={"firmware": firmware})
    try:
        out = written(data, machine, ADVICE)
    except GcodeError:
        return
    folder = tmp_path_factory.getbasetemp()
    source, target = folder / "advised.gcode", folder / "restored.gcode"
    source.write_bytes(out)
    assert remove_advice(source, target) == out.count(MARK)
    assert target.read_bytes() == data


@pytest.mark.parametrize("fixed_time", [False, True])
def test_nothing_of_ours_is_stored_for_good(fixed_time: bool) -> None:
    stated = MarlinShaper(freq_x_hz=40.0, freq_y_hz=35.0)
    machine = klipper().model_copy(update={"firmware": Marlin(shaper=stated, ft_motion=fixed_time)})
    own = "M493 C1 A44 I.1" if fixed_time else "M593 X F44"
    head = f"M83\nM204 P900\n{own}\n;LAYER_CHANGE\n;LAYER_CHANGE\n;TYPE:External perimeter\n"
    data = head + "G1 X5 E1 F600\nN3 M500*33\nG1 X20 E1\n"
    out = written(data.encode(), machine, Advice({0: Bound(2400.0, 2400.0)}, [(-1, OURS)])).decode()
    assert out.count("M500") == 1
    before, behind = out.split("N3 M500*33\n")
    adviser = adapter(machine).adviser(Interpreter(machine).dialect)
    shaping = adviser.stated or OFF
    for line in before.splitlines():
        shaping = adviser.read_shaper(line, shaping)
    hertz = (44.0, 44.0) if fixed_time else (44.0, 35.0)
    assert (shaping.x.f_hz, shaping.y.f_hz) == hertz
    accels = [x.split(" ;")[0] for x in before.splitlines() if x.startswith("M204 P")]
    assert accels == ["M204 P900", "M204 P2400", "M204 P900"]
    assert behind.startswith(adviser.shaper_lines(OURS)[0].decode())
    assert "M204 P2400" in behind
