"""Sets from several measurements, and what one measurement is varied by."""

from __future__ import annotations

from dataclasses import replace
from datetime import date

import numpy as np
import pytest

from stillpath.models.errors import ModelError
from stillpath.models.identification.averaging import mean_response, mean_spectrum
from stillpath.models.identification.sets import (
    Origin,
    model_file_set,
    parametric_members,
    plant_set_from,
    response_set,
    spectrum_set,
)
from stillpath.models.identification.spectrum_fit import explanations
from stillpath.models.identification.synthetic import Sensor, simulate_spectrum
from stillpath.models.identification.trust import delay_warning
from stillpath.models.identification.types import Excitation, FrequencyResponse, Spectrum
from stillpath.models.plants import (
    Mode,
    ModesSpec,
    RelativeModesSpec,
    frequency_response,
)
from stillpath.models.provenance import SourceFile

F = np.arange(5.0, 134.0, 0.5)
TEST = Excitation((1.0, 0.0), 5.0, 133.33, 75.0, 1.0, 0.0)
SOURCE = SourceFile(name="raw_data_x.csv", sha256="0" * 64)


def plant(f_scale: float = 1.0, zeta_scale: float = 1.0) -> ModesSpec:
    return ModesSpec(
        modes=(
            Mode(f_hz=47.0 * f_scale, zeta=0.035 * zeta_scale, gain=0.75),
            Mode(f_hz=95.0 * f_scale, zeta=0.060 * zeta_scale, gain=0.25),
        )
    )


def response(
    spec: ModesSpec, seed: int = 0, *, label: str = "", delay_s: float = 0.5e-3
) -> FrequencyResponse:
    h = 0.97 * frequency_response(spec, F) * np.exp(-2j * np.pi * F * delay_s)
    rng = np.random.default_rng(seed)
    sd = 0.002 * np.abs(h)
    h = h + sd * (rng.standard_normal(len(F)) + 1j * rng.standard_normal(len(F))) / np.sqrt(2)
    return FrequencyResponse(F, h, sd, np.full(len(F), 0.999), label=label)


def spectrum(spec: ModesSpec, seed: int = 0) -> Spectrum:
    rng = np.random.default_rng(seed)
    plants = {"x": spec, "y": plant()}
    made = simulate_spectrum(plants, TEST, sensor=Sensor(rate_hz=1600.0), rng=rng)
    return replace(made, source=f"resonances_x_{seed}.csv")


def test_one_response_makes_a_set_of_what_explains_it() -> None:
    origin = Origin((SOURCE,), date(2026, 8, 1))
    found = response_set([response(plant())], axis="x", origin=origin)
    members = found.plants.weighted_members()
    assert 4 < len(members) <= 16
    assert members[0].plant == found.plants.nominal
    size = np.abs(frequency_response(plant(), F))
    sizes = np.abs([frequency_response(m.plant, F) for m in members])
    assert np.all(sizes.min(axis=0) < 1.03 * size)
    assert np.all(sizes.max(axis=0) > size / 1.03)
    about = found.plants.provenance
    assert about is not None
    assert (about.kind, about.sources, about.measured_on) == (
        "raw log",
        (SOURCE,),
        date(2026, 8, 1),
    )
    assert about.gain == pytest.approx(0.97, rel=2e-3)
    assert about.modes[0].f_hz == pytest.approx(47.0, rel=1e-3)
    assert about.modes[0].f_sd_hz is not None
    assert found.plants.band_hz == (5.0, 133.5)


def test_amplitudes_are_members() -> None:
    """Four amplitudes: frequency falls, damping rises; each recording has its own delay."""
    conditions = [(1.0, 1.0), (0.97, 1.3), (0.985, 1.15), (1.01, 0.9)]
    measured = [
        response(plant(f, z), i, label=f"{40 + 20 * i} mm/s", delay_s=(3 + i) * 1e-4)
        for i, (f, z) in enumerate(conditions)
    ]
    found = response_set(measured, axis="x")
    assert found.fit is not None
    assert found.fit.order == 2
    assert len(found.member_fits) == 4
    for member, (f, z) in zip(found.member_fits, conditions, strict=True):
        assert member.order == 2
        assert member.modes[0].f_hz == pytest.approx(47.0 * f, rel=1e-3)
        assert member.modes[0].zeta == pytest.approx(0.035 * z, rel=0.02)
    listed = found.plants.weighted_members()
    assert len(listed) == 5
    for one in listed:
        assert frequency_response(one.plant, [0.0])[0] == pytest.approx(1.0, abs=1e-9)
    assert 0.97 < found.fit.modes[0].f_hz / 47.0 < 1.01


@pytest.mark.slow
def test_what_lies_within_the_scatter_of_repeats_adds_no_member() -> None:
    repeats = [response(plant(f), i, label="75") for i, f in enumerate((0.985, 1.0, 1.015))]
    near = response(plant(1.003), 7, label="110")
    found = response_set([*repeats, near], axis="y")
    assert found.member_fits == ()
    assert isinstance(found.plants.members, tuple)
    assert any("2 of 2 measurements add no member" in w for w in found.warnings)
    # Without repeats there is no scatter but the noise, and both count.
    assert len(response_set([repeats[1], near], axis="y").member_fits) == 2


