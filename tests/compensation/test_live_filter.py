"""The filter for print time: what it may not move, what it reaches, and how it keeps limits."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import signal

from stillpath.compensation.live_filter import LiveFilter, design_taps, shaper_taps
from stillpath.models.plants import ContinuousPlant, DiscretePlant
from stillpath.models.shaper_pulses import SHAPERS, shaper_pulses

DT_S = 1e-3


def mode(f_hz: float, zeta: float) -> DiscretePlant:
    """One mode without delay at zero frequency: (2 z w s + w^2)/(s^2 + 2 z w s + w^2)."""
    w = 2 * np.pi * f_hz
    a, b, c, d = signal.tf2ss([2 * zeta * w, w * w], [1.0, 2 * zeta * w, w * w])
    return ContinuousPlant(a, b[:, 0], c[0], float(d[0, 0])).discretise(DT_S)


def moments(taps: np.ndarray) -> tuple[float, float]:
    late = np.arange(len(taps)) - len(taps) // 2
    return float(taps.sum()), float(late @ taps)


@settings(max_examples=15)
@given(st.floats(20.0, 90.0), st.floats(0.03, 0.2), st.sampled_from([70.0, 150.0, 270.0]))
def test_slow_motion_is_not_moved(f_hz: float, zeta: float, corner_hz: float) -> None:
    taps = design_taps([mode(f_hz, zeta)], np.ones(1), corner_hz)
    gain, moment = moments(taps)
    assert gain == pytest.approx(1.0, abs=1e-14)
    assert moment == pytest.approx(0.0, abs=1e-11)


@pytest.mark.parametrize("kind", SHAPERS)
def test_a_shaper_is_such_a_filter(kind: str) -> None:
    pulses = shaper_pulses(kind, 40.0)
    taps = shaper_taps(pulses, DT_S)
    assert moments(taps) == pytest.approx((1.0, 0.0), abs=1e-12)
    f = np.array([5.0, 20.0, 40.0])
    late = np.arange(-80, 81) * DT_S
    ours = np.exp(-2j * np.pi * np.outer(f, late)) @ taps
    centred = pulses[1] - pulses[0] @ pulses[1]
    theirs = np.exp(-2j * np.pi * np.outer(f, centred)) @ pulses[0]
    assert np.abs(ours - theirs).max() < 5e-3


def test_a_shaper_that_is_too_long_is_refused() -> None:
    with pytest.raises(ValueError, match="longer than"):
        shaper_taps(shaper_pulses("3hump_ei", 10.0), DT_S)


def test_vibration_that_scipy_simulates_goes_away() -> None:
    plant = mode(40.0, 0.06)
    # Half a second at 100 mm/s and 5000 mm/s2, and back.
    a = np.zeros(2000)
    a[300:320], a[800:820], a[1100:1120], a[1600:1620] = 5e3, -5e3, -5e3, 5e3
    path = np.cumsum(np.cumsum(a)) * DT_S**2
    live = LiveFilter(
        np.stack([design_taps([plant], np.ones(1), 150.0)] * 2), DT_S, 1e3, 1e5,
        np.array([[-1e3, 1e3]] * 2),
    )  # fmt: skip
    padded = np.pad(np.stack([path, path]), ((0, 0), (live.margin, live.margin)), mode="edge")
    command = live.command(padded)[0]
    system = (plant.a, plant.b[:, None], plant.c[None], [[plant.d]], DT_S)

    def answer(u: np.ndarray) -> np.ndarray:
        return np.asarray(signal.dlsim(system, u)[1][:, 0])

    plain, ours = answer(path) - path, answer(command) - path
    assert np.sqrt(np.mean(ours**2)) < 0.1 * np.sqrt(np.mean(plain**2))
    # It stands where the plan stands.
    assert command[0] == pytest.approx(path[0], abs=1e-12)
    assert command[-1] == pytest.approx(path[-1], abs=1e-12)


def test_a_set_is_not_worse_than_its_middle_on_its_edges() -> None:
    edges = [mode(36.0, 0.06), mode(44.0, 0.06)]
    f = np.linspace(1.0, 100.0, 400)
    wave = np.exp(-2j * np.pi * np.outer(f, np.arange(-80, 81) * DT_S))

    def worst(taps: np.ndarray) -> float:
        return max(
            float(np.sum((np.abs(1 - g.frequency_response(f) * (wave @ taps)) / f**2) ** 2))
            for g in edges
        )

    middle = design_taps([mode(40.0, 0.06)], np.ones(1), 200.0)
    both = design_taps(edges, np.full(2, 0.5), 200.0)
    assert worst(both) < worst(middle)


@pytest.mark.parametrize("motors", [False, True])
def test_limits_are_kept_where_the_plan_keeps_them(motors: bool) -> None:
    a = np.zeros(3000)
    a[500:530], a[900:930], a[1500:1530], a[2200:2230] = 4e3, -4e3, -4e3, 4e3
    row = np.cumsum(np.cumsum(a)) * DT_S**2
    taps = np.stack([design_taps([mode(30.0, 0.03)], np.ones(1), 270.0)] * 2)
    limits, bounds = (500.0, 4200.0), np.array([[-1.0, 1e3]] * 2)
    live = LiveFilter(taps, DT_S, *limits, bounds)
    if motors:
        # One of a CoreXY moves with x + y, here with twice the motion of X.
        live = LiveFilter(taps, DT_S, 1e9, 1e9, bounds, *(2.0 * limit for limit in limits))
    free = LiveFilter(taps, DT_S, 1e9, 1e9, np.array([[-1e9, 1e9]] * 2))
    padded = np.pad(np.stack([row, row]), ((0, 0), (400, 400)), mode="edge")

    def most(one: LiveFilter) -> float:
        return float(np.abs(np.diff(one.command(padded), 2)).max()) / DT_S**2

    assert most(free) > 1.2 * limits[1]
    # What the share's own change adds is small.
    assert most(live) < 1.1 * limits[1]
