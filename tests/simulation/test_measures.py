"""Error measures against their definitions in plain numpy."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stillpath.simulation.measures import (
    ContourMeter,
    GroupTally,
    MotionMeter,
    PathDistances,
    Tally,
    contour_error,
    tracking_error,
)


def brute_force(y_d: np.ndarray, y: np.ndarray, i: int, window: int) -> float:
    """Distance to every segment of the window."""
    part = y_d[:, max(0, i - window) : i + window + 1]
    if part.shape[1] == 1:
        return float(np.hypot(*(y[:, i] - part[:, 0])))
    step, offset = np.diff(part, axis=1), y[:, i : i + 1] - part[:, :-1]
    size = np.sum(step**2, axis=0)
    along = np.clip(np.sum(offset * step, axis=0) / np.where(size > 0, size, 1), 0, 1)
    return float(np.sqrt(np.sum((offset - along * step) ** 2, axis=0).min()))


def wander(
    seed: int, n: int, deviation: float, bends: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """A path with rests, reversals and loops, and points beside it."""
    rng = np.random.default_rng(seed)
    heading = np.cumsum(rng.normal(scale=0.3, size=n) * (rng.random(n) < bends))
    heading += np.pi * np.cumsum(rng.random(n) < 0.03)
    speed = np.repeat(rng.choice([0.0, 0.02, 0.1], size=n // 7 + 1), 7)[:n]
    path = np.cumsum(speed * np.vstack([np.cos(heading), np.sin(heading)]), axis=1)
    return path, path + rng.normal(scale=deviation, size=(2, n))


@given(
    st.integers(0, 10_000), st.integers(1, 300), st.sampled_from([1e-4, 0.02, 1.0]),
    st.sampled_from([0.03, 1.0]), st.integers(1, 5), st.integers(1, 80),
    st.lists(st.integers(0, 300), max_size=4),
)  # fmt: skip
@settings(max_examples=80)
def test_contour_meter_is_brute_force(
    seed: int, n: int, deviation: float, bends: float, stride: int, window: int, cuts: list[int]
) -> None:
    y_d, y = wander(seed, n, deviation, bends)
    meter = ContourMeter(1e-3, window * 1e-3, stride)
    edges = [0, *sorted(min(c, n) for c in cuts), n]
    parts = [meter.push(y_d[:, a:b], y[None, :, a:b]) for a, b in pairwise(edges)]
    parts.append(meter.flush())
    index = np.concatenate([part.index for part in parts])
    np.testing.assert_array_equal(index, np.arange(0, n, stride))
    expected = [brute_force(y_d, y, i, window) for i in index]
    errors = np.concatenate([part.error_mm[0] for part in parts])
    np.testing.assert_allclose(errors, expected, atol=1e-12)
    np.testing.assert_allclose(
        PathDistances(y_d, 1e-3, window * 1e-3).at(y[:, index], index), expected, atol=1e-12
    )


def test_after_a_flush_another_path_is_measured() -> None:
    """Nothing leads from the end of one to the beginning of the next."""
    first, second = wander(1, 150, 0.5, 1.0), wander(2, 150, 0.5, 1.0)
    meter = ContourMeter(1e-3, 0.08, 2)
    found = []
    for y_d, y in (first, second):
        found += [meter.push(y_d + 0.7, y[None] + 0.7), meter.flush()]
    expected = [contour_error(y_d + 0.7, y + 0.7, stride=2) for y_d, y in (first, second)]
    np.testing.assert_array_equal(
        np.concatenate([part.error_mm[0] for part in found]), np.concatenate(expected)
    )
    assert found[-1].index[-1] == 298


def test_contour_error_of_a_late_point_is_zero_on_a_straight_line() -> None:
    y_d = np.vstack([np.arange(500) * 0.1, np.zeros(500)])
    late = np.roll(y_d, 20, axis=1)
    late[:, :20] = 0
    assert contour_error(y_d, late).max() < 1e-12
    assert tracking_error(y_d, late)[250] == pytest.approx(2.0)
    assert contour_error(y_d, late + 0.5)[250] == pytest.approx(0.5)


def test_few_segments_are_looked_at() -> None:
    y_d = np.vstack([np.arange(20_000) * 0.1, np.zeros(20_000)])
    meter = ContourMeter()
    meter.push(y_d, y_d[None] + 0.01)
    # 160 segments in each window.
    assert meter.evaluations < 20 * 10_000


@given(st.integers(0, 1000), st.lists(st.integers(0, 400), max_size=3))
@settings(max_examples=25)
def test_motion_meter_adds_up(seed: int, cuts: list[int]) -> None:
    n, stride = 400, 3
    y_d, y = wander(seed, n, 0.02)
    answers = np.stack([y, y_d + 0.5 * (y - y_d)])
    extruding = np.random.default_rng(seed).random(n) < 0.6
    meter = MotionMeter(stride=stride, channels=2)
    for a, b in pairwise([0, *sorted(cuts), n]):
        meter.push(y_d[:, a:b], answers[:, :, a:b], extruding[a:b])
    meter.flush()
    for c, answer in enumerate(answers):
        contour = np.array([brute_force(y_d, answer, i, 80) for i in range(0, n, stride)])
        tracking = np.hypot(*(answer - y_d))
        for tally, values in (
            (meter.contour_all[c], contour),
            (meter.contour_extruding[c], contour[extruding[::stride]]),
            (meter.tracking_all[c], tracking),
            (meter.tracking_extruding[c], tracking[extruding]),
        ):
            assert tally.count == len(values)
            assert tally.rms == pytest.approx(np.sqrt(np.mean(values**2)))
            assert tally.max == pytest.approx(values.max())


@given(st.integers(0, 1000), st.lists(st.integers(0, 60), max_size=3))
@settings(max_examples=25)
def test_groups_add_up(seed: int, cuts: list[int]) -> None:
    n = 60
    rng = np.random.default_rng(seed)
    values, groups = rng.random((2, n)), rng.integers(-1, 4, n).astype(np.int32)
    use = rng.random(n) < 0.6
    tally = GroupTally(2)
    for a, b in pairwise([0, *sorted(cuts), n]):
        tally.add(values[:, a:b], groups[a:b], use[a:b])
    for c, row in enumerate(values):
        found = tally.tallies(c)
        assert sorted(found) == sorted(set(groups[use].tolist()))
        for i, one in found.items():
            mine = row[use & (groups == i)]
            assert one.count == len(mine)
            assert one.rms == pytest.approx(np.sqrt(np.mean(mine**2)))
            assert one.max == pytest.approx(mine.max())


def test_groups_grow_both_ways() -> None:
    groups = GroupTally(1)
    use = np.array([True, True])
    groups.add(np.array([[1.0, 2.0]]), np.array([5, 5], np.int32), use)
    groups.add(np.array([[3.0, 4.0]]), np.array([-1, 9], np.int32), use)
    groups.add(np.zeros((1, 0)), np.zeros(0, np.int32), np.zeros(0, bool))
    assert {k: t.max for k, t in groups.tallies().items()} == {-1: 3.0, 5: 2.0, 9: 4.0}
    assert Tally().rms == 0.0


@pytest.mark.parametrize("block", [7, 1000])
def test_residual_vibration(block: int) -> None:
    """Rests of 300 and 60 samples count, one of 10 does not; the first standstill neither."""
    move = np.arange(1, 51) * 0.1
    x = np.concatenate(
        [np.zeros(50), move, np.full(300, 5.0), 5 + move, np.full(10, 10.0), 10 + move,
         np.full(60, 15.0)]
    )  # fmt: skip
    y_d = np.vstack([x, np.zeros_like(x)])
    y = y_d + np.vstack([np.sin(np.arange(len(x))), np.zeros_like(x)])
    meter, extruding = MotionMeter(), np.zeros(len(x), bool)
    for a in range(0, len(x), block):
        part = slice(a, a + block)
        meter.push(y_d[:, part], y[None, :, part], extruding[part])
    error = np.abs(y - y_d)[0]
    used = np.concatenate([error[99:199], error[509:570]])
    assert meter.rests == 2
    tally = meter.residual[0]
    assert tally.count == len(used)
    assert tally.rms == pytest.approx(np.sqrt(np.mean(used**2)))
    assert tally.max == pytest.approx(used.max())


def test_bad_shapes() -> None:
    with pytest.raises(ValueError, match="must be"):
        ContourMeter().push(np.zeros((2, 3)), np.zeros((1, 2, 4)))
