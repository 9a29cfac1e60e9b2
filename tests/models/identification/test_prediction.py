"""What a model says a test recorded, against Klipper's own estimate of a simulated one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stillpath.models.errors import ModelError
from stillpath.models.identification.prediction import predicted_psd, predicted_spectrum
from stillpath.models.identification.spectrum_fit import explanations
from stillpath.models.identification.synthetic import Sensor, simulate_spectrum
from stillpath.models.identification.types import Spectrum
from stillpath.models.plants import PairsSpec, PolePair
from tests.models.identification.recordings import LEGACY, one_mode

SMOOTH = one_mode(55.0, 0.25)  # wider than the window's 2.3 Hz


def simulated(plant: PairsSpec, gain: float = 1.0) -> Spectrum:
    quiet = Sensor(noise_mm_s2=0.0, lsb_mm_s2=0.0, gain=gain)
    return simulate_spectrum({"x": plant}, LEGACY, sensor=quiet, rng=np.random.default_rng(1))


def test_a_model_predicts_the_spectrum_of_its_plant() -> None:
    measured = simulated(SMOOTH)
    f, psd = predicted_spectrum(SMOOTH, LEGACY)
    inside = (f > 15.0) & (f < 125.0)
    seen = np.interp(f[inside], measured.f_hz, measured.psd["x"])
    assert np.median(psd[inside] / seen) == pytest.approx(1.0, abs=0.02)
    np.testing.assert_allclose(psd[inside], seen, rtol=0.15)
    assert f[-1] < 200.0


def test_amplitudes_count_by_their_square() -> None:
    f, once = predicted_spectrum(SMOOTH, LEGACY)
    _, twice = predicted_spectrum(SMOOTH, replace(LEGACY, accel_per_hz_mm_s=150.0))
    np.testing.assert_allclose(twice, 4 * once, rtol=1e-9)
    assert np.all(np.isfinite(once[(f > 10) & (f < 130)]))


def test_a_fit_predicts_its_own_file() -> None:
    """Also a sharp mode, which the window widens, and a sensor with another scale."""
    measured = simulated(PairsSpec(poles=(PolePair(f_hz=45.0, zeta=0.02),)), gain=0.9)
    fit = explanations([measured], LEGACY).explained().fit
    f, seen, predicted = predicted_psd(measured, "x", LEGACY, fit)
    at_bins = np.interp(f, measured.f_hz, measured.psd["x"])
    np.testing.assert_allclose(seen, at_bins, rtol=1e-9)
    db = 10 * np.log10(predicted / seen)
    assert np.sqrt(np.mean(db**2)) < 0.5
    assert abs(db[np.argmax(seen)]) < 0.5


def test_a_column_that_is_not_there() -> None:
    measured = simulated(SMOOTH)
    with pytest.raises(ModelError, match="nothing"):
        predicted_psd(
            measured,
            "nothing",
            LEGACY,
            explanations([measured], LEGACY, max_order=1).explained().fit,
        )
