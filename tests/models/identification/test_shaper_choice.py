"""Klipper's recommendation, against what Klipper's own code gave on the same files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stillpath.models.errors import ModelError
from stillpath.models.identification.shaper_choice import (
    choose_shaper,
    choose_shaper_of,
    residual_vibration,
)
from stillpath.models.identification.types import Spectrum
from stillpath.models.shaper_pulses import SHAPERS, shaper_pulses

F = np.arange(0.0, 200.0, 1.5625)


def one_mode(f_hz: float, zeta: float) -> np.ndarray:
    """A spectrum as a resonance test makes it: drive proportional to f^2 times |G|^2."""
    ratio = F / f_hz
    return F**2 / ((1 - ratio**2) ** 2 + (2 * zeta * ratio) ** 2)


@pytest.mark.shared
@pytest.mark.parametrize(
    ("file", "name", "f_hz", "mzv_hz"),
    [
        ("bassco_ender3/resonances_x_20210821_152037", "ei", 51.4, 41.2),
        ("bassco_ender3/resonances_y_20210630_223910", "ei", 40.6, 29.6),
        ("bassco_v0/resonances_x_20220703_144605", "mzv", 125.8, 125.8),
        ("bassco_v0/resonances_y_20220703_143119", "mzv", 82.6, 82.6),
        ("nielsvz_annexK3/resonances_x_20220522_092825", "mzv", 98.6, 98.6),
    ],
)
def test_recommendation_is_klippers(
    shared_dir: Path, file: str, name: str, f_hz: float, mzv_hz: float
) -> None:
    table = np.genfromtxt(shared_dir / "measurements" / f"{file}.csv", delimiter=",", names=True)
    best, every = choose_shaper(table["freq"], table["psd_xyz"])
    assert (best.name, round(best.f_hz, 1)) == (name, f_hz)
    assert [c.name for c in every] == list(SHAPERS)
    assert round(every[1].f_hz, 1) == mzv_hz


def test_one_mode_is_met_by_mzv() -> None:
    best, every = choose_shaper(F, one_mode(55.0, 0.06))
    assert best.name == "mzv"
    assert best.f_hz == pytest.approx(55.0, rel=0.06)
    assert best.vibrations < 0.05
    # Klipper's documentation: zv leaves more vibration and smooths less.
    assert every[0].vibrations > best.vibrations
    assert every[0].smoothing_mm < best.smoothing_mm


def test_no_shaper_above_150_hz() -> None:
    """What Klipper's own shaper_calibrate.py (2026-08) says of this spectrum."""
    f_hz, psd = F[F >= 5.0], one_mode(170.0, 0.05)[F >= 5.0]
    best, every = choose_shaper(f_hz, psd)
    assert (best.name, round(best.f_hz, 1)) == ("ei", 149.8)
    assert [round(one.f_hz, 1) for one in every] == [149.8, 105.8, 149.8, 149.8, 149.8]


@pytest.mark.parametrize(("f_hz", "accel"), [(30, 2700), (40, 4700), (50, 7400), (60, 10600)])
def test_suggested_acceleration(f_hz: float, accel: float) -> None:
    """Figures that Klipper's code prints for mzv, rounded to 100 mm/s^2."""
    _, every = choose_shaper(F, one_mode(f_hz, 0.06))
    mzv = every[1]
    nearby = accel * (mzv.f_hz / f_hz) ** 2
    assert mzv.max_accel_mm_s2 == pytest.approx(nearby, rel=0.06)


def test_residual_vibration_of_a_cancelled_mode_is_zero() -> None:
    pulses = shaper_pulses("zv", 40.0, 0.1)
    np.testing.assert_allclose(residual_vibration(pulses, [40.0], 0.1), 0, atol=1e-12)


def test_a_file_of_one_axis_or_several_data_sets() -> None:
    psd = one_mode(50.0, 0.1)
    whole = choose_shaper(F, psd)
    assert choose_shaper_of(Spectrum(F, {"x": psd / 2, "y": psd / 2, "xyz": psd})) == whole
    assert choose_shaper_of(Spectrum(F, {"x": psd / 2, "y": psd / 2}))[0] == whole[0]
    assert choose_shaper_of(Spectrum(F, {"0,0,0": psd / 2, "9,9,9": psd / 2}))[0] == whole[0]


def test_the_worst_of_several_data_sets_decides() -> None:
    low, high = one_mode(45.0, 0.05), one_mode(65.0, 0.05)
    (_, both), (_, only) = choose_shaper(F, np.stack([low, high])), choose_shaper(F, low)
    for together, alone in zip(both, only, strict=True):
        assert together.vibrations >= alone.vibrations - 0.01
    assert both[1].vibrations > 5 * only[1].vibrations


def test_an_empty_spectrum_is_refused() -> None:
    with pytest.raises(ModelError, match="no vibration below 200 Hz"):
        choose_shaper(F, np.zeros(len(F)))
