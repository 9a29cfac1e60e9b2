from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from stillpath.gcode.errors import GcodeError
from stillpath.gcode.firmware.encoding import as_moves
from stillpath.gcode.firmware.klipper.limits import KlipperLimits
from stillpath.gcode.firmware.klipper.planner import Planner
from stillpath.gcode.firmware.planning import join_phases
from stillpath.gcode.types import Moves, Phases, rows_of
from stillpath.models.firmware import Klipper
from stillpath.models.machine import Machine
from tests.gcode.cutting import blocks_of

FIRMWARE = Klipper()
LIMITS = [
    KlipperLimits(500.0, 5000.0, 5.0, 0.5),
    KlipperLimits(80.0, 1000.0, 8.0, 0.0),
    KlipperLimits(400.0, 3000.0, 5.0, 0.5, 1000.0),
    KlipperLimits(400.0, 500.0, 5.0, 0.5, 1000.0),
]


def moves_of(
    steps: NDArray[np.float64], speed: NDArray[np.float64], limits_id: NDArray[np.int64]
) -> Moves:
    points = np.vstack((np.zeros(4), np.cumsum(steps, axis=0)))
    return as_moves(points[:-1], points[1:], speed, limits_id.astype(np.int32))


def plan_moves(moves: Moves, limits: list[KlipperLimits], firmware: Klipper) -> Phases:
    planner = Planner(firmware)
    return join_phases([planner.push_moves(moves, limits), planner.flush()])


def duration(phases: Phases) -> float:
    return float(np.sum(phases.accel_s + phases.cruise_s + phases.decel_s))


def straight(*lengths: float, speed: float = 100.0) -> Moves:
    steps = np.zeros((len(lengths), 4))
    steps[:, 0] = lengths
    return moves_of(steps, np.full(len(lengths), speed), np.zeros(len(lengths), np.int64))


# By hand


def test_one_move_is_a_trapezoid() -> None:
    plan = plan_moves(straight(50.0), LIMITS, FIRMWARE)
    # 100 mm/s at 5000 mm/s2: 20 ms and 1 mm up, 48 mm level, the same down.
    assert [plan.accel_s[0], plan.cruise_s[0], plan.decel_s[0]] == pytest.approx([0.02, 0.48, 0.02])
    assert (plan.start_mm_s[0], plan.cruise_mm_s[0], plan.end_mm_s[0]) == (0, 100, 0)


def test_short_move_keeps_the_cruise_ratio() -> None:
    # With the ratio 0.5 the peak is that of half the acceleration: v2 = 2500 * 1.
    plan = plan_moves(straight(1.0, speed=400.0), LIMITS, FIRMWARE)
    assert plan.cruise_mm_s[0] == pytest.approx(50.0)
    assert plan.accel_s[0] == pytest.approx(0.01)
    assert plan.cruise_s[0] * 50.0 == pytest.approx(0.5)


def test_square_corner() -> None:
    steps = np.array([[20.0, 0, 0, 0], [0, 20.0, 0, 0]])
    plan = plan_moves(moves_of(steps, np.full(2, 100.0), np.zeros(2, np.int64)), LIMITS, FIRMWARE)
    assert plan.start_mm_s[1] == pytest.approx(5.0)


def test_extruder_corner_and_only_moves() -> None:
    steps = np.array([[20.0, 0, 0, 1.0], [20.0, 0, 0, 0], [0, 0, 0, -1.0], [20.0, 0, 0, 0]])
    plan = plan_moves(moves_of(steps, np.full(4, 60.0), np.zeros(4, np.int64)), LIMITS, FIRMWARE)
    assert plan.start_mm_s == pytest.approx([0, 20.0, 0, 0])  # 1 mm/s / 0.05
    assert plan.direction[2].tolist() == [0, 0, 0, -1]
    assert plan.accel_mm_s2[2] == 5000


