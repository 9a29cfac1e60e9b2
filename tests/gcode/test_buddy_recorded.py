"""Plans against the blocks of Prusa's Buddy firmware itself.

Its planner.cpp and precise_stepping.cpp (6.3.2, 2025-04) were run with a virtual clock: 100 steps
per mm in X and Y, a queue of 32, classic jerk of 8 mm/s.
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
from stillpath.models.firmware import Marlin
from stillpath.models.firmware.marlin import PerAxis
from tests.gcode.test_marlin_planner import moves_through

FIRMWARE = Marlin(
    variant="prusa",
    steps_per_mm=PerAxis(x=100.0, y=100.0, z=400.0, e=380.0),
    junction="classic_jerk",
)


def lasts_ms(
    points_mm: Any,
    speed_mm_s: float,
    *,
    accel_mm_s2: float = 1250.0,
    fastest_mm_s: float = 300.0,
    corexy: bool = False,
) -> NDArray[np.float64]:
    names = ("print_accel_mm_s2", "travel_accel_mm_s2", "accel_x_mm_s2", "accel_y_mm_s2")
    limits = dict.fromkeys(names, accel_mm_s2) | dict.fromkeys(
        ("feedrate_x_mm_s", "feedrate_y_mm_s"), fastest_mm_s
    )
    table = [replace(initial_limits(FIRMWARE), **limits, jerk_x_mm_s=8.0, jerk_y_mm_s=8.0)]
    planner = Planner(FIRMWARE, corexy=corexy)
    moves = moves_through(points_mm, speed_mm_s)
    phases = join_phases([planner.push_moves(moves, table), planner.flush()])
    return np.asarray(phases.lasts_s * 1e3)


def test_positions_are_quarters_of_steps() -> None:
    """The fourth move has 5.9 steps, which are 6 here; it was taken to be too short."""
    x = np.cumsum([0.0, 58.1, 53.0, 35.3, 5.5, 60.0, 80.0]) / 100.0
    y = np.cumsum([0.0, 8.4, 32.4, 36.8, 5.9, 0.0, 20.0]) / 100.0
    found = lasts_ms(np.column_stack([x, y]), 144.0, accel_mm_s2=1000.0)
    recorded = [35.6667, 20.0112, 19.3399, 5.8976, 25.528, 40.9549]
    assert found == pytest.approx(recorded, abs=0.001)


def test_half_of_the_queue_is_known() -> None:
    """The other half is steps already; 29 blocks were taken to be known, or 13."""
    found = lasts_ms(np.arange(61.0)[:, None], 300.0)
    begin = [39.96, 16.5685, 12.7135, 10.718, 9.4427, 8.5369, 7.8505, 7.307, 6.8629, 6.4911]
    begin += [6.1739, 5.8991, 5.658, 5.4442, 5.253]
    assert found == pytest.approx([*begin, *30 * [5.1216], *begin[::-1]], abs=0.001)


def test_m203_limits_the_motors_of_a_corexy() -> None:
    """At 150 mm/s along a diagonal a motor runs at 212; such moves were planned too fast."""
    points = 20.0 * np.arange(4.0)[:, None] * [1.0, 1.0]
    found = lasts_ms(points, 150.0, fastest_mm_s=200.0, corexy=True)
    assert found == pytest.approx([256.5284, 200.0, 256.5284], abs=0.001)
    found = lasts_ms(points, 150.0, fastest_mm_s=200.0)
    assert found == pytest.approx([248.5217, 188.5618, 248.5217], abs=0.001)
