"""Rational fits against transfer functions that python-control evaluates."""

from __future__ import annotations

import control
import numpy as np
import pytest

from stillpath.models.identification.sanathanan_koerner import (
    pairs_of,
    polynomial_basis,
    sanathanan_koerner,
)

F = np.linspace(5.0, 134.0, 130)
X = 1j * F / 26.0


def test_exact_data_give_the_polynomials_back() -> None:
    b, a = np.array([0.97, 0.1, 0.3, 0.02]), np.array([1.0, 0.05, 0.4, 0.01, 0.03])
    plant = control.tf(b[::-1], a[::-1])
    found_b, found_a, error = sanathanan_koerner(
        polynomial_basis(X, 4), plant(X), np.ones(len(F)), 3, 4
    )
    np.testing.assert_allclose(found_b, b, rtol=1e-7)
    np.testing.assert_allclose(found_a, a, rtol=1e-7)
    assert error < 1e-9


def test_iteration_beats_the_linear_fit_in_noise() -> None:
    b, a = np.array([1.0, 0.0, 0.2, 0.0]), np.array([1.0, 0.03, 0.35, 0.01, 0.025])
    exact = control.tf(b[::-1], a[::-1])(X)
    rng = np.random.default_rng(3)
    noisy = exact + 0.03 * (rng.standard_normal(len(F)) + 1j * rng.standard_normal(len(F)))
    basis, weight = polynomial_basis(X, 4), np.ones(len(F))
    _, _, once = sanathanan_koerner(basis, noisy, weight, 3, 4, rounds=1)
    _, _, often = sanathanan_koerner(basis, noisy, weight, 3, 4)
    assert often < once


@pytest.mark.parametrize(
    ("roots", "pairs", "taus"),
    [
        ([-1 + 2j, -1 - 2j], [(np.sqrt(5), 1 / np.sqrt(5))], []),
        ([1 + 2j, 1 - 2j, -4], [(np.sqrt(5), -1 / np.sqrt(5))], [0.25]),
        ([-1.0, -4.0], [(2.0, 1.25)], []),
        ([1.0, 4.0], [(2.0, -1.25)], []),
        ([3.0], [], [-1 / 3]),
    ],
)
def test_pairs_of(
    roots: list[complex], pairs: list[tuple[float, float]], taus: list[float]
) -> None:
    coefficients = np.real(np.poly(roots))[::-1]
    found, tau = pairs_of(coefficients)
    np.testing.assert_allclose(found, np.array(pairs).reshape(-1, 2), rtol=1e-9)
    np.testing.assert_allclose(tau, taus, rtol=1e-9)
    # Multiplied out again, up to the constant.
    x = np.array([0.3 + 0.4j])
    value = np.prod([1 + t * x for t in tau], axis=0) * np.prod(
        [1 + 2 * z * x / w + (x / w) ** 2 for w, z in found], axis=0
    )
    expected = np.polynomial.polynomial.polyval(x, coefficients / coefficients[0])
    np.testing.assert_allclose(value, expected, rtol=1e-9)