def test_z_limits_slow_down_what_climbs() -> None:
    steps = np.array([[0, 0, 10.0, 0], [30.0, 0, 10.0, 0]])
    plan = plan_moves(moves_of(steps, np.full(2, 100.0), np.zeros(2, np.int64)), LIMITS, FIRMWARE)
    assert plan.accel_mm_s2 == pytest.approx([200, 200 * math.sqrt(10)])
    assert plan.cruise_mm_s[0] <= 20
    assert plan.cruise_mm_s[1] <= 20 * math.sqrt(10)


def test_extruder_refuses() -> None:
    steps = np.array([[20.0, 0, 0, 1.0], [0, 0, 0, 60.0]])
    with pytest.raises(GcodeError, match=r"60.000 mm.*50.000 mm") as caught:
        plan_moves(moves_of(steps, np.full(2, 60.0), np.zeros(2, np.int64)), LIMITS, FIRMWARE)
    assert caught.value.line == 2
    steps = np.array([[1.0, 0, 0, 1.0]])
    with pytest.raises(GcodeError, match=r"2.405 mm2.*0.640 mm2"):
        plan_moves(moves_of(steps, np.full(1, 60.0), np.zeros(1, np.int64)), LIMITS, FIRMWARE)
    with pytest.raises(GcodeError, match=r"line 1: .*speed is 0 mm/s.*correct its F"):
        plan_moves(moves_of(steps, np.zeros(1), np.zeros(1, np.int64)), LIMITS, FIRMWARE)


def test_stops_of_a_block(golden_machine: Machine) -> None:
    text = b"G28\nG1 X10 F6000\nM106\nG1 X20\nG4 P500\nG1 X30\nM400\nEXCLUDE_OBJECT_END\nG1 X40\n"
    (block,) = blocks_of(text, golden_machine)
    planner = Planner(golden_machine.firmware)
    plan = join_phases([planner.push(block), planner.flush()])
    assert plan.end_mm_s.tolist() == [100, 0, 0, 0]
    gaps = plan.t_s[1:] - (plan.t_s + plan.accel_s + plan.cruise_s + plan.decel_s)[:-1]
    assert gaps == pytest.approx([0, 0.5, 0])
    assert plan.move_index.tolist() == [0, 1, 2, 3]


def test_move_without_displacement_has_no_phase() -> None:
    plan = plan_moves(straight(5.0, 0.0, 5.0), LIMITS, FIRMWARE)
    assert plan.move_index.tolist() == [0, 2]
    assert plan.start_mm_s[1] == pytest.approx(100.0)


# The rules once more, in plain Python, from the description of the firmware


