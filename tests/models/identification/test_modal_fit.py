"""Fits of modes and of pairs on time to responses whose plant is known."""

from __future__ import annotations

import numpy as np
import pytest

from stillpath.models.identification.modal_fit import fit_modes
from stillpath.models.identification.prompt import delay_of, prompt
from stillpath.models.identification.types import FrequencyResponse
from stillpath.models.plants import RelativeMode, RelativeModesSpec, frequency_response

F_HZ = np.arange(24, 520) * 0.25


def plant(*modes: tuple[float, float, float], scale: float = 1.0) -> RelativeModesSpec:
    """Return a plant of modes of frequency, damping and share."""
    return RelativeModesSpec(
        modes=tuple(RelativeMode(f_hz=scale * f, zeta=z, share=share) for f, z, share in modes)
    )


def measured(
    spec: RelativeModesSpec, seed: int, noise: float = 0.002, late_s: float = 1e-3
) -> FrequencyResponse:
    rng = np.random.default_rng(seed)
    h = frequency_response(spec, F_HZ) * np.exp(-2j * np.pi * F_HZ * late_s)
    sd = noise * np.abs(h)
    h = h + sd * (rng.standard_normal(len(h)) + 1j * rng.standard_normal(len(h))) / np.sqrt(2)
    return FrequencyResponse(F_HZ, h, sd, np.ones(len(h)))


@pytest.mark.parametrize("share", [0.05, 0.1])
def test_a_weak_mode_far_below_the_resonance_is_fitted(share: float) -> None:
    """What the resonance of repeats scatters hid it: motion was early by 1 ms there."""
    modes = ((25.0, 0.08, share), (50.0, 0.065, 1.45 - share), (96.0, 0.06, -0.45))
    repeats = [
        measured(plant(*modes, scale=scale), seed) for seed, scale in enumerate((0.993, 1.0, 1.007))
    ]
    fit = fit_modes(repeats)
    low = (F_HZ > 15.0) & (F_HZ < 40.0)
    found = frequency_response(prompt(fit), F_HZ[low])
    true = frequency_response(plant(*modes), F_HZ[low])
    early_s = np.angle(found / true) / (2 * np.pi * F_HZ[low])
    assert np.abs(early_s).max() < 0.25e-3
    np.testing.assert_allclose(np.abs(found), np.abs(true), rtol=0.04)


def test_pairs_are_the_plant_that_was_fitted() -> None:
    """Their delay was taken off after the fit, which left another plant."""
    modes = ((24.6, 0.16, 0.4), (34.4, 0.08, 0.75), (108.0, 0.05, -0.15))
    h = frequency_response(plant(*modes), F_HZ)
    # A notch that no mode on relative speed makes, where dry friction or play is.
    s = 2j * np.pi * F_HZ / (2 * np.pi * 41.0)
    bent = h * (1 + 2 * 0.25 * s + s * s) / (1 + 2 * 0.4 * s + s * s)
    fit = fit_modes(FrequencyResponse(F_HZ, bent, 0.002 * np.abs(bent), np.ones(len(bent))))
    used = prompt(fit)
    assert abs(delay_of(used)) < 1e-9
    turned = np.exp(-2j * np.pi * F_HZ * (fit.delay_s + delay_of(fit.spec)))
    model = fit.gain * turned * frequency_response(used, F_HZ)
    missed = np.linalg.norm(model - bent) / np.linalg.norm(bent)
    assert missed < 0.03
