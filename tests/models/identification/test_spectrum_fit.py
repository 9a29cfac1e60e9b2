"""Fits of spectra: of simulated tests with known truth, and of all real files there are."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from stillpath.models.errors import ModelError
from stillpath.models.identification.excitation import drive_spectrum, klipper_psd
from stillpath.models.identification.frame import LIKELY
from stillpath.models.identification.spectrum_fit import (
    Explained,
    Explanations,
    explanations,
    refit_spectrum,
)
from stillpath.models.identification.spectrum_model import (
    cross_axis_share,
    driven_column,
    spectrum_model,
)
from stillpath.models.identification.spectrum_search import Search
from stillpath.models.identification.synthetic import Sensor, simulate_spectrum
from stillpath.models.identification.types import Excitation, Fit, Spectrum
from stillpath.models.plants import (
    Mode,
    ModesSpec,
    RelativeModesSpec,
    frequency_response,
)

LEGACY = Excitation((1.0, 0.0), 5.0, 133.33, 75.0, 1.0, 0.0)
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


def explain_spectra(
    spectra: list[Spectrum],
    test: Excitation,
    *,
    column: str | None = None,
    frame_likely: float = LIKELY,
    max_order: int = 4,
) -> Explained:
    found = explanations(spectra, test, column=column, max_order=max_order)
    return found.explained(frame_likely)


@cache
def narrow() -> Explanations:
    """What explains a spectrum of the narrow modes."""
    return explanations([simulated(NARROW, (0.7, 0.3), LEGACY)], LEGACY)


def check_usable(fit: Fit) -> None:
    assert abs(frequency_response(fit.spec, [0.0])[0] - 1) < 1e-9
    roots = fit.spec.roots()
    assert roots.poles.real.max() < 0
    assert fit.magnitude_only
    slow = frequency_response(fit.spec, [0.01])[0]
    assert abs(np.angle(slow)) / (2 * np.pi * 0.01) < 1e-6  # no delay
    assert fit.trust_below_hz is not None
    assert 0 < fit.trust_below_hz <= fit.band_hz[1]


def test_modes_that_are_close_to_each_other() -> None:
    """From Klipper's 2.3 Hz wide bins; other modes are in `test_acceptance`."""
    fit = explain_spectra([simulated(CLOSE, (0.4, 0.4, 0.2), LEGACY, 400.0)], LEGACY).fit
    check_usable(fit)
    assert fit.gain == pytest.approx(1.0, abs=0.03)
    for f, zeta in CLOSE:
        if f < LEGACY.f_end_hz:
            mode = min(fit.modes, key=lambda m: abs(m.f_hz - f))
            close = f < 50.0  # they trade damping with each other
            assert mode.f_hz == pytest.approx(f, rel=0.015 if close else 0.005)
            assert mode.zeta == pytest.approx(zeta, rel=0.4 if close else 0.15)


@pytest.mark.slow
def test_trials_tell_what_each_order_leaves() -> None:
    fit = explain_spectra([simulated(OUT_OF_BAND, (0.75, 0.2, 0.05), LEGACY)], LEGACY).fit
    assert [t.order for t in fit.trials] == [1, 2, 3, 4]
    assert fit.trials[0].residual > 3 > fit.trials[1].residual > 0.2 > fit.trials[2].residual
    alone = explain_spectra(
        [simulated(OUT_OF_BAND, (0.75, 0.2, 0.05), LEGACY)], LEGACY, max_order=2
    ).fit
    assert [t.order for t in alone.trials] == [1, 2]


@pytest.mark.slow
def test_members_stand_for_what_explains_the_spectrum() -> None:
    """Every member fits about as well; the truth lies within what they say of |G| and phase."""
    truth, spectrum = (
        modal(OUT_OF_BAND, (0.6, 0.3, 0.1)),
        simulated(OUT_OF_BAND, (0.6, 0.3, 0.1), LEGACY),
    )
    found = explain_spectra([spectrum], LEGACY)
    members, weights = found.population.members, found.population.weights
    assert 8 <= len(members) <= 16
    assert sum(weights) == pytest.approx(1.0)
    assert members[0] == found.fit.spec
    f = np.linspace(10.0, 110.0, 60)
    answers = np.array([frequency_response(m, f) for m in members])
    size = np.abs(frequency_response(truth, f))
    assert np.all(np.abs(answers).min(axis=0) < 1.1 * size)
    assert np.all(np.abs(answers).max(axis=0) > size / 1.1)
    again = explain_spectra([spectrum], LEGACY)
    assert again.population == found.population


