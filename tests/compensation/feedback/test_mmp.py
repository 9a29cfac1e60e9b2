"""Multirate predictor and observer: paper 001, its full system of equations, noise, refusals."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from stillpath.compensation.base import DesignError
from stillpath.compensation.feedback.controller import Refusal
from stillpath.compensation.feedback.mmp import (
    mmp,
    predictor,
    predictor_of_gain,
    singular_distance_hz,
)
from stillpath.models.diagrams import Diagram, Running
from stillpath.models.disturbances import SensorSpec
from stillpath.models.loops import load_loop
from stillpath.simulation.closed_loop import batch, simulate

SPEC = load_loop("galvo-camera")
LOOP = SPEC.nominal()
TS = 1e-4
TONES = [0.8e4 / 6, 1.6e4 / 6, 2.3e4 / 6]
B = [-0.1668, 0.7440, 0.7068, 0.6715, -0.1359, 0.7351]
W1 = [-0.0365, -0.0877, 0.1119, -0.1501, -0.0110, 0.1043]
W2 = [-0.0688, -0.0045, 0.1522, -0.1023, 0.0903, -0.0051]
sets = st.tuples(
    st.lists(st.floats(0.02, 0.48), min_size=1, max_size=3, unique=True),
    st.integers(2, 5),
    st.floats(0.0, 0.97),
)


def full_system(f_hz: list[float], ratio: int, alpha: float, k: int) -> np.ndarray:
    """w_k from (22)-(24) of paper 001, with f_i Ts instead of f_i L Ts in (25)."""
    count = 2 * len(f_hz)
    a, b = np.ones(1), np.ones(1)
    for f in f_hz:
        w = 2 * np.pi * f * TS
        a = np.convolve(a, [1, -2 * np.cos(w), 1])
        b = np.convolve(b, [1, -2 * alpha * np.cos(ratio * w), alpha**2])
    size = count * ratio
    system = np.zeros((size, size))
    for j in range(count * (ratio - 1)):
        system[j : j + count + 1, j] = a
    for j in range(count):
        system[k + j * ratio - 1, count * (ratio - 1) + j] = 1.0
    right = np.zeros(size)
    right[:count] -= a[1:]
    right[ratio - 1 :: ratio] += b[1:]
    # The decoupled form (36), (37): the rows without w_k first.
    taken = np.arange(k - 1, size, ratio)
    others = np.setdiff1d(np.arange(size), taken)
    h = np.linalg.solve(system[others, : size - count], right[others])
    decoupled = right[taken] - system[taken, : size - count] @ h
    whole = np.linalg.solve(system, right)[-count:]
    assert decoupled == pytest.approx(whole, abs=1e-6)
    return whole


def test_section_5() -> None:
    """All 18 printed numbers."""
    made = predictor(TONES, 3, TS, 0.95)
    assert made.b[1:] == pytest.approx(B, abs=5e-5)
    assert made.w[1] == pytest.approx(W1, abs=5e-5)
    assert made.w[2] == pytest.approx(W2, abs=5e-5)
    assert made.b[-1] ** (1 / 6) == pytest.approx(0.95)


@given(sets)
@settings(max_examples=60)
def test_short_form_is_the_full_system(case: tuple[list[float], int, float]) -> None:
    parts, ratio, alpha = case
    f = [p / TS for p in parts]
    assume(singular_distance_hz(f, ratio * TS) > 100)
    assume(len(f) == 1 or np.diff(np.sort(f)).min() > 100)
    made = predictor(f, ratio, TS, alpha)
    for k in range(1, ratio):
        assert made.w[k] == pytest.approx(full_system(f, ratio, alpha, k), abs=1e-6)


@given(sets, st.integers(0, 2), st.integers(0, 2**32 - 1))
@settings(max_examples=60)
def test_predictor_is_exact_on_its_signals(
    case: tuple[list[float], int, float], late: int, seed: int
) -> None:
    parts, ratio, alpha = case
    f = [p / TS for p in parts]
    assume(singular_distance_hz(f, ratio * TS) > 60)
    made = predictor(f, ratio, TS, alpha, late)
    generator = np.random.default_rng(seed)
    t = np.arange(ratio * 1500) * TS
    d = np.zeros(len(t))
    for tone in f:
        d += generator.normal() * np.sin(2 * np.pi * tone * t + generator.uniform(0, 6.28))
    slow = np.repeat(np.concatenate([np.zeros(late), d[::ratio]])[: len(t) // ratio], ratio)
    found = Running(Diagram(made.blocks("slow", "fast"))).push({"slow": slow}, ("fast",))["fast"]
    assert found[-100:] == pytest.approx(d[-100:], abs=1e-6 * max(1.0, np.abs(d).max()))
    assert made.response(f) == pytest.approx(1.0, abs=1e-7)


def test_singular_sets() -> None:
    """Paper 001, after (14): a multiple of half the rate, and an alias."""
    assert singular_distance_hz([600, 2000], 1 / 2000) == 0
    assert singular_distance_hz([300, 1700], 1 / 2000) == 0
    assert singular_distance_hz(TONES, 3 * TS) == pytest.approx(1000 / 6)
    for pair in ([600.0, 2000.0], [300.0, 1700.0]):
        with pytest.raises(Refusal, match="cannot be told apart") as refused:
            predictor(pair, 5, TS)
        assert refused.value.reason == "singular"


def test_noise_gain() -> None:
    """The set of figure 7; and what nearness to an alias costs."""
    found = [
        predictor([187.5, 812.5, 1125], 3, 0.8e-3 / 3, a).noise_gain for a in (0, 0.5, 0.9, 0.95)
    ]
    assert found == pytest.approx([3.19, 1.56, 0.55, 0.39], abs=0.005)
    made = predictor(TONES, 3, TS, 0.9)
    slow = np.random.default_rng(0).normal(size=200_000)
    blocks = Diagram(made.blocks("slow", "fast"))
    fast = Running(blocks).push({"slow": np.repeat(slow, 3)}, ("fast",))["fast"]
    rms = np.sqrt(np.mean(fast.reshape(-1, 3) ** 2, axis=0))
    assert rms[0] == pytest.approx(1.0, abs=0.01)
    assert rms.max() == pytest.approx(1.0, abs=0.01)
    assert rms[1:].max() == pytest.approx(made.noise_gain, rel=0.02)
    near = [TONES[0], TONES[1], 1e4 / 3 - TONES[0] + 1.0]
    assert predictor(near, 3, TS, 0.95).noise_gain == pytest.approx(7.7, abs=0.05)
    with pytest.raises(Refusal, match="even at alpha"):
        predictor_of_gain([TONES[0], 1e4 / 3 - TONES[0] + 0.01], 3, TS)
    with pytest.raises(Refusal, match=r"multiplies sensor noise by 7\.68"):
        mmp(SPEC.loops(), near, SensorSpec(every=3))


def test_chosen_alpha_is_the_fastest_that_is_quiet_enough() -> None:
    made = predictor_of_gain(TONES, 3, TS, 0.6)
    assert made.noise_gain <= 0.6
    assert predictor(TONES, 3, TS, made.alpha - 0.1).noise_gain > 0.6
    assert predictor(TONES, 3, TS, 0.95).settling_s > made.settling_s


@pytest.mark.parametrize("age", [0, 2])
def test_rejection_beyond_nyquist(age: int) -> None:
    sensor = SensorSpec(every=3, delay_samples=age)
    made = mmp(SPEC.loops(), TONES, sensor, bandwidth_hz=10.0)
    t = np.arange(20000) * TS
    d = sum(np.sin(2 * np.pi * f * t + i) for i, f in enumerate(TONES))
    for y in batch(SPEC.loops(), made.blocks, {"d_out": d}, sensor=sensor):
        assert np.abs(y[-1000:]).max() < 1e-6
    r = np.sin(2 * np.pi * 30 * t)
    both = simulate(LOOP, made.blocks, {"d_out": d, "r": r}, sensor=sensor)["y"]
    alone = simulate(LOOP, (), {"r": r})["y"]
    assert both[-1000:] == pytest.approx(alone[-1000:], abs=1e-6)


def test_table_1() -> None:
    """Class of the published reductions at 28 % noise, with the fitted Q bandwidth of 1.5 Hz."""
    made = mmp(SPEC.loops(), TONES, SensorSpec(every=3), bandwidth_hz=1.5)
    t = np.arange(30000) * TS
    d = sum(np.sin(2 * np.pi * f * t + i) for i, f in enumerate(TONES))
    noise = 0.28 * np.abs(d).max() * np.random.default_rng(0).uniform(-1, 1, len(t))
    y = simulate(LOOP, made.blocks, {"d_out": d, "n": noise}, sensor=SPEC.sensor)["y"]
    assert 1 - np.abs(y[-10000:]).max() / np.abs(d).max() == pytest.approx(0.969, abs=0.01)


@given(
    st.lists(st.floats(0.03, 0.47), min_size=1, max_size=3, unique=True), st.integers(2, 4),
    st.floats(2.0, 60.0),
)  # fmt: skip
@settings(max_examples=25)
def test_what_is_returned_is_stable_on_every_member(
    parts: list[float], ratio: int, bandwidth_hz: float
) -> None:
    sensor = SensorSpec(every=ratio)
    try:
        made = mmp(SPEC.loops(), [p / TS for p in parts], sensor, bandwidth_hz=bandwidth_hz)
    except DesignError:
        return
    ticks = ratio * int(8 / (1 - max(made.spectral_radii)) / ratio + 1)
    assume(ticks < 100_000)
    pulse = np.zeros(2 * ticks)
    pulse[0] = 1.0
    for signal in ("y", "c"):
        out = np.abs(
            batch(SPEC.loops(), made.blocks, {"d_out": pulse}, signal=signal, sensor=sensor)
        )
        assert out[:, ticks:].max() <= 0.05 * out.max()


@pytest.mark.parametrize(
    ("f_hz", "ratio", "alpha"),
    [
        ([100.0], 1, 0.9),
        ([100.0], 3, 1.0),
        ([6000.0], 3, 0.9),
        ([float("nan")], 3, 0.9),
        ([], 3, 0),
    ],
)
def test_impossible_predictors(f_hz: list[float], ratio: int, alpha: float) -> None:
    with pytest.raises(DesignError):
        predictor(f_hz, ratio, TS, alpha)


def test_a_servo_on_the_slow_sensor_is_refused() -> None:
    with pytest.raises(DesignError, match="beside the servo"):
        mmp(load_loop("galvo-10khz").loops(), [300.0], SensorSpec(every=4))
