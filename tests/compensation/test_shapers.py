"""Shapers against figures that Klipper's own code gave (reference notes, field study)."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stillpath.compensation._shaper_kernels import add_delayed
from stillpath.compensation.base import DesignError
from stillpath.compensation.registry import COMPENSATORS, compensator
from stillpath.compensation.shapers import SHAPERS, ShaperCompensator, shape, shaper_pulses
from stillpath.models.store import load_machine

NO_RESTS = np.zeros((0, 2), np.int64)


def residual(name: str, ratio: float, zeta: float) -> float:
    """Vibration left of a step, as a share, at `ratio` times the design frequency."""
    weights, times = shaper_pulses(name, 1.0, 0.1)
    w = 2 * np.pi * ratio
    phase = w * np.sqrt(1 - zeta**2) * times
    size = weights * np.exp(-zeta * w * (times[-1] - times))
    return float(np.hypot(size @ np.sin(phase), size @ np.cos(phase)))


def smoothing(name: str, f_hz: float, accel: float, corner: float = 5.0) -> float:
    weights, times = shaper_pulses(name, f_hz, 0.1)
    late = times - weights @ times
    after = late >= 0
    right = (weights * (corner + accel / 2 * late) * late)[after].sum() * np.sqrt(2)
    return float(max(right, weights @ (accel / 2 * late**2)))


@pytest.mark.parametrize(
    ("name", "percent"),
    [
        ("zv", (30, 16, 7, 16, 29)),
        ("mzv", (22, 11, 4, 8, 13)),
        ("ei", (4, 5, 7, 5, 5)),
        ("2hump_ei", (6, 5, 3, 5, 7)),
        ("3hump_ei", (3, 6, 7, 5, 4)),
    ],
)
def test_residual_vibration(name: str, percent: tuple[int, ...]) -> None:
    ours = [100 * residual(name, r, 0.05) for r in (0.8, 0.9, 1.0, 1.1, 1.2)]
    # The figures were printed as whole percent.
    np.testing.assert_allclose(ours, percent, atol=0.55)


@pytest.mark.parametrize(
    ("name", "smooth_mm", "accels"),
    [
        ("zv", 0.10, (3300, 6200, 9700, 14000)),
        ("mzv", 0.13, (2700, 4700, 7400, 10600)),
        ("ei", 0.21, (1600, 2900, 4600, 6600)),
        ("2hump_ei", 0.35, (800, 1600, 2600, 3800)),
        ("3hump_ei", 0.57, (400, 900, 1500, 2400)),
    ],
)
def test_smoothing_and_suggested_acceleration(
    name: str, smooth_mm: float, accels: tuple[int, ...]
) -> None:
    assert smoothing(name, 40, 5000) == pytest.approx(smooth_mm, abs=0.006)
    for f_hz, accel in zip((30, 40, 50, 60), accels, strict=True):
        assert smoothing(name, f_hz, accel + 51) > 0.12 > smoothing(name, f_hz, accel - 51)


@pytest.mark.parametrize("name", ["zv", "mzv"])
@given(zeta=st.floats(0, 0.5))
def test_exact_shapers_cancel_their_mode(name: str, zeta: float) -> None:
    weights, times = shaper_pulses(name, 40.0, zeta)
    pole = 2 * np.pi * 40 * (-zeta + 1j * np.sqrt(1 - zeta**2))
    assert abs(weights @ np.exp(-pole * times)) < 1e-12
    assert weights.sum() == pytest.approx(1.0)


@given(
    st.sampled_from(SHAPERS),
    st.floats(20, 200),
    st.booleans(),
    st.lists(st.floats(-1, 1), min_size=2, max_size=60),
)
def test_shape_is_linear_interpolation(
    name: str, f_hz: float, centred: bool, values: list[float]
) -> None:
    command = np.array(values)
    pulses = shaper_pulses(name, f_hz)
    weights, times = pulses
    k = np.arange(len(command))
    mean = weights @ times if centred else 0.0
    expected = sum(
        w * np.interp(k - (t - mean) / 1e-3, k, command)
        for w, t in zip(weights, times, strict=True)
    )
    np.testing.assert_allclose(shape(command, 1e-3, pulses, centred=centred), expected, atol=1e-12)
    given = np.full(len(command), np.nan)
    assert shape(command, 1e-3, pulses, centred=centred, out=given) is given
    np.testing.assert_allclose(given, expected, atol=1e-12)


def test_centred_shaper_does_not_delay_a_ramp() -> None:
    ramp = np.arange(400) * 0.1
    for name in SHAPERS:
        shaped = shape(ramp, 1e-3, shaper_pulses(name, 45.0))
        np.testing.assert_allclose(shaped[100:300], ramp[100:300], atol=1e-10)


def test_bad_shapers_are_refused() -> None:
    with pytest.raises(DesignError, match="there are zv, mzv"):
        shaper_pulses("zvx", 40)
    with pytest.raises(DesignError, match="must be positive"):
        shaper_pulses("zv", 0)
    with pytest.raises(DesignError, match=r"between 0 and 0\.2"):
        shaper_pulses("3hump_ei", 40, 0.3)
    with pytest.raises(DesignError, match="no compensator is called 'magic'; there are fbf"):
        compensator("magic", load_machine("ender3"), 1e-3)


def test_compensator_stands_still_in_rests() -> None:
    machine = load_machine("voron-v24-250")
    made = compensator("shaper:mzv", machine, 1e-3)
    assert isinstance(made, ShaperCompensator)
    assert made.name in COMPENSATORS
    # The resonance that rings most: 65 Hz on X.
    assert made.frequencies_hz[0] == pytest.approx(65.2, abs=0.3)
    ramp = np.concatenate([np.zeros(50), np.arange(100) * 0.1, np.full(80, 9.9)])
    y_d = np.stack([np.concatenate([ramp, 9.9 + ramp]), np.concatenate([-ramp, ramp - 9.9])])
    rests = np.array([[151, 270]])
    u = made.compensate(y_d, np.ones(y_d.shape[1], bool), rests)
    assert np.all(u[:, 150:270] == y_d[:, [200]])
    np.testing.assert_array_equal(u[:, [0, -1]], y_d[:, [0, -1]])
    assert np.abs(u - y_d).max() < 0.5
    free = made.compensate(y_d, np.ones(y_d.shape[1], bool), NO_RESTS)
    np.testing.assert_allclose(u[:, 50:115], free[:, 50:115], atol=1e-12)


@given(
    n=st.integers(1, 12),
    shifts=st.lists(st.integers(-20, 20), max_size=4),
    seed=st.integers(0, 99),
)
def test_delayed_commands_add_up(n: int, shifts: list[int], seed: int) -> None:
    random = np.random.default_rng(seed)
    command, out = random.normal(size=n), random.normal(size=n)
    samples, gains = np.array(shifts, np.int64), random.normal(size=len(shifts))
    expected = out.copy()
    for late, gain in zip(shifts, gains, strict=True):
        expected += gain * command[np.clip(np.arange(n) - late, 0, n - 1)]
    add_delayed(command, samples, gains, out)
    np.testing.assert_array_equal(out, expected)
