"""Fits of spectra: of simulated tests with known truth, and of all real files there are."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from models.errors import ModelError
from models.identification.excitation import drive_spectrum, klipper_psd
from models.identification.readers import read_measurements
from models.identification.shaper_choice import choose_shaper_of
from models.identification.spectrum_fit import fit_spectrum, refit_spectrum
from models.identification.spectrum_model import cross_axis_share, driven_column, spectrum_model
from models.identification.synthetic import Sensor, simulate_spectrum
from models.identification.types import Excitation, Fit, Spectrum
from models.plants import Mode, ModesSpec, frequency_response

LEGACY = Excitation((1.0, 0.0), 5.0, 133.33, 75.0, 1.0, 0.0)
SWEEPING = Excitation((1.0, 0.0))
Modes = tuple[tuple[float, float], ...]
OUT_OF_BAND: Modes = ((47.0, 0.035), (95.0, 0.060), (170.0, 0.050))
NARROW: Modes = ((38.0, 0.015), (61.0, 0.020))
CLOSE: Modes = ((40.0, 0.030), (44.0, 0.080), (90.0, 0.050))


def modal(modes: Modes, gains: tuple[float, ...]) -> ModesSpec:
    return ModesSpec(
        modes=tuple(Mode(f_hz=f, zeta=z, gain=g) for (f, z), g in zip(modes, gains, strict=True))
    )


def simulated(
    modes: Modes, gains: tuple[float, ...], test: Excitation, noise: float = 60.0
) -> Spectrum:
    plants = {"x": modal(modes, gains), "y": modal(((50.0, 0.1),), (1.0,))}
    rng = np.random.default_rng(0)
    return simulate_spectrum(plants, test, sensor=Sensor(noise_mm_s2=noise), rng=rng)


def check_usable(fit: Fit) -> None:
    assert abs(frequency_response(fit.spec, [0.0])[0] - 1) < 1e-9
    roots = fit.spec.roots()
    assert roots.poles.real.max() < 0
    assert fit.magnitude_only
    assert np.all(roots.zeros.real < 0)
    assert fit.trust_below_hz is not None
    assert 0 < fit.trust_below_hz <= fit.band_hz[1]


@pytest.mark.parametrize("test", [LEGACY, SWEEPING], ids=["legacy", "sweeping"])
@pytest.mark.parametrize("noise", [60.0, 400.0])
@pytest.mark.parametrize(
    ("modes", "gains"),
    [(OUT_OF_BAND, (0.6, 0.3, 0.1)), (NARROW, (0.7, 0.3)), (CLOSE, (0.4, 0.4, 0.2))],
    ids=["out of band", "narrow", "close"],
)
def test_modes_of_a_simulated_spectrum(
    modes: Modes, gains: tuple[float, ...], noise: float, test: Excitation
) -> None:
    """Within 0.5 % and 15 % (reference notes, section 9), from Klipper's 2.3 Hz wide bins."""
    fit = fit_spectrum(simulated(modes, gains, test, noise), test)
    check_usable(fit)
    assert fit.gain == pytest.approx(1.0, abs=0.01)
    for f, zeta in modes:
        if f < test.f_end_hz:
            mode = min(fit.modes, key=lambda m: abs(m.f_hz - f))
            assert mode.f_hz == pytest.approx(f, rel=0.005)
            assert mode.zeta == pytest.approx(zeta, rel=0.15)


def test_a_mode_depends_on_the_order() -> None:
    """A mode outside the band that the model lacks moves its neighbour."""
    spectrum = simulated(OUT_OF_BAND, (0.75, 0.2, 0.05), LEGACY)
    two, enough = (fit_spectrum(spectrum, LEGACY, max_order=n) for n in (2, 4))
    assert (two.order, enough.order) == (2, 3)
    assert two.modes[1].f_hz == pytest.approx(95.0, rel=0.02)
    assert abs(two.modes[1].f_hz / 95.0 - 1) > 0.005 > abs(enough.modes[1].f_hz / 95.0 - 1)
    assert [t.order for t in enough.trials] == [1, 2, 3]
    assert enough.trials[0].residual > 3 > two.residual > 0.2 > enough.residual


def test_forward_model_is_what_klipper_would_print() -> None:
    """Drive, plant and window against Klipper's estimate of the exact response."""
    plant = modal(NARROW, (0.7, 0.3))
    spectrum = simulated(NARROW, (0.7, 0.3), LEGACY, noise=0.0)
    model = spectrum_model(spectrum, "x", LEGACY)
    signal = model.kernel @ np.abs(frequency_response(plant, model.fine_hz)) ** 2
    decibel = 10 / np.log(10) * (np.log(signal) - model.log_psd)
    assert np.abs(decibel).max() < 0.15


def test_window_keeps_the_power_of_a_flat_spectrum() -> None:
    rng = np.random.default_rng(1)
    f, psd = klipper_psd(np.arange(60000) / 3200.0, rng.standard_normal(60000))
    model = spectrum_model(Spectrum(f, {"x": psd}), "x", LEGACY)
    inner = (model.f_hz > 25) & (model.f_hz < 120)
    seen = model.kernel.sum(axis=1)[inner] / drive_spectrum(LEGACY, model.f_hz[inner])
    np.testing.assert_allclose(seen, 1.0, atol=0.02)


