"""Approximate inverses against their definitions, python-control and the dissertation."""

from __future__ import annotations

import control
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import lfilter

from stillpath.compensation.base import DesignError
from stillpath.compensation.inversion import KINDS, Inversion, TwoSidedFilter, invert
from stillpath.models.plants import DiscretePlant, ZpkSpec, discretise

F_HZ = np.linspace(0.5, 499.0, 150)
DT = 1e-3


def first_order(a: float, p: float = 0.5) -> DiscretePlant:
    """(q - a) / (q - p), equation 2.27; its gain at DC is not 1."""
    return DiscretePlant(np.array([[p]]), np.ones(1), np.array([p - a]), 1.0, (), DT)


def third_order(*zeros: complex) -> DiscretePlant:
    spec = ZpkSpec(
        zeros=tuple((z.real, z.imag) for z in zeros),
        poles=((0.8, 0.4), (0.8, -0.4), (0.3, 0.0)),
        dt_s=DT,
    )
    return discretise(spec, DT)


def in_control(plant: DiscretePlant) -> np.ndarray:
    system = control.ss(plant.a, plant.b[:, None], plant.c[None, :], [[plant.d]], DT)
    return np.asarray(control.frequency_response(system, 2 * np.pi * F_HZ).complex)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("zeros", [(-2.5,), (1.6,), (1.2 + 0.5j, 1.2 - 0.5j), (-1.8, 0.4)])
def test_frequency_response_is_that_of_the_definition(
    kind: str, zeros: tuple[complex, ...]
) -> None:
    """F G by the formulas of the literature, with the plant as python-control sees it."""
    plant = third_order(*map(complex, zeros))
    design = invert(kind, plant, 4)
    q = np.exp(2j * np.pi * F_HZ * DT)
    a = np.array([z for z in zeros if abs(z) > 1])
    b = np.prod((q[:, None] - a) / (1 - a), axis=1)
    if kind == "ts":
        # The Taylor polynomial of 1 / b about q = 0, by its definition as a Cauchy integral.
        circle = 0.5 * np.exp(2j * np.pi * np.arange(64) / 64)
        on_it = 1 / np.prod((circle[:, None] - a) / (1 - a), axis=1)
        terms = [np.mean(on_it / circle**k) for k in range(4)]
        expected = b * sum(t * q**k for k, t in enumerate(terms))
    else:
        expected = {
            "npz-ignore": b,
            "zmetc": b / np.prod((1 - a * q[:, None]) / (1 - a), axis=1),
            "zpetc": np.abs(b) ** 2,
            "ebzpetc": 1 - (1 - np.abs(b) ** 2) ** 5,
        }[kind]
    through = design.response(F_HZ, DT) * in_control(plant)
    np.testing.assert_allclose(through, expected, rtol=1e-7, atol=1e-8 * np.abs(expected).max())
    np.testing.assert_allclose(
        design.overall.response(F_HZ, DT), expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max()
    )


@pytest.mark.parametrize("kind", KINDS)
def test_minimum_phase_plants_are_inverted_exactly(kind: str) -> None:
    plant = third_order(-0.6, 0.9)
    design = invert(kind, plant)
    assert len(design.uncancelled) == 0
    assert design.preview == 1
    y_d = np.cumsum(np.random.default_rng(1).normal(size=400))
    y_d[:3], y_d[-3:] = y_d[2], y_d[-3]
    u = design.apply(y_d)
    y = y_d[0] + lfilter(plant.impulse_response(400), 1.0, u - y_d[0])
    np.testing.assert_allclose(y, y_d, atol=1e-9 * np.abs(y_d).max())
    np.testing.assert_array_equal(design.lifted_error(50), np.zeros((50, 50)))


@pytest.mark.parametrize("a", [-5.0, -1.4, -1.0, -0.7, -0.2, 0.3, 0.8, 0.98, 1.02, 1.5, 5.0])
def test_errors_of_first_order_plants(a: float) -> None:
    """Equations 2.28 and 2.29, also where the zero could be cancelled, as figure 2.4 has it."""
    samples, n1 = 1001, 5
    zpetc = invert("zpetc", first_order(a), cancel_below=0.0)
    expected = np.sqrt(6 - 2 / samples) * abs(a) / (1 - a) ** 2
    assert zpetc.error_metric(samples) == pytest.approx(expected, rel=1e-9)
    error = zpetc.lifted_error(8)
    np.testing.assert_allclose(np.diag(error), -2 * a / (1 - a) ** 2, rtol=1e-9)
    np.testing.assert_allclose(np.diag(error, 1), a / (1 - a) ** 2, rtol=1e-9)
    np.testing.assert_allclose(np.diag(error, -1), a / (1 - a) ** 2, rtol=1e-9)
    np.testing.assert_allclose(np.tril(error, -2), 0.0, atol=1e-12)
    if abs(a) == 1:
        return
    ts = invert("ts", first_order(a), n1, cancel_below=0.0)
    left = abs(a) ** (-n1 if abs(a) > 1 else n1)
    expected = np.sqrt(1 - n1 / samples) * left
    assert ts.error_metric(samples) == pytest.approx(expected, rel=1e-9)
    error = ts.lifted_error(12)
    np.testing.assert_allclose(np.abs(np.diag(error, n1 if abs(a) > 1 else -n1)), left, rtol=1e-9)


