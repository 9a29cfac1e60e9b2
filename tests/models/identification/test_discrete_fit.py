"""The refit in z against the continuous plant, and against holds of scipy and the product."""

from __future__ import annotations

import control
import numpy as np
import pytest

from stillpath.models.errors import ModelError
from stillpath.models.identification.discrete_fit import discrete_model, zeros_outside
from stillpath.models.plants import (
    Mode,
    ModesSpec,
    PairsSpec,
    PolePair,
    ZeroPair,
    discretise,
    frequency_response,
)

THREE = ModesSpec(
    modes=(
        Mode(f_hz=47.0, zeta=0.035, gain=0.75),
        Mode(f_hz=95.0, zeta=0.060, gain=0.20),
        Mode(f_hz=170.0, zeta=0.050, gain=0.05),
    )
)
NON_MINIMUM = PairsSpec(
    poles=(PolePair(f_hz=35.5, zeta=0.089), PolePair(f_hz=60.0, zeta=0.1)),
    zeros=(ZeroPair(f_hz=51.5, zeta=-0.104),),
)
F = np.linspace(1.0, 150.0, 400)


@pytest.mark.parametrize("dt_s", [5e-4, 1e-3, 2e-3])
def test_closer_than_the_hold_and_without_its_zero(dt_s: float) -> None:
    found = discrete_model(THREE, dt_s)
    exact = frequency_response(THREE, F)
    hold = discretise(THREE, dt_s)
    of_hold = np.abs(hold.frequency_response(F) - exact).max() / np.abs(exact).max()
    assert found.error < of_hold
    assert found.notes == ()
    assert (len(found.spec.zeros), len(found.spec.poles)) == (5, 6)
    assert np.abs(hold.zeros()).max() > 3
    (said,) = zeros_outside(hold.zeros(), THREE.roots().zeros, dt_s)
    assert "comes from sampling" in said


def test_at_one_millisecond() -> None:
    found = discrete_model(THREE, 1e-3)
    assert found.error < 0.0015
    assert frequency_response(found.spec, [0.0])[0] == pytest.approx(1.0, abs=1e-9)
    poles = np.array([complex(*p) for p in found.spec.poles])
    assert np.abs(poles).max() == pytest.approx(0.990, abs=5e-4)
    # Evaluated by python-control from the zeros and poles as they are written.
    zeros = np.array([complex(*z) for z in found.spec.zeros])
    gain = np.prod(1 - poles).real / np.prod(1 - zeros).real
    by_control = control.zpk(zeros, poles, gain, dt=1e-3)(np.exp(2j * np.pi * F * 1e-3))
    exact = frequency_response(THREE, F)
    assert np.abs(by_control - exact).max() / np.abs(exact).max() < 0.0015


def test_zero_of_the_plant_is_named_so() -> None:
    found = discrete_model(NON_MINIMUM, 1e-3)
    (said,) = found.notes
    assert "51.5 Hz, is the plant's own" in said


def test_what_cannot_be_refitted() -> None:
    with pytest.raises(ModelError, match="too fast for 2 ms"):
        discrete_model(PairsSpec(poles=(PolePair(f_hz=210.0, zeta=0.1),)), 2e-3)
    with pytest.raises(ModelError, match="discrete at 1 ms already"):
        discrete_model(discrete_model(THREE, 1e-3).spec, 5e-4)
