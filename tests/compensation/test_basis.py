"""Bases: what each is defined by, nesting, and the identity after the robust one."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.fft import idct
from scipy.linalg import subspace_angles

from stillpath.compensation.base import DesignError
from stillpath.compensation.basis import (
    BASES,
    bspline_functions,
    ce_opt_basis,
    ce_opt_basis_of,
    dct_basis,
    orthonormal,
    robust_basis,
    robust_basis_for,
    robust_functions,
    spread_functions,
)
from stillpath.compensation.lifted import LiftedSet, integrated, lift, lifted_set, lifted_set_of
from stillpath.compensation.metrics import robust_error_metric
from stillpath.compensation.nominal import lifted_optimum, spread_gram
from stillpath.compensation.operators import BlockOperator, ToeplitzOperator
from stillpath.models.plants import Mode, ModesSpec, discretise

M = 80


def markov(spread: float = 0.2, count: int = 9, samples: int = M) -> np.ndarray:
    """First-order-hold models of one mode: d != 0, so no direction is silent."""
    return np.array([
        discretise(ModesSpec(modes=(Mode(f_hz=f, zeta=0.05),)), 1e-3).impulse_response(samples)
        for f in 200 * np.linspace(1 - spread, 1 + spread, count)
    ])  # fmt: skip


def plant_set(spread: float = 0.2, count: int = 9, samples: int = M) -> LiftedSet:
    return lifted_set(markov(spread, count, samples), np.full(count, 1 / count))


@pytest.mark.parametrize("name", BASES)
@pytest.mark.parametrize("n", [4, 20, 60])
@pytest.mark.parametrize("in_preview", [False, True])
def test_orthonormal(name: str, n: int, in_preview: bool) -> None:
    h = markov()
    lifted = lifted_set(integrated(h) if in_preview else h, np.full(len(h), 1 / len(h)))
    psi = BASES[name](lifted, n)
    assert psi.shape == (M, n)
    np.testing.assert_allclose(psi.T @ psi, np.eye(n), atol=1e-10)
    np.testing.assert_array_equal(psi, BASES[name](lifted, n))


@pytest.mark.parametrize("name", ["dct", "ce-opt", "robust"])
def test_fewer_functions_are_the_first_of_more(name: str) -> None:
    lifted = plant_set()
    np.testing.assert_allclose(BASES[name](lifted, 30)[:, :12], BASES[name](lifted, 12), atol=1e-9)


def test_dct_is_scipys() -> None:
    np.testing.assert_allclose(dct_basis(M, 25), idct(np.eye(M), axis=0, norm="ortho")[:, :25],
                               atol=1e-12)  # fmt: skip


@pytest.mark.parametrize("degree", [1, 3, 5])
def test_bsplines_by_the_recursion(degree: int) -> None:
    """F.2 as printed, with 0/0 = 0 and the last knot closed."""
    n = 14
    eta = np.concatenate([np.zeros(degree), np.linspace(0, 1, n - degree + 1), np.ones(degree)])
    xi = np.linspace(0, 1, M)
    phi = [(eta[i] <= xi) & (xi < eta[i + 1]) for i in range(len(eta) - 1)]
    last = max(i for i in range(len(eta) - 1) if eta[i] < eta[i + 1])
    phi[last] = phi[last] | (xi == 1)
    phi = [p.astype(float) for p in phi]
    for m in range(1, degree + 1):

        def share(top: np.ndarray, span: float) -> np.ndarray:
            return top / span if span > 0 else 0 * top

        phi = [
            share(xi - eta[i], eta[i + m] - eta[i]) * phi[i]
            + share(eta[i + m + 1] - xi, eta[i + m + 1] - eta[i + 1]) * phi[i + 1]
            for i in range(len(phi) - 1)
        ]  # fmt: skip
    got = bspline_functions(M, n, degree)
    np.testing.assert_allclose(got, np.stack(phi, axis=1), atol=1e-12)
    np.testing.assert_allclose(got.sum(axis=1), 1, atol=1e-12)


def test_ce_opt_needs_least_effort() -> None:
    g = lift(markov(count=1)[0], M).dense()
    _, sigma, vt = np.linalg.svd(g)
    np.testing.assert_allclose(ce_opt_basis(g.T @ g, 10) ** 2, vt[:10].T ** 2, atol=1e-6)

    def effort(psi: np.ndarray) -> float:
        return float(np.linalg.norm(psi @ np.linalg.pinv(g @ psi)))

    least = effort(ce_opt_basis(g.T @ g, 10))
    assert least == pytest.approx(np.sqrt(np.sum(sigma[:10] ** -2.0)), rel=1e-9)
    rng = np.random.default_rng(0)
    for _ in range(20):
        assert effort(orthonormal(rng.normal(size=(M, 10)))) > least


def test_ce_opt_by_lanczos() -> None:
    g = lift(markov(count=1)[0], M)
    got = ce_opt_basis_of(g, 15)
    np.testing.assert_allclose(got, ce_opt_basis(g.dense().T @ g.dense(), 15), atol=1e-7)
    np.testing.assert_array_equal(got, ce_opt_basis_of(g, 15))
    with pytest.raises(DesignError, match="n = 80 "):
        ce_opt_basis_of(g, M)


def test_robust_is_422_with_428() -> None:
    """Ensemble least squares in its best basis = (4.22) under the nominal model (4.28)."""
    # Lags p in (1 - p) / (1 - p / q) that have an inverse: nothing needs to be left out.
    lags = np.linspace(0.5, 0.9, 7)[:, None]
    lifted = lifted_set((1 - lags) * lags ** np.arange(M), np.full(7, 1 / 7))
    nominal = lifted_optimum(lifted)
    spread = spread_gram(lifted, nominal)
    functions, mu = robust_functions(lifted.gram, lifted.mean)
    explicit, sigma = spread_functions(nominal, spread)
    np.testing.assert_allclose(sigma**2, 1 - mu, atol=1e-10)
    assert functions.shape == explicit.shape == (M, M)
    for n in (5, 30, 79):
        psi = robust_basis(lifted.gram, lifted.mean, n)
        assert subspace_angles(psi, robust_basis_for(nominal, spread, n)).max() < 1e-6
        # Also the controllers agree: nominal least squares and ensemble least squares.
        printed = robust_basis_for(nominal, spread, n)
        by_nominal = printed @ (nominal @ printed).T
        by_ensemble = psi @ np.linalg.solve(psi.T @ lifted.gram @ psi, psi.T @ lifted.mean.T)
        np.testing.assert_allclose(by_nominal, by_ensemble, atol=1e-6)
        assert robust_error_metric(lifted, by_ensemble) == pytest.approx(
            np.sqrt(1 - mu[:n].sum() / M), abs=1e-9
        )


def test_422_as_printed() -> None:
    lifted = plant_set()
    nominal = lift(markov(count=1)[0], M).dense()
    spread = spread_gram(lifted, nominal)
    psi = robust_basis_for(nominal, spread, 25, r=3)
    filtered = nominal @ psi
    np.testing.assert_allclose(filtered.T @ filtered, np.eye(25), atol=1e-10)
    v, _, _ = np.linalg.svd(nominal)
    np.testing.assert_allclose(v[:, -3:].T @ filtered, 0, atol=1e-10)
    _, sigma = spread_functions(nominal, spread, 3)
    np.testing.assert_allclose(np.diag(psi.T @ spread @ psi), sigma[:25] ** 2, atol=1e-10)


def test_silent_directions_are_left_out() -> None:
    """Relative degree one: no member answers the last sample of the command."""
    delayed = np.concatenate([np.zeros((9, 1)), markov()[:, :-1]], axis=1)
    lifted = lifted_set(delayed, np.full(9, 1 / 9))
    functions, _ = robust_functions(lifted.gram, lifted.mean)
    assert functions.shape == (M, M - 1)
    np.testing.assert_allclose(functions[-1], 0, atol=1e-9)
    with pytest.raises(DesignError, match=r"r = 0 of 80 .* but 1 are answered by less"):
        robust_basis(lifted.gram, lifted.mean, 5, r=0)
    with pytest.raises(DesignError, match=r"n = 80 robust functions, but .* answers 79 of 80"):
        robust_basis(lifted.gram, lifted.mean, M)
    assert robust_basis(lifted.gram, lifted.mean, 76, r=4).shape == (M, 76)


def test_every_input_gets_the_functions() -> None:
    g = ToeplitzOperator(markov(count=1)[0])
    both = lifted_set_of([BlockOperator([[g, None], [None, g]])], [1.0], inputs=2)
    for name in BASES:
        psi = BASES[name](both, 10)
        assert psi.shape == (2 * M, 10)
        np.testing.assert_allclose(psi.T @ psi, np.eye(10), atol=1e-10)
    np.testing.assert_allclose(BASES["dct"](both, 10)[:M, :5], dct_basis(M, 5))
    with pytest.raises(DesignError, match="n = 9 functions for 2 inputs: take a multiple"):
        BASES["bspline"](both, 9)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda s: dct_basis(M, M + 1), "n = 81 basis functions of 80 samples: take 1 to 80"),
        (lambda s: bspline_functions(M, 3, 3), "n = 3 B-splines of degree 3: take at least 4"),
        (lambda s: ce_opt_basis(s.gram, 0), "n = 0 "),
        (lambda s: robust_basis(s.gram, s.mean, 70, r=20), "take at most 60"),
        (lambda s: robust_basis(s.gram, s.mean, 5, r=80), "r = 80 of 80"),
        (lambda s: robust_basis_for(s.mean, s.gram, 70, r=20), "1 <= n <= 60"),
        (lambda s: spread_functions(s.mean, s.gram, r=-1), "r = -1 of 80"),
        (lambda s: spread_functions(np.diag(np.arange(80.0)), s.gram), "zero: take r = 1"),
    ],
)
def test_a_basis_that_cannot_be_says_why(make, message: str) -> None:
    with pytest.raises(DesignError, match=message):
        make(plant_set())