def test_wrong_level_is_told() -> None:
    spectrum = simulated(NARROW, (0.7, 0.3), LEGACY)
    fit = fit_spectrum(spectrum, replace(LEGACY, accel_per_hz_mm_s=100.0))
    assert fit.gain == pytest.approx(0.75, abs=0.01)
    assert any("implies accel_per_hz = 75, stated are 100" in note for note in fit.notes)
    # The shape does not depend on it.
    assert fit.modes[0].zeta == pytest.approx(0.015, rel=0.05)


def test_column_that_follows_the_drive() -> None:
    spectrum = simulated(NARROW, (0.7, 0.3), LEGACY)
    assert driven_column(spectrum) == "x"
    turned = replace(spectrum, psd={"x": spectrum.psd["y"], "z": spectrum.psd["x"]})
    assert driven_column(turned) == "z"
    assert fit_spectrum(turned, LEGACY).spec == fit_spectrum(spectrum, LEGACY, column="x").spec
    with pytest.raises(ModelError, match="no column 'q'; there are x, z"):
        fit_spectrum(turned, LEGACY, column="q")


def test_coupled_axes_are_told() -> None:
    spectrum = simulated(NARROW, (0.7, 0.3), LEGACY)
    coupled = replace(spectrum, psd={**spectrum.psd, "y": 0.3 * spectrum.psd["x"]})
    assert cross_axis_share(coupled, "x", (8.0, 130.0)) == (pytest.approx(0.3), "y")
    assert any("'y' has 30% of the power of 'x'" in n for n in fit_spectrum(coupled, LEGACY).notes)
    assert not any("power of" in n for n in fit_spectrum(spectrum, LEGACY).notes)


def test_dead_column_and_short_band_are_refused() -> None:
    spectrum = simulated(NARROW, (0.7, 0.3), LEGACY)
    dead = replace(spectrum, psd={"x": np.zeros(len(spectrum.f_hz))}, source="a.csv")
    with pytest.raises(ModelError, match=r"a\.csv: column 'x' is zero"):
        fit_spectrum(dead, LEGACY)
    with pytest.raises(ModelError, match="at least 30 are needed; check max_freq"):
        fit_spectrum(spectrum, replace(LEGACY, f_end_hz=40.0))


def test_refit_keeps_the_structure() -> None:
    fit = fit_spectrum(simulated(NARROW, (0.7, 0.3), LEGACY), LEGACY)
    moved = ((37.0, 0.018), (60.0, 0.024))
    member = refit_spectrum(simulated(moved, (0.7, 0.3), LEGACY), LEGACY, fit)
    assert (member.order, len(member.spec.zeros)) == (fit.order, len(fit.spec.zeros))
    for mode, (f, zeta) in zip(member.modes, moved, strict=True):
        assert mode.f_hz == pytest.approx(f, rel=0.005)
        assert mode.zeta == pytest.approx(zeta, rel=0.15)


def real_tables(folder: Path) -> list[Path]:
    return sorted(folder.glob("measurements/*/resonances_*.csv"))


@pytest.mark.shared
@pytest.mark.slow
def test_every_real_table(shared_dir: Path) -> None:
    """Stable, DC gain 1, rms <= 1.1 dB; Klipper's own frequency among the modes."""
    files = real_tables(shared_dir)
    assert len(files) >= 45
    met = []
    for path in files:
        (spectrum,) = read_measurements(path)
        assert isinstance(spectrum, Spectrum)
        fit = fit_spectrum(spectrum, LEGACY)
        check_usable(fit)
        assert fit.residual <= 1.1, path.name
        assert fit.order <= 4
        best, _ = choose_shaper_of(spectrum)
        if best.name == "mzv":
            met.append(min(abs(m.f_hz / best.f_hz - 1) for m in fit.modes) < 0.1)
    assert len(met) >= 20
    assert np.mean(met) >= 0.95


@pytest.mark.slow
@pytest.mark.shared
@pytest.mark.parametrize(
    ("file", "f_hz", "peak"),
    [
        ("bassco_v0/resonances_x_20220703_144605", 126.0, 3.8),
        ("bassco_v0/resonances_y_20220703_143119", 83.0, 3.1),
        ("nielsvz_annexK3/resonances_x_20220522_092825", 95.0, 14.9),
    ],
)
def test_main_mode_of_real_axes(shared_dir: Path, file: str, f_hz: float, peak: float) -> None:
    """Figures of an independent fit of the same files (reference notes, section 5)."""
    (spectrum,) = read_measurements(shared_dir / "measurements" / f"{file}.csv")
    assert isinstance(spectrum, Spectrum)
    fit = fit_spectrum(spectrum, LEGACY)
    main = max(fit.modes, key=lambda m: m.peak)
    assert main.f_hz == pytest.approx(f_hz, rel=0.02)
    assert main.peak == pytest.approx(peak, rel=0.2)
