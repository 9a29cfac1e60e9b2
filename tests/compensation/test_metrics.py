"""Frobenius metrics: from matrices and from closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from stillpath.compensation.base import DesignError
from stillpath.compensation.basis import BASES, ce_opt_basis, robust_basis_for, spread_functions
from stillpath.compensation.full_preview import FullPreview
from stillpath.compensation.lifted import lift, lifted_set
from stillpath.compensation.metrics import (
    best_number,
    effort_metric,
    effort_of_ce_opt,
    error_metric,
    error_of_functions,
    robust_error_metric,
    robust_error_of_functions,
    robust_error_of_spread,
    toeplitz_metric,
)
from stillpath.compensation.nominal import spread_gram
from stillpath.compensation.operators import ToeplitzOperator
from stillpath.models.plants import Mode, ModesSpec, discretise

M = 70


def markov(f_hz: float, samples: int = M) -> np.ndarray:
    plant = discretise(ModesSpec(modes=(Mode(f_hz=f_hz, zeta=0.03),)), 1e-3)
    return plant.impulse_response(samples)


@pytest.mark.parametrize("name", BASES)
@pytest.mark.parametrize("n", [5, 30, 65])
def test_error_depends_on_n_alone(name: str, n: int) -> None:
    """Proposition 2.1."""
    h = markov(200.0)
    phi = BASES[name](lifted_set(h[None], [1.0]), n)
    g = ToeplitzOperator(h)
    controller = FullPreview(g, phi).controller()
    assert error_metric(g, controller) == pytest.approx(error_of_functions(n, M), abs=1e-9)
    assert error_of_functions(n, M) == np.sqrt(1 - n / M)


@given(st.integers(1, 25), st.integers(0, 2**31))
@settings(max_examples=30)
@example(25, 1272295057)
def test_no_basis_needs_less_effort_than_323(n: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    g = ToeplitzOperator(rng.normal(size=25) * 0.6 ** np.arange(25))
    sigma = np.linalg.svd(g.dense(), compute_uv=False)
    least = effort_of_ce_opt(sigma, n)
    random = np.linalg.qr(rng.normal(size=(25, n)))[0]
    design = FullPreview(g, random)
    if design.report.unique:
        # A random basis of all functions can be as bad for rounding as the plant itself.
        rounding = 1e-9 + 4 * np.finfo(float).eps * np.linalg.cond(g.dense() @ random)
        assert effort_metric(design.controller()) >= least * (1 - rounding)
    if sigma[n - 1] > 1e-5 * sigma[0]:
        best = FullPreview(g, ce_opt_basis(g.dense().T @ g.dense(), n)).controller()
        assert effort_metric(best) == pytest.approx(least, rel=1e-5)


@pytest.mark.parametrize("n", [3, 20, 50])
def test_robust_metric_four_ways(n: int) -> None:
    weights = np.array([0.2, 0.5, 0.3])
    pulses = np.array([markov(f) for f in (180.0, 200.0, 220.0)])
    lifted = lifted_set(pulses, weights)
    nominal = lift(markov(200.0), M).dense()
    spread = spread_gram(lifted, nominal)
    psi = robust_basis_for(nominal, spread, n, r=2)
    controller = psi @ (nominal @ psi).T
    direct = sum(
        w * error_metric(ToeplitzOperator(h), controller) ** 2
        for w, h in zip(weights, pulses, strict=True)
    )
    assert robust_error_metric(lifted, controller) ** 2 == pytest.approx(direct, abs=1e-10)
    assert robust_error_of_functions(psi, spread) ** 2 == pytest.approx(direct, abs=1e-10)
    _, sigma = spread_functions(nominal, spread, 2)
    assert robust_error_of_spread(sigma, n, M) ** 2 == pytest.approx(direct, abs=1e-10)
    assert robust_error_of_spread(sigma[::-1], n, M) ** 2 == pytest.approx(direct, abs=1e-10)


def test_best_number_is_the_minimum() -> None:
    weights = np.full(5, 0.2)
    lifted = lifted_set(np.array([markov(f) for f in np.linspace(160, 240, 5)]), weights)
    nominal = lift(markov(200.0), M).dense()
    _, sigma = spread_functions(nominal, spread_gram(lifted, nominal), 2)
    errors = [robust_error_of_spread(sigma, n, M) for n in range(1, len(sigma) + 1)]
    assert best_number(sigma) == 1 + int(np.argmin(errors))
    assert 1 < best_number(sigma) < len(sigma)
    assert best_number([0.1, 0.5, 0.9]) == 3
    assert best_number([1.1, 2.0]) == 1


@pytest.mark.parametrize("a", [-3.0, 2.0])
def test_zpetc_by_228(a: float) -> None:
    """E(q) = (a / q - 2 a + a q) / (1 - a)^2."""
    samples = 40
    e = np.array([a, -2 * a, a]) / (1 - a) ** 2
    expected = np.sqrt(6 - 2 / samples) * abs(a) / (1 - a) ** 2
    assert toeplitz_metric(e, samples) == pytest.approx(expected)
    dense = ToeplitzOperator(np.append(e[1:], np.zeros(samples - 2)), e[:1]).dense()
    assert np.linalg.norm(dense) / np.sqrt(samples) == pytest.approx(expected)


def test_metric_tends_to_the_two_norm() -> None:
    """(2.20), and from below (D.8)."""
    e = np.concatenate([0.5 ** np.arange(30, 0, -1), 0.8 ** np.arange(31)])
    values = [toeplitz_metric(e, samples) for samples in (31, 100, 1000, 100_000)]
    assert np.all(np.diff(values) > 0)
    assert values[-1] == pytest.approx(np.linalg.norm(e), rel=1e-4)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: error_of_functions(71, M), "71 functions for 70 samples"),
        (lambda: effort_of_ce_opt([2.0, 1.0, 0.0], 3), "with 2 singular values above 0"),
        (lambda: robust_error_of_spread([0.5], 2, M), "n = 2 of 1 robust functions"),
        (lambda: toeplitz_metric([1.0, 2.0], M), "odd number, at most 139"),
        (lambda: toeplitz_metric(np.ones(5), 2), "5 coefficients over 2 samples"),
    ],
)
def test_figures_that_cannot_be_say_why(make, message: str) -> None:
    with pytest.raises(DesignError, match=message):
        make()