def twin(
    moves: Moves, limits: list[KlipperLimits], firmware: Klipper
) -> list[tuple[float, float, float]]:
    """Squared start, cruise and end speed of every move with a displacement."""
    planner, extruder = firmware.planner, firmware.extruder
    rows = []
    for start, end, speed, k in zip(
        moves.start_mm, moves.end_mm, moves.speed_mm_s, moves.limits_id, strict=True
    ):
        limit, step = limits[k], end - start
        path = math.sqrt(sum(v * v for v in step[:3]))
        kinematic = path >= 1e-9
        path = path if kinematic else abs(step[3])
        if path == 0:
            continue
        r = step * (1.0 / path) if kinematic else np.array([0, 0, 0, np.sign(step[3])])
        v, a = (min(speed, limit.velocity_mm_s), limit.accel_mm_s2) if kinematic else (speed, 1e8)
        smooth = limit.accel_mm_s2 * (1 - limit.minimum_cruise_ratio)
        if limit.accel_to_decel_mm_s2:
            smooth = min(limit.accel_mm_s2, limit.accel_to_decel_mm_s2)
        if kinematic and r[2]:
            v = min(v, planner.max_z_velocity_mm_s / abs(r[2]))
            a = min(a, planner.max_z_accel_mm_s2 / abs(r[2]))
        if r[3] and (not (r[0] or r[1]) or r[3] < 0):
            v = min(v, extruder.max_extrude_only_velocity_mm_s / abs(r[3]))
            a = min(a, extruder.max_extrude_only_accel_mm_s2 / abs(r[3]))
        deviation = limit.square_corner_velocity_mm_s**2 * (math.sqrt(2) - 1) / limit.accel_mm_s2
        row = {
            "v2": v * v, "a": a, "gain": 2 * path * a, "soft": 2 * path * min(smooth, a),
            "r": r, "jd": deviation, "kinematic": kinematic, "in": 0.0, "soft_in": 0.0,
        }  # fmt: skip
        if rows and kinematic and rows[-1]["kinematic"]:
            last = rows[-1]
            bound = [row["v2"], last["v2"], last["in"] + last["gain"]]
            if r[3] != last["r"][3]:
                bound.append(
                    (extruder.instantaneous_corner_velocity_mm_s / (r[3] - last["r"][3])) ** 2
                )
            cosine = -float(r[:3] @ last["r"][:3])
            half_sin = math.sqrt(max((1 - cosine) / 2, 0))
            half_cos = math.sqrt(max((1 + cosine) / 2, 0))
            if half_sin < 1 and half_cos > 0:
                for one in (row, last):
                    bound.append(half_sin / (1 - half_sin) * one["jd"] * one["a"])
                    bound.append(one["gain"] / 4 * half_sin / half_cos)
            row["in"] = min(bound)
            row["soft_in"] = min(row["in"], last["soft_in"] + last["soft"])
        rows.append(row)

    n = len(rows)
    start = [0.0] * (n + 1)
    soft = [0.0] * (n + 1)
    cruise: list[float | None] = [None] * n
    peak, waiting = 0.0, False
    for k in reversed(range(n)):
        row = rows[k]
        reach, soft_reach = start[k + 1] + row["gain"], soft[k + 1] + row["soft"]
        start[k], soft[k] = min(row["in"], reach), min(row["soft_in"], soft_reach)
        if soft[k] >= soft_reach:
            waiting = True  # cannot speed up: keeps the cruise speed of the move before
            continue
        if waiting or soft[k] + row["soft"] > soft[k + 1]:
            peak = (soft[k] + soft_reach) / 2
        cruise[k] = min((start[k] + reach) / 2, row["v2"], peak)
        waiting = False
    result, before = [], 0.0
    for k in range(n):
        own = cruise[k]
        before = min(before, start[k]) if own is None else own
        result.append((min(start[k], before), before, min(start[k + 1], before)))
    return result


LENGTH = st.one_of(st.floats(-30, 30), st.sampled_from([0.0, 1e-3, -0.02, 5.0]))
STEP = st.tuples(
    LENGTH,
    LENGTH,
    st.sampled_from([0.0, 0.0, 0.0, 0.2, -0.4]),
    st.sampled_from([0.0, 0.0, 0.001, 0.02, -0.5]),
)


@st.composite
def streams(draw: st.DrawFn) -> Moves:
    steps = draw(st.lists(STEP, min_size=1, max_size=40))
    n = len(steps)
    speed = draw(st.lists(st.sampled_from([3.0, 25.0, 60.0, 180.0, 700.0]), min_size=n, max_size=n))
    limits_id = draw(st.lists(st.integers(0, 3), min_size=n, max_size=n))
    return moves_of(np.array(steps), np.array(speed), np.array(limits_id))


thick = FIRMWARE.extruder.model_copy(update={"max_extrude_cross_section_mm2": 1e6})
TOLERANT = FIRMWARE.model_copy(update={"extruder": thick})


@settings(max_examples=60)
@given(streams())
def test_the_planner_agrees_with_plain_python(moves: Moves) -> None:
    plan = plan_moves(moves, LIMITS, TOLERANT)
    expected = np.array(twin(moves, LIMITS, TOLERANT)).reshape(-1, 3)
    got = np.column_stack((plan.start_mm_s, plan.cruise_mm_s, plan.end_mm_s)) ** 2
    # The last bits of the direction matter at a reversal, hence the loose bound in v^2.
    np.testing.assert_allclose(got, expected, rtol=1e-9, atol=1e-3)


