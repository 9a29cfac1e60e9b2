"""Full preview: least squares twins, uniqueness, decoupling, several axes, changing plants."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stillpath.compensation.base import DesignError
from stillpath.compensation.basis import bspline_functions, ce_opt_basis, dct_basis
from stillpath.compensation.full_preview import FullPreview, independence
from stillpath.compensation.lifted import (
    free_response,
    lift,
    lifted_set,
    lifted_set_of,
    time_varying,
)
from stillpath.compensation.operators import (
    BlockOperator,
    DenseOperator,
    LiftedOperator,
    ProductOperator,
    ToeplitzOperator,
)
from stillpath.models.plants import DiscretePlant
from tests.plants import one_mode

M = 90


def first_order(a: float, p: float = 0.5) -> DiscretePlant:
    """K (q - a) / (q - p) with DC gain 1 (C.1)."""
    gain = (1 - p) / (1 - a)
    return DiscretePlant(np.array([[p]]), np.ones(1), np.array([gain * (p - a)]), gain, (), 1e-3)


def path(seed: int = 0, columns: int | None = None) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.cumsum(rng.normal(size=M if columns is None else (M, columns)), axis=0)


def test_one_plant_is_least_squares() -> None:
    g = lift(one_mode(), M)
    phi = bspline_functions(M, 25)
    design = FullPreview(g, phi)
    y_d = path(columns=3)
    gamma = np.linalg.lstsq(g.dense() @ phi, y_d, rcond=None)[0]
    np.testing.assert_allclose(design.coefficients(y_d), gamma, atol=1e-8)
    np.testing.assert_allclose(design.command(y_d), phi @ gamma, atol=1e-8)
    np.testing.assert_allclose(design.command(y_d[:, 0]), phi @ gamma[:, 0], atol=1e-8)
    np.testing.assert_allclose(design.controller() @ y_d, phi @ gamma, atol=1e-8)
    assert design.report.unique
    assert design.report.rank == design.report.functions == 25
    assert design.report.condition == pytest.approx(np.linalg.cond(g.dense() @ phi), rel=1e-6)


def test_decoupled_form() -> None:
    """Appendix E: Phi = Psi Omega with the Cholesky factor, G Psi orthonormal."""
    g, phi = lift(one_mode(), M), bspline_functions(M, 25)
    design = FullPreview(g, phi)
    filtered = g.dense() @ phi
    omega = np.linalg.cholesky(filtered.T @ filtered).T
    np.testing.assert_allclose(design.transform, omega, atol=1e-9)
    np.testing.assert_allclose(design.functions @ design.transform, phi, atol=1e-10)
    np.testing.assert_allclose(g.apply(design.functions), design.targets, atol=1e-10)
    np.testing.assert_allclose(design.targets.T @ design.targets, np.eye(25), atol=1e-12)


@given(st.integers(1, 30), st.integers(0, 2**31))
@settings(max_examples=30)
def test_error_is_orthogonal_to_what_can_be_done(n: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    g = ToeplitzOperator(rng.normal(size=30) * 0.7 ** np.arange(30))
    phi = np.linalg.qr(rng.normal(size=(30, n)))[0]
    y_d = rng.normal(size=30)
    design = FullPreview(g, phi)
    error = y_d - g.apply(design.command(y_d))
    scale = np.abs(design.controller()).max() + 1
    np.testing.assert_allclose(g.apply(phi).T @ error, 0, atol=1e-10 * scale)


def test_commands_of_fewer_functions() -> None:
    g, phi, y_d = lift(one_mode(), M), dct_basis(M, 40), path()
    commands = FullPreview(g, phi).commands(y_d, [3, 17, 40])
    for n, u in zip([3, 17, 40], commands.T, strict=True):
        np.testing.assert_allclose(u, FullPreview(g, phi[:, :n]).command(y_d), atol=1e-8)


def test_dependent_filtered_functions() -> None:
    """A delay hides the last samples: shortest coefficients, and the report says so."""
    g = lift(np.array([0.0, 0.0, 1.0, 0.5]), M)
    phi = np.linalg.qr(np.random.default_rng(2).normal(size=(M, M)))[0]
    design = FullPreview(g, phi)
    y_d = path()
    assert not design.report.unique
    assert (design.report.rank, design.report.condition > 1e12) == (M - 2, True)
    gamma = np.linalg.lstsq(g.dense() @ phi, y_d, rcond=1e-12)[0]
    np.testing.assert_allclose(design.coefficients(y_d), gamma, atol=1e-8)
    np.testing.assert_allclose(design.command(y_d), phi @ gamma, atol=1e-8)
    np.testing.assert_allclose(
        design.functions @ design.transform, phi @ design.transform.T
        @ np.diag(np.sum(design.transform**2, axis=1) ** -1.0) @ design.transform, atol=1e-10
    )  # fmt: skip
    with pytest.raises(DesignError, match=f"dependent .rank {M - 2} of {M}.: design each"):
        design.commands(y_d, [5])


def stacked(plants: list[LiftedOperator], weights: np.ndarray, phi: np.ndarray) -> np.ndarray:
    return np.concatenate(
        [np.sqrt(w) * g.dense() @ phi for w, g in zip(weights, plants, strict=True)]
    )


def test_ensemble() -> None:
    plants = [lift(one_mode(f), M) for f in (36.0, 40.0, 44.0)]
    weights, phi, y_d = np.array([0.2, 0.5, 0.3]), bspline_functions(M, 20), path()
    right = np.concatenate([np.sqrt(w) * y_d for w in weights])
    gamma = np.linalg.lstsq(stacked(plants, weights, phi), right, rcond=None)[0]
    design = FullPreview(plants, phi, weights=weights)
    np.testing.assert_allclose(design.coefficients(y_d), gamma, atol=1e-8)
    np.testing.assert_allclose(design.command(y_d), phi @ gamma, atol=1e-8)
    by_grams = FullPreview(lifted_set(np.stack([g.markov for g in plants]), weights), phi)
    np.testing.assert_allclose(by_grams.command(y_d), phi @ gamma, atol=1e-5)
    np.testing.assert_allclose(by_grams.transform, design.transform, atol=1e-6)
    equal = FullPreview(plants, phi)
    thirds = FullPreview(plants, phi, weights=np.full(3, 1 / 3))
    np.testing.assert_array_equal(equal.command(y_d), thirds.command(y_d))


def test_dependent_functions_from_a_set() -> None:
    delayed = np.concatenate([np.zeros(2), one_mode().impulse_response(M - 2)])
    lifted = lifted_set(delayed[None], [1.0])
    phi = np.linalg.qr(np.random.default_rng(3).normal(size=(M, M)))[0]
    design = FullPreview(lifted, phi)
    assert not design.report.unique
    assert design.report.tolerance == 1e-7
    y_d = np.sin(np.arange(M) / 9)
    single = FullPreview(lift(delayed, M), phi, rank_tolerance=1e-7)
    assert design.report.rank == single.report.rank < M
    np.testing.assert_allclose(design.command(y_d), single.command(y_d), atol=1e-5)


def test_weighting_filter() -> None:
    """Remark 3.3: |W (y_d - G u)| is least."""
    g, w = lift(one_mode(), M), lift(first_order(0.0, 0.9), M)
    phi, y_d = bspline_functions(M, 20), path()
    both = ProductOperator(w, g)
    gamma = np.linalg.lstsq(both.dense() @ phi, w.apply(y_d), rcond=None)[0]
    design = FullPreview(g, phi, weighting=w)
    np.testing.assert_allclose(design.command(y_d), phi @ gamma, atol=1e-7)
    # And the basis can be made for the weighted plant.
    dense = both.dense()
    assert FullPreview(g, ce_opt_basis(dense.T @ dense, 20), weighting=w).report.unique


def test_nonzero_initial_state() -> None:
    plant = one_mode()
    x0 = np.array([0.3, -0.2])
    free = free_response(plant, M) @ x0
    y_d = np.sin(np.arange(M) / 15)
    g, phi = lift(plant, M), bspline_functions(M, 40)
    design = FullPreview(g, phi)
    error = y_d - g.apply(design.command(y_d, free)) - free
    ignored = y_d - g.apply(design.command(y_d)) - free
    # What comes before the first command has shown cannot be helped.
    assert np.abs(error[20:]).max() < 0.05 * np.abs(ignored[20:]).max()
    gamma = np.linalg.lstsq(g.dense() @ phi, y_d - free, rcond=None)[0]
    np.testing.assert_allclose(design.coefficients(y_d, free), gamma, atol=1e-7)


@pytest.mark.slow
def test_changing_plant() -> None:
    """A nozzle that moves along a beam: stiffness changes, states are position and velocity."""
    dt = 1e-3
    plants = []
    for f in np.linspace(30, 50, 9):
        w = 2 * np.pi * f
        # Semi-implicit Euler: the position moves with the new velocity.
        kick = np.array([-w * w * dt, 1 - 0.1 * w * dt])
        a = np.array([[1, 0] + dt * kick, kick])
        plants.append(DiscretePlant(a, w * w * dt * np.array([dt, 1]), np.array([1.0, 0]), 0.0))
    g = time_varying(plants, list(range(0, M, 10)), M)
    phi, y_d = bspline_functions(M, 30), np.sin(np.arange(M) / 12) ** 2
    gamma = np.linalg.lstsq(g.dense() @ phi, y_d, rcond=None)[0]
    design = FullPreview(g, phi)
    np.testing.assert_allclose(design.command(y_d), phi @ gamma, atol=1e-7)
    frozen = FullPreview(lift(plants[0], M), phi)
    error = np.linalg.norm(y_d - g.apply(design.command(y_d)))
    assert error < 0.2 * np.linalg.norm(y_d - g.apply(frozen.command(y_d)))


@pytest.mark.parametrize("outputs", [1, 2, 3])
def test_several_axes(outputs: int) -> None:
    """Two inputs; fewer, as many and more outputs."""
    rng = np.random.default_rng(4)
    pulses = rng.normal(size=(outputs, 2, M)) * 0.8 ** np.arange(M)
    for i in range(min(outputs, 2)):
        pulses[i, i, 0] = 8.0  # minimum phase, so that the twin has digits to compare
    g = BlockOperator([[ToeplitzOperator(h) for h in row] for row in pulses])
    phi = np.linalg.qr(rng.normal(size=(2 * M, 40)))[0]
    y_d = rng.normal(size=outputs * M)
    design = FullPreview(g, phi)
    gamma = np.linalg.lstsq(g.dense() @ phi, y_d, rcond=None)[0]
    np.testing.assert_allclose(design.command(y_d), phi @ gamma, atol=1e-8)
    by_grams = FullPreview(lifted_set_of([g], [1.0], inputs=2), phi)
    np.testing.assert_allclose(by_grams.command(y_d), phi @ gamma, atol=1e-6)


def test_more_functions_than_outputs() -> None:
    """Two inputs, one output: the shortest of many commands, and no error."""
    rng = np.random.default_rng(5)
    g = BlockOperator([[ToeplitzOperator([2.0, *rng.uniform(size=M - 1) * 0.5 ** np.arange(M - 1)]),
                        ToeplitzOperator([1.0] + (M - 1) * [0.0])]])  # fmt: skip
    phi = np.linalg.qr(rng.normal(size=(2 * M, M + 30)))[0]
    y_d = rng.normal(size=M)
    design = FullPreview(g, phi)
    assert (design.report.rank, design.report.unique) == (M, False)
    gamma = np.linalg.lstsq(g.dense() @ phi, y_d, rcond=None)[0]
    np.testing.assert_allclose(design.coefficients(y_d), gamma, atol=1e-9)
    np.testing.assert_allclose(g.apply(design.command(y_d)), y_d, atol=1e-9)


def test_filter_states_restore_independence() -> None:
    """Appendix C: n = M with a zero at 2 is dependent; filter states of 1e-3 cure it."""
    plant, samples = first_order(2.0), 101
    g, o = lift(plant, samples), free_response(plant, samples)
    half = independence(plant, dct_basis(samples, 51))
    assert (half.rank, half.augmented, half.independent) == (51, 52, True)
    whole = independence(plant, dct_basis(samples, samples))
    assert (whole.rank, whole.augmented, whole.independent) == (101, 101, False)
    assert not FullPreview(g, dct_basis(samples, samples)).report.unique
    states = np.full((1, samples), 1e-3)
    cured = independence(plant, dct_basis(samples, samples), states)
    assert (cured.rank, cured.augmented, cured.independent) == (101, 102, True)
    y_d = np.sign(np.sin(np.arange(samples) ** 1.5 / 30))
    design = FullPreview(g, dct_basis(samples, samples), responses=o, states=states)
    assert design.report.unique
    answer = g.apply(design.command(y_d)) + o @ design.initial_state(y_d)
    np.testing.assert_allclose(answer, y_d, atol=1e-9)


def test_independence_sees_a_delay() -> None:
    plant = DiscretePlant(np.array([[0.5]]), np.ones(1), np.array([0.5]), 0.0)
    phi = np.eye(20)
    assert independence(plant, phi[:, :19]).independent
    assert not independence(plant, phi[:, 1:]).independent


G = lift(one_mode(), M)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: FullPreview(G, np.ones((M, M + 1))), "91 functions for 90 input samples"),
        (lambda: FullPreview(G, np.ones((M + 1, 3))), r"basis of shape \(91, 3\): one row for"),
        (lambda: FullPreview(G, np.ones((M, 2))), r"dependent before any filtering \(rank 1\)"),
        (lambda: FullPreview(G, np.full((M, 2), np.nan)), "not finite"),
        (lambda: FullPreview(DenseOperator(np.zeros((M, M))), np.eye(M)[:, :3]), "answers none"),
        (lambda: FullPreview(lifted_set([G.markov], [1.0]), np.eye(M), weighting=G), "LiftedSet"),
        (lambda: FullPreview(G, np.eye(M)[:, :3], states=np.ones((2, 3))), "need one plant"),
        (lambda: FullPreview(G, np.eye(M)[:, :3]).initial_state(path()), "without filter"),
        (lambda: FullPreview(G, np.eye(M)[:, :3]).command(np.ones(M - 1)), r"path of shape \(89,"),
        (lambda: FullPreview(G, np.eye(M)[:, :3]).commands(path(), [4]), "4 to 4 of 3 functions"),
        (lambda: independence(one_mode(), np.eye(M), np.ones((1, M))), r"\(2, 90\) needed"),
    ],
)  # fmt: skip
def test_a_design_that_cannot_be_says_why(make, message: str) -> None:
    with pytest.raises(DesignError, match=message):
        make()
