"""Plants of recordings: slow motion on time, resonances where they were against it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stillpath.models.identification.prompt import advanced, delay_of
from stillpath.models.plants import (
    Mode,
    ModesSpec,
    PairsSpec,
    PlantSpec,
    PolePair,
    RelativeMode,
    RelativeModesSpec,
    TfSpec,
    ZeroPair,
    frequency_response,
)


def slope_s(plant: PlantSpec) -> float:
    """Delay at low frequency, by the phase."""
    return -float(np.angle(frequency_response(plant, [1e-3])[0])) / (2 * np.pi * 1e-3)


@st.composite
def plants(draw: st.DrawFn) -> PlantSpec:
    n = draw(st.integers(1, 4))
    f_hz = [draw(st.floats(15.0, 150.0)) for _ in range(n)]
    zeta = [draw(st.floats(0.01, 0.4)) for _ in range(n)]
    if draw(st.booleans()):
        zeros = tuple(
            ZeroPair(
                f_hz=draw(st.floats(20.0, 200.0)),
                zeta=draw(st.floats(0.01, 1.2)) * draw(st.sampled_from([1, -1])),
            )
            for _ in range(n - 1)
        )
        poles = tuple(PolePair(f_hz=f, zeta=z) for f, z in zip(f_hz, zeta, strict=True))
        tau_s = draw(st.floats(1e-6, 2e-3) | st.floats(-2e-3, -1e-6) | st.just(0.0))
        return PairsSpec(poles=poles, zeros=zeros, real_zero_tau_s=tau_s)
    grounded = draw(st.floats(0.01, 1.0) | st.just(0.0))
    share = np.array([draw(st.floats(0.05, 1.0)) for _ in range(n)])
    modes = zip(f_hz, zeta, share / share.sum(), strict=True)
    return RelativeModesSpec(
        modes=tuple(
            RelativeMode(f_hz=f, zeta=z, share=float(r), grounded=grounded) for f, z, r in modes
        )
    )


@settings(max_examples=80)
@given(plants())
def test_slow_motion_is_on_time(plant: PlantSpec) -> None:
    late_s = delay_of(plant)
    assert slope_s(plant) == pytest.approx(late_s, abs=1e-7)
    there = advanced(plant)
    assert slope_s(there) == pytest.approx(0.0, abs=1e-7)
    assert delay_of(there) == pytest.approx(0.0, abs=1e-9)
    # Same poles: what rings is what was measured.
    np.testing.assert_allclose(
        np.sort_complex(there.roots().poles), np.sort_complex(plant.roots().poles), rtol=1e-6
    )


@pytest.mark.parametrize("grounded", [0.0, 0.5, 1.0])
def test_resonances_keep_their_phase_against_slow_motion(grounded: float) -> None:
    plant = RelativeModesSpec(
        modes=(
            RelativeMode(f_hz=42.0, zeta=0.06, share=0.8, grounded=grounded),
            RelativeMode(f_hz=90.0, zeta=0.05, share=0.2, grounded=grounded),
        )
    )
    f = np.linspace(1.0, 100.0, 200)
    wanted = frequency_response(plant, f) * np.exp(2j * np.pi * f * plant.delay_s)
    got = frequency_response(advanced(plant), f)
    assert np.max(np.abs(got - wanted)) < 0.07
    assert np.max(np.abs(np.angle(got / wanted))) < 0.02


def test_damping_against_the_frame_is_found_in_other_plants() -> None:
    modes = ModesSpec(modes=(Mode(f_hz=40.0, zeta=0.1, gain=1.0),))
    assert delay_of(modes) == pytest.approx(2 * 0.1 / (2 * np.pi * 40.0))
    assert delay_of(TfSpec(num=(0.2,), den=(1.0, -0.8), dt_s=1e-3)) == 0.0