@settings(max_examples=60)
@given(streams(), st.lists(st.integers(0, 40), max_size=8))
def test_streaming_is_one_shot(moves: Moves, cuts: list[int]) -> None:
    whole = plan_moves(moves, LIMITS, TOLERANT)
    planner = Planner(TOLERANT)
    bounds = [0, *sorted(min(cut, len(moves)) for cut in cuts), len(moves)]
    parts = [planner.push_moves(rows_of(moves, slice(a, b)), LIMITS) for a, b in pairwise(bounds)]
    plan = join_phases([*parts, planner.flush()])
    for name in Phases.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(plan, name), getattr(whole, name))
    assert planner.time_s == pytest.approx(duration(whole))


@settings(max_examples=60)
@given(streams())
def test_plan_is_sound(moves: Moves) -> None:
    plan = plan_moves(moves, LIMITS, TOLERANT)
    if len(plan) == 0:
        return
    up, level, down = plan.accel_s, plan.cruise_s, plan.decel_s
    assert min(up.min(), level.min(), down.min()) >= -1e-12
    np.testing.assert_allclose(np.diff(plan.t_s), (up + level + down)[:-1], rtol=0, atol=1e-9)
    # From rest to rest, without a step of the speed.
    assert plan.start_mm_s[0] == 0
    assert plan.end_mm_s[-1] == 0
    np.testing.assert_allclose(plan.end_mm_s[:-1], plan.start_mm_s[1:], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(plan.cruise_mm_s - plan.start_mm_s, plan.accel_mm_s2 * up, atol=1e-6)
    np.testing.assert_allclose(plan.cruise_mm_s - plan.end_mm_s, plan.accel_mm_s2 * down, atol=1e-6)
    # The phases cover the moves.
    path = (
        0.5 * (plan.start_mm_s + plan.cruise_mm_s) * up
        + plan.cruise_mm_s * level
        + 0.5 * (plan.end_mm_s + plan.cruise_mm_s) * down
    )
    step = (moves.end_mm - moves.start_mm)[plan.move_index]
    straight = np.sqrt(np.sum(step[:, :3] ** 2, axis=1)) >= 1e-9
    e_axis = plan.direction * path[:, None]
    np.testing.assert_allclose(e_axis[straight], step[straight], atol=1e-8)
    np.testing.assert_allclose(e_axis[~straight, 3], step[~straight, 3], atol=1e-8)
    # Limits.
    speed = moves.speed_mm_s[plan.move_index]
    assert np.all(plan.cruise_mm_s <= speed * (1 + 1e-12))
    planner, extruder = TOLERANT.planner, TOLERANT.extruder
    z = np.abs(plan.direction[:, 2])
    assert np.all(plan.cruise_mm_s * z <= planner.max_z_velocity_mm_s * (1 + 1e-9))
    assert np.all(plan.accel_mm_s2 * z <= planner.max_z_accel_mm_s2 * (1 + 1e-9))
    back = np.maximum(-plan.direction[:, 3], 0)
    limit = extruder.max_extrude_only_velocity_mm_s * (1 + 1e-9)
    assert np.all(plan.cruise_mm_s * back <= limit)


def test_long_stream_settles_as_it_goes() -> None:
    rng = np.random.default_rng(1)
    steps = np.zeros((50_000, 4))
    steps[:, :2] = rng.normal(0, 0.5, (len(steps), 2))
    moves = moves_of(steps, np.full(len(steps), 100.0), np.zeros(len(steps), np.int64))
    planner = Planner(FIRMWARE)
    waiting = 0
    settled = 0
    for a in range(0, len(moves), 500):
        settled += len(planner.push_moves(rows_of(moves, slice(a, a + 500)), LIMITS))
        waiting = max(waiting, a + 500 - settled)
    assert waiting < 600
    assert settled + len(planner.flush()) == len(moves)
