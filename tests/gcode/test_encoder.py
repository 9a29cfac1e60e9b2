"""Encoding read back: the firmware's plan of the written moves against the command."""

from __future__ import annotations

import re
from decimal import Decimal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stillpath.gcode.firmware._encoding_kernels import lay_out
from stillpath.gcode.firmware._writing_kernels import format_moves
from stillpath.gcode.firmware.registry import adapter
from stillpath.gcode.pieces import Piece
from stillpath.models.machine import Machine
from stillpath.models.store import load_machine
from stillpath.pipeline.compensated_piece import CompensatedPiece, deviation
from stillpath.pipeline.measuring.reference_shaper import BestShaper
from stillpath.pipeline.options import Options
from stillpath.pipeline.piece_compensator import PieceCompensator
from tests.gcode.cutting import HEAD, blocks_of, compensated, pieces_of

BODIES = {
    "corners": "G1 X80 Y60 E1 F6000\nG1 X60 Y80 E1\nG1 X60 Y60 E1\n",
    "slow corners": "G1 X61 Y51 E.04 F300\nG1 X60 Y51 E.04\nG1 X62 Y52 E.08 F600\nG1 X60 Y50 E.1\n",
    "retraction": (
        "G1 X90 Y60 E1 F6000\nG1 E-0.8 F2100\nG1 X20 Y20 F9000\nG1 E0.8\nG1 X50 E1 F3600\n"
    ),
    "hop": "G1 X90 E1 F6000\nG1 Z5.4 F600\nG1 X20 Y20 F9000\nG1 Z5\nG1 X50 E1 F3600\n",
    "hop and retraction": (
        "G1 X90 E1 F6000\nG1 E-0.8 F2100\nG1 Z5.4 F600\nG1 X20 Y20 F9000\nG1 Z5\nG1 E0.8 F2100\n"
        "G1 X50 E1 F3600\n"
    ),
    "wipe": (
        "G1 X90 E1 F3600\nG1 X85 E-.5 F7200\nG1 E-.3 F2100\nG1 X20 Y20 F9000\nG1 E.8\nG1 Y50 E1\n"
    ),
}


@pytest.fixture(scope="module")
def machine() -> Machine:
    return load_machine("ender3")


@pytest.fixture(scope="module")
def work(machine: Machine) -> PieceCompensator:
    return PieceCompensator(machine, Options(), BestShaper("mzv", 40.0, 40.0, 0.1, 0.0, 0.0))


def made(work: PieceCompensator, piece: Piece) -> CompensatedPiece:
    work.compensator.reset(piece.moves.start_mm[0, :2])
    return work.compensate(piece)


def test_reversals_in_a_row_are_on_time(machine: Machine) -> None:
    """A thin wall filled to and fro, by motors that can do little more than the file asks."""
    zigzag = "".join(
        f"G1 X{60 + 0.45 * k + 2.2 * (k % 2):.2f} Y{50 + 2.2 * (k % 2)} E.08 F6000\n"
        for k in range(1, 200)
    )
    command = machine.command.model_copy(update={"accel_mm_s2": 7500.0, "speed_step_mm_s": 30.0})
    firmware = machine.firmware
    assert firmware.kind == "klipper"
    planner = firmware.planner.model_copy(update={"max_accel_mm_s2": 5000.0})
    firmware = firmware.model_copy(update={"planner": planner})
    limited = machine.model_copy(update={"command": command, "firmware": firmware})
    _, written = compensated(HEAD + zigzag, limited)
    assert deviation(written, written.encoded.phases).max() < 12e-3


def test_a_stream_under_limits_that_a_firmware_caps(machine: Machine) -> None:
    """Written under a higher acceleration, it came late where the firmware did not take that."""
    firmware = machine.firmware.model_copy(update={"limits_capped": True})
    capped = machine.model_copy(update={"firmware": firmware})
    assert machine.command.accel_mm_s2 > firmware.largest_accel_mm_s2
    _, written = compensated(HEAD + "M204 S2000\n" + BODIES["corners"], capped)
    limits = adapter(capped).stream_limits(adapter(capped).initial_limits())
    line = adapter(capped).stream_commands().limits(limits)
    assert b"ACCEL=%g " % firmware.largest_accel_mm_s2 in line
    assert f"VELOCITY={firmware.fastest_mm_s:g} ".encode() in line
    assert deviation(written, written.encoded.phases).max() < 22e-3