def test_most_plants_are_without_a_mode_that_may_be_the_frame_s() -> None:
    """Unless the frame stands firm; which mode that is, is said."""
    spectrum = simulated(((14.0, 0.1), (45.0, 0.06)), (0.1, 0.9), LEGACY)
    explaining = explanations([spectrum], LEGACY)
    found = explaining.explained()
    weights = found.population.weights
    without = [min(m.f_hz for m in plant.modes) > 25.0 for plant in found.population.members]
    assert without[0]
    assert 0.6 < sum(w for w, free in zip(weights, without, strict=True) if free) < 0.95
    (note,) = (text for text in found.fit.warnings if "frame on its feet" in text)
    assert re.search(r"\b1[34]\.\d Hz", note)
    firm = explaining.explained(frame_likely=0.0)
    assert not any("frame on its feet" in text for text in firm.fit.warnings)
    assert min(m.f_hz for m in firm.population.members[0].modes) == pytest.approx(14.0, rel=0.1)


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
    fit = explain_spectra([spectrum], replace(LEGACY, accel_per_hz_mm_s=120.0)).fit
    assert fit.gain == pytest.approx(0.625, rel=0.05)
    assert any("implies accel_per_hz = 7" in n and "stated are 120" in n for n in fit.warnings)
    # The shape does not depend on it.
    assert fit.modes[0].zeta == pytest.approx(0.015, rel=0.1)


@pytest.mark.slow
def test_tables_of_a_machine_that_was_changed_between_them_are_told() -> None:
    first = replace(simulated(NARROW, (0.7, 0.3), LEGACY), source="before.csv")
    again = replace(simulated(NARROW, (0.7, 0.3), LEGACY, noise=80.0), source="again.csv")
    tighter = tuple((1.15 * f, zeta) for f, zeta in NARROW)
    after = replace(simulated(tighter, (0.7, 0.3), LEGACY), source="after.csv")

    def told(*spectra: Spectrum) -> list[str]:
        fit = explain_spectra(spectra, LEGACY).fit
        return [note for note in fit.warnings if "something was changed between them" in note]

    assert told(first, again) == []
    (note,) = told(first, again, after)
    assert note.startswith(("before.csv and after.csv differ by", "again.csv and after.csv differ"))


def test_interpolated_tables_count_by_bin() -> None:
    """Klipper writes several data sets every 0.2 Hz: eight times the numbers, and no more known."""
    single = simulated(NARROW, (0.7, 0.3), LEGACY)
    f_hz = np.arange(0.0, 200.0, 0.2)
    fine = replace(single, f_hz=f_hz, psd={"head": np.interp(f_hz, single.f_hz, single.psd["x"])})
    own, thinned = (
        spectrum_model(s, column, LEGACY) for s, column in ((single, "x"), (fine, "head"))
    )
    assert len(thinned.f_hz) == pytest.approx(len(own.f_hz), abs=3)
    assert np.diff(thinned.f_hz) == pytest.approx(1.6)


def test_column_of_a_sensor_that_garbles_samples() -> None:
    """Its y hissed more than the test began with, so models were made of noise (a Trident)."""
    clean = simulated(NARROW, (0.7, 0.3), LEGACY)
    noise = {"x": 4e3, "y": 2e4, "z": 1e4}
    garbled = replace(clean, psd={n: clean.psd[n] + noise[n] for n in noise}, source="x.csv")
    low = (clean.f_hz >= 8.0) & (clean.f_hz <= 15.0)
    assert garbled.psd["y"][low].sum() > garbled.psd["x"][low].sum()
    found = explanations([garbled], LEGACY, max_order=1)
    assert found.column == "x"
    warnings = found.explained().fit.warnings
    assert any(w.startswith("x.csv: at low frequency") and "shield" in w for w in warnings)
    of_clean = explanations([clean], LEGACY, max_order=1).explained().fit.warnings
    assert not any("at low frequency" in warning for warning in of_clean)


@pytest.mark.slow
def test_column_that_follows_the_drive() -> None:
    spectrum = simulated(NARROW, (0.7, 0.3), LEGACY)
    assert driven_column(spectrum) == "x"
    turned = replace(spectrum, psd={"x": spectrum.psd["y"], "z": spectrum.psd["x"]})
    assert driven_column(turned) == "z"
    assert explain_spectra([turned], LEGACY).fit.spec == narrow().explained().fit.spec
    with pytest.raises(ModelError, match="axis 'q', only x, z; give another sensor_axis"):
        explain_spectra([turned], LEGACY, column="q")


def test_column_of_a_test_that_begins_above_15_hz() -> None:
    """Below its start the axis of the sensor that hisses most was taken to follow it."""
    test = replace(LEGACY, f_start_hz=20.0)
    spectrum = simulated(NARROW, (0.7, 0.3), test)
    z = np.where(spectrum.f_hz < 18.0, 10.0 * spectrum.psd["x"], spectrum.psd["y"])
    hissing = replace(spectrum, psd={**spectrum.psd, "z": z})
    assert driven_column(hissing) == "z"
    assert driven_column(hissing, test.f_start_hz) == "x"
    assert explanations([hissing], test, max_order=1).column == "x"


