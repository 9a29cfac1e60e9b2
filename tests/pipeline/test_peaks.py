"""Passes over a command, over its moves, and over measured motion, against numpy."""

from __future__ import annotations

import numpy as np
import pytest

from stillpath.pipeline.measuring._maxima_kernels import above, ringing
from stillpath.pipeline.measuring._peak_kernels import peaks, speed_steps


@pytest.mark.parametrize("n", [1, 2, 3, 50])
def test_peaks_agree_with_plain_numpy(n: int) -> None:
    command = np.random.default_rng(n).normal(size=(4, n))
    steps = np.diff(command[:2])
    step_mm, bend_mm = peaks(command)
    assert step_mm == pytest.approx(np.max(np.hypot(*steps), initial=0.0), rel=1e-14)
    assert bend_mm == np.max(np.abs(np.diff(steps)), initial=0.0)


@pytest.mark.parametrize("corexy", [False, True])
@pytest.mark.parametrize("mean", [False, True])
@pytest.mark.parametrize("n", [0, 1, 2, 50])
def test_speed_steps(n: int, mean: bool, corexy: bool) -> None:
    rng = np.random.default_rng(n)
    accel, cruise, decel = rng.uniform(0.0, 0.01, size=(3, n))
    start, top = rng.uniform(0.0, 100.0, size=(2, n))
    rate, direction = rng.uniform(100.0, 3000.0, size=n), rng.normal(size=(n, 4))
    found = speed_steps(accel, cruise, decel, start, top, rate, direction, 0.01, mean, corexy)
    duration = accel + cruise + decel
    lost = 0.5 * (accel * (top - start) + rate * decel**2) / duration
    ends = np.stack([start, top - rate * decel])
    near = np.minimum(ends + 0.5e-3 * rate, top)
    speeds = np.broadcast_to(top - lost, (4, n)) if mean else np.concatenate([ends, near])
    velocity = direction[:, :2] * speeds[..., None]
    rounding = 0.01 / np.maximum(duration, 1e-4)
    if corexy:
        velocity = velocity @ np.array([[1.0, 1.0], [1.0, -1.0]])
        rounding = 2.0 * rounding
    begin, end, after, before = velocity
    for one, later, earlier in zip(found, (begin, after), (end, before), strict=True):
        steps = np.abs(later[1:] - earlier[:-1]).max(axis=1) - rounding[1:] - rounding[:-1]
        assert one == pytest.approx(np.max(steps, initial=0.0), rel=1e-12)


@pytest.mark.parametrize("seed", range(20))
def test_samples_behind_the_ends_of_lines(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n, reach, still_mm = 200, int(rng.integers(1, 30)), 1e-9
    moves = np.repeat(rng.random(40) < 0.4, 5)
    path = np.cumsum(np.where(moves, rng.choice([0.0, 1e-3, -0.1], (2, n)), 0.0), axis=1)
    extruding = moves & np.repeat(rng.random(20) < 0.5, 10)
    before, (printed, moved) = path[:, 0] - [0.0, 0.1 * (seed % 2)], -rng.integers(1, 40, 2)
    found = np.empty((2, n), np.int64)
    count, *last = ringing(path, extruding, before, still_mm, reach, printed, moved, found)

    here, step = np.arange(n), np.abs(np.diff(path, axis=1, prepend=before[:, None]))
    line = np.maximum.accumulate(np.where(extruding, here, printed))
    since = np.maximum.accumulate(np.where(np.any(step > still_mm, axis=0), here, moved))
    chosen = ~extruding & (here - line <= reach) & (since <= line + 1)
    np.testing.assert_array_equal(found[:, :count], [here[chosen], line[chosen]])
    assert last == [line[-1], since[-1]]


@pytest.mark.parametrize("features", [0, 1, 4])
def test_samples_above_the_largest_of_their_feature(features: int) -> None:
    rng = np.random.default_rng(features)
    path, answer = rng.normal(size=(2, 2, 300))
    feature = rng.integers(-2, 4, 300).astype(np.int32)
    most = rng.uniform(0.5, 2.0, features)
    chosen = np.empty(300, np.int64)
    count = above(path, answer, feature, most, chosen)
    limit = np.append(most, np.zeros(5 - features))[feature + 1]
    distance = np.hypot(*(answer - path))
    np.testing.assert_array_equal(
        chosen[:count], np.flatnonzero((feature >= -1) & (distance > limit))
    )