@pytest.mark.parametrize("name", sorted(BODIES))
def test_executed_is_the_command(machine: Machine, work: PieceCompensator, name: str) -> None:
    piece = pieces_of(HEAD + BODIES[name], machine)[1]
    result = made(work, piece)
    encoded = result.encoded
    gap = deviation(result, encoded.phases)
    assert np.max(gap[result.extruding]) <= 10e-3
    assert np.max(gap) <= 55e-3
    assert np.mean(gap <= 6e-3) > 0.98
    # Time: the plan ends when the encoder says.
    p = encoded.phases
    executed_s = p.end_s[-1] - p.t_s[0]
    line = result.timeline
    expected_s = encoded.group_start_s[-1] + line.end_s[-1] - line.start_s[-1] - line.start_s[0]
    assert executed_s == pytest.approx(expected_s, abs=1e-3)
    # Filament and the last place are the original's.
    np.testing.assert_allclose(encoded.position[-1] * 1e-6, piece.moves.end_mm[-1], atol=1e-6)
    np.testing.assert_allclose(encoded.begin * 1e-6, piece.moves.start_mm[0], atol=1e-6)


@pytest.mark.parametrize("name", sorted(BODIES))
def test_rests_pass_as_they_came(machine: Machine, work: PieceCompensator, name: str) -> None:
    piece = pieces_of(HEAD + BODIES[name], machine)[1]
    encoded = made(work, piece).encoded
    for i in np.flatnonzero(encoded.row >= 0):
        before = encoded.position[i - 1] * 1e-6
        row = encoded.row[i]
        np.testing.assert_allclose(before, piece.moves.start_mm[row], atol=1.5e-6)
        np.testing.assert_allclose(encoded.position[i] * 1e-6, piece.moves.end_mm[row], atol=1.5e-6)
    own = np.flatnonzero(np.all(piece.moves.end_mm == piece.moves.start_mm, axis=1))
    assert len(own) == 0
    assert np.all(np.diff(encoded.start_s) > 0)
    assert np.all(encoded.feedrate_mm_min[encoded.row < 0] > 0)


# Twins


@settings(max_examples=60)
@given(seed=st.integers(0, 2**31), level=st.booleans())
def test_twin_of_lay_out(seed: int, level: bool) -> None:
    """Small steps on a coarse grid, so that many segments round to no motion."""
    rng = np.random.default_rng(seed)
    grid = np.array([3, 2, 2])
    groups = np.array([(0, 2, 0), (2, 3, 1), (3, 5, 1), (5, 6, 0), (6, 9, 0)])
    asked = np.cumsum(rng.integers(0, 3, (10, 4)) * (rng.random((10, 1)) < 0.6), axis=0)
    if level:
        asked[:, 2] = 7
    segment_group = np.repeat([0, 3, 4], rng.integers(0, 12, 3))
    n = len(segment_group)
    units = 2 * np.cumsum(rng.random((4, n)) * (rng.random(n) < 0.7), axis=1)
    end_s, start_s = np.cumsum(rng.random(n)), rng.random(5)
    room = n + 9
    row, group = np.empty((2, room), np.int64)
    position = np.empty((room, 4), np.int64)
    move_end_s, planned_s = np.empty((2, room))
    count = lay_out(
        units / 1e6,
        end_s,
        segment_group,
        groups,
        start_s,
        asked,
        grid,
        1e6,
        row,
        position,
        move_end_s,
        planned_s,
        group,
    )
    expected = laid_out(units, end_s, segment_group, groups, start_s, asked, grid)
    found = zip(row, position.tolist(), move_end_s, planned_s, group, strict=True)
    assert list(found)[:count] == expected


def laid_out(
    units: np.ndarray,
    end_s: np.ndarray,
    segment_group: np.ndarray,
    groups: np.ndarray,
    start_s: np.ndarray,
    asked: np.ndarray,
    grid: np.ndarray,
) -> list[tuple[int, list[int], float, float, int]]:
    """Rows (row, position, end, planned time, group) of the kernel, in plain words."""
    out = []
    for g, (first, last, rest) in enumerate(groups.tolist()):
        if rest:
            out += [(r, asked[r + 1].tolist(), 0.0, 0.0, g) for r in range(first, last)]
            continue
        ends = np.round(units[:, segment_group == g]).astype(np.int64).T
        ends[:, :3] = grid * np.round(ends[:, :3] / grid).astype(np.int64)
        ends[-1:] = asked[last]
        if np.all(asked[first : last + 1, 2] == asked[first, 2]):
            ends[:, 2] = asked[first, 2]
        kept: list[tuple[list[int], float]] = []
        at = asked[first].tolist()
        times = end_s[segment_group == g]
        for i, (end, time_s) in enumerate(zip(ends.tolist(), times, strict=True)):
            final = i + 1 == len(ends)
            if end[:3] != at[:3] or (final and not kept and end != at):
                kept.append((end, time_s))
                at = end
            elif final and kept:
                kept[-1] = ([*at[:3], end[3]], time_s)
        begins = [start_s[g], *(time_s for _, time_s in kept)]
        out += [(-1, end, t, t - b, g) for (end, t), b in zip(kept, begins, strict=False)]
    return out


