"""Marlin's stream: vertices that it executes, rates that land on time, and its words."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stillpath.gcode.firmware.encoding import as_moves
from stillpath.gcode.firmware.marlin import encoder
from stillpath.gcode.firmware.marlin._encoder_kernels import (
    Blocks,
    assign_rates,
    bend_reversals,
    thin,
)
from stillpath.gcode.firmware.marlin.adapter import STEEPEST_MESH, MarlinAdapter
from stillpath.gcode.firmware.marlin.limits import MarlinLimits, initial_limits
from stillpath.gcode.firmware.marlin.planner import Planner
from stillpath.gcode.firmware.marlin.stream_commands import MarlinStreamCommands
from stillpath.gcode.firmware.marlin.stream_limits import stream_limits
from stillpath.gcode.firmware.planning import join_phases
from stillpath.gcode.firmware.vertices import Lattice, vertices_on_steps
from stillpath.gcode.interpreter import Interpreter
from stillpath.gcode.segments import Segments
from stillpath.gcode.timeline import Timeline
from stillpath.models.firmware import Marlin
from stillpath.models.firmware.marlin import MarlinPlanner, MarlinShaper, PerAxis
from stillpath.models.machine import CommandLimits, Machine
from stillpath.models.store import load_machine
from stillpath.pipeline.compensated_piece import deviation
from tests.compensating import compensated
from tests.gcode.cutting import HEAD, MARLIN_PLANNER
from tests.gcode.cutting import compensated as compensated_piece
from tests.gcode.prints import polygon
from tests.gcode.states import differences, tagged

FIRMWARE = Marlin(
    min_steps_per_segment=1,
    steps_per_mm=PerAxis(x=160.0, y=160.0, z=400.0, e=400.0),
    planner=MARLIN_PLANNER,
)


def with_firmware(firmware: Marlin = FIRMWARE) -> Machine:
    return load_machine("ender3").model_copy(update={"firmware": firmware})


# Vertices


def thinned(x: list[int], end_s: list[float], **options: Any) -> list[bool]:
    n = len(x)
    steps = np.column_stack((x, np.zeros(n), np.zeros(n))).astype(np.int64)
    given = {"least": 6, "room": np.zeros(n), "rate": 1e6, "burst": 8.0, "corexy": False, **options}
    keep = np.zeros(n, np.bool_)
    begin, group = np.zeros((1, 3), np.int64), np.zeros(n, np.int64)
    thin(steps, begin, np.array(end_s), np.zeros(1), group, *given.values(), keep)
    return keep.tolist()


def test_short_hops_wait_for_more_steps() -> None:
    # 4 steps are too few; 8 from the start will do; of the end's 3 the vertex before goes.
    assert thinned([4, 8, 20, 23], [0.001, 0.002, 0.003, 0.004]) == [False, True, False, True]
    assert thinned([4, 8, 20, 23], [0.001, 0.002, 0.003, 0.004], least=1) == [True] * 4


def test_no_more_segments_than_come_in() -> None:
    # Two blocks in stock and a good 250 lines a second: the third waits until 5 ms, when
    # .25 + 3 * .25 have come in; then one in four; the last is always kept.
    times = [0.001 * k for k in range(1, 13)]
    keep = thinned([10 * k for k in range(1, 13)], times, least=1, rate=250.1, burst=2.0)
    assert np.flatnonzero(keep).tolist() == [0, 1, 4, 8, 11]


def test_fast_moves_are_long_enough_to_stop_within_the_queue() -> None:
    times = [0.001 * k for k in range(1, 13)]
    room = np.repeat([0.0, 25.0, 0.0], 4)
    keep = thinned([10 * k for k in range(1, 13)], times, room=room)
    # The sixth is only 20 steps from the fourth.
    assert np.flatnonzero(keep).tolist() == [0, 1, 2, 3, 6, 8, 9, 10, 11]


def test_a_turn_straight_back_gets_a_step_to_the_side() -> None:
    # Also across a vertex where nothing moves.
    steps = np.array([[10, 0, 0], [10, 0, 0], [2, 0, 0], [-5, 0, 0]], np.int64)
    wish = steps[:, :2] + np.array([0.0, -0.3])
    bend_reversals(steps, np.zeros((1, 3), np.int64), np.zeros(4, np.int64), wish, 1, False)
    assert steps[:, 0].tolist() == [10, 10, 2, -5]
    assert steps[2, 1] == -1
    assert steps[3].tolist() == [-5, 0, 0]


def test_no_turn_is_bent_into_a_move_that_is_swallowed() -> None:
    # Back along X, then 6 steps along Y: a step towards them would leave 5.
    steps = np.array([[20, 0, 0], [8, 0, 0], [8, 6, 0], [30, 6, 0]], np.int64)
    for least, y in ((1, 1), (6, -1)):
        bent, group = steps.copy(), np.zeros(4, np.int64)
        bend_reversals(bent, np.zeros((1, 3), np.int64), group, steps[:, :2] + 0.2, least, False)
        assert bent[1].tolist() == [8, y, 0]


# Rates


@given(st.integers(0, 2**32 - 1), st.sampled_from([80.0, 160.0]), st.sampled_from([1.0, 2.0]))
@settings(max_examples=40)
def test_rates_reach_the_ends_in_time(seed: int, per_mm: float, first_steps: float) -> None:
    rng = np.random.default_rng(seed)
    n = 200
    planned_s = rng.uniform(1e-3, 8e-3, n)
    speed = 60.0 + 40.0 * np.sin(np.cumsum(rng.normal(0.0, 0.2, n)))
    steps = np.maximum(np.round(speed * planned_s * per_mm), 1.0)
    feedrate, predicted = np.zeros(n), np.zeros(n)
    ours, fastest, none = np.ones(n, np.bool_), np.full(n, 500.0), np.zeros(n)
    blocks = Blocks(ours, steps, steps / per_mm, np.cumsum(planned_s), planned_s, fastest, none)
    assign_rates(blocks, none, none, first_steps, 2e6, 0.0, 120.0, 1.0, 0.0, feedrate, predicted)
    late_s = np.cumsum(predicted)[5:] - np.cumsum(planned_s)[5:]
    # A block may end early by the share of a step, or of two, that the next one loses.
    assert np.all(late_s < 1.5e-4)
    assert np.all(late_s * speed[5:] * per_mm > -2.5 * first_steps)
    rate = feedrate / 60.0 * per_mm
    # The firmware rounds up: nothing that is written lies on a whole rate.
    assert np.all(np.abs(rate - np.round(rate)) > 0.1)


def test_what_a_stand_is_too_short_is_made_up_for() -> None:
    """No step takes longer than 1/120 s, whatever feedrate is written; the next segment waits."""
    steps, planned_s = np.array([20.0, 1.0, 20.0, 20.0]), np.array([2e-3, 50e-3, 2e-3, 2e-3])
    feedrate, predicted = np.zeros(4), np.zeros(4)
    ours, free = np.ones(4, np.bool_), np.zeros(4)
    ends_s = np.cumsum(planned_s)
    per_mm, fastest = 80.0, np.full(4, 500.0)
    blocks = Blocks(ours, steps, steps / per_mm, ends_s, planned_s, fastest, fastest)
    assign_rates(blocks, free, free, 1.0, 2e6, 0.0, 120.0, 1.0, 0.0, feedrate, predicted)
    assert predicted[1] == pytest.approx(1 / 120.0, rel=1e-3)
    assert np.sum(predicted) == pytest.approx(ends_s[-1], abs=1e-4)


@pytest.mark.parametrize(("variant", "first_steps"), [("2.0", 2.0), ("2.1", 1.0)])
def test_with_classic_jerk_fast_moves_start_as_slowly_as_the_one_before(
    variant: Any, first_steps: float
) -> None:
    """Only below the jerk a move starts at its own speed; above it, it was thought to, too."""
    n, per_mm, jerk = 200, 80.0, 19.0
    planned_s = np.full(n, 4e-3)
    speed = np.linspace(80.0, 10.0, n) * (1.0 + 0.2 * np.sin(np.arange(n) * 1.1))
    steps = np.round(speed * planned_s * per_mm)
    feedrate, predicted, none = np.zeros(n), np.zeros(n), np.zeros(n)
    ours, fastest = np.ones(n, np.bool_), np.full(n, 500.0)
    ends_s = np.cumsum(planned_s)
    at_once = np.full(n, jerk)
    blocks = Blocks(ours, steps, steps / per_mm, ends_s, planned_s, fastest, at_once)
    assign_rates(blocks, none, none, first_steps, 2e6, 0.0, 120.0, 1.0, 0.0, feedrate, predicted)
    firmware = FIRMWARE.model_copy(update={"variant": variant, "junction": "classic_jerk"})
    firmware = firmware.model_copy(update={"min_steps_per_segment": 1})
    limits = {"accel_x_mm_s2": 20_000.0, "travel_accel_mm_s2": 20_000.0, "jerk_x_mm_s": jerk}
    table = [replace(initial_limits(firmware), min_segment_time_us=0.0, **limits)]
    x_mm = np.append(0.0, np.cumsum(steps)) / per_mm
    places_mm = np.column_stack([x_mm, np.zeros((n + 1, 3))])
    moves = as_moves(places_mm[:-1], places_mm[1:], feedrate / 60.0, np.zeros(n, np.int32))
    planner = Planner(firmware)
    phases = join_phases([planner.push_moves(moves, table), planner.flush()])
    late_s = np.cumsum(phases.lasts_s - planned_s)
    # Before it was 2.9 and 4.6 ms.
    assert np.abs(late_s[1:-1] - late_s[1]).max() < 1.3e-3 * first_steps


FAST = "G1 X200 Y190 E6 F15000\nG1 X20 Y150 E6\nG1 X190 Y20 E6\nG1 X60 Y200 E6\n"


def without_room(name: str) -> Machine:
    """The motors bear no more than the printer asks of one axis."""
    accel = PerAxis(x=5000.0, y=5000.0, z=200.0, e=5000.0)
    planner = MARLIN_PLANNER.model_copy(
        update={"max_accel_mm_s2": accel, "accel_mm_s2": 5000.0, "travel_accel_mm_s2": 5000.0}
    )
    firmware = FIRMWARE.model_copy(
        update={"planner": planner, "steps_per_mm": PerAxis(x=80.0, y=80.0, z=400.0, e=400.0)}
    )
    command = CommandLimits(accel_mm_s2=5000.0)
    return load_machine(name).model_copy(update={"firmware": firmware, "command": command})


@pytest.mark.parametrize("name", ["ender3", "voron-v24-250"])
def test_a_late_piece_has_what_x_and_y_bear_together(name: str) -> None:
    """M204 as one axis's limit left each only sqrt(1/2) of it on a diagonal: millimetres late."""
    _, made = compensated_piece(HEAD + FAST, without_room(name))
    assert np.max(deviation(made, made.encoded.phases)) < 0.07
    for limits in made.encoded.limits:
        assert isinstance(limits, MarlinLimits)
        along_x = min(limits.accel_x_mm_s2, limits.travel_accel_mm_s2)
        if name == "ender3":  # an axis keeps its own
            assert along_x <= 5000.0
        else:  # and a motor of a CoreXY what it makes where the head has that along a diagonal
            assert limits.travel_accel_mm_s2 == 5000.0
            assert limits.accel_x_mm_s2 <= 5000.0 * 2**0.5 * (1 + 1e-9)


