"""Weights of the worst case: the saddle point, and what the weights do to a design."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stillpath.compensation.base import DesignError
from stillpath.compensation.minimax import (
    guarded_weights,
    member_errors,
    path_spectrum,
    worst_case_weights,
)
from stillpath.models.plants import Mode, ModesSpec, discretise, plant_set
from stillpath.models.store import load_machine

F_HZ = np.linspace(2.0, 150.0, 300)


def responses(f_hz: list[float], zeta: float = 0.05) -> np.ndarray:
    plants = [discretise(ModesSpec(modes=(Mode(f_hz=f, zeta=zeta),)), 1e-3) for f in f_hz]
    return np.array([p.frequency_response(F_HZ) for p in plants])


@settings(max_examples=25)
@given(st.lists(st.floats(20.0, 90.0), min_size=1, max_size=6), st.floats(0.02, 0.2))
def test_saddle_point(f_hz: list[float], zeta: float) -> None:
    """Members with weight are the worst and equal; no other member is worse (duality)."""
    g, s = responses(f_hz, zeta), path_spectrum(F_HZ)
    weights = worst_case_weights(g, s)
    assert weights.min() >= 0
    assert weights.sum() == pytest.approx(1.0)
    errors = member_errors(g, s, weights)
    if errors.max() > 1e-12:
        dual = weights @ errors
        assert errors.max() <= dual * 1.01


@settings(max_examples=20)
@given(st.integers(0, 2**31))
def test_no_weights_have_a_smaller_worst_member(seed: int) -> None:
    g, s = responses([36.0, 40.5, 45.0, 49.5, 54.0]), path_spectrum(F_HZ)
    best = member_errors(g, s, worst_case_weights(g, s)).max()
    others = np.random.default_rng(seed).dirichlet(np.ones(5))
    assert member_errors(g, s, others).max() >= best * (1 - 1e-6)


def test_errors_are_the_definition() -> None:
    g, s = responses([40.0, 50.0]), path_spectrum(F_HZ)
    w = np.array([0.3, 0.7])
    expected = []
    for j in range(2):
        total = 0.0
        for k in range(len(F_HZ)):
            c = np.conj(w @ g[:, k]) / (w @ np.abs(g[:, k]) ** 2)
            total += s[k] * abs(1 - g[j, k] * c) ** 2
        expected.append(total / s.sum())
    np.testing.assert_allclose(member_errors(g, s, w), expected, rtol=1e-12)


def test_of_a_machine() -> None:
    plants = plant_set(load_machine("ender3").axes["x"], 1e-3)
    weights = guarded_weights(plants)
    assert weights.shape == (len(plants.members),)
    assert weights.sum() == pytest.approx(1.0)
    assert weights.min() >= 0.5 * plants.weights.min()
    assert weights.tobytes() == guarded_weights(plants).tobytes()


def test_an_empty_set_is_refused() -> None:
    with pytest.raises(DesignError, match="set is empty"):
        worst_case_weights(np.zeros((0, 5)), np.ones(5))