@pytest.mark.slow
def test_coupled_axes_are_told() -> None:
    spectrum = simulated(NARROW, (0.7, 0.3), LEGACY)
    coupled = replace(spectrum, psd={**spectrum.psd, "y": 0.3 * spectrum.psd["x"]})
    assert cross_axis_share(coupled, "x", (8.0, 130.0)) == (pytest.approx(0.3), "y")
    assert any(
        "'y' has 30% of the power of 'x'" in n
        for n in explain_spectra([coupled], LEGACY).fit.warnings
    )
    assert not any("power of" in n for n in narrow().explained().fit.warnings)


def test_dead_column_and_short_band_are_refused() -> None:
    spectrum = simulated(NARROW, (0.7, 0.3), LEGACY)
    dead = replace(spectrum, psd={"x": np.zeros(len(spectrum.f_hz))}, source="a.csv")
    with pytest.raises(ModelError, match=r"a\.csv: column 'x' is zero"):
        explain_spectra([dead], LEGACY)
    with pytest.raises(ModelError, match="at least 30 are needed; check max_freq"):
        explain_spectra([spectrum], replace(LEGACY, f_end_hz=40.0))


def test_refit_keeps_the_structure() -> None:
    fit = narrow().explained().fit
    moved = ((37.0, 0.018), (60.0, 0.024))
    member = refit_spectrum(simulated(moved, (0.7, 0.3), LEGACY), LEGACY, fit)
    assert member.order == fit.order
    for mode, (f, zeta) in zip(member.modes, moved, strict=True):
        assert mode.f_hz == pytest.approx(f, rel=0.005)
        assert mode.zeta == pytest.approx(zeta, rel=0.15)


def test_power_that_no_other_column_shows_is_no_noise_of_the_sensor() -> None:
    """Real tables have more power than the drive explains, and other columns tell the noise."""
    table = simulated(NARROW, (0.7, 0.3), LEGACY, noise=300.0)
    noise = np.median(table.psd["z"])
    psd = {**table.psd, "x": table.psd["x"] + 20.0 * noise}
    for columns, times in ((psd, 4.0), ({"x": psd["x"]}, 40.0)):
        search = Search(replace(table, psd=columns), "x", LEGACY, [replace(table, psd=columns)], 2)
        found = np.exp(search.candidates(None)[0].vector[1])
        assert 0.2 * times * noise < found < times * noise


def test_modes_close_to_each_other_are_found() -> None:
    """Shares of both signs within a few hertz, as an Annex K3's X showed."""
    modes, shares = (
        ((88.0, 0.05), (92.0, 0.03), (95.0, 0.07), (115.0, 0.08)),
        (-0.5, 0.92, 0.71, -0.13),
    )
    explaining = explanations([simulated(modes, shares, LEGACY)], LEGACY)
    # Random starts alone leave 0.2 dB.
    assert explaining.found[0].residual_db < 0.1
    assert len(explaining.accepted) > 8


def test_no_plant_keeps_a_weak_mode_at_the_edge_of_the_table() -> None:
    """That of the frame on its feet: slow motion would follow it most of all."""
    explaining = explanations(
        [simulated(((10.5, 0.08), (70.0, 0.04)), (0.06, 0.94), LEGACY)], LEGACY
    )
    assert explaining.frame_hz == pytest.approx(10.5, rel=0.1)
    for plant in explaining.explained().population.members:
        assert min(mode.f_hz for mode in plant.modes) > 12.5


def test_a_stiff_axis_is_not_explained_by_modes_without_a_peak() -> None:
    """A table that is level up to 30 Hz; modes far below would move slow motion eight times as far.

    Its bins are as uneven as those of real tables: by half a decibel, and less at low frequency.
    """
    modes, shares = ((58.0, 0.2), (88.0, 0.045), (143.0, 0.04), (300.0, 0.08)), (0.24, 0.03, -0.15)
    values = zip(modes, (*shares, 1.0 - sum(shares)), strict=True)
    stiff = RelativeModesSpec.model_validate(
        {"modes": [{"f_hz": f, "zeta": zeta, "share": share} for (f, zeta), share in values]}
    )
    rng = np.random.default_rng(0)
    plants = {"x": stiff, "y": modal(((50.0, 0.1),), (1.0,))}
    table = simulate_spectrum(plants, LEGACY, sensor=Sensor(noise_mm_s2=60.0), rng=rng)
    uneven = np.convolve(rng.standard_normal(len(table.f_hz)), np.full(3, 3**-0.5), "same")
    uneven_db = 0.5 * uneven * np.clip(table.f_hz / 25.0, 0.15, 1.0)
    table = replace(table, psd={**table.psd, "x": table.psd["x"] * 10 ** (0.1 * uneven_db)})
    for plant in explain_spectra([table], LEGACY).population.members:
        assert compliance_s2(plant) == pytest.approx(compliance_s2(stiff), rel=0.8)


def compliance_s2(plant: RelativeModesSpec) -> float:
    return sum(mode.share / (2 * np.pi * mode.f_hz) ** 2 for mode in plant.modes)