def test_a_late_piece_is_searched_for_vertices_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each attempt to be on time repeated the search, with the same result."""
    searched: list[tuple[Segments, float]] = []

    def watched(lattice: Lattice, timeline: Timeline, segments: Segments) -> Segments:
        searched.append((segments, lattice.fast_accel_mm_s2))
        return vertices_on_steps(lattice, timeline, segments)

    monkeypatch.setattr(encoder, "vertices_on_steps", watched)
    compensated_piece(HEAD + FAST, without_room("ender3"))
    assert len({(id(segments), accel) for segments, accel in searched}) == len(searched) > 0


# Words


def test_limits_of_a_stream() -> None:
    own = initial_limits(FIRMWARE)
    stream = stream_limits(own, CommandLimits())
    assert stream.min_segment_time_us == 0.0
    assert stream.retract_accel_mm_s2 == own.retract_accel_mm_s2
    assert stream.advance_in_filament == 0.0
    lines = MarlinStreamCommands(FIRMWARE).limits(stream).decode().splitlines()
    assert lines == [
        "M201 X20000 Y20000 Z200 E300000",
        "M203 X525 Y525 Z20 E200",
        "M204 P20000 R500 T20000",
        "M205 B0 S0 T0 J0.01",
    ]
    assert all(len(line) < 96 for line in lines)
    classic = MarlinStreamCommands(Marlin(junction="classic_jerk")).limits(stream).decode()
    assert classic.splitlines()[3] == "M205 B0 S0 T0 X19.09 Y19.09 Z0.3 E100"


def test_the_shaper_of_the_firmware() -> None:
    shaper = MarlinShaper(freq_x_hz=40.0, freq_y_hz=35.5)
    stream_commands = MarlinStreamCommands(Marlin(shaper=shaper))
    assert stream_commands.shaper_off == b"M593 F0\n"
    assert stream_commands.shaper_on == b"M593 X F40 D0.15\nM593 Y F35.5 D0.15\n"
    # A build without INPUT_SHAPING_Y takes the line of Y for X.
    alone = MarlinStreamCommands(Marlin(shaper=MarlinShaper(freq_x_hz=40.0)))
    assert alone.shaper_on == b"M593 Y F0 D0.15\nM593 X F40 D0.15\n"
    for none in (Marlin(variant="2.0"), Marlin(shaper=MarlinShaper())):
        assert (MarlinStreamCommands(none).shaper_off, MarlinStreamCommands(none).shaper_on) == (
            b"",
            b"",
        )
    # Nobody says whether there is one: off it goes, and the pipeline warns.
    unknown = MarlinStreamCommands(Marlin())
    assert unknown.acceleration(1e6) == b"M204 P1000000 T1000000\n"
    assert (unknown.shaper_off, unknown.shaper_on) == (b"M593 F0\n", None)


@pytest.mark.parametrize(
    ("facts", "says"),
    [
        ({"variant": "bambu"}, "closed"),
        ({"variant": "prusa"}, "HWLIMIT"),
        ({"variant": "bugfix"}, "2.1.2"),
        ({"ft_motion": True}, "M493 S0"),
        ({"board": "avr"}, "8-bit"),
        ({"block_buffer_size": 4}, "BLOCK_BUFFER_SIZE 8 or more"),
        ({"min_steps_per_segment": 20}, "MIN_STEPS_PER_SEGMENT 1"),
        (
            {"min_steps_per_segment": 6, "steps_per_mm": PerAxis(x=160, y=40, z=400, e=93)},
            "below 6 steps (150 um)",
        ),
        ({"planner": MarlinPlanner(junction_deviation_mm=0.005)}, "M205 J takes 0.01 to 0.3 mm"),
    ],
)
def test_what_cannot_be_executed_is_refused(facts: dict[str, Any], says: str) -> None:
    firmware = FIRMWARE.model_copy(update=facts)
    refusal = MarlinAdapter(with_firmware(firmware), firmware).refusal
    assert refusal is not None
    assert says in refusal
    assert "method advise" in refusal


def test_the_document_says_how_steep_a_bed_mesh_may_be() -> None:
    document = (Path(__file__).parents[2] / "docs" / "marlin.md").read_text()
    assert f"a bed mesh steeper than {STEEPEST_MESH:g} " in document


def test_the_coarser_axis_says_what_is_swallowed() -> None:
    coarse_y = {"min_steps_per_segment": 6, "steps_per_mm": PerAxis(x=160, y=80, z=400, e=93)}
    notes = MarlinStreamCommands(FIRMWARE.model_copy(update=coarse_y)).notes
    assert any("6 steps (75 um)" in note for note in notes)


@pytest.mark.parametrize("per_mm", [80.0, 160.0])
def test_a_stock_machine_can(per_mm: float) -> None:
    """With the 6 steps that nearly every configuration has, which is our default too."""
    assert Marlin().min_steps_per_segment == 6
    facts = {"min_steps_per_segment": 6, "steps_per_mm": PerAxis(x=per_mm, y=per_mm, z=400, e=93)}
    stock = FIRMWARE.model_copy(update=facts)
    curved = stock.model_copy(update={"s_curve": True})
    for firmware in (FIRMWARE, stock, curved):
        assert MarlinAdapter(with_firmware(firmware), firmware).refusal is None


# The pipeline


PRINT = HEAD + "G1 X120 Y100 F6000\n" + "\n".join(polygon(6, 15)) + "\nG1 E-1 F2100\nG28 X\n"


def test_a_print_is_compensated_and_its_limits_come_back(tmp_path: Path, cache: Path) -> None:
    firmware = FIRMWARE.model_copy(update={"home_mm": (0.0, 0.0, 0.0)})
    machine = with_firmware(firmware)
    result, text = compensated("M204 P1500 T1800\n" + PRINT, tmp_path, cache, machine)
    assert result.pieces > 0
    assert result.put_back == []
    assert b"M205 B0" in text
    interpreter = Interpreter(machine)
    blocks = [*interpreter.push(text), *interpreter.flush()]
    last = blocks[-1].limits[int(blocks[-1].events.limits_id[-1])].as_row()
    assert last[8:11] == (1500.0, 500.0, 1800.0)
    assert last[:8] == initial_limits(firmware).as_row()[:8]
    assert last[15:17] == (0.02, 20_000.0)


def test_fast_travels_of_a_slow_machine_are_in_time(tmp_path: Path, cache: Path) -> None:
    """M204 P500: moves were too short to stop within the queue, and first ones held up the next."""
    facts = {"home_mm": (0.0, 0.0, 0.0), "min_steps_per_segment": 6}
    stock = FIRMWARE.model_copy(update={**facts, "steps_per_mm": PerAxis(x=80, y=80, z=400, e=93)})
    command = CommandLimits(accel_mm_s2=1500.0)
    machine = with_firmware(stock).model_copy(update={"command": command})
    walls = "\n".join(
        f"G1 X{x} Y{y} F9000\nG1 E1 F2400\nG1 X{x + 5} E.165 F1200\nG1 Y{y + 5} E.165\nG1 E-1 F2400"
        for x, y in ((60, 60), (150, 70), (80, 150), (160, 160)) * 2
    )
    text = "M201 X500 Y500\nM204 P500 T500\n" + HEAD + walls + "\nG28 X\n"
    result, _ = compensated(text, tmp_path, cache, machine)
    assert result.put_back == []
    assert result.emission_max_um < 60.0


def test_a_machine_that_times_parts_of_steps_is_compensated(tmp_path: Path, cache: Path) -> None:
    """ADAPTIVE_STEP_SMOOTHING: rates are coarser by it, which had half the file reverted."""
    facts = {"home_mm": (0.0, 0.0, 0.0), "step_smoothing_hz": 120_000.0}
    machine = with_firmware(FIRMWARE.model_copy(update=facts))
    result, _ = compensated(PRINT, tmp_path, cache, machine)
    assert result.pieces > 0
    assert result.put_back == []
    assert result.emission_max_um < 20.0


@pytest.mark.slow
@pytest.mark.parametrize("stated", [True, None])
def test_linear_advance_is_off_in_the_stream_and_on_again_after_it(
    tmp_path: Path, cache: Path, stated: bool | None
) -> None:
    """Whether the machine says that it has it or only the file does, and where it repeats K."""
    half = len(HEAD + "G1 X120 Y100 F6000\n" + "\n".join(polygon(6, 15)[:3])) + 1
    original = f"M900 K0.05\n{PRINT[:half]}M900 K0.05\n{PRINT[half:]}"
    facts = {"home_mm": (0.0, 0.0, 0.0), "linear_advance": stated}
    machine = with_firmware(FIRMWARE.model_copy(update=facts))
    result, text = compensated(original, tmp_path, cache, machine)
    assert result.pieces > 0
    assert result.put_back == []
    lines = text.decode().splitlines()
    on, off = (
        next(i for i, line in enumerate(lines) if line.startswith(f"; stillpath: stream {word}"))
        for word in ("on", "off")
    )
    known = [(i, line) for i, line in enumerate(lines) if line.startswith("M900")]
    assert known[0][1] == "M900 K0.05"
    assert lines.count("; stillpath, held back: M900 K0.05") == 1
    assert {line for i, line in known if on < i < off - 8} == {"M900 K0"}
    assert next(line for i, line in known if i >= off - 8) == "M900 K0.05"
    fed = [Interpreter(machine).push(original.encode()), Interpreter(machine).push(text)]
    ends = [[b.moves.end_mm[-1, 3] for b in blocks if len(b.moves)][-1] for blocks in fed]
    assert ends[1] == pytest.approx(ends[0], abs=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["M82", "M83"])
def test_far_from_zero_no_filament_is_lost(tmp_path: Path, cache: Path, mode: str) -> None:
    """Marlin adds up E in single precision: nine metres out a stream would lose a percent."""
    lines, e = [f"{mode}\nG92 E9000\nG1 X120 Y100 F6000"], 9000.0
    for k, line in enumerate(polygon(24, 20) * 3):
        place, _, fed = line.partition(" E")
        e += float(fed.split()[0])
        lines.append(f"{place} E{e:.5f} F3600" if mode == "M82" else line)
        if k % 24 == 20:
            back, on = (f"{e - 1:.5f}", f"{e:.5f}") if mode == "M82" else ("-1", "1")
            lines += [f"G1 E{back} F2100", "G1 Z5.4 F600", "G1 Z5 F600", f"G1 E{on} F2100"]
    original = tagged((HEAD + "\n".join(lines) + "\nM221 S90\nM400\nG1 X50 Y50 F6000\n").encode())
    machine = with_firmware(FIRMWARE.model_copy(update={"home_mm": (0.0, 0.0, 0.0)}))
    result, written = compensated(original, tmp_path, cache, machine, method="shaper:mzv")
    assert result.put_back == []
    assert differences(original, written, machine) == []
    lost_mm, furthest_mm, reads_mm = in_single_precision(written)
    assert abs(lost_mm) < 1e-4
    assert furthest_mm < 30.0
    assert reads_mm == pytest.approx(e, abs=2e-3)


def in_single_precision(text: bytes) -> tuple[float, float, float]:
    """What relative moves of a stream lose as floats add up, how far out, what E reads at last."""
    at, relative, lost, furthest = np.float32(0.0), False, 0.0, 0.0
    for line in text.decode().splitlines():
        name, *words = line.split(";")[0].split() or [""]
        relative = name == "M83" or (relative and name not in ("M82", "G90"))
        for word in words:
            if word[0] != "E" or name not in ("G1", "G92"):
                continue
            value = np.float32(word[1:])
            if name == "G92" or not relative:
                at = value
                continue
            if ";#" not in line:
                furthest = max(furthest, abs(float(at)))
                lost += float(np.float32(at + value)) - float(at) - float(word[1:])
            at = np.float32(at + value)
    return lost, furthest, float(at)


@pytest.mark.parametrize("value", [1e-9, 2.5e-5, 0.4, 3000.0])
def test_limits_are_written_as_marlin_reads_them(value: float) -> None:
    """Seen by fuzzing: Marlin reads `1e-09` as 1."""
    own = replace(initial_limits(FIRMWARE), feedrate_x_mm_s=value)
    reader = Interpreter(with_firmware())
    (block,) = reader.push(MarlinStreamCommands(FIRMWARE).limits(own) + b"G28\n") + reader.flush()
    found = block.limits[-1]
    assert isinstance(found, MarlinLimits)
    assert found.feedrate_x_mm_s == value
