"""Filament along a compensated path."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stillpath.pipeline.filament import feed_evenly


def moving_mean(xy_mm: np.ndarray, fed_mm: np.ndarray) -> np.ndarray:
    """The same in numpy: the mean over the path of what a trapezoidal rule gives."""
    way = np.append(0.0, np.cumsum(np.hypot(*np.diff(xy_mm))))
    if way[-1] <= 0.0:
        return fed_mm
    own = fed_mm - fed_mm[0]
    reach = np.minimum(np.minimum(way, way[-1] - way), min(2.5 * own[-1] / way[-1], 0.5))
    area = np.append(0.0, np.cumsum(0.5 * (own[1:] + own[:-1]) * np.diff(way)))
    low, high = (np.interp(way + side * reach, way, area) for side in (-1.0, 1.0))
    wide = reach > 1e-3
    own[wide] = (high - low)[wide] / (2.0 * reach[wide])
    return own + fed_mm[0]


def printed(seed: int, samples: int) -> np.ndarray:
    """A path with stands, and filament that is uneven along it."""
    rng = np.random.default_rng(seed)
    speed = rng.uniform(0.0, 0.08, samples) * (rng.random(samples) > 0.1)
    angle = np.cumsum(rng.normal(0.0, 0.3, samples))
    feed = np.abs(speed + rng.normal(0.0, 0.01, samples)) * 0.04
    steps = np.stack([speed * np.cos(angle), speed * np.sin(angle), 0.0 * speed, feed])
    return np.cumsum(steps, axis=1) + np.array([100.0, 80.0, 0.2, 500.0])[:, None]


@given(st.integers(0, 2**31), st.integers(2, 400))
def test_the_kernel_is_a_moving_mean_over_the_path(seed: int, samples: int) -> None:
    command = printed(seed, samples)
    expected = moving_mean(command[:2], command[3])
    first, last = command[3, 0], command[3, -1]
    feed_evenly(command, np.ones(samples, bool))
    np.testing.assert_allclose(command[3], expected, rtol=0, atol=1e-9)
    assert (command[3, 0], command[3, -1]) == pytest.approx((first, last), abs=1e-9)


def test_each_printed_run_keeps_its_total() -> None:
    command = printed(3, 300)
    before = command.copy()
    extruding = np.ones(300, bool)
    extruding[100:140] = False
    feed_evenly(command, extruding)
    np.testing.assert_array_equal(command[:3], before[:3])
    np.testing.assert_array_equal(command[3, 100:139], before[3, 100:139])
    assert command[3, [99, 139, 299]] == pytest.approx(before[3, [99, 139, 299]], abs=1e-9)
    step_mm = np.hypot(*np.diff(command[:2, :100]))
    moving = step_mm > 0.01
    uneven = [np.std(np.diff(one[3, :100])[moving] / step_mm[moving]) for one in (before, command)]
    assert uneven[1] < 0.6 * uneven[0]


def test_a_run_that_stands_is_left_alone() -> None:
    command = np.tile(np.array([[1.0], [2.0], [0.2], [0.0]]), 50)
    command[3] = np.linspace(0.0, 1.0, 50)
    before = command.copy()
    feed_evenly(command, np.ones(50, bool))
    np.testing.assert_array_equal(command, before)