def test_a_set_has_at_most_fifteen_plants() -> None:
    scales = np.linspace(0.96, 1.04, 18)
    measured = [response(plant(f), i, label=str(i)) for i, f in enumerate(scales)]
    found = response_set(measured, axis="x")
    frequencies = [m.modes[0].f_hz for m in found.member_fits]
    assert len(found.plants.weighted_members()) == 15
    # The extremes stay.
    assert min(frequencies) == pytest.approx(47.0 * 0.96, rel=2e-3)
    assert max(frequencies) == pytest.approx(47.0 * 1.04, rel=2e-3)


@pytest.mark.slow
def test_spectra_make_a_set_of_what_explains_them() -> None:
    one = spectrum_set(explanations([spectrum(plant())], TEST), axis="x")
    assert one.plants.provenance is not None
    assert one.plants.provenance.magnitude_only
    assert one.plants.provenance.trust_below_hz == one.fit.trust_below_hz  # type: ignore[union-attr]
    listed = one.plants.weighted_members()
    assert 8 <= len(listed) <= 16
    # What guides delay is unknown: some members have a delay, the nominal plant has none.
    delays = [m.plant.delay_s for m in listed if isinstance(m.plant, RelativeModesSpec)]
    assert len(delays) == len(listed)
    assert delays[0] == 0.0
    assert 0.0 < max(delays) < 2 * 0.08 / (2 * np.pi * 47.0)
    repeats = [spectrum(plant(f), i) for i, f in enumerate((0.99, 1.0, 1.02))]
    several = spectrum_set(explanations(repeats, TEST), axis="x")
    assert several.fit is not None
    assert several.fit.modes[0].f_hz == pytest.approx(47.0, rel=0.01)


def test_a_model_that_was_read_is_varied() -> None:
    made = model_file_set(plant())
    assert made.provenance is not None
    assert made.provenance.kind == "model file"
    assert made.members == parametric_members("model file")
    assert len(made.weighted_members()) == 9


def test_delays_that_differ_shear_corners() -> None:
    x = response_set([response(plant())], axis="x").fit
    y = response_set([response(plant(), delay_s=0.9e-3)], axis="y").fit
    assert x is not None
    assert y is not None
    assert delay_warning(x, x) is None
    assert "differ by 0.40 ms" in (delay_warning(x, y) or "")


def test_mean_response_weighs_by_certainty_and_aligns() -> None:
    sure, unsure = response(plant(), 1), response(plant(), 2, delay_s=1.5e-3)
    unsure = replace(unsure, sd=10 * unsure.sd, f_hz=F.copy())
    mean = mean_response([sure, unsure])
    error = np.abs(mean.response - sure.response) / np.abs(sure.response)
    assert np.median(error) < 1e-3
    assert np.all(mean.sd <= np.fmax(sure.sd, np.abs(error * sure.response)) * 1.5)
    with pytest.raises(ModelError, match="share no frequencies"):
        mean_response([sure, replace(sure, f_hz=F + 500.0)])
    with pytest.raises(ModelError, match="give one or more"):
        mean_response([])


def test_mean_spectrum_is_geometric() -> None:
    f = np.arange(0.0, 200.0, 1.5625)
    a, b = Spectrum(f, {"x": np.full(len(f), 4.0)}), Spectrum(f, {"x": np.full(len(f), 9.0)})
    np.testing.assert_allclose(mean_spectrum([a, b]).psd["x"], 6.0)
    with pytest.raises(ModelError, match="share no column"):
        mean_spectrum([a, Spectrum(f, {"y": np.ones(len(f))})])


def test_mean_spectrum_ends_where_a_table_does() -> None:
    f = np.arange(5.0, 100.0)
    whole, part = Spectrum(f, {"x": np.ones(len(f))}), Spectrum(f[35:80], {"x": np.ones(45)})
    np.testing.assert_array_equal(mean_spectrum([whole, part]).f_hz, part.f_hz)
    with pytest.raises(ModelError, match="share no frequencies"):
        mean_spectrum([whole, Spectrum(f + 200.0, {"x": np.ones(len(f))})])


def test_plant_set_of_a_fit_survives_json() -> None:
    found = response_set([response(plant())], axis="x")
    assert found.fit is not None
    made = plant_set_from(found.fit, [found.fit], kind="frequency response")
    again = type(made).model_validate_json(made.model_dump_json())
    assert again == made


def test_noise_does_not_shift_repeats_against_each_other() -> None:
    """Delays told at low frequency alone would take a fifth off the mean at 100 Hz."""
    low = ModesSpec(
        modes=(Mode(f_hz=19.0, zeta=0.03, gain=0.8), Mode(f_hz=90.0, zeta=0.1, gain=0.2))
    )
    rng = np.random.default_rng(0)
    repeats = []
    for delay_s in (0.5e-3, -2.0e-3, 3.1e-3, 0.0):
        one = response(low, delay_s=delay_s)
        noise = rng.standard_normal((2, len(F))) * (0.4 / F)
        repeats.append(replace(one, response=one.response + noise[0] + 1j * noise[1], sd=0.57 / F))
    mean = mean_response(repeats)
    seen = np.abs(mean.response / frequency_response(low, F))[F > 80] / 0.97
    assert np.mean(seen) == pytest.approx(1.0, abs=0.02)
