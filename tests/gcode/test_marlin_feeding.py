"""Steps of E in Marlin's stream: each is a turn by junction deviation, and moves must bear it."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from stillpath.gcode.firmware.marlin._feed_kernels import place_steps

STEP_MM, ACCEL_MM_S2, SPEED_MM_S = 1.0 / 93.0, 1500.0, 40.0


def placed(length_mm: list[float], wish: list[float]) -> NDArray[np.float64]:
    way = np.column_stack([length_mm, np.zeros(len(length_mm)), np.zeros(len(length_mm))])
    speed = np.full(len(length_mm), SPEED_MM_S)
    return place_steps(way, speed, np.array(wish), STEP_MM, ACCEL_MM_S2)


def cost(length_mm: list[float], wish: list[float], whole: tuple[float, ...]) -> float:
    """What the kernel's search is to find the least of."""
    total = sum(0.01 * (k - w) ** 2 for k, w in zip(whole[1:], wish[1:], strict=True))
    heading = [
        np.array([length, STEP_MM * (after - before)])
        / math.hypot(length, STEP_MM * (after - before))
        for length, before, after in zip(length_mm, whole[:-1], whole[1:], strict=True)
    ]
    for k in range(1, len(heading)):
        turn = np.linalg.norm(heading[k] - heading[k - 1])
        needed = SPEED_MM_S**2 * turn / (length_mm[k] * ACCEL_MM_S2)
        total += max(needed - 0.7, 0.0) ** 2
    return total


def test_short_moves_make_no_step_of_their_own() -> None:
    # At the nearest steps, the two moves of 75 um would have one, and be passed at 28 mm/s.
    length = [0.3, 0.375, 0.075, 0.075, 0.275, 0.24]
    wish = [0.0, *np.cumsum([3.1 * x for x in length])]
    steps = np.diff(placed(length, wish))
    assert np.diff(np.round(wish))[2:4].any()
    assert not steps[2:4].any()
    assert steps.sum() == round(wish[-1])


@settings(max_examples=50, deadline=None)
@given(
    st.lists(st.sampled_from([0.075, 0.1, 0.2, 0.4]), min_size=2, max_size=5),
    st.sampled_from([1.0, 3.1, 14.0]),
)
def test_no_other_places_cost_less(length_mm: list[float], per_mm: float) -> None:
    wish = [0.0, *np.cumsum([per_mm * x for x in length_mm])]
    around = [[math.floor(w) + k for k in range(-1, 3)] for w in wish[1:-1]]
    ways = [
        (0.0, *map(float, inner), float(math.floor(wish[-1] + 0.5)))
        for inner in itertools.product(*around)
    ]
    least = min(cost(length_mm, wish, way) for way in ways if list(way) == sorted(way))
    found = placed(length_mm, wish)
    assert np.all(np.diff(found) >= 0.0)
    assert cost(length_mm, wish, tuple(found)) == pytest.approx(least)


def test_travels_have_no_filament_and_retractions_go_back() -> None:
    length = [0.1, 0.1, 5.0, 0.1, 0.1, 0.1]
    wish = [0.0, 0.6, 1.2, 1.2, 1.9, 1.1, 0.4]
    steps = np.diff(placed(length, wish))
    assert steps[2] == 0.0
    assert np.all(steps[[0, 1, 3]] >= 0.0)
    assert np.all(steps[4:] <= 0.0)
    assert steps.sum() == 0.0
