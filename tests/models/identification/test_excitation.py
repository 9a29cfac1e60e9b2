"""Klipper's resonance test, regenerated, against published figures and first principles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import welch

from stillpath.models.errors import ModelError
from stillpath.models.identification.excitation import (
    drive_spectrum,
    drive_spectrum_regenerated,
    klipper_psd,
    regenerate,
    welch_kernel,
)
from stillpath.models.identification.types import Excitation

NEW = Excitation((1.0, 0.0))
LEGACY = Excitation((1.0, 0.0), 5.0, 10_000 / 75, 75.0, 1.0, 0.0, 0.0)


def test_the_legacy_sweep_has_its_published_figures() -> None:
    profile = regenerate(LEGACY)
    assert profile.duration_s == pytest.approx(128.337, abs=5e-4)
    assert profile.segments == 35504
    assert np.abs(profile.velocity_mm_s).max() <= 18.8
    assert np.abs(profile.accelerations_mm_s2()).max() <= 10_000
    assert profile.travel_mm() == pytest.approx((0.0, 18.75 / 2 / 10), abs=1e-9)


def test_the_sweep_before_2024_12_is_as_its_klipper_planned_it() -> None:
    """Recorded from klippy/toolhead.py and resonance_tester.py of 2024-02-17 (72b301a28)."""
    profile = regenerate(replace(LEGACY, out_and_back=True))
    first_s = [0.0, 0.0353553391, 0.0707106781, 0.120710678, 0.169730286, 0.218749894, 0.266844952]
    last_s = [128.35354318, 128.35541819, 128.35674402, 128.35806985]
    np.testing.assert_allclose(profile.time_s[:7], first_s, atol=2e-9)
    np.testing.assert_allclose(profile.time_s[-4:], last_s, atol=2e-8)
    first_mm_s = [0.0, 13.2582521, 0.0, -18.75, 0.0, 18.75, 0.0]
    last_mm_s = [-18.75, 0.0, 13.2582521, 0.0]
    np.testing.assert_allclose(profile.velocity_mm_s[:7], first_mm_s, atol=1e-7)
    np.testing.assert_allclose(profile.velocity_mm_s[-4:], last_mm_s, atol=1e-7)
    assert profile.travel_mm() == pytest.approx((-0.4595588, 0.46875), abs=1e-6)


def test_the_new_sweep_has_its_published_figures() -> None:
    profile = regenerate(NEW)
    assert np.abs(profile.velocity_mm_s).max() == pytest.approx(135.0, abs=0.5)
    low, high = profile.travel_mm()
    assert low == pytest.approx(-18.0, abs=0.5)
    assert high == pytest.approx(19.0, abs=0.5)


def test_the_slow_wave_is_added_to_the_pulses() -> None:
    middles = np.arange(0.0005, 40.0, 0.00137)
    with_wave, without = (
        regenerate(e).cell_averages(middles, 1e-7)
        for e in (NEW, replace(NEW, sweeping_accel_mm_s2=0.0))
    )
    added = with_wave - without
    np.testing.assert_allclose(np.abs(added), 400.0, atol=0.1)
    flips = middles[1:][np.diff(np.sign(added)) != 0]
    early = 1.2 * np.sqrt(2) / 8
    np.testing.assert_allclose(flips[:2], [early, 2 * early + 0.3], atol=0.002)
    np.testing.assert_allclose(np.diff(flips[1:]), 0.6, atol=0.003)


def test_frequency_rises_at_the_given_rate() -> None:
    profile = regenerate(replace(LEGACY, hz_per_s=2.0))
    half_periods = np.diff(profile.time_s[::2])
    f = 0.5 / half_periods
    expected = 5.0 + 2.0 * profile.time_s[:-1:2]
    np.testing.assert_allclose(f, expected, rtol=1e-3)


@settings(max_examples=25)
@given(
    st.floats(3.0, 12.0),
    st.floats(20.0, 60.0),
    st.floats(20.0, 120.0),
    st.floats(0.5, 2.0),
    st.sampled_from([0.0, 400.0]),
)
def test_cell_averages_add_up_to_the_velocity(
    low: float, high: float, accel_per_hz: float, hz_per_s: float, sweeping: float
) -> None:
    profile = regenerate(Excitation((1.0, 0.0), low, high, accel_per_hz, hz_per_s, sweeping))
    h = 1 / 1600
    t = np.arange(-0.1, profile.duration_s + 0.2, h) + 0.3 * h
    u = profile.cell_averages(t, h)
    expected = np.interp(t + h / 2, profile.time_s, profile.velocity_mm_s)
    np.testing.assert_allclose(np.cumsum(u) * h, expected, atol=1e-7)
    assert np.abs(u).max() <= accel_per_hz * high + sweeping + 1e-6


def test_drive_spectrum_is_what_welch_sees_of_the_command() -> None:
    f = np.arange(8.0, 20.0, 0.5)
    ratio = drive_spectrum_regenerated(LEGACY, f) / drive_spectrum(LEGACY, f)
    np.testing.assert_allclose(ratio, 1.005, atol=0.02)
    f = np.arange(20.0, 130.0, 0.5)
    ratio = drive_spectrum_regenerated(LEGACY, f) / drive_spectrum(LEGACY, f)
    np.testing.assert_allclose(ratio, 1.0, atol=0.01)


def test_drive_spectrum_above_the_sweep_is_its_harmonics() -> None:
    f = np.array([160.0, 180.0, 200.0])
    fundamental = (4 / np.pi * 75 * f) ** 2 / (2 * (LEGACY.f_end_hz - LEGACY.f_start_hz))
    assert drive_spectrum(LEGACY, f) / fundamental == pytest.approx(
        1 / 243 + 1 / 5**5 + 1 / 7**5 + 1 / 9**5, abs=5e-5
    )
    assert drive_spectrum_regenerated(LEGACY, f) / fundamental == pytest.approx(0.0045, abs=1e-4)


@pytest.mark.parametrize(("f", "factor"), [(7.8, 1.60), (9.4, 1.36), (12.5, 1.14)])
def test_the_slow_wave_raises_the_low_end(f: float, factor: float) -> None:
    ratio = drive_spectrum_regenerated(NEW, f) / drive_spectrum(NEW, f)
    assert float(ratio) == pytest.approx(factor, abs=0.015)


def test_the_slow_wave_is_gone_above_17_hz() -> None:
    f = np.arange(17.2, 130.0, 1.0)
    ratio = drive_spectrum_regenerated(NEW, f) / drive_spectrum(NEW, f)
    assert ratio.max() < 1.03
    assert ratio.min() > 0.99


def test_psd_has_the_power_of_the_record() -> None:
    noise = np.random.default_rng(1).normal(0.0, 100.0, (64_000, 3))
    t = np.arange(64_000) / 3200
    f, psd = klipper_psd(t, noise)
    assert f[1] == pytest.approx(3200 / 2048, rel=1e-3)
    np.testing.assert_allclose(np.trapezoid(psd, f, axis=0), 100.0**2, rtol=0.02)


@pytest.mark.parametrize("columns", [(), (3,)])
def test_psd_is_scipys_welch(columns: tuple[int, ...]) -> None:
    x = np.random.default_rng(2).normal(50.0, 1.0, (20_000, *columns))
    t = 7.0 + np.arange(len(x)) / 1600.0
    rate = len(t) / (t[-1] - t[0])
    f, psd = klipper_psd(t, x)
    expected = welch(x, rate, np.kaiser(1024, 6.0), noverlap=512, detrend="constant", axis=0)
    np.testing.assert_allclose(f, expected[0], rtol=1e-12)
    np.testing.assert_allclose(psd, expected[1], rtol=1e-9, atol=1e-15)


def test_a_record_shorter_than_a_window_is_refused() -> None:
    with pytest.raises(ModelError, match="shorter than one window of 2048"):
        klipper_psd(np.arange(2000) / 3200, np.zeros(2000))


def test_kernel_is_the_response_of_the_estimate_to_a_tone() -> None:
    rate, nfft, tone = 3200.0, 2048, 100.3
    t = np.arange(200_000) / rate
    f, psd = klipper_psd(t, np.sqrt(2.0) * np.cos(2 * np.pi * tone * t))
    near = np.abs(f - tone) < 8
    # A tone of power 1 is two lines of 1/2; one-sided doubles them.
    np.testing.assert_allclose(psd[near], welch_kernel(nfft, rate, f[near] - tone), atol=3e-4)


def test_kernel_has_unit_area_and_its_published_bandwidth() -> None:
    offsets = np.linspace(-60, 60, 12_001)
    kernel = welch_kernel(2048, 3200.0, offsets)
    assert np.trapezoid(kernel, offsets) == pytest.approx(1.0, abs=1e-4)
    assert 1 / kernel.max() == pytest.approx(2.3, abs=0.02)
    np.testing.assert_allclose(kernel, kernel[::-1], atol=1e-15)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        *(("f_start_hz", value) for value in (0.0, 1e-6)),
        ("f_end_hz", float("nan")),
        *(("accel_per_hz_mm_s", value) for value in (-1.0, 1e9)),
        *(("hz_per_s", value) for value in (1e-6, 1e6)),
        *(("sweeping_accel_mm_s2", value) for value in (-400.0, 1e300)),
        *(("sweeping_period_s", value) for value in (float("inf"), 1e-9)),
    ],
)
def test_parameters_that_make_no_test_are_named(field: str, value: float) -> None:
    with pytest.raises(ModelError, match=field):
        regenerate(replace(NEW, **{field: value}))  # type: ignore[arg-type]
