"""Plans against the steps of Marlin itself: planner.cpp and stepper.cpp, run with a virtual timer.

Release 2.1.2.5, and 2.0.8 where it says so, 80 steps per mm in X and Y and 400 in Z, a timer of
2 MHz, a queue of 16. Points are in steps; a time is that from a move's begin to its last step. The
board counts E and computes in single precision, so rates may differ by a step per second.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from stillpath.gcode.firmware.marlin.limits import initial_limits
from stillpath.gcode.firmware.marlin.planner import Planner
from stillpath.gcode.firmware.planning import join_phases
from stillpath.gcode.types import Limits
from stillpath.models.firmware import Marlin
from stillpath.models.firmware.marlin import PerAxis
from tests.gcode.marlin_interrupts import stepped
from tests.gcode.test_marlin_planner import moves_through

FIRMWARE = Marlin(steps_per_mm=PerAxis(x=80.0, y=80.0, z=400.0, e=93.0))


def lasts_ms(
    steps: Any, speed_mm_s: Any, firmware: Marlin = FIRMWARE, **limits: float
) -> NDArray[np.float64]:
    scale = firmware.steps_per_mm
    points = np.asarray(steps, np.float64) / [scale.x, scale.y, scale.z]
    table = [replace(initial_limits(firmware), min_segment_time_us=0.0, **limits)]
    planner = Planner(firmware)
    moves = moves_through(points, speed_mm_s)
    phases = join_phases([planner.push_moves(moves, table), planner.flush()])
    return np.asarray(phases.lasts_s * 1e3)


def test_slight_turns_of_short_moves() -> None:
    """Until 2026-11 the angle of a turn was never below .033, up to .78 ms off a move."""
    x = [0, 56, 112, 168, 224, 280, 336, 391, 446, 499, 549, 593, 626, 637, 617, 566, 510, 454]
    y = [0, 0, 0, 1, 3, 6, 11, 19, 31, 49, 74, 109, 155, 210, 262, 286, 291, 287]
    x += [399, 344, 289, 235, 181]
    y += [278, 266, 253, 240, 226]
    limits = {f"{kind}_accel_mm_s2": 500.0 for kind in ("print", "travel")}
    limits |= {"accel_x_mm_s2": 500.0, "accel_y_mm_s2": 500.0, "junction_deviation_mm": 0.3}
    found = lasts_ms(np.column_stack([x, y, np.zeros(len(x))]), 100.0, **limits)
    recorded = [51.018, 21.961, 16.8365, 14.189, 12.5035, 11.327, 10.7865, 11.9455, 13.3095]
    recorded += [15.396, 17.3565, 20.569, 23.3925, 25.962, 25.4915, 19.3355, 15.5635, 13.3595]
    recorded += [14.179, 16.883, 21.554, 40.4755]
    assert found == pytest.approx(recorded, abs=0.005)


def test_a_step_of_z_along_the_way() -> None:
    """As in a lift or descent while travelling: the turn is slight, and slows nothing here."""
    k = np.arange(25)
    z = (k > 8).astype(int) + (k > 14)
    limits = {f"{kind}_accel_mm_s2": 5000.0 for kind in ("print", "travel")}
    limits |= {"accel_x_mm_s2": 5000.0, "accel_y_mm_s2": 5000.0, "accel_z_mm_s2": 200.0}
    limits |= {"feedrate_z_mm_s": 15.0, "junction_deviation_mm": 0.01}
    found = lasts_ms(np.column_stack([20 * k, 17 * k, z]), 60.0, **limits)
    assert found == pytest.approx([14.0135, 5.479, *21 * [5.46], 7.5345], abs=0.002)


RAMPS = {
    ("2.0", False): [64.166, 4.9675, 9.996, 4.7635, 18.75, 3.1265, 20.193, 50.0, 8.8615, 42.3595],
    ("2.0", True): [64.166, 4.8935, 9.996, 4.68, 18.75, 3.1365, 18.498, 50.0, 8.685, 41.9325],
    ("2.1", False): [57.083, 4.144, 9.996, 4.272, 18.75, 2.8855, 19.535, 50.0, 6.701, 42.3595],
    ("2.1", True): [57.083, 4.1535, 9.996, 4.2755, 18.75, 2.881, 18.2955, 50.0, 6.5535, 41.9325],
}
"""Times of ten moves along X in 2.0.8 and 2.1.2.5, without and with S_CURVE_ACCELERATION."""


@pytest.mark.parametrize(("variant", "s_curve"), RAMPS)
def test_moves_that_speed_up_and_slow_down(variant: Any, s_curve: bool) -> None:
    """In 2.0 the second step is as slow as the first: until 2026-11 it was planned as in 2.1."""
    steps = np.cumsum([0, 40, 6, 12, 8, 30, 6, 80, 20, 10, 100])
    speed = np.array([10.0, 40.0, 15.0, 60.0, 20.0, 80.0, 100.0, 5.0, 50.0, 30.0])
    limits = {f"{kind}_accel_mm_s2": 5000.0 for kind in ("print", "travel")}
    limits |= {"accel_x_mm_s2": 5000.0, "junction_deviation_mm": 0.05}
    firmware = FIRMWARE.model_copy(update={"variant": variant, "s_curve": s_curve})
    points = np.column_stack([steps, 0 * steps, 0 * steps])
    found = lasts_ms(points, speed, firmware, **limits)
    assert found == pytest.approx(RAMPS[variant, s_curve], abs=0.01)
    if not s_curve:
        table: list[Limits] = [replace(initial_limits(FIRMWARE), min_segment_time_us=0.0, **limits)]
        moves = moves_through(points / 80.0, speed)
        t_s, place_mm = stepped(moves, table, firmware, corexy=False)
        ends_s = t_s[np.isin(np.round(80.0 * place_mm[0], 6), steps)]
        assert np.diff(1e3 * ends_s) == pytest.approx(RAMPS[variant, s_curve], abs=0.01)


def test_parts_of_steps() -> None:
    """With ADAPTIVE_STEP_SMOOTHING at 72 MHz; parts of no step end the last move, left out here."""
    steps = np.cumsum([0, 40, 6, 12, 8, 30, 6, 80, 20, 10, 100])
    speed = np.array([10.0, 40.0, 15.0, 60.0, 20.0, 80.0, 100.0, 5.0, 50.0, 30.0])
    limits = {f"{kind}_accel_mm_s2": 5000.0 for kind in ("print", "travel")}
    limits |= {"accel_x_mm_s2": 5000.0, "junction_deviation_mm": 0.05}
    firmware = FIRMWARE.model_copy(update={"step_smoothing_hz": 30_769.0})
    found = lasts_ms(np.column_stack([steps, 0 * steps, 0 * steps]), speed, firmware, **limits)
    recorded = [50.683, 4.0405, 9.984, 4.2715, 18.72, 2.8015, 20.0295, 49.92, 6.2395]
    assert found[:-1] == pytest.approx(recorded, abs=0.01)


@pytest.mark.parametrize(
    ("variant", "recorded"),
    [("2.0", [340.1235, 363.8415, 361.35, 506.888]), ("2.1", [331.951, 363.8145, 361.35, 506.62])],
)
def test_long_ramps_along_s_curves(variant: Any, recorded: list[float]) -> None:
    """As slicers write them; until 2026-11 they had the time of straight ramps, 27 ms too much."""
    steps = np.cumsum([0, 1600, 2400, 900, 3000])
    speed = np.array([77.77, 93.33, 31.11, 93.33])
    limits = {f"{kind}_accel_mm_s2": 500.0 for kind in ("print", "travel")}
    limits |= {"accel_x_mm_s2": 500.0, "junction_deviation_mm": 0.05}
    firmware = FIRMWARE.model_copy(update={"variant": variant, "s_curve": True})
    found = lasts_ms(np.column_stack([steps, 0 * steps, 0 * steps]), speed, firmware, **limits)
    assert found == pytest.approx(recorded, abs=0.2)
