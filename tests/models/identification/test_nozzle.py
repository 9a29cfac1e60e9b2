"""Two bodies on feet: what is felt, what is printed."""

from __future__ import annotations

import numpy as np
import pytest

from stillpath.models.identification.nozzle import Frame, frame_of
from stillpath.models.identification.response_data import response_data
from stillpath.models.identification.types import FrequencyResponse
from stillpath.models.plants import RelativeMode, RelativeModesSpec, frequency_response

F_HZ = np.arange(24, 520) * 0.25


def two_bodies(frame: Frame, main_hz: float, zeta: float) -> tuple[np.ndarray, np.ndarray]:
    """Return what is felt and what is done over the bed, solved as forces of two masses."""
    s = 2j * np.pi * F_HZ
    moving, heavy = frame.mass_ratio, 1.0
    w, w_feet = 2 * np.pi * main_hz, 2 * np.pi * frame.f_hz
    k, d = moving * w**2, 2 * zeta * moving * w
    feet = heavy * (s**2 + 2 * frame.zeta * w_feet * s + w_feet**2)
    # Head a, frame b: m a'' = belt, M b'' + feet b = -belt, belt = (k + d s)(u - (a - b)).
    belt = k + d * s
    felt = belt * feet / (moving * s**2 * (feet + belt) + belt * feet)
    return felt, felt * (1 + moving * s**2 / feet)


def measured(response: np.ndarray, seed: int = 0, noise: float = 0.003) -> FrequencyResponse:
    rng = np.random.default_rng(seed)
    noises = noise * (rng.standard_normal(len(F_HZ)) + 1j * rng.standard_normal(len(F_HZ)))
    late = 0.93 * np.exp(-2j * np.pi * F_HZ * 2.3e-3)
    sd = np.full(len(F_HZ), noise / 0.75)
    return FrequencyResponse(F_HZ, late * response + noises, sd, np.ones(len(F_HZ)))


@pytest.mark.parametrize(
    ("frame", "main_hz", "zeta"),
    [
        (Frame(9.0, 0.12, 0.05), 64.0, 0.03),
        (Frame(14.0, 0.15, 0.11), 34.0, 0.05),
        (Frame(22.0, 0.10, 0.08), 45.0, 0.08),
        # Their flanks reach the lowest frequencies, and turn the phase there.
        (Frame(8.2, 0.09, 0.08), 55.0, 0.05),
        (Frame(8.4, 0.15, 0.24), 39.0, 0.08),
    ],
)
def test_a_frame_is_found_and_its_motion_taken_out(
    frame: Frame, main_hz: float, zeta: float
) -> None:
    felt, printed = two_bodies(frame, main_hz, zeta)
    found = frame_of(measured(felt))
    assert found is not None
    assert found.f_hz == pytest.approx(frame.f_hz, rel=0.03)
    assert found.mass_ratio == pytest.approx(frame.mass_ratio, rel=0.15)
    over_bed = found.over_bed(measured(felt)).response
    true = measured(printed).response
    low = 1.5 * main_hz > F_HZ
    felt_off = np.linalg.norm((measured(felt).response - true)[low])
    assert np.linalg.norm((over_bed - true)[low]) < 0.2 * felt_off


@pytest.mark.parametrize("feet_hz", [6.5, 8.2, 9.5])
def test_the_flanks_of_a_frame_are_no_delay(feet_hz: float) -> None:
    """They were taken for 36 to 110 ms, and the sensor for turned round."""
    felt, _ = two_bodies(Frame(feet_hz, 0.12, 0.16), 38.0, 0.08)
    data = response_data(measured(felt))
    assert data.delay_s == pytest.approx(2.3e-3, abs=4e-3)
    assert not any("opposite sign" in note for note in data.warnings)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_an_axis_whose_guides_damp_it_has_no_frame(seed: int) -> None:
    """A frame of 6 Hz with a mode of the axis beside it explained what the guides do."""
    guided = RelativeModesSpec(modes=(RelativeMode(f_hz=42.0, zeta=0.09, share=1.0, grounded=0.4),))
    felt = frequency_response(guided, F_HZ)
    assert frame_of(measured(felt, seed, noise=0.0003)) is None


def test_derivatives_are_those_of_differences() -> None:
    frame, step = Frame(14.0, 0.15, 0.11), 1e-6
    log_f_hz, log_zeta = np.log(frame.f_hz), np.log(frame.zeta)

    def reaction(by: np.ndarray) -> np.ndarray:
        f_hz, zeta = np.exp([log_f_hz + by[0], log_zeta + by[1]])
        return Frame(float(f_hz), float(zeta), frame.mass_ratio + by[2]).reaction(F_HZ)

    differences = [(reaction(step * by) - reaction(-step * by)) / (2 * step) for by in np.eye(3)]
    gradient = frame.reaction_gradient(F_HZ)
    np.testing.assert_allclose(gradient, np.transpose(differences), rtol=1e-6, atol=1e-7)


def test_a_frame_that_stands_firm_is_not_invented() -> None:
    s = 1j * F_HZ
    modes = ((50.0, 0.06, 1.3), (95.0, 0.05, -0.3))
    plain = sum(r * (2 * z * f * s + f * f) / (s * s + 2 * z * f * s + f * f) for f, z, r in modes)
    found = frame_of(measured(np.asarray(plain)))
    assert found is None or found.mass_ratio < 0.02
