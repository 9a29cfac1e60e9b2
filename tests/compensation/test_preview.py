"""Limited preview: the condensed recursion, the bases, and what a design refuses."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import BSpline

from stillpath.compensation._preview_kernels import (
    advance_state,
    advance_window,
    impulse_states,
    run_windows,
)
from stillpath.compensation.base import DesignError
from stillpath.compensation.basis import BASES, bspline_basis, ce_opt_basis
from stillpath.compensation.lifted import LiftedSet
from stillpath.compensation.lifted_window import LiftedWindow, lifted_window
from stillpath.compensation.preview import PreviewDesign
from stillpath.models.plants import DiscretePlant, FirSpec, discretise, plant_set
from stillpath.models.reference_motion import reference_motion
from stillpath.models.store import load_machine
from stillpath.simulation.measures import contour_error
from stillpath.simulation.response import response
from tests.plants import answer, one_mode

DT_S = 1e-3
WINDOW, UPDATE = 300, 150


def members(count: int, window: int = WINDOW, update: int = UPDATE) -> LiftedWindow:
    f_hz = [45.0] if count == 1 else np.linspace(41.0, 49.0, count)
    plants = [one_mode(f) for f in f_hz]
    return lifted_window(plants, np.full(count, 1.0 / count), window, update)


def windows_of(path: np.ndarray, design: PreviewDesign) -> np.ndarray:
    padded = np.append(path, np.full(2 * design.window, path[-1]))
    starts = range(0, len(path), design.update)
    return np.array([padded[s : s + design.window] for s in starts])


def run(design: PreviewDesign, path: np.ndarray) -> np.ndarray:
    """The design's gains through the kernel, from rest at 0."""
    views = windows_of(path, design)
    u = np.empty(len(views) * design.update)
    z = np.zeros(len(design.state_gain))
    driven = views @ design.path_gain.T
    drives = driven, driven @ design.state_drive.T
    run_windows(design.command_gain, design.state_gain, *drives, z, 0, len(views), u)
    return u


def direct(design: PreviewDesign, plants: list[DiscretePlant], path: np.ndarray) -> np.ndarray:
    """The same by solving every window with lstsq, simulating sample by sample."""
    window, update = design.window, design.update
    weights = np.sqrt(design.lifted.weights)
    psi = BASES["ce-opt"](design.lifted.lifted_set(), design.n)
    doubled = np.cumsum(np.cumsum(psi, axis=0), axis=0)
    filtered = np.concatenate([
        s * np.stack([answer(p, column) for column in doubled.T], axis=1)
        for s, p in zip(weights, plants, strict=True)
    ])  # fmt: skip
    states = [np.zeros(p.order) for p in plants]
    last = previous = 0.0
    u: list[float] = []
    for y_d in windows_of(path, design):
        free = last + np.arange(1.0, window + 1.0) * (last - previous)
        error = np.concatenate([
            s * (y_d - answer(p, free, x)) for s, p, x in zip(weights, plants, states, strict=True)
        ])  # fmt: skip
        c = np.linalg.lstsq(filtered, error, rcond=1e-14)[0]
        command = (free + doubled @ c)[:update]
        u.extend(command)
        last, previous = command[-1], command[-2]
        for p, x in zip(plants, states, strict=True):
            for value in command:
                x[:] = p.a @ x + p.b * value
    return np.array(u)


def stroke(samples: int) -> np.ndarray:
    x = np.linspace(0, 1, samples)
    return 20 * (10 * x**3 - 15 * x**4 + 6 * x**5)


@pytest.mark.parametrize("count", [1, 2, 9])
def test_recursion_is_the_window_solution(count: int) -> None:
    lifted = members(count)
    design = PreviewDesign(lifted, 60)
    path = np.concatenate([stroke(400), 20 - stroke(350)])
    expected = direct(design, list(lifted.plants), path)
    # Nine members are told apart by fewer components, good to 1e-5 of the move.
    atol = 1e-9 * 20 if count < 9 else 1e-4
    np.testing.assert_allclose(run(design, path), expected, rtol=0, atol=atol)


def test_price_is_a_ridge() -> None:
    """One window with a price equals the stacked least squares with sqrt(price) Psi under it."""
    lifted = members(1)
    free, priced = PreviewDesign(lifted, 60), PreviewDesign(lifted, 60, price=0.3)
    path = stroke(WINDOW)
    stacked = np.concatenate([lifted.integrated[0] @ free.basis, np.sqrt(0.3) * free.basis])
    c = np.linalg.lstsq(stacked, np.append(path, np.zeros(WINDOW)), rcond=1e-14)[0]
    u = np.cumsum(np.cumsum(free.basis @ c))[:UPDATE]
    np.testing.assert_allclose(priced.path_gain @ path, u, atol=1e-8)