@settings(max_examples=60)
@given(seed=st.integers(0, 2**31), n=st.integers(1, 40))
def test_written_numbers_read_back(machine: Machine, seed: int, n: int) -> None:
    """The text of the moves, read by the interpreter, has their positions, filament and F."""
    rng = np.random.default_rng(seed)
    xy = rng.integers(0, 300_000, (n, 2)) * 1000
    e = np.cumsum(rng.integers(-20_000, 60_000, n))
    position = np.column_stack([xy, np.full(n, 5_000_000), e]).astype(np.int64)
    begin = np.array([60_000_000, 50_000_000, 5_000_000, 0], np.int64)
    feedrate = np.round(rng.uniform(60, 20_000, n), 1)
    extrude, speed = np.full(n, 0.95), np.full(n, 0.8)
    origin = np.tile(np.array([1_500_000, -2_000_000, 0], np.int64), (n, 1))
    buffer, line_end = np.empty(n * 96 + 16, np.uint8), np.empty(n, np.int64)
    nothing = np.zeros(n + 1, bool)
    size = format_moves(
        position,
        begin,
        nothing[:n],
        nothing,
        feedrate,
        extrude,
        speed,
        origin,
        buffer,
        line_end,
        np.empty(n),
    )
    text = buffer[:size].tobytes()
    assert line_end[-1] == size
    assert text.count(b"\n") == n
    head = HEAD + "M221 S95\nM220 S80\nG92 X58.5 Y52\n"
    blocks = blocks_of(head.encode() + text, machine)
    moves = blocks[-1].moves
    np.testing.assert_allclose(moves.end_mm[-n:, :3], position[:, :3] * 1e-6, atol=1e-9)
    np.testing.assert_allclose(moves.end_mm[-n:, 3], e * 1e-6, atol=1e-5)
    np.testing.assert_allclose(moves.speed_mm_s[-n:], feedrate / 60, rtol=1e-6)


@pytest.mark.parametrize("top", [999, 10**6 + 1, 10**9, 10**14])
def test_numbers_are_written_as_python_does(top: int) -> None:
    """All digits but zeros after the last one that counts, and a zero before the point."""
    rng = np.random.default_rng(top)
    millionths = rng.integers(-top, top, 200) * rng.choice([1, 10, 1000], 200)
    n = len(millionths)
    position = np.zeros((n, 4), np.int64)
    position[:, 0] = millionths
    buffer, nothing = np.empty(n * 96 + 16, np.uint8), np.zeros(n + 1, bool)
    ones, origin = np.ones(n), np.zeros((n, 3), np.int64)
    begin = np.array([top * 10**4, 0, 0, 0])
    ends, extruded = np.empty(n, np.int64), np.empty(n)
    used = format_moves(
        position, begin, nothing[:n], nothing, ones, ones, ones, origin, buffer, ends, extruded
    )
    words = [line.split()[1] for line in buffer[:used].tobytes().decode().splitlines()]
    written = [f"{Decimal(int(m)) / 10**6:.6f}".rstrip("0").rstrip(".") for m in millionths]
    assert words == ["X" + re.sub(r"^(-?)0[.]", r"\1.", number) for number in written]


def test_stream_limits_are_the_machines(machine: Machine) -> None:
    firmware = adapter(machine)
    stream = firmware.stream_limits(firmware.initial_limits())
    diagonal = pytest.approx(2**0.5 * machine.command.velocity_mm_s)
    # 27 mm/s at a small angle, of the 45 that a motor's speed may step by within a ms.
    corner = pytest.approx(27.0 / 1.8203, abs=0.01)
    assert stream.as_row() == (diagonal, 20_000.0, corner, 0.0, 0.0)
