"""One window by itself: the unconstrained solution, pinned rests, and bounds, against scipy."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import LinearConstraint, minimize

from stillpath.compensation._least_squares_kernels import (
    BLOCK,
    backward,
    factorise,
    forward,
    weighted_gram,
)
from stillpath.compensation._window_kernels import tied_window
from stillpath.compensation.lifted_window import lifted_window
from stillpath.compensation.preview import PreviewDesign, running_gram
from stillpath.compensation.window_problem import (
    EFFORT_PRICE,
    Bounds,
    Extremes,
    functions_of,
    refusing_singular,
    within_bounds,
)
from stillpath.models.plants import Mode, ModesSpec, discretise

DT_S = 1e-3
WINDOW, UPDATE = 120, 60
NO_RESTS = np.zeros((0, 2), np.int64)
WIDE = Bounds(1e3, 1e3, -1e6, 1e6)


@pytest.fixture(scope="module", params=[1, 5], ids=["one plant", "a set"])
def design(request: pytest.FixtureRequest) -> PreviewDesign:
    count = request.param
    f_hz = [45.0] if count == 1 else np.linspace(40.0, 50.0, count)
    plants = [discretise(ModesSpec(modes=(Mode(f_hz=f, zeta=0.05),)), DT_S) for f in f_hz]
    lifted = lifted_window(plants, np.full(count, 1.0 / count), WINDOW, UPDATE)
    return PreviewDesign(lifted, 24, price=0.1)


def solve(
    design: PreviewDesign,
    z: np.ndarray,
    path: np.ndarray,
    weight: np.ndarray,
    rests: np.ndarray,
    bounds: Bounds,
) -> np.ndarray:
    # A part of an array, as where a whole piece is solved: no kernel is compiled for this alone.
    targets = np.repeat(design.lifted.target[:, None] * path, 2, axis=1)[:, ::2]
    functions = functions_of(design, at_rests=len(rests) > 0)
    with refusing_singular():
        tied = tied_window(functions, z, path, targets, weight, rests, bounds.limits())
    return tied.command if tied.kept else within_bounds(functions, tied, z, path, bounds)


def corner() -> np.ndarray:
    k = np.arange(1.0, WINDOW + 1.0)
    return np.minimum(0.1 * k, 5.0)


def standing(design: PreviewDesign) -> np.ndarray:
    return design.lifted.rest_state(0.0)


def test_without_rests_it_is_the_recursion(design: PreviewDesign) -> None:
    z = np.random.default_rng(3).normal(0, 1e-3, design.lifted.states)
    alone = solve(design, z, corner(), np.ones(WINDOW), NO_RESTS, WIDE)
    expected = design.command_gain @ z + design.path_gain @ corner()
    np.testing.assert_allclose(alone[:UPDATE], expected, atol=1e-7)


@pytest.mark.parametrize("kind", ["accel", "speed", "travel"])
def test_bounds_are_kept_at_the_least_cost(design: PreviewDesign, kind: str) -> None:
    z, path = standing(design), corner()
    free = solve(design, z, path, np.ones(WINDOW), NO_RESTS, WIDE)
    whole = np.concatenate([[0.0, 0.0], free])
    accel, speed = np.abs(np.diff(whole, 2)).max(), np.abs(np.diff(whole)).max()
    bounds = {
        "accel": Bounds(0.7 * accel, 1e3, -1e6, 1e6),
        "speed": Bounds(1e3, 0.95 * speed, -1e6, 1e6),
        "travel": Bounds(1e3, 1e3, -1e6, 5.001),
    }[kind]
    assert not bounds.kept(Extremes.of(free, 0.0, 0.0))
    bounded = solve(design, z, path, np.ones(WINDOW), NO_RESTS, bounds)
    assert bounds.kept(Extremes.of(bounded, 0.0, 0.0))

    # The same quadratic programme by scipy, from the definition.
    stacked = np.concatenate([*design.filtered, np.sqrt(design.price) * design.basis])
    wanted = np.concatenate([*(t * path for t in design.lifted.target), np.zeros(WINDOW)])
    first = np.cumsum(design.basis, axis=0)
    rows, low, high = {
        "accel": (design.basis, -bounds.accel, bounds.accel),
        "speed": (first, -bounds.speed, bounds.speed),
        "travel": (np.cumsum(first, axis=0), -np.inf, bounds.high_mm),
    }[kind]

    def cost(c: np.ndarray) -> tuple[float, np.ndarray]:
        error = stacked @ c - wanted
        return 0.5 * error @ error, stacked.T @ error

    found = minimize(cost, np.zeros(design.n), jac=True, method="trust-constr",
                     constraints=[LinearConstraint(rows, low, high)],
                     options={"gtol": 1e-10, "xtol": 1e-12, "maxiter": 3000})  # fmt: skip
    ours = np.linalg.lstsq(np.cumsum(first, axis=0), bounded, rcond=None)[0]
    assert cost(ours)[0] <= cost(found.x)[0] * (1 + 1e-3) + 1e-9


@pytest.mark.parametrize("rests", [[[70, 120]], [[0, 30]], [[-5, 10], [40, 60], [90, 200]]])
def test_rests_are_least_squares_over_what_they_leave(
    design: PreviewDesign, rests: list[list[int]]
) -> None:
    """The definition, with dense matrices: tied functions, pinned commands, a price on bends."""
    lifted = design.lifted
    rng = np.random.default_rng(5)
    z = rng.normal(0, 1e-2, lifted.states)
    path, weight = corner() + z[-2], rng.choice([0.05, 0.2, 1.0], WINDOW)
    tied, offset, begin = design.basis.copy(), np.zeros(WINDOW), 0
    pins = []
    spans = [(max(a, 0), min(b, WINDOW)) for a, b in rests]
    for a, b in spans:
        path[a:b] = path[a - 1] if a else z[-2]
        tied[a] = -design.basis[begin:a].sum(axis=0)
        tied[a + 1 : b] = 0.0
        offset[a] = -(z[-2] - z[-1]) if begin == 0 else 0.0
        pins += [a - 1] if a else []
        begin = b
    price = max(EFFORT_PRICE, design.price)
    rows = [np.sqrt(price) * tied, np.sqrt(price) * design.basis]
    wanted = [-np.sqrt(price) * offset, np.zeros(WINDOW)]
    for target, free, g in zip(lifted.target, lifted.from_state, lifted.integrated, strict=True):
        rows.append(weight[:, None] * (g @ tied))
        wanted.append(weight * (target * path - free @ z - g @ offset))
    command = np.cumsum(np.cumsum(tied, axis=0), axis=0)
    k = np.arange(1.0, WINDOW + 1.0)
    fixed = z[-2] + k * (z[-2] - z[-1]) + np.cumsum(np.cumsum(offset))
    # Least squares with equalities: the usual saddle point.
    m, y = np.concatenate(rows), np.concatenate(wanted)
    held = command[pins]
    saddle = np.block([[m.T @ m, held.T], [held, np.zeros((len(pins), len(pins)))]])
    right = np.concatenate([m.T @ y, path[pins] - fixed[pins]])
    found = np.linalg.solve(saddle, right)[: design.n]
    ours = solve(design, z, path, weight, np.array(rests), WIDE)
    np.testing.assert_allclose(ours, fixed + command @ found, atol=1e-8)
    for a, b in spans:
        np.testing.assert_array_equal(ours[a:b], path[a])


def test_rests_are_kept_within_bounds(design: PreviewDesign) -> None:
    path = np.concatenate([0.05 * np.arange(1.0, 51.0), np.full(30, 2.5), np.linspace(2.5, 5, 40)])
    rests = np.array([[50, 80]])
    free = solve(design, standing(design), path, np.ones(WINDOW), rests, WIDE)
    bend = np.diff(np.concatenate([[0.0, 0.0], free]), 2)
    limit = 0.8 * np.abs(bend).max()
    bounds = Bounds(limit, 1e3, -1e6, 1e6)
    kept = solve(design, standing(design), path, np.ones(WINDOW), rests, bounds)
    for command in (free, kept):
        np.testing.assert_array_equal(command[49:80], path[49])
    assert np.abs(np.diff(np.concatenate([[0.0, 0.0], kept]), 2)).max() <= limit * (1 + 1e-9)


def test_impossible_bounds_are_left_to_the_caller(design: PreviewDesign) -> None:
    """A window that starts at speed cannot stop at once; the free solution comes back."""
    z = standing(design)
    z[-1] = -0.1
    tight = Bounds(1e-6, 1e3, -1e6, 1e-3)
    free = solve(design, z, corner(), np.ones(WINDOW), NO_RESTS, WIDE)
    found = solve(design, z, corner(), np.ones(WINDOW), NO_RESTS, tight)
    np.testing.assert_array_equal(found, free)


@settings(max_examples=30)
@given(st.integers(0, 2**31), st.integers(1, 3), st.integers(1, 3 * BLOCK))
def test_twin_of_weighted_gram(seed: int, components: int, window: int) -> None:
    """Against the definition, with weights that change anywhere, to and from nothing."""
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(components, window, 3))
    weight = np.repeat(rng.choice([0.0, 0.05, 1.0], window), rng.integers(1, 30, window))[:window]
    out = rng.normal(size=(3, 3))
    expected = out + np.einsum("cwi,w,cwj->ij", rows, weight, rows)
    weighted_gram(running_gram(rows), rows, weight, out)
    np.testing.assert_allclose(out, expected, atol=1e-10)


@settings(max_examples=30)
@given(st.integers(0, 2**31), st.integers(1, 12))
def test_twin_of_factorise(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    rows, x = rng.normal(size=(2 * n, n)), rng.normal(size=n)
    square = rows.T @ rows + np.eye(n)
    factor = square.copy()
    factorise(factor)
    np.testing.assert_allclose(np.triu(factor), np.linalg.cholesky(square).T, atol=1e-10)
    found = square @ x
    forward(factor, found)
    backward(factor, found)
    np.testing.assert_allclose(found, x, atol=1e-8)


def test_what_is_not_definite_has_no_factor() -> None:
    for square in (np.zeros((2, 2)), np.array([[1.0, 2.0], [2.0, 1.0]]), np.full((1, 1), np.nan)):
        with pytest.raises(np.linalg.LinAlgError, match="not positive definite"):
            factorise(square)
