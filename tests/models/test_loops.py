"""Closed-loop machines against the printed models and python-control."""

from __future__ import annotations

import json
from pathlib import Path

import control
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stillpath.models.diagrams import Diagram
from stillpath.models.errors import ModelError
from stillpath.models.loops import Loop, LoopSpec, PidLoop, builtin_loops, load_loop, read_loop

F_HZ = np.array([10.0, 300.0, 1500.0, 3300.0])
PRINTED = {
    # Papers 000 (9) and section VIII-A, 004 (20) and (21), as N/D in falling powers of z.
    "galvo-40khz": ([0.0282, 0.1504, 0.1146], [1, -1.3190, 0.929, -0.6073, -0.0035], 1.0006),
    "galvo-10khz": (
        [0.5465, 0.4598, -0.0717, -0.0721],
        [1, -0.5221, -0.6208, 0.0730, 0.0721],
        0.9983,
    ),
    "galvo-crosstalk-48khz": (
        [0.061, 0.103, 0.061],
        [1, -1.485, 1.032, -0.433, -0.057, -0.061],
        1.0032,
    ),
    "galvo-crosstalk-16khz": (
        [0.061, 0.737, 0.351, 0.034, 0.0001],
        [1, 0.144, -0.773, -0.359, -0.034, -0.0001],
        1.0086,
    ),
}


@pytest.mark.parametrize("name", builtin_loops())
def test_built_in_loops_are_consistent_and_stable(name: str) -> None:
    spec = load_loop(name)
    assert spec.name == name
    assert spec.source
    loop = spec.nominal()
    assert LoopSpec.model_validate_json(spec.model_dump_json()) == spec
    if loop.fed_back:
        assert loop.s0(F_HZ) + loop.t0(F_HZ) == pytest.approx(1.0, abs=1e-12)
    for member in spec.loops():
        diagram = Diagram(member.blocks())
        assert diagram.spectral_radius() < 1
        for signal, expected in (
            ("d_out", member.s0(F_HZ)),
            ("d_in", member.servo(F_HZ)),
            ("r", member.tracking(F_HZ)),
        ):
            found = diagram.response(F_HZ, member.dt_s, signal, "y")
            assert found == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("name", sorted(PRINTED))
def test_loop_of_a_printed_plant(name: str) -> None:
    num, den, radius = PRINTED[name]
    loop = load_loop(name).nominal()
    assert np.abs(np.roots(den)).max() == pytest.approx(radius, abs=1e-4)
    assert loop.plant_radius <= 1 + 1e-12
    closed = control.feedback(control.tf(num, den, loop.dt_s))
    dc = float(np.real(closed(1.0)))
    printed = closed(np.exp(2j * np.pi * F_HZ * loop.dt_s)) / max(dc, 1.0)
    assert loop.t0(F_HZ) == pytest.approx(printed, abs=1e-12)
    assert bool(loop.notes) == (dc > 1)


def test_disturbed_outside_is_not_fed_back() -> None:
    loop = load_loop("galvo-camera").nominal()
    assert not loop.fed_back
    assert loop.s0(F_HZ) == pytest.approx(1.0)
    assert abs(loop.tracking([1e-9])[0]) == pytest.approx(1.002, abs=5e-4)


def test_pid_on_the_error_is_python_controls() -> None:
    spec = PidLoop(
        plant_num=(0.0, 0.1, 0.05), plant_den=(1.0, -1.5, 0.6), delay_samples=1, dt_s=1e-3,
        kp=0.5, ki=20.0, kv=0.3, velocity_corner_hz=100.0, velocity_from="error",
    )  # fmt: skip
    loop = spec.loop("axis")
    p = np.exp(-2 * np.pi * 100.0 * 1e-3)
    z = control.tf([1, 0], [1], 1e-3)
    c = 0.5 + 20.0 * 1e-3 * z / (z - 1) + 0.3 * (1 - p) * (z - 1) / (z - p)
    closed = control.feedback(control.tf([0.1, 0.05], [1, -1.5, 0.6, 0], 1e-3) * c)
    f = np.array([1.0, 20.0, 150.0])
    expected = closed(np.exp(2j * np.pi * f * 1e-3))
    assert loop.t0(f) == pytest.approx(expected, abs=1e-9)
    assert loop.tracking(f) == pytest.approx(expected, abs=1e-9)
    from_output = spec.model_copy(update={"velocity_from": "output"}).loop("axis")
    assert from_output.t0(f) == pytest.approx(expected, abs=1e-9)
    assert np.abs(from_output.tracking(f) - expected).max() > 0.03
    assert from_output.tracking([1e-9])[0] == pytest.approx(1.0, abs=1e-6)
    found = Diagram(from_output.blocks()).response(f, 1e-3, "r", "y")
    assert found == pytest.approx(from_output.tracking(f), abs=1e-9)


@given(st.floats(0.8, 1.2), st.floats(0.0, 2.0))
@settings(max_examples=30)
def test_variation_is_gain_and_delay(gain: float, delay: float) -> None:
    loop = load_loop("galvo-40khz").nominal()
    f = np.array([50.0, 400.0])
    found = loop.varied(gain, delay).plant(f) / loop.plant(f)
    assert found == pytest.approx(gain * np.exp(-2j * np.pi * f * delay * loop.dt_s), abs=1e-3)


def test_loops_that_cannot_be_say_why(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="strictly proper"):
        Loop((1.0, 0.2), (1.0, -0.5), 1e-3)
    with pytest.raises(ModelError, match="unstable"):
        Loop((0.0, 3.0), (1.0, -0.5), 1e-3)
    with pytest.raises(ModelError, match="built in are"):
        load_loop("galvo")
    with pytest.raises(ModelError, match="cannot read"):
        load_loop(tmp_path / "none.json")
    document = json.loads(load_loop("galvo-10khz").model_dump_json())
    document["loop"]["dt_s"] = -1
    with pytest.raises(
        ModelError, match=r"mine: loop\.servo\.dt_s: must be more than 0 s \(given: -1"
    ):
        read_loop(json.dumps(document), "mine")
    with pytest.raises(ModelError, match="mine: 'name' is there twice"):
        read_loop('{"name": "a", "name": "b"}', "mine")
    with pytest.raises(ModelError, match="not JSON"):
        read_loop(b"\xff")
    document["loop"]["dt_s"] = 1e-4
    document["members"] = [{"gain": 40.0}]
    path = tmp_path / "wild.json"
    path.write_text(json.dumps(document))
    with pytest.raises(ModelError, match="unstable"):
        load_loop(path)


@pytest.mark.parametrize(
    ("num", "den", "words"),
    [
        ((0.0, 0.0), (1.0, -0.5), "plant is 0"),
        ((0.0, float("nan")), (1.0, -0.5), "finite"),
        ((0.0, 0.5), (0.0, 1.0), "begins with 0"),
        ((0.0, 0.5), (1.0, -1.0), "no finite gain"),
    ],
)
def test_what_is_no_loop(num: tuple[float, ...], den: tuple[float, ...], words: str) -> None:
    with pytest.raises(ModelError, match=words):
        Loop.from_t0(num, den, 1e-3)