def test_lifted_window_is_the_simulation() -> None:
    plant = one_mode(45.0)
    lifted = lifted_window([plant], [1.0], 40, 20)
    rng = np.random.default_rng(1)
    v, x, (u1, u2) = rng.normal(size=40), rng.normal(size=plant.order), rng.normal(size=2)
    doubled = np.cumsum(np.cumsum(v))
    free = u1 + np.arange(1.0, 41.0) * (u1 - u2)
    predicted = lifted.integrated[0] @ v + lifted.from_state[0] @ [*x, u1, u2]
    np.testing.assert_allclose(predicted, answer(plant, free + doubled, x), atol=1e-9)
    u = rng.normal(size=20)
    after = lifted.advance @ x + lifted.drive @ u
    np.testing.assert_allclose(after, advance_state(plant.a, plant.b, x, u), atol=1e-12)


def test_bsplines_span() -> None:
    psi = bspline_basis(120, 14, 3)
    knots = np.concatenate([[0.0] * 3, np.linspace(0, 119, 12), [119.0] * 3])
    design = BSpline.design_matrix(np.arange(120.0), knots, 3).toarray()
    np.testing.assert_allclose(psi @ (psi.T @ design), design, atol=1e-10)
    # Cubics are cubic splines.
    cubic = (np.arange(120.0) / 119) ** 3
    np.testing.assert_allclose(psi @ (psi.T @ cubic), cubic, atol=1e-10)


@pytest.mark.parametrize(("basis", "n"), [("ce-opt", 0), ("ce-opt", 151), ("bspline", 3)])
def test_wrong_numbers_of_functions(basis: str, n: int) -> None:
    with pytest.raises(DesignError, match=f"n = {n} "):
        PreviewDesign(members(1, 150, 75), n, basis)


def test_acceptance_figures() -> None:
    design = PreviewDesign(members(1), 60)
    assert design.spectral_radius == pytest.approx(
        np.abs(np.linalg.eigvals(design.state_gain)).max()
    )
    assert design.spectral_radius < 0.9
    assert 1 < design.condition < 1e10


@pytest.mark.parametrize(("window", "update", "n"), [(60, 30, 55), (20, 19, 2)])
def test_unstable_design_is_refused(window: int, update: int, n: int) -> None:
    """Short windows, or n / window near 1, on a non-minimum-phase axis (METHOD 3)."""
    taz = plant_set(load_machine("taz6-x").axes["x"], DT_S).nominal
    with pytest.raises(DesignError, match=r"spectral radius \d+\.\d+, limit 0.9: a plant rings"):
        PreviewDesign(lifted_window([taz], [1.0], window, update), n)


def test_nearly_dependent_basis_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    def twice(lifted: LiftedSet, n: int) -> np.ndarray:
        psi = ce_opt_basis(lifted.gram, n)
        psi[:, -1] = psi[:, 0] * (1 + 1e-13)
        return psi

    monkeypatch.setitem(BASES, "ce-opt", twice)
    with pytest.raises(
        DesignError, match=r"nearly dependent .*condition .*limit 1e\+10.*another basis"
    ):
        PreviewDesign(members(1), 20)


def test_figures_of_the_method() -> None:
    """METHOD 3, 45 Hz / .05: contour rms 1.2 um with n = 60, .3 with n = 100, tens without."""
    plant = one_mode(45.0)
    path, _ = reference_motion()
    before = contour_error(path, response([plant, plant], path), DT_S)
    rms = {0: 1e3 * np.sqrt(np.mean(before**2))}
    for n in (60, 100):
        design = PreviewDesign(members(1), n)
        u = np.stack([run(design, row)[: path.shape[1]] for row in path])
        error = contour_error(path, response([plant, plant], u), DT_S)
        rms[n] = 1e3 * np.sqrt(np.mean(error**2))
    assert rms[0] > 25
    assert rms[60] <= 1.5
    assert rms[100] <= 0.5


