"""What is written in numpy to spare an import, against scipy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import linalg

from models.exponential import exponential
from models.realisation import balanced


@pytest.mark.parametrize("size", [1, 2, 8])
@pytest.mark.parametrize("norm", [0.0, 1e-3, 0.9, 40.0])
def test_exponential_is_scipys(size: int, norm: float) -> None:
    matrix = np.random.default_rng(size).normal(size=(size, size))
    matrix *= norm / np.abs(matrix).sum(axis=0).max()
    assert exponential(matrix) == pytest.approx(
        linalg.expm(matrix), rel=1e-12, abs=1e-13 * np.exp(norm)
    )


def test_exponential_of_an_oscillation() -> None:
    """A mode of 40 Hz over 1 s: many squarings, and known in closed form."""
    angle = 2.0 * np.pi * 40.0
    turned = exponential(np.array([[-1.0, angle], [-angle, -1.0]]))
    assert turned == pytest.approx(np.exp(-1.0) * np.eye(2), abs=1e-12)


@pytest.mark.parametrize("order", [2, 8, 9, 10, 12])
@pytest.mark.parametrize("discrete", [False, True])
def test_balanced_states_have_equal_gramians(order: int, discrete: bool) -> None:
    """On both sides of the order from which on scipy solves."""
    random = np.random.default_rng(order)
    a = random.normal(size=(order, order))
    radius = np.abs(np.linalg.eigvals(a)).max()
    a = 0.9 * a / radius if discrete else a - 1.2 * radius * np.eye(order)
    b, c = random.normal(size=order), random.normal(size=order)
    a, b, c, _ = balanced(a, b, c, 0.0, discrete=discrete)
    if discrete:
        reached = linalg.solve_discrete_lyapunov(a, np.outer(b, b))
        seen = linalg.solve_discrete_lyapunov(a.T, np.outer(c, c))
    else:
        reached = linalg.solve_continuous_lyapunov(a, -np.outer(b, b))
        seen = linalg.solve_continuous_lyapunov(a.T, -np.outer(c, c))
    assert np.diag(reached) == pytest.approx(np.diag(seen), rel=1e-9)
