"""Nominal models: the lifted optimum, the spread around it, two steps."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import subspace_angles

from stillpath.compensation.base import DesignError
from stillpath.compensation.basis import robust_basis_for, spread_functions
from stillpath.compensation.full_preview import FullPreview
from stillpath.compensation.lifted import LiftedSet, lift, lifted_set
from stillpath.compensation.metrics import robust_error_metric, robust_error_of_spread
from stillpath.compensation.nominal import lifted_optimum, spread_gram, two_step
from stillpath.compensation.operators import DenseOperator

M = 60


def lags(count: int = 6) -> np.ndarray:
    """Plants (1 - p) / (1 - p / q), which have an inverse."""
    p = np.linspace(0.4, 0.9, count)[:, None]
    return (1 - p) * p ** np.arange(M)


def equal(markov: np.ndarray) -> LiftedSet:
    return lifted_set(markov, np.full(len(markov), 1 / len(markov)))


@given(st.integers(1, 6), st.integers(2, 20), st.integers(0, 2**31))
@settings(max_examples=40)
def test_spread_is_the_sum(count: int, m: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    markov, weights = rng.normal(size=(count, m)), rng.uniform(0.1, 1, count)
    weights /= weights.sum()
    nominal = rng.normal(size=(m, m))
    expected = np.zeros((m, m))
    for w, h in zip(weights, markov, strict=True):
        delta = lift(h, m).dense() - nominal
        expected += w * delta.T @ delta
    got = spread_gram(lifted_set(markov, weights), nominal)
    np.testing.assert_allclose(got, expected, atol=1e-10)


def test_lifted_optimum_is_stationary() -> None:
    """(4.26): no step from it lowers |Delta G_nom^-1|."""
    members = equal(lags())
    inverse = np.linalg.inv(lifted_optimum(members))

    def cost(x: np.ndarray) -> float:
        # sum l_j |G_j X - I|^2
        return float(np.sum(x * (members.gram @ x)) - 2 * np.sum(members.mean * x.T) + M)

    least = cost(inverse)
    rng = np.random.default_rng(0)
    for _ in range(20):
        step = rng.normal(size=(M, M))
        assert cost(inverse + 1e-4 * step) > least
    nominal = lifted_optimum(members)
    assert least == pytest.approx(
        np.trace(np.linalg.solve(nominal.T, spread_gram(members, nominal)) @ inverse), rel=1e-9
    )


def test_one_plant_is_its_own_optimum() -> None:
    members = equal(lags(1))
    np.testing.assert_allclose(lifted_optimum(members), members.mean, atol=1e-10)
    np.testing.assert_allclose(spread_gram(members, members.mean), 0, atol=1e-12)


def test_pseudo_inverse_leaves_out_what_no_plant_answers() -> None:
    delayed = np.concatenate([np.zeros((6, 1)), lags()[:, :-1]], axis=1)
    nominal = lifted_optimum(equal(delayed))
    assert np.isfinite(nominal).all()
    assert np.linalg.matrix_rank(nominal) == M - 1
    np.testing.assert_allclose(nominal[:, -1], 0, atol=1e-12)


@pytest.mark.parametrize("n", [None, 10])
def test_two_steps_with_the_optimum(n: int | None) -> None:
    members = equal(lags())
    design = two_step(members, n)
    assert design.r == 0
    assert design.best == M  # scenario (i)
    assert design.basis.shape == (M, n or M)
    assert np.all(design.singular_values < 1)
    np.testing.assert_allclose(design.nominal, lifted_optimum(members))
    _, sigma = spread_functions(design.nominal, spread_gram(members, design.nominal))
    np.testing.assert_allclose(design.singular_values, sigma, atol=1e-7)
    controller = FullPreview(DenseOperator(design.nominal), design.basis).controller()
    assert robust_error_metric(members, controller) == pytest.approx(
        robust_error_of_spread(sigma, n or M, M), abs=1e-8
    )


def test_two_steps_with_a_given_model() -> None:
    members = equal(lags())
    given_model = lift(lags()[-1], M).dense()
    design = two_step(members, nominal=given_model)
    assert 1 < design.best < M  # scenario (iii)
    assert design.basis.shape == (M, design.best)
    expected = robust_basis_for(given_model, spread_gram(members, given_model), design.best)
    assert subspace_angles(design.basis, expected).max() < 1e-6
    # The optimum is better with the same number of functions.
    both = [
        robust_error_metric(
            members, FullPreview(DenseOperator(d.nominal), d.basis).controller()
        )
        for d in (design, two_step(members, design.best))
    ]  # fmt: skip
    assert both[1] < both[0]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: lifted_optimum(equal(np.stack([lags(1)[0], -lags(1)[0]]))), "cancel each other"),
        (lambda: spread_gram(equal(lags()), np.eye(3)), r"shape \(3, 3\) for plants"),
        (lambda: two_step(equal(lags()), 55, r=10), r"answer 50 directions \(r = 10\)"),
        (lambda: two_step(equal(lags()), 0), "n = 0 robust functions"),
    ],
)
def test_a_nominal_model_that_cannot_be_says_why(make, message: str) -> None:
    with pytest.raises(DesignError, match=message):
        make()
