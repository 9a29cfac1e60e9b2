"""A start from rest at any line of Marlin's stream: fast lines have no more acceleration than
they need."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from stillpath.gcode.firmware.encoding import Interleaved
from stillpath.gcode.firmware.marlin.limits import initial_limits
from stillpath.gcode.firmware.marlin.starting import StreamLevels, gentle_accel_mm_s2
from stillpath.gcode.firmware.marlin.stream_limits import stream_limits
from stillpath.gcode.types import Phases
from stillpath.models.firmware import Marlin
from stillpath.models.machine import CommandLimits

FIRMWARE, LINE_S = Marlin(), 3e-3


def lines(velocity_mm_s: NDArray[np.float64]) -> Interleaved:
    """Segments of 3 ms with these velocities, shape (n, 2)."""
    n = len(velocity_mm_s)
    position = np.zeros((n, 4), np.int64)
    position[:, :2] = np.round(1e6 * LINE_S * np.cumsum(velocity_mm_s, axis=0))
    every = np.full(n, LINE_S)
    none = np.zeros(n, np.int64)
    return Interleaved(none - 1, np.zeros(4, np.int64), position, np.cumsum(every), every, none)


def levels(
    velocity_mm_s: NDArray[np.float64],
    command: CommandLimits | None = None,
    least_hz: float = 120.0,
    corexy: bool = False,
) -> StreamLevels:
    command = command or CommandLimits()
    stream = stream_limits(initial_limits(FIRMWARE), command)
    return StreamLevels(
        lines(velocity_mm_s), stream, command, least_hz=least_hz, ahead=13, corexy=corexy
    )


def along_x(speed_mm_s: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.stack([speed_mm_s, np.zeros_like(speed_mm_s)], axis=1)


def accel_x(found: StreamLevels) -> NDArray[np.float64]:
    return np.array([found.limits[i].accel_x_mm_s2 for i in found.level])


def ramped(top_mm_s: float, accel_mm_s2: float) -> NDArray[np.float64]:
    """Up with an acceleration, at a speed, and down."""
    up = np.arange(0.5 * accel_mm_s2 * LINE_S, top_mm_s, accel_mm_s2 * LINE_S)
    return along_x(np.concatenate([up, np.full(40, top_mm_s), up[::-1]]))


def test_fast_lines_start_gently_and_slow_ones_as_they_like() -> None:
    fast = accel_x(levels(ramped(100.0, 1000.0)))
    gentle = gentle_accel_mm_s2(CommandLimits(), 120.0)
    assert gentle == pytest.approx(45.0 / (1 / 120.0 + 1e-3))
    assert set(fast) == {round(gentle)}
    # A turn at 40 mm/s needs what the motors bear, and the straight line behind it does not.
    straight = np.full(20, 100.0)
    turn = np.stack([np.full(6, 40.0), np.tile([40.0, -40.0], 3)], axis=1)
    brake = along_x(np.linspace(100.0, 40.0, 8))
    course = np.vstack(
        [ramped(100.0, 4000.0)[:-8], brake, turn, brake[::-1], along_x(straight), brake]
    )
    found = accel_x(levels(course))
    slow = np.hypot(*course.T) < 60.0
    assert found[slow].max() == 20_000.0
    assert np.median(found[-25:-12]) == round(gentle)


def test_a_fast_line_has_what_it_needs() -> None:
    need = accel_x(levels(ramped(200.0, 7000.0)))
    middle = need[8:-8]
    assert middle.max() == 20_000.0 or middle.max() >= 7000.0
    assert accel_x(levels(ramped(200.0, 15_000.0))).max() == 20_000.0


def test_on_a_corexy_a_diagonal_counts_by_its_motor() -> None:
    speed = np.concatenate([np.linspace(2.0, 40.0, 30), np.full(20, 40.0)])
    diagonal = np.stack([speed, speed], axis=1)
    # 80 mm/s of a motor, and 1267 mm/s2 of X, 2534 of the motor.
    assert set(accel_x(levels(diagonal, corexy=True))[25:-1]) == {4821.0}


def test_the_motors_limit_is_never_passed() -> None:
    own = CommandLimits(accel_mm_s2=4000.0)
    only = levels(ramped(100.0, 3000.0), own)
    assert [one.accel_x_mm_s2 for one in only.limits] == [4000.0]
    assert not np.any(only.level)
    between = levels(ramped(100.0, 3000.0), CommandLimits(accel_mm_s2=6500.0))
    assert [one.accel_x_mm_s2 for one in between.limits] == [4821.0, 5304.0, 6027.0, 6500.0]


def test_without_a_slow_first_step_there_is_one_level() -> None:
    """Classic jerk starts with the jerk's speed."""
    assert len(levels(ramped(100.0, 3000.0), least_hz=np.inf).limits) == 1


def test_a_late_plan_gets_more_until_it_ends() -> None:
    found = levels(ramped(100.0, 1000.0))
    n = len(found.level)
    still, zero = np.zeros((n, 4)), np.zeros(n)
    late = Phases(
        t_s=zero,
        accel_s=zero,
        cruise_s=np.full(n, 1.1 * LINE_S),
        decel_s=zero,
        start_mm=still,
        direction=still,
        start_mm_s=zero,
        cruise_mm_s=zero,
        end_mm_s=zero,
        accel_mm_s2=zero,
        move_index=np.arange(n),
        s_curve=np.zeros(n, np.bool_),
    )
    before = found.level.copy()
    assert np.any(found.raise_late(late))
    assert np.all(found.level >= before)
    assert found.level.max() == before.max() + 1
    times = 1
    while np.any(found.raise_late(late)):
        times += 1
    assert times < 10
    assert found.level.max() == len(found.limits) - 1
