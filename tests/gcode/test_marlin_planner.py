"""Cases worked out by hand from Marlin's planner.cpp and stepper.cpp, with their arithmetic."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from stillpath.gcode.errors import GcodeError
from stillpath.gcode.firmware.encoding import as_moves
from stillpath.gcode.firmware.marlin.limits import MarlinLimits, initial_limits
from stillpath.gcode.firmware.marlin.planner import Planner
from stillpath.gcode.firmware.planning import join_phases
from stillpath.gcode.types import Moves, Phases
from stillpath.models.firmware import Marlin
from stillpath.models.firmware.marlin import PerAxis

SCALE = PerAxis(x=80.0, y=80.0, z=400.0, e=100.0)
FINE_HZ = 1e9
"""A timer whose ticks do not matter."""
FAST = {"accel_x_mm_s2": 1e6, "accel_y_mm_s2": 1e6, "accel_z_mm_s2": 1e6, "accel_e_mm_s2": 1e6}
STREAM = {
    **FAST,
    "print_accel_mm_s2": 1e6,
    "travel_accel_mm_s2": 1e6,
    "feedrate_z_mm_s": 500.0,
    "feedrate_e_mm_s": 500.0,
    "min_segment_time_us": 0.0,
}


def machine(**facts: Any) -> Marlin:
    return Marlin(**{"steps_per_mm": SCALE, "step_timer_hz": FINE_HZ, **facts})


def moves_through(points: Any, speed_mm_s: Any, limits_id: int = 0) -> Moves:
    points = np.asarray(points, np.float64)
    full = np.zeros((len(points), 4))
    full[:, : points.shape[1]] = points
    n = len(full) - 1
    speed = np.broadcast_to(np.asarray(speed_mm_s, np.float64), n).copy()
    return as_moves(full[:-1], full[1:], speed, np.full(n, limits_id, np.int32))


def plan(
    firmware: Marlin, points: Any, speed_mm_s: Any, *, corexy: bool = False, **limits: float
) -> Phases:
    table: list[MarlinLimits] = [replace(initial_limits(firmware), **limits)]
    planner = Planner(firmware, corexy=corexy)
    return join_phases(
        [planner.push_moves(moves_through(points, speed_mm_s), table), planner.flush()]
    )


# Steps and speeds


def test_positions_are_whole_steps() -> None:
    # .0874 mm * 80 = 6.99 steps -> 7 = .0875 mm; on to .2 mm = 16 steps: 9 more = .1125 mm.
    phases = plan(machine(), [[0], [0.0874], [0.2]], 20.0)
    assert phases.start_mm[:, 0] == pytest.approx([0.0, 0.0875])
    way = phases.cruise_mm_s * phases.lasts_s
    assert phases.direction[:, 0].tolist() == [1.0, 1.0]
    assert np.all(way >= 0.0875 - 1e-9)


def test_corexy_rounds_the_axes_and_not_the_motors() -> None:
    # X .0874 -> 7 steps, Y .1 -> 8 steps; the motors turn 15 and -1.
    phases = plan(machine(), [[0, 0], [0.0874, 0.1], [1, 1]], 20.0, corexy=True)
    assert phases.start_mm[1, :2] == pytest.approx([0.0875, 0.1])


def test_the_step_rate_is_rounded_up() -> None:
    # 100.3 mm/s * 80 = 8024 steps/s as it is; 33.33 mm/s * 80 = 2666.4 -> 2667 = 33.3375 mm/s.
    phases = plan(machine(), [[0], [50], [100]], [100.3, 33.33], **STREAM)
    assert phases.cruise_mm_s == pytest.approx([100.3, 33.3375], rel=1e-4)


def test_a_motor_steps_once_in_a_tick_at_most() -> None:
    # 400 mm/s of 1000 steps per mm would be 400 kHz; a timer of 100 kHz lets 100 mm/s through.
    fine = machine(step_timer_hz=1e5, steps_per_mm=PerAxis(x=1000.0, y=80.0, z=400.0, e=93.0))
    assert plan(fine, [[0], [200]], 400.0, **STREAM).cruise_mm_s.max() == pytest.approx(100.0)


def test_every_axis_keeps_its_speed() -> None:
    # Z may do 5 mm/s: a move of 3 up and 4 along takes 3/5 s, 25/3 mm/s of path.
    phases = plan(machine(), [[0, 0, 0], [4, 0, 3]], 100.0, **FAST)
    assert phases.cruise_mm_s[0] == pytest.approx(25 / 3, rel=2e-3)
    # E may do 25 mm/s: .5 mm of filament per mm of path cap it at 50 mm/s.
    phases = plan(machine(), [[0, 0, 0, 0], [100, 0, 0, 50]], 100.0, **FAST)
    assert phases.cruise_mm_s[0] == pytest.approx(50.0, rel=1e-3)


def test_motors_of_a_corexy_keep_their_speed() -> None:
    # 300 mm/s along the diagonal are 424 mm/s of A; with 212.13 allowed, half of it.
    phases = plan(
        machine(), [[0, 0], [300, 300]], 300.0, corexy=True, feedrate_x_mm_s=150 * math.sqrt(2)
    )
    assert phases.cruise_mm_s[0] == pytest.approx(150.0, rel=1e-3)


def test_the_least_feedrates() -> None:
    # M205 S for moves with E, T for those without.
    points = [[0, 0, 0, 0], [30, 0, 0, 1], [60, 0, 0, 1]]
    phases = plan(machine(), points, 1.0, min_feedrate_mm_s=10.0, min_travel_feedrate_mm_s=20.0)
    assert phases.cruise_mm_s == pytest.approx([10.0, 20.0], rel=1e-3)


# Acceleration


@pytest.mark.parametrize(
    ("points", "expected"),
    [
        ([[0, 0, 0, 0], [50, 0, 0, 2]], 600.0),  # M204 P
        ([[0, 0, 0, 0], [50, 0, 0, 0]], 700.0),  # M204 T
        ([[0, 0, 0, 0], [0, 0, 0, -20]], 800.0),  # M204 R
        ([[0, 0, 0, 0], [50, 0, 0, -2]], 600.0),  # a wipe is a move with E
    ],
)
def test_kinds_of_acceleration(points: Any, expected: float) -> None:
    own = {"print_accel_mm_s2": 600.0, "travel_accel_mm_s2": 700.0, "retract_accel_mm_s2": 800.0}
    phases = plan(machine(variant="prusa"), points, 20.0, **FAST, **own)
    assert phases.accel_mm_s2[0] == pytest.approx(expected, rel=1e-3)


def test_axes_cap_the_acceleration() -> None:
    # X may do 300: a diagonal may do 300 sqrt 2. E may do 20: .1 mm per mm allow 200 mm/s2.
    firmware = machine(variant="prusa")
    phases = plan(firmware, [[0, 0], [50, 50]], 20.0, accel_x_mm_s2=300.0, travel_accel_mm_s2=1e4)
    assert phases.accel_mm_s2[0] == pytest.approx(300 * math.sqrt(2), rel=1e-3)
    phases = plan(firmware, [[0, 0, 0, 0], [50, 0, 0, 5]], 20.0, accel_e_mm_s2=20.0)
    assert phases.accel_mm_s2[0] == pytest.approx(200.0, rel=1e-3)


def test_motors_of_a_corexy_cap_the_acceleration() -> None:
    # 500 along the diagonal are 707 of A, which may do 500: 353.6 remain. From 1.5 to 30 mm/s.
    phases = plan(machine(variant="bugfix"), [[0, 0], [50, 50]], 30.0, corexy=True)
    assert phases.accel_mm_s2[0] == pytest.approx(353.6, rel=0.03)


def test_linear_advance_caps_the_acceleration() -> None:
    # Jerk of E 5 mm/s, K .05 s, .033 mm of E per mm: 5 / (.05 * .033) = 3030 mm/s2.
    firmware = machine(variant="bugfix", linear_advance=True, junction="classic_jerk")
    line = [[0, 0, 0, 0], [100, 0, 0, 3.3]]
    caps = {**STREAM, "linear_advance_k_s": 0.05, "jerk_e_mm_s": 5.0}
    ramp = plan(firmware, line, 100.0, **caps)
    assert ramp.accel_mm_s2[0] == pytest.approx(3030.0, rel=0.03)
    # Retractions, travel and K = 0 are not capped.
    assert plan(firmware, [[0], [100]], 100.0, **caps).accel_mm_s2[0] > 3e4
    caps["linear_advance_k_s"] = 0.0
    assert plan(firmware, line, 100.0, **caps).accel_mm_s2[0] > 3e4


def test_linear_advance_with_junction_deviation_makes_its_own_jerk() -> None:
    # sqrt(.08 * .7071 / .2929 * 5000) = 31.08 mm/s: 31.08 / (.05 * .033) = 18 835 mm/s2.
    firmware = machine(variant="bugfix", linear_advance=True)
    caps = {**STREAM, "linear_advance_k_s": 0.05, "accel_e_mm_s2": 5000.0}
    ramp = plan(firmware, [[0, 0, 0, 0], [100, 0, 0, 3.3]], 100.0, **caps)
    assert ramp.accel_mm_s2[0] == pytest.approx(18_835.0, rel=0.08)


# Corners


def corner(firmware: Marlin, points: Any, speed_mm_s: Any, **limits: float) -> float:
    """Speed at which the second of long moves begins."""
    return float(plan(firmware, points, speed_mm_s, **limits).start_mm_s[1])


@pytest.mark.parametrize("variant", ["2.0", "2.1", "bugfix", "prusa"])
def test_junction_deviation_at_a_right_angle(variant: Any) -> None:
    # v2 = 500 * .08 * s / (1 - s) with s = sqrt .5: 96.57, 9.827 mm/s.
    v = corner(machine(variant=variant), [[0, 0], [50, 0], [50, 50]], 60.0)
    assert v == pytest.approx(9.827, abs=0.02)


def test_junction_deviation_keeps_the_axes_limits() -> None:
    # The corner's acceleration points along (1, -1) / sqrt 2: Y with 100 mm/s2 allows 141.4.
    # v2 = 141.4 * .08 * 2.4142 = 27.3.
    v = corner(machine(), [[0, 0], [0, 50], [50, 50]], 40.0, accel_y_mm_s2=100.0)
    assert v == pytest.approx(math.sqrt(27.31), abs=0.02)


def test_straight_back_is_a_stop() -> None:
    # At 120 steps/s at least (MINIMAL_STEP_RATE of the releases): 1.5 mm/s.
    assert corner(machine(), [[0, 0], [50, 0], [0, 0]], 60.0) == pytest.approx(1.5)
    assert corner(machine(variant="prusa"), [[0, 0], [50, 0], [0, 0]], 60.0) == 0.05


def arc(turn_rad: float, side_mm: float, count: int) -> Any:
    angle = turn_rad * np.arange(count)
    return np.cumsum(
        np.vstack(([0.0, 0.0], side_mm * np.column_stack((np.cos(angle), np.sin(angle))))), 0
    )


def test_short_segments_are_part_of_an_arc() -> None:
    # .5 mm, 30 degrees: arc of v2 = .5 * 5000 / acos(.866); Marlin's broken line from
    # 1.0075 acos(.75) = .7282 to 1.0075 acos(.875) = .5092 gives .5249 rad: 4763, 69.01 mm/s.
    # By the angle alone it were 5000 * .08 * .9659 / .0341 = 11 340.
    wide = {"accel_x_mm_s2": 5000.0, "accel_y_mm_s2": 5000.0, "travel_accel_mm_s2": 5000.0}
    points = arc(math.radians(30), 0.5, 40)
    fine = PerAxis(x=4000.0, y=4000.0, z=400.0, e=100.0)  # so that rounding bends nothing
    phases = plan(machine(steps_per_mm=fine), points, 150.0, **wide)
    assert phases.start_mm_s[20] == pytest.approx(69.01, rel=2e-3)
    phases = plan(machine(steps_per_mm=fine, small_segment_junctions=False), points, 150.0, **wide)
    assert phases.start_mm_s[12] > 75.0


def test_classic_jerk_at_a_right_angle() -> None:
    # X gives up 60 and may give up 10: a sixth of 60; then Y's 10 is allowed.
    points = [[0, 0], [50, 0], [50, 50]]
    for variant in ("2.0", "2.1", "bugfix", "prusa"):
        v = corner(machine(variant=variant, junction="classic_jerk"), points, 60.0)
        assert v == pytest.approx(10.0, abs=0.02)


def test_classic_jerk_at_a_slight_bend() -> None:
    # 60 mm/s, 30 degrees: X steps by 60 (1 - .866) = 8.04, Y by 30 of 10: a third, 20 mm/s.
    points = [[0, 0], [50, 0], [50 + 43.3, 25]]
    for variant in ("2.1", "bugfix"):
        v = corner(machine(variant=variant, junction="classic_jerk"), points, 60.0)
        assert v == pytest.approx(20.0, rel=5e-3)


def test_classic_jerk_straight_back() -> None:
    # The releases let both sides start at the safe speed of 10 mm/s, though X steps by 20;
    # bugfix steps by 10: 5 mm/s.
    points = [[0, 0], [50, 0], [0, 0]]
    assert corner(machine(junction="classic_jerk"), points, 60.0) == pytest.approx(10.0, abs=0.02)
    late = machine(variant="bugfix", junction="classic_jerk")
    assert corner(late, points, 60.0) == pytest.approx(5.0, abs=0.02)


def test_from_slow_to_fast_with_classic_jerk() -> None:
    # From 5 to 60 mm/s straight on. Both 5 and the safe speed 10 of the fast move are above
    # 99 % of the junction's 5: the releases start the fast move at 10. bugfix: at 5.
    points = [[0, 0], [20, 0], [70, 0]]
    late = machine(variant="bugfix", junction="classic_jerk")
    assert corner(machine(junction="classic_jerk"), points, [5, 60]) == pytest.approx(10, abs=0.02)
    assert corner(late, points, [5.0, 60.0]) == pytest.approx(5.0, abs=0.02)


def test_the_extruder_has_a_jerk_too() -> None:
    # From 60 mm/s with E into a retraction at 40 mm/s: min 40. X: 60 * 40/60 = 40 -> 0 of 10:
    # a quarter. E: .04 * 40 / 4 = .4 to -10 is a reversal: 10 of 5, half of a quarter: 5 mm/s.
    # Safe speeds: 10 of the print, 5 of the retraction; both above .99 * 5: 5.
    points = [[0, 0, 0, 0], [50, 0, 0, 2], [50, 0, 0, -8]]
    for variant in ("2.1", "prusa"):
        firmware = machine(variant=variant, junction="classic_jerk")
        assert corner(firmware, points, [60.0, 40.0], feedrate_e_mm_s=50.0) == pytest.approx(
            5.0, abs=0.02
        )


# Queue


def test_short_moves_are_swallowed_and_made_up_for() -> None:
    # .05 mm are 4 steps: nothing moves. With the next .05 mm it is 8 steps from the start.
    phases = plan(machine(), [[0], [0.05], [0.1], [10]], 20.0)
    assert len(phases) == 3
    assert phases.lasts_s[0] == 0.0
    assert phases.direction[0, 0] == 1.0
    assert phases.start_mm[:, 0] == pytest.approx([0.0, 0.0, 0.1])
    # A build with MIN_STEPS_PER_SEGMENT 1 executes both.
    assert np.all(plan(machine(min_steps_per_segment=1), [[0], [0.05], [0.1]], 20.0).lasts_s > 0)


def test_rests_of_a_file_stay_apart_from_what_the_firmware_joins_with_them() -> None:
    """4 steps of X at 80 per mm, then a retraction: joined by the firmware, apart in a file."""
    firmware = machine(min_steps_per_segment=6)
    points = [[0, 0, 0, 0], [10, 0, 0, 1], [10.05, 0, 0, 1], [10.05, 0, 0, 0.2]]
    moves = moves_through(points, 50.0)
    limits = [initial_limits(firmware)]
    swallowed, told = (
        Planner(firmware, rests_apart=apart).plan_whole(moves, limits) for apart in (False, True)
    )
    assert swallowed.lasts_s[1] == 0.0
    assert swallowed.direction[2, 0] > 0.0
    assert np.all(told.lasts_s > 0.0)
    assert told.direction[2, 0] == 0.0
    np.testing.assert_allclose(told.start_mm[2, :2], [10.05, 0.0], atol=1e-9)


def test_a_short_way_with_a_retraction_is_measured_along_the_filament() -> None:
    # 4 steps of X and 100 of E: the path is 1 mm of filament, at 10 mm/s.
    phases = plan(machine(), [[0, 0, 0, 0], [0.05, 0, 0, -1]], 10.0, retract_accel_mm_s2=1e5)
    assert phases.direction[0] == pytest.approx([0.05, 0.0, 0.0, -1.0])
    assert phases.cruise_mm_s[0] == pytest.approx(10.0, rel=1e-3)


def test_segments_are_stretched_while_the_queue_fills() -> None:
    # 1 mm at 100 mm/s are 10 ms, 10 too short. Two blocks wait before the third: it is
    # stretched by 2 * 10 / 2 to 20 ms; the sixth (four wait) by 2 * 10 / 4 to 15 ms.
    points = np.arange(0.0, 40.0)[:, None]
    caps = {**STREAM, "min_segment_time_us": 20_000.0}
    phases = plan(machine(), points, 100.0, **caps)
    assert phases.lasts_s[2] == pytest.approx(0.020, abs=2e-4)
    assert phases.lasts_s[5] == pytest.approx(0.015, abs=2e-4)
    assert phases.lasts_s[10:30] == pytest.approx(0.010, abs=1e-6)
    # M205 B0, or a build without SLOWDOWN.
    caps["min_segment_time_us"] = 0.0
    assert plan(machine(), points, 100.0, **caps).lasts_s[2] == pytest.approx(0.01, abs=1e-6)


def test_the_queue_sees_thirteen_blocks() -> None:
    # .1 mm each: from the start of a block the firmware must be able to brake within it and
    # the twelve after it: v2 = 2 * 500 * 1.3 = 1300, 36.06 mm/s, whatever F says.
    points = 0.1 * np.arange(400.0)[:, None]
    facts = {"variant": "bambu", "slowdown": False, "junction": "classic_jerk"}
    phases = plan(machine(**facts), points, 100.0)
    assert phases.start_mm_s[200] == pytest.approx(math.sqrt(1300.0), rel=1e-4)
    large = machine(**facts, block_buffer_size=64)
    assert plan(large, points, 100.0).start_mm_s[200] == pytest.approx(math.sqrt(6100), rel=1e-4)


def test_a_stop_ends_the_queue() -> None:
    firmware = machine()
    table = [initial_limits(firmware)]
    planner = Planner(firmware)
    first = planner.push_moves(moves_through([[0], [50]], 60.0), table)
    first = join_phases([first, planner.stop(0.5)])
    then = join_phases(
        [planner.push_moves(moves_through([[50], [99]], 60.0), table), planner.flush()]
    )
    assert then.t_s[0] == pytest.approx(first.lasts_s[0] + 0.5)
    assert then.start_mm_s[0] == pytest.approx(1.5)
    assert then.move_index.tolist() == [1]


# A dense stream: accelerations so high that only single steps are lost


def test_the_releases_lose_a_step_where_the_stream_speeds_up() -> None:
    # 1 mm = 80 steps. From 50 to 100 mm/s the first step comes after 1/4000 s, the others 1/8000:
    # 10.125 ms. From 100 to 50 nothing is lost: floor() leaves no step to brake in.
    points = np.arange(0.0, 9.0)[:, None]
    speed = [50, 50, 50, 100, 100, 100, 50, 50]
    time_s = plan(machine(), points, speed, **STREAM).lasts_s
    assert time_s[2:7] == pytest.approx([0.02, 0.010125, 0.01, 0.01, 0.02], abs=1e-7)


def test_bugfix_loses_a_step_where_the_stream_slows_down() -> None:
    # Speeds up to sqrt(.5 * 1e6 / 80) = 79.06 mm/s are as good as rest: the faster block begins
    # at 6325 steps/s: 158.1 us for its first step, 125 for the others. Slowing down, the last
    # step of the fast block takes 1/4000 s.
    points = np.arange(0.0, 9.0)[:, None]
    speed = [50, 50, 50, 100, 100, 100, 50, 50]
    firmware = machine(variant="bugfix", min_steps_per_segment=1)
    time_s = plan(firmware, points, speed, **STREAM).lasts_s
    expected = [0.02, 0.01 + 1 / 6325 - 1 / 8000, 0.01, 0.010125, 0.02]
    assert time_s[2:7] == pytest.approx(expected, abs=2e-7)


def test_an_s_curve_within_a_step_is_not_seen() -> None:
    # A stream: 4000, 8000, 4000 steps/s; 50 mm/s by 300 m/s2 take .17 ms, a step .25 ms.
    points = np.arange(0.0, 9.0)[:, None]
    speed = [50, 50, 50, 100, 100, 100, 50, 50]
    times = [
        plan(machine(s_curve=s, min_steps_per_segment=1), points, speed, **STREAM).lasts_s
        for s in (False, True)
    ]
    assert times[1][1:-1] == pytest.approx(times[0][1:-1], abs=1e-9)


def test_an_s_curve_is_looked_at_step_by_step() -> None:
    # .1 mm, 8 steps, from the least rate of 120 steps/s up by 40 000 steps/s2 for 4 steps, to
    # 578.6 steps/s, and down again. Step 1 comes at 120 steps/s, the next four at the rate of the
    # curve when the one before came; the first one down still at the highest rate.
    first, accel = 120.0, 40_000.0
    peak = np.sqrt(first**2 + 2.0 * accel * 4.0)
    over_s = (peak - first) / accel

    def rate(begin: float, end: float, t_s: float) -> float:
        x = min(t_s / over_s, 1.0)
        return float(begin + (end - begin) * x**3 * (10.0 - 15.0 * x + 6.0 * x**2))

    up_s = 1.0 / first
    for _ in range(4):
        up_s += 1.0 / rate(first, peak, up_s)
    down_s = 0.0
    for _ in range(3):
        down_s += 1.0 / rate(peak, first, down_s)
    limits = {"print_accel_mm_s2": 500.0, "travel_accel_mm_s2": 500.0}
    planned = plan(machine(s_curve=True), [[0], [0.1]], 20.0, **limits).lasts_s
    assert planned[0] == pytest.approx(up_s + down_s, rel=1e-5)


def test_a_move_needs_a_speed() -> None:
    with pytest.raises(GcodeError, match="give it an F"):
        plan(machine(), [[0], [1]], 0.0)