def test_shape_of_figures_2_3_and_2_4() -> None:
    """ZPETC is worst next to a = 1, and better left than right; TS grows towards |a| = 1."""
    grid = [-5.0, -2.0, -1.05, -0.95, -0.5, 0.5, 0.95, 1.05, 2.0, 5.0]

    def metric(kind: str) -> dict[float, float]:
        return {a: invert(kind, first_order(a), cancel_below=0.0).error_metric(1001) for a in grid}

    zpetc, ts = metric("zpetc"), metric("ts")
    assert sorted(grid, key=zpetc.__getitem__)[-2:] in ([1.05, 0.95], [0.95, 1.05])
    assert all(zpetc[-a] < zpetc[a] for a in grid if a > 0)
    assert all(ts[-a] == pytest.approx(ts[a]) for a in grid)
    assert ts[5.0] < ts[2.0] < ts[1.05]
    assert ts[0.5] < ts[0.95]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("a", [-2.5, 1.5])
def test_lifted_matrix_is_the_filter(kind: str, a: float) -> None:
    """Also with the plant: G C = 1 - E but where the preview or the settling is cut off."""
    design = invert(kind, first_order(a), 4)
    samples, edge = 240, 60
    y_d = np.zeros(samples)
    y_d[edge:-edge] = np.random.default_rng(2).normal(size=samples - 2 * edge)
    y_d[0] = y_d[-1] = 0.0
    c = design.lifted(samples)
    np.testing.assert_allclose(c @ y_d, design.apply(y_d), atol=1e-9)
    pulse = first_order(a).impulse_response(samples)
    y = np.convolve(pulse, c @ y_d)[:samples]
    np.testing.assert_allclose(y_d - y, design.lifted_error(samples) @ y_d, atol=1e-8)
    norm = np.linalg.norm(c) / np.sqrt(samples)
    assert design.effort_metric(samples) == pytest.approx(norm, rel=1e-12)
    norm = np.linalg.norm(design.lifted_error(samples)) / np.sqrt(samples)
    assert design.error_metric(samples) == pytest.approx(norm, rel=1e-12)


def test_ts_reaches_constant_positions_only_when_told_to() -> None:
    y_d = np.full(40, 7.0)
    plain, scaled = (invert("ts", third_order(1.5), 3, unit_dc=unit) for unit in (False, True))
    np.testing.assert_allclose(plain.apply(y_d), 7.0 * (1 - 1.5**-3))
    np.testing.assert_allclose(scaled.apply(y_d), 7.0)


def test_zeros_that_cannot_be_inverted_are_refused() -> None:
    on_circle = np.exp(0.2j * np.pi)
    circle = third_order(on_circle, on_circle.conjugate())
    for kind in ("ts", "zmetc"):
        with pytest.raises(DesignError, match=rf"{kind}: zero .* unit circle \(100 Hz\)"):
            invert(kind, circle)
    for kind in ("zpetc", "ebzpetc", "npz-ignore"):
        assert isinstance(invert(kind, circle, 2), Inversion)
    for kind in KINDS:
        with pytest.raises(DesignError, match=rf"{kind}: zero z = 1.* lies at 1"):
            invert(kind, first_order(1.0001))
    with pytest.raises(DesignError, match="no inversion is called 'zp'"):
        invert("zp", first_order(2.0))
    with pytest.raises(DesignError, match="at least one term"):
        invert("ts", first_order(2.0), 0)
    with pytest.raises(DesignError, match=r"pole \|z\| = 1.2"):
        invert("zpetc", first_order(2.0, 1.2))
    with pytest.raises(DesignError, match=r"zmetc.*reflection"):
        invert("zmetc", first_order(0.5), cancel_below=0.0)


@given(
    st.integers(-6, 6),
    st.lists(st.floats(-2, 2), min_size=1, max_size=6),
    st.booleans(),
    st.integers(1, 12),
)
def test_two_sided_filter_lifts_to_its_impulse_response(
    preview: int, taps: list[float], recursive: bool, samples: int
) -> None:
    sections = np.array([[1.0, 0.5, 0.0, 1.0, -0.6, 0.2]]) if recursive else None
    made = TwoSidedFilter(preview, np.array(taps), sections)
    pulse = np.zeros(60)
    pulse[: len(taps)] = taps
    if recursive:
        pulse = lfilter([1.0, 0.5], [1.0, -0.6, 0.2], pulse)
    expected = np.array(
        [
            [pulse[i - j + preview] if i - j + preview >= 0 else 0.0 for j in range(samples)]
            for i in range(samples)
        ]
    )
    np.testing.assert_allclose(made.lifted(samples), expected, atol=1e-12)
