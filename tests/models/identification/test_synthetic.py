"""Simulated measurements against independent simulation and what was asked for."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lsim

from stillpath.models.errors import ModelError
from stillpath.models.identification.excitation import drive_spectrum, regenerate
from stillpath.models.identification.synthetic import (
    LIS2DW,
    Sensor,
    acceleration_response,
    simulate_log,
    simulate_spectrum,
)
from stillpath.models.identification.types import Excitation
from stillpath.models.plants import (
    FirSpec,
    Mode,
    ModesSpec,
    PairsSpec,
    PolePair,
    ZeroPair,
    frequency_response,
)

SHORT = Excitation((1.0, 0.0), 5.0, 9.0, 60.0, 2.0)
NEW = Excitation((1.0, 0.0))
PAIRS = PairsSpec(
    poles=(PolePair(f_hz=47, zeta=0.035), PolePair(f_hz=95, zeta=0.06)),
    zeros=(ZeroPair(f_hz=60, zeta=-0.05),),
    real_zero_tau_s=1e-4,
)
TURNED = ((0.0, -0.8, 0.6), (1.0, 0.0, 0.0), (0.0, 0.6, 0.8))


def one(f_hz: float, zeta: float) -> ModesSpec:
    return ModesSpec(modes=(Mode(f_hz=f_hz, zeta=zeta),))


@pytest.mark.parametrize("plant", [one(40.0, 0.1), one(30.0, 2.0), PAIRS])
def test_response_is_that_of_scipy(plant: PairsSpec | ModesSpec) -> None:
    profile = regenerate(SHORT)
    h = 5e-5
    t = np.arange(0.0, profile.duration_s, h)
    roots = plant.roots()
    gain = np.real(np.prod(-roots.poles) / np.prod(-roots.zeros))
    held = profile.cell_averages(t + h / 2, h)
    expected = lsim((roots.zeros, roots.poles, gain), held, t, interp=False)[1]
    found = acceleration_response(plant, profile, t)
    assert np.abs(found - expected).max() < 2e-4 * np.abs(expected).max()


def test_response_before_the_test_is_zero_and_any_order_of_times_will_do() -> None:
    profile = regenerate(SHORT)
    t = np.array([1.0, -0.5, 0.3, 2.5])
    found = acceleration_response(PAIRS, profile, t)
    assert found[1] == 0.0
    np.testing.assert_array_equal(found, acceleration_response(PAIRS, profile, t[::-1])[::-1])


def test_plants_without_a_closed_form_are_refused() -> None:
    twice = PairsSpec(poles=(PolePair(f_hz=40, zeta=0.1), PolePair(f_hz=40, zeta=0.1)))
    with pytest.raises(ModelError, match="coincide"):
        acceleration_response(twice, regenerate(SHORT), np.zeros(1))
    with pytest.raises(ModelError, match="pure delay"):
        acceleration_response(FirSpec(taps=(0.0, 1.0), dt_s=1e-3), regenerate(SHORT), np.zeros(1))


def test_a_log_has_gravity_noise_steps_and_the_sensors_axes() -> None:
    sensor = Sensor(rotation=TURNED, noise_mm_s2=60.0, lsb_mm_s2=37.0)
    rng = np.random.default_rng(4)
    log = simulate_log({"x": PAIRS}, SHORT, sensor=sensor, start_s=50.0, lead_s=5.0, rng=rng)
    np.testing.assert_allclose(np.diff(log.time_s), 1 / 3200, atol=1e-12)
    assert log.time_s[0] == pytest.approx(45.0, abs=1e-3)
    assert log.time_s[-1] == pytest.approx(50.0 + regenerate(SHORT).duration_s + 0.5, abs=0.05)
    np.testing.assert_allclose(log.accel_mm_s2 / 37.0, np.round(log.accel_mm_s2 / 37.0), atol=1e-9)
    still = log.accel_mm_s2[log.time_s < 50.0]
    expected = 9806.65 * np.array(TURNED) @ np.array([0.0, 0.0, 1.0])
    np.testing.assert_allclose(still.mean(axis=0), expected, atol=3.0)
    np.testing.assert_allclose(still.std(axis=0), np.hypot(60.0, 37 / np.sqrt(12)), rtol=0.05)
    # The machine's x is the sensor's y.
    moved = log.accel_mm_s2[log.time_s > 50.0].std(axis=0)
    assert moved[1] > 4 * max(moved[0], moved[2])


def test_the_machine_stands_still_after_the_test() -> None:
    quiet = Sensor(noise_mm_s2=0.0, lsb_mm_s2=0.0)
    rng = np.random.default_rng(5)
    log = simulate_log({"x": PAIRS}, NEW, sensor=quiet, tail_s=2.0, rng=rng)
    velocity = np.cumsum(log.accel_mm_s2[:, 0]) / 3200
    assert np.abs(velocity[-1000:]).max() < 0.1
    assert np.abs(log.accel_mm_s2[-10:, 0]).max() < 0.1


def test_a_diagonal_test_moves_both_axes() -> None:
    both = Excitation((0.6, 0.8), 5.0, 9.0)
    quiet = Sensor(noise_mm_s2=0.0, lsb_mm_s2=0.0)
    rng = np.random.default_rng(7)
    log = simulate_log({"x": PAIRS, "y": PAIRS}, both, sensor=quiet, rng=rng)
    np.testing.assert_allclose(log.accel_mm_s2[:, 1], log.accel_mm_s2[:, 0] * 0.8 / 0.6, atol=1e-6)
    assert log.axis == "0.600,0.800"


def test_a_spectrum_is_drive_times_squared_response() -> None:
    plant = one(60.0, 0.25)
    spectrum = simulate_spectrum({"x": plant}, NEW, sensor=LIS2DW, rng=np.random.default_rng(8))
    f = spectrum.f_hz
    assert f[-1] <= 200.0
    used = (f > 20) & (f < 130)
    expected = drive_spectrum(NEW, f) * np.abs(frequency_response(plant, f)) ** 2
    np.testing.assert_allclose(spectrum.psd["x"][used], expected[used], rtol=0.03)
    total = sum(spectrum.psd[c] for c in "xyz")
    np.testing.assert_allclose(spectrum.psd["xyz"], total, rtol=1e-12)