@settings(max_examples=30)
@given(
    seed=st.integers(0, 2**31),
    update=st.integers(1, 6),
    states=st.integers(1, 5),
    first=st.integers(0, 6),
    count=st.integers(0, 6),
)
def test_twin_of_run_windows(seed: int, update: int, states: int, first: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    e, f = rng.normal(size=(update, states)), 0.5 * rng.normal(size=(states, states))
    s, h = rng.normal(size=(12, update)), rng.normal(size=(12, states))
    z, u = rng.normal(size=states), np.zeros(12 * update)
    expected_u, expected_z = u.copy(), z.copy()
    for w in range(first, first + count):
        expected_u[w * update : (w + 1) * update] = e @ expected_z + s[w]
        expected_z = f @ expected_z + h[w]
    run_windows(e, f, s, h, z, first, first + count, u)
    np.testing.assert_allclose(u, expected_u, atol=1e-9, rtol=1e-9)
    np.testing.assert_allclose(z, expected_z, atol=1e-9, rtol=1e-9)


@pytest.mark.parametrize("count", [1, 3])
def test_twin_of_advance_window(count: int) -> None:
    design = PreviewDesign(members(count, 150, 75), 20)
    rng = np.random.default_rng(count)
    z, committed = rng.normal(size=design.lifted.states), rng.normal(size=75)
    states = design.lifted.advance @ z[:-2] + design.lifted.drive @ committed
    advance_window(design.lifted.advance, design.state_drive, z, committed)
    np.testing.assert_allclose(z, [*states, committed[-1], committed[-2]], atol=1e-12)


@settings(max_examples=30)
@given(st.integers(0, 2**31), st.integers(1, 6), st.integers(0, 50))
def test_twin_of_advance_state(seed: int, order: int, samples: int) -> None:
    rng = np.random.default_rng(seed)
    a = 0.9 * np.linalg.qr(rng.normal(size=(order, order)))[0]
    b, x, u = rng.normal(size=order), rng.normal(size=order), rng.normal(size=samples)
    expected = x.copy()
    for value in u:
        expected = a @ expected + b * value
    kept = x.copy()
    np.testing.assert_allclose(advance_state(a, b, x, u), expected, atol=1e-10)
    from_rest = advance_state(a, b, np.zeros(order), u)
    np.testing.assert_allclose(impulse_states(a, b, samples) @ u, from_rest, atol=1e-10)
    np.testing.assert_array_equal(x, kept)


def test_wrong_sets() -> None:
    with pytest.raises(DesignError, match="set of plants is empty"):
        lifted_window([], [], 60, 30)
    good = one_mode(45.0)
    unstable = dataclasses.replace(good, a=1.2 * good.a)
    with pytest.raises(DesignError, match=r"plant 1 of the set is unstable: .* below 1"):
        lifted_window([good, unstable], [0.5, 0.5], 60, 30)
    with pytest.raises(DesignError, match="between 2 and the window's 60"):
        lifted_window([good], [1.0], 60, 61)
    late = discretise(FirSpec(taps=(0.0,) * 60 + (1.0,), dt_s=DT_S), DT_S)
    with pytest.raises(DesignError, match="no plant answers within the preview of 60 samples"):
        lifted_window([late], [1.0], 60, 30)


@settings(max_examples=20)
@given(st.integers(0, 2**31), st.integers(2, 8))
def test_components_are_the_members(seed: int, count: int) -> None:
    """The components' weighted errors add up to the members', up to what no command changes."""
    rng = np.random.default_rng(seed)
    plants = [
        one_mode(f, z)
        for f, z in zip(rng.uniform(30, 60, count), rng.uniform(0.02, 0.2, count), strict=True)
    ]
    weights = rng.dirichlet(np.full(count, 3.0))
    lifted = lifted_window(plants, weights, 60, 30)
    path, square = rng.normal(size=60), rng.uniform(0.1, 1.0, 60)
    z = rng.normal(size=lifted.states)
    free = z[-2] + np.arange(1.0, 61.0) * (z[-2] - z[-1])

    def costs(v: np.ndarray) -> tuple[float, float]:
        u = free + np.cumsum(np.cumsum(v))
        row, members = 0, 0.0
        for p, w in zip(plants, weights, strict=True):
            y = answer(p, u, z[row : row + p.order])
            members += w * square @ (path - y) ** 2
            row += p.order
        error = lifted.target[:, None] * path - lifted.from_state @ z - lifted.integrated @ v
        return members, float(np.sum(error**2 @ square))

    # The part that no command changes drops out of differences.
    a, b = (costs(0.01 * rng.normal(size=60)) for _ in range(2))
    assert a[0] - b[0] == pytest.approx(a[1] - b[1], rel=1e-3, abs=1e-3 * max(a[0], b[0]))


@pytest.mark.parametrize(("n", "price"), [(90, 0.03), (90, 1.0), (18, 3.0)])
@pytest.mark.parametrize("count", [1, 4])
def test_nodes_tell_the_whole_command(count: int, n: int, price: float) -> None:
    design = PreviewDesign(members(count), n, price=price)
    at_nodes = design.path_gain[design.nodes]
    assert len(design.nodes) < (100 if n == 90 else 19)
    missed = np.abs(design.spread @ at_nodes - design.path_gain)
    # Of a path that is 200 mm away all the time, with whatever signs: nm.
    assert 200.0 * missed.sum(axis=1).max() < 1e-6
    of_components = np.einsum("k,knw->nw", design.lifted.target, design.target_gain)
    np.testing.assert_allclose(of_components, at_nodes, atol=1e-12)
