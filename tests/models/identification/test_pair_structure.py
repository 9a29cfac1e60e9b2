"""The fitted plant against python-control, and its derivatives against differences."""

from __future__ import annotations

import control
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from stillpath.models.identification.pair_structure import PairStructure
from stillpath.models.plants import PairsSpec, PolePair, ZeroPair

F = np.linspace(1.0, 150.0, 60)
SPEC = PairsSpec(
    poles=(PolePair(f_hz=40.0, zeta=0.05), PolePair(f_hz=70.0, zeta=0.1)),
    zeros=(ZeroPair(f_hz=55.0, zeta=-0.08),),
    real_zero_tau_s=4e-4,
)


@st.composite
def vectors(draw: st.DrawFn) -> tuple[PairStructure, np.ndarray]:
    n = draw(st.integers(1, 4))
    structure = PairStructure(n, n - 1, 26.0)
    log_f = st.floats(-1.5, 1.5)
    tau = draw(st.floats(-0.5, 0.5))
    poles = [draw(log_f) for _ in range(n)] + [draw(st.floats(-4, 0)) for _ in range(n)]
    zeros = [draw(log_f) for _ in range(n - 1)]
    damping = [draw(st.floats(0.01, 1.4)) * draw(st.sampled_from([1, -1])) for _ in zeros]
    return structure, np.array([tau, *poles, *zeros, *damping])


def test_response_is_that_of_python_control() -> None:
    structure = PairStructure(2, 1, 30.0)
    ours = structure.response(structure.parameters(SPEC), F)
    s = control.tf("s")
    plant = 1 + 4e-4 * s
    for pair, power in ((SPEC.zeros[0], 1), (SPEC.poles[0], -1), (SPEC.poles[1], -1)):
        w = 2 * np.pi * pair.f_hz
        factor = 1 + 2 * pair.zeta * s / w + s**2 / w**2
        plant = plant * factor if power > 0 else plant / factor
    np.testing.assert_allclose(ours, plant(2j * np.pi * F), rtol=1e-9)


@settings(max_examples=50)
@given(vectors())
def test_gain_at_dc_is_one_and_the_plant_stable(case: tuple[PairStructure, np.ndarray]) -> None:
    structure, theta = case
    assert abs(structure.response(theta, np.zeros(1))[0] - 1) < 1e-12
    assert structure.spec(theta).roots().poles.real.max() < 0


@settings(max_examples=50)
@given(vectors())
def test_gradient_is_the_derivative(case: tuple[PairStructure, np.ndarray]) -> None:
    structure, theta = case
    gradient = structure.log_gradient(theta, F)
    for i in range(structure.size):
        step = np.eye(structure.size)[i] * 1e-6
        ahead, behind = (structure.response(theta + k * step, F) for k in (1, -1))
        numeric = (ahead - behind) / 2e-6
        exact = gradient[:, i] * structure.response(theta, F)
        scale = np.abs(exact).max() + np.abs(numeric).max()
        np.testing.assert_allclose(exact, numeric, atol=2e-5 * scale + 1e-9)


def test_a_mode_beyond_the_band_may_not_ring_by_chance() -> None:
    structure = PairStructure(2, 1, 30.0)
    theta = structure.parameters(SPEC)
    np.testing.assert_array_equal(structure.least_damping(theta, 0.003, 60.0), [0.003, 0.03])
