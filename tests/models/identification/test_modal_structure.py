"""Modes on relative speed against python-control, and their derivatives against differences."""

from __future__ import annotations

import control
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stillpath.models.identification.modal_structure import ModalStructure
from stillpath.models.plants import RelativeMode, RelativeModesSpec, frequency_response

F = np.linspace(1.0, 150.0, 60)


def plant(grounded: float = 0.0) -> RelativeModesSpec:
    return RelativeModesSpec(
        modes=(
            RelativeMode(f_hz=40.0, zeta=0.05, share=1.2, grounded=grounded),
            RelativeMode(f_hz=70.0, zeta=0.1, share=-0.2, grounded=grounded),
        )
    )


@st.composite
def vectors(draw: st.DrawFn) -> tuple[ModalStructure, np.ndarray]:
    n, grounded = draw(st.integers(1, 4)), draw(st.booleans())
    structure = ModalStructure(n, 26.0, grounded)
    log_f = [draw(st.floats(-1.5, 1.5)) for _ in range(n)]
    log_zeta = [draw(st.floats(-4, -0.5)) for _ in range(n)]
    shares = [draw(st.floats(-1.5, 1.5)) for _ in range(n - 1)]
    last = [draw(st.floats(0.0, 1.0))] if grounded else []
    return structure, np.array([*log_f, *log_zeta, *shares, *last])


@pytest.mark.parametrize("grounded", [0.0, 0.4, 1.0])
def test_response_is_that_of_python_control(grounded: float) -> None:
    structure = ModalStructure(2, 30.0, grounded=True)
    total = 0
    for mode in plant().modes:
        w = 2 * np.pi * mode.f_hz
        lag = 2 * mode.zeta / w
        total = total + control.tf(
            [mode.share * lag * (1 - grounded), mode.share], [1 / w**2, lag, 1.0]
        )
    theta = structure.parameters_of(plant(grounded))
    np.testing.assert_allclose(structure.response(theta, F), total(2j * np.pi * F), rtol=1e-9)
    np.testing.assert_allclose(
        structure.response(theta, F), frequency_response(plant(grounded), F), rtol=1e-8
    )


@settings(max_examples=50)
@given(vectors())
def test_slow_motion_is_late_by_what_is_grounded_alone(
    case: tuple[ModalStructure, np.ndarray],
) -> None:
    """Phase slope towards 0 Hz; 0 where nothing is grounded, whatever the parameters are."""
    structure, theta = case
    slow = structure.response(theta, np.array([0.0, 1e-4]))
    assert abs(slow[0] - 1) < 1e-12
    delay_s = -float(np.angle(slow[1])) / (2 * np.pi * 1e-4)
    f, zeta, share = structure.split(theta)
    grounded = float(theta[-1]) if structure.grounded else 0.0
    expected_s = float(np.sum(share * zeta / (np.pi * f * structure.unit_hz))) * grounded
    assert delay_s == pytest.approx(expected_s, abs=1e-9)
    assert structure.spec(theta).delay_s == pytest.approx(expected_s, abs=1e-12)


@settings(max_examples=50)
@given(vectors())
def test_gradient_is_the_derivative(case: tuple[ModalStructure, np.ndarray]) -> None:
    structure, theta = case
    _, gradient = structure.response_and_gradient(theta, F)
    for i in range(structure.size):
        step = np.eye(structure.size)[i] * 1e-6
        ahead, behind = (structure.response(theta + k * step, F) for k in (1, -1))
        numeric, exact = (ahead - behind) / 2e-6, gradient[:, i]
        scale = np.abs(exact).max() + np.abs(numeric).max()
        np.testing.assert_allclose(exact, numeric, atol=2e-5 * scale + 1e-8)
    logs = structure.log_gradient(theta, F) * structure.response(theta, F)[:, None]
    np.testing.assert_allclose(logs, gradient, rtol=1e-9, atol=1e-12)
