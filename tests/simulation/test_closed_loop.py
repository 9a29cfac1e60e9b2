"""Closed loops against scipy, python-control and what limits and sensors must do."""

from __future__ import annotations

import control
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter

from stillpath.models.diagrams import Block
from stillpath.models.disturbances import SensorSpec
from stillpath.models.loops import PidLoop, load_loop
from stillpath.simulation.closed_loop import ClosedLoop, Imperfections, batch, simulate

GALVO = load_loop("galvo-10khz")
TABLE = load_loop("direct-drive-table").nominal()
WHITE = np.random.default_rng(1).normal(size=3000)


def test_sensitivity_is_scipys_filter() -> None:
    loop = GALVO.nominal()
    y = simulate(loop, (), {"d_out": WHITE})["y"]
    assert y == pytest.approx(lfilter(loop.plant_den, loop.t0_den, WHITE), abs=1e-12)


def test_step_is_python_controls() -> None:
    num, den = np.trim_zeros(TABLE.plant_num, "f"), TABLE.plant_den
    plant = control.tf(num, np.pad(den, (0, len(TABLE.plant_num) - len(den))), TABLE.dt_s)
    kp = TABLE.error_num[0]
    rate = control.tf(TABLE.rate_num, TABLE.rate_den, TABLE.dt_s)
    closed = kp * control.feedback(plant, rate + kp)
    t = np.arange(400) * TABLE.dt_s
    expected = control.step_response(closed, t).outputs
    y = simulate(TABLE, (), {"r": np.ones(400)})["y"]
    assert y == pytest.approx(expected, abs=1e-8)
    assert y[-1] == pytest.approx(1.0, abs=1e-3)


@given(st.integers(0, 3000), st.integers(1, 4), st.integers(0, 3))
@settings(max_examples=20)
def test_stream_is_the_whole(cut: int, every: int, age: int) -> None:
    sensor = SensorSpec(every=every, delay_samples=age, quantum=0.01)
    made = [
        ClosedLoop(
            GALVO.nominal(), (), sensor=sensor, imperfections=Imperfections(noise_rms=0.1),
            generator=np.random.default_rng(3),
        )
        for _ in range(2)
    ]  # fmt: skip
    whole = made[0].push({"d_out": WHITE})["y"]
    parts = [made[1].push({"d_out": part})["y"] for part in (WHITE[:cut], WHITE[cut:])]
    assert np.array_equal(whole, np.concatenate(parts))


def test_batch_is_each_plant() -> None:
    loops = GALVO.loops()
    found = batch(loops, (), {"d_out": WHITE})
    for row, loop in zip(found, loops, strict=True):
        assert row == pytest.approx(lfilter(loop.plant_den, loop.t0_den, WHITE), abs=1e-10)
    noisy = batch(loops, (), {"d_out": WHITE}, seed=5, imperfections=Imperfections(noise_rms=0.1))
    again = batch(loops, (), {"d_out": WHITE}, seed=5, imperfections=Imperfections(noise_rms=0.1))
    assert np.array_equal(noisy, again)
    assert not np.array_equal(noisy, found)
    with pytest.raises(ValueError, match="generator"):
        simulate(loops[0], (), {"r": [0.0]}, imperfections=Imperfections(noise_rms=1.0))


def test_slow_sensor_holds_and_rounds() -> None:
    out = simulate(
        GALVO.nominal(), (), {"d_out": WHITE}, ("y", "ym"), sensor=SensorSpec(every=4, quantum=0.25)
    )
    seen = 0.25 * np.floor(out["y"][::4] / 0.25 + 0.5)
    assert out["ym"] == pytest.approx(np.repeat(seen, 4), abs=1e-12)


def test_saturation_limits_the_input() -> None:
    free = simulate(TABLE, (), {"r": np.ones(2000)}, ("u", "y"))
    held = simulate(
        TABLE, (), {"r": np.ones(2000)}, ("u", "y"), imperfections=Imperfections(input_limit=10.0)
    )
    assert np.abs(free["u"]).max() > 40
    assert np.abs(held["u"]).max() == 10.0
    # Full thrust to half way would take 2 sqrt(1 mm / 66.7 m/s^2); the loop needs longer.
    assert np.argmax(held["y"] > 0.9) > np.argmax(free["y"] > 0.9)
    assert held["y"][-1] == pytest.approx(1.0, abs=1e-3)


def test_friction_leaves_an_error_that_proportional_control_cannot_remove() -> None:
    imperfections = Imperfections(friction=0.12, friction_speed=1e-7)
    y = simulate(TABLE, (), {"r": np.ones(8000)}, imperfections=imperfections)["y"]
    rest = 0.12 / TABLE.error_num[0]
    assert 0 < abs(1 - y[-1]) <= 1.001 * rest
    free = simulate(TABLE, (), {"r": np.ones(8000)})["y"]
    assert abs(1 - free[-1]) < 1e-9


def test_add_on_may_run_faster_than_the_plant() -> None:
    """A controller at three ticks per sample that passes the error on changes nothing."""
    loop = GALVO.nominal()
    every = 3
    inputs = {"d_out": np.repeat(WHITE, every)}
    same = simulate(loop, [Block("c", (("ym", 0.0),))], inputs, every=every)["y"]
    assert same[::every] == pytest.approx(simulate(loop, (), {"d_out": WHITE})["y"], abs=1e-12)


def test_retuning_while_running() -> None:
    loop = GALVO.nominal()
    running = ClosedLoop(loop, [Block("c", (("ym", 0.0),), (1.0, 0.5))])
    first = running.push({"d_out": WHITE})["y"]
    assert first == pytest.approx(simulate(loop, (), {"d_out": WHITE})["y"], abs=1e-12)
    running.retune([Block("c", (("ym", 0.2),), (1.0, 0.5))], reset=False)
    changed = running.push({"d_out": WHITE})["y"]
    assert np.abs(changed - first).max() > 0.01


def test_pid_loop_removes_a_constant_disturbance() -> None:
    spec = PidLoop(
        plant_num=(0.0, 0.1, 0.05), plant_den=(1.0, -1.5, 0.6), dt_s=1e-3, kp=0.5, ki=20.0
    )
    y = simulate(spec.loop("axis"), (), {"d_in": np.ones(4000)})["y"]
    assert abs(y[-1]) < 1e-9
