"""Passes over a command, and over its moves, against numpy."""

from __future__ import annotations

import numpy as np
import pytest

from stillpath.pipeline.measuring._peak_kernels import peaks, speed_step


@pytest.mark.parametrize("n", [1, 2, 3, 50])
def test_peaks(n: int) -> None:
    command = np.random.default_rng(n).normal(size=(4, n))
    steps = np.diff(command[:2])
    step_mm, bend_mm = peaks(command)
    assert step_mm == pytest.approx(np.max(np.hypot(*steps), initial=0.0), rel=1e-14)
    assert bend_mm == np.max(np.abs(np.diff(steps)), initial=0.0)


@pytest.mark.parametrize("corexy", [False, True])
@pytest.mark.parametrize("mean", [False, True])
@pytest.mark.parametrize("n", [0, 1, 2, 50])
def test_speed_step(n: int, mean: bool, corexy: bool) -> None:
    rng = np.random.default_rng(n)
    accel, cruise, decel = rng.uniform(0.0, 0.01, size=(3, n))
    start, top = rng.uniform(0.0, 100.0, size=(2, n))
    rate, direction = rng.uniform(100.0, 3000.0, size=n), rng.normal(size=(n, 4))
    found = speed_step(accel, cruise, decel, start, top, rate, direction, 0.01, mean, corexy)
    duration = accel + cruise + decel
    lost = 0.5 * (accel * (top - start) + rate * decel**2) / duration
    velocity = direction[:, :2] * (top - lost if mean else top)[:, None]
    rounding = 0.01 / np.maximum(duration, 1e-4)
    if corexy:
        velocity = velocity @ np.array([[1.0, 1.0], [1.0, -1.0]])
        rounding = 2.0 * rounding
    steps = np.abs(np.diff(velocity, axis=0)).max(axis=1) - rounding[1:] - rounding[:-1]
    assert found == pytest.approx(np.max(steps, initial=0.0), rel=1e-12)
