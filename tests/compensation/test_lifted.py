"""Lifted systems against dense matrices, simulation and python-control."""

from __future__ import annotations

import control
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stillpath.compensation.base import DesignError
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

RNG = np.random.default_rng


def random_plants(rng: np.random.Generator, count: int, order: int = 3) -> list[DiscretePlant]:
    plants = []
    for _ in range(count):
        a = rng.normal(size=(order, order))
        a *= 0.9 / np.abs(np.linalg.eigvals(a)).max()
        plants.append(DiscretePlant(a, *rng.normal(size=(2, order)), float(rng.normal())))
    return plants


def lower_toeplitz(h: np.ndarray) -> np.ndarray:
    m = len(h)
    return np.array([[h[i - k] if i >= k else 0.0 for k in range(m)] for i in range(m)])


def changing(plants: list[DiscretePlant], which: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Plain numpy twin of the time-varying plant."""
    x = np.zeros((plants[0].order, u.shape[1]))
    y = np.empty_like(u)
    for k, p in enumerate(plants[i] for i in which):
        y[k] = p.c @ x + p.d * u[k]
        x = p.a @ x + np.outer(p.b, u[k])
    return y


def operators() -> dict[str, LiftedOperator]:
    rng = RNG(3)
    plain = ToeplitzOperator(rng.normal(size=23))
    plants = random_plants(rng, 3)
    changes = time_varying(plants, [0, 7, 11], 23)
    return {
        "toeplitz": plain,
        "looks ahead": ToeplitzOperator(rng.normal(size=23), rng.normal(size=9)),
        "time-varying": changes,
        "dense": DenseOperator(rng.normal(size=(12, 23))),
        "product": ProductOperator(DenseOperator(rng.normal(size=(5, 23))), changes),
        "square": BlockOperator([[plain, changes], [None, plain]]),
        "wide": BlockOperator([[plain, changes, DenseOperator(rng.normal(size=(23, 7)))]]),
        "tall": BlockOperator([[plain], [changes], [DenseOperator(rng.normal(size=(4, 23)))]]),
    }


@pytest.mark.parametrize("name", operators())
def test_products_are_those_of_the_matrix(name: str) -> None:
    g = operators()[name]
    dense = np.stack([g.apply(column) for column in np.eye(g.shape[1])], axis=1)
    assert dense.shape == g.shape
    np.testing.assert_allclose(g.dense(), dense, atol=1e-12)
    u, e = RNG(1).normal(size=(g.shape[1], 70)), RNG(2).normal(size=(g.shape[0], 70))
    np.testing.assert_allclose(g.apply(u), dense @ u, atol=1e-11)
    np.testing.assert_allclose(g.apply_adjoint(e), dense.T @ e, atol=1e-11)
    operator = g.as_linear_operator()
    np.testing.assert_allclose(operator @ u[:, 0], dense @ u[:, 0], atol=1e-11)
    np.testing.assert_allclose(operator.T @ e, dense.T @ e, atol=1e-11)


@given(st.integers(1, 40), st.integers(0, 39), st.integers(0, 2**31))
@settings(max_examples=60)
def test_adjoint_identity(m: int, ahead: int, seed: int) -> None:
    rng = RNG(seed)
    g = ToeplitzOperator(rng.normal(size=m), rng.normal(size=min(ahead, m - 1)))
    u, e = rng.normal(size=m), rng.normal(size=m)
    assert e @ g.apply(u) == pytest.approx(g.apply_adjoint(e) @ u, rel=1e-9, abs=1e-9)


def test_lifted_plant_is_its_simulation() -> None:
    plant = one_mode()
    rng = RNG(4)
    u, x0 = rng.normal(size=80), rng.normal(size=plant.order)
    system = control.ss(plant.a, plant.b[:, None], plant.c[None, :], plant.d, plant.dt_s)
    expected = control.forced_response(system, inputs=u, initial_state=x0).outputs
    got = lift(plant, 80).apply(u) + free_response(plant, 80) @ x0
    np.testing.assert_allclose(got, expected, atol=1e-11)


def test_taps_are_padded_and_truncated() -> None:
    taps = np.array([0.0, 0.5, 0.3])
    np.testing.assert_array_equal(lift(taps, 5).markov, [0, 0.5, 0.3, 0, 0])
    np.testing.assert_array_equal(lift(taps, 2).markov, [0, 0.5])


def test_time_varying_plant_keeps_its_state() -> None:
    plants = random_plants(RNG(5), 4)
    g = time_varying(plants, [0, 3, 10, 20], 30)
    which = np.repeat(np.arange(4), [3, 7, 10, 10])
    u = RNG(6).normal(size=(30, 5))
    np.testing.assert_allclose(g.apply(u), changing(plants, which, u), atol=1e-12)
    x0 = RNG(7).normal(size=3)
    impulse = np.zeros((31, 1))
    # A state is what an earlier impulse leaves: prepend a sample that makes it.
    maker = DiscretePlant(plants[0].a, x0, plants[0].c, 0.0)
    impulse[0] = 1.0
    expected = changing([maker, *plants], np.append(0, which + 1), impulse)[1:, 0]
    np.testing.assert_allclose(g.free_response(x0), expected, atol=1e-12)


@given(st.integers(1, 8), st.integers(1, 30), st.integers(0, 2**31))
@settings(max_examples=40)
def test_set_by_displacement_is_the_dense_sum(members: int, m: int, seed: int) -> None:
    rng = RNG(seed)
    markov, weights = rng.normal(size=(members, m)), rng.uniform(0.1, 1, size=members)
    weights /= weights.sum()
    got = lifted_set(markov, weights)
    dense = lifted_set_of([ToeplitzOperator(h) for h in markov], weights)
    np.testing.assert_allclose(got.gram, dense.gram, atol=1e-11)
    np.testing.assert_allclose(got.mean, dense.mean, atol=1e-12)
    plants = [lower_toeplitz(h) for h in markov]
    expected = sum(w * g.T @ g for w, g in zip(weights, plants, strict=True))
    np.testing.assert_allclose(got.gram, expected, atol=1e-11)
    assert got.samples == dense.samples == m


UNSTABLE = DiscretePlant(np.array([[1.02]]), np.ones(1), np.ones(1), 0.0)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: lifted_set(np.zeros((0, 5)), []), "set of plants is empty"),
        (lambda: lifted_set(np.ones((2, 5)), [1.2, -0.2]), r"weight -0.2 .* not be negative"),
        (lambda: lifted_set(np.ones((2, 5)), [0.5, 0.6]), r"sum to 1.1, must be 1"),
        (lambda: lifted_set(np.ones((2, 5)), [1.0]), r"weights of shape \(1,\) for 2 plants"),
        (lambda: lift(UNSTABLE, 10), r"unstable: largest pole \|z\| = 1.02, .* feedback"),
        (lambda: time_varying([one_mode(), UNSTABLE], [0, 3], 9), r"orders \[1, 2\]"),
        (lambda: time_varying([UNSTABLE], [0], 9), "plant 0 of the time-varying system is unst"),
        (lambda: time_varying([one_mode()] * 2, [0, 9], 9), "rising, and all below"),
        (lambda: lift(one_mode(), 0), "at least one"),
        (lambda: ToeplitzOperator([1.0, np.inf]), "not finite: is the plant unstable"),
        (lambda: ToeplitzOperator([1.0], [1.0]), "looks ahead"),
        (lambda: lift([1.0], 4).apply(np.ones(3)), r"takes \(4,\) or \(4, k\)"),
        (lambda: lift([1.0], 4).apply_adjoint(np.ones((3, 2))), "output of shape"),
        (lambda: BlockOperator([[lift([1.0], 4), lift([1.0], 3)]]), r"output 0 .* \[3, 4\]"),
        (lambda: BlockOperator([[lift([1.0], 4), None]]), "input 1 have lengths"),
        (lambda: BlockOperator([[lift([1.0], 4)], []]), "grid"),
        (lambda: lifted_set_of([lift([1.0], 4), lift([1.0], 3)], [0.5, 0.5]), "one shape"),
    ],
)
def test_a_system_that_cannot_be_lifted_says_why(make, message: str) -> None:
    with pytest.raises(DesignError, match=message):
        make()
