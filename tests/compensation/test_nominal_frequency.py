"""The robust nominal model G_r against its defining cost, and what it is good for."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from stillpath.compensation.base import DesignError
from stillpath.compensation.basis import bspline_functions
from stillpath.compensation.full_preview import FullPreview
from stillpath.compensation.lifted import lift
from stillpath.compensation.nominal_frequency import (
    Distribution,
    Region,
    bandwidths,
    extended_response,
    robust_nominal,
    robust_response,
    sampled_responses,
)
from stillpath.models.plants import DiscretePlant, Mode, ModesSpec, ZpkSpec, discretise, plant_set
from stillpath.models.store import load_machine

DT = 1e-3
DISTRIBUTIONS: tuple[Distribution, ...] = ("sampled", "uniform", "kernel")


def mode(f_hz: float = 40.0, zeta: float = 0.1) -> DiscretePlant:
    return discretise(ModesSpec(modes=(Mode(f_hz=f_hz, zeta=zeta),)), DT)


def spread(rng: np.random.Generator, l_: int = 5, f: int = 1) -> np.ndarray:
    middle = rng.uniform(0.3, 3.0, f) * np.exp(2j * np.pi * rng.uniform(size=f))
    size = rng.uniform(0.6, 1.5, (l_, f))
    return np.asarray(middle * size * np.exp(1j * rng.uniform(-0.8, 0.8, (l_, f))))


def density(region: Region, kind: str, r: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """f(r, theta) of (I.5) or an even one, on a mesh, for one frequency."""
    if kind == "uniform":
        return np.ones((len(r), len(theta)))
    parts = []
    for samples, at in ((region.r[:, 0], r), (region.theta[:, 0], theta)):
        sigma = bandwidths(samples[:, None])[0]
        kernels = np.exp(-((at[:, None] - samples) ** 2) / (2 * sigma**2))
        parts.append(kernels.sum(axis=1) / sigma)
    return np.outer(*parts)


@pytest.mark.parametrize("kind", ["uniform", "kernel"])
@pytest.mark.parametrize("seed", range(2))
def test_it_is_the_minimum_of_the_cost(kind: Distribution, seed: int) -> None:
    """(I.1) integrated by brute force over the box, with r dr dtheta, and minimised over C."""
    g = spread(np.random.default_rng(seed))
    region = Region.of(g)

    def midpoints(span: np.ndarray, n: int = 500) -> np.ndarray:
        return span[0] + (span[1] - span[0]) * (np.arange(n) + 0.5) / n

    r, theta = midpoints(region.r_span[:, 0]), midpoints(region.theta_span[:, 0])
    weight = density(region, kind, r, theta) * r[:, None]
    weight /= weight.sum()
    plant = r[:, None] * np.exp(1j * theta)

    def cost(c: np.ndarray) -> float:
        return float(np.sum(weight * np.abs(1 - (c[0] + 1j * c[1]) * plant) ** 2))

    best = minimize(cost, [1.0, 0.0], method="BFGS", options={"gtol": 1e-9})
    response, tracked = robust_response(g, distribution=kind)
    assert 1 / response[0] == pytest.approx(complex(*best.x), rel=1e-4)
    assert 1 - tracked[0] == pytest.approx(best.fun, rel=1e-3)


def test_sampled_is_the_minimum_over_the_members() -> None:
    rng = np.random.default_rng(0)
    g, weights = spread(rng, 6), rng.dirichlet(np.ones(6))
    response, tracked = robust_response(g, weights, "sampled")

    def cost(c: complex) -> float:
        return float(weights @ np.abs(1 - c * g[:, 0]) ** 2)

    c = 1 / response[0]
    assert cost(c) == pytest.approx(1 - tracked[0])
    assert all(cost(c) < cost(c * (1 + 1e-3 * s)) for s in (1, -1, 1j, -1j))


def test_default_bandwidth() -> None:
    normal = np.random.default_rng(0).normal(3.0, 0.7, (4000, 1))
    assert bandwidths(normal)[0] == pytest.approx(0.7 * (4 / 12000) ** 0.2, rel=0.05)
    # Half of the samples equal: the range stands in.
    assert bandwidths(np.array([[1.0], [1.0], [1.0], [3.0]]))[0] == pytest.approx(
        2.0 * (1 / 3) ** 0.2
    )


@settings(max_examples=60)
@given(
    st.integers(0, 2**31),
    st.sampled_from(DISTRIBUTIONS),
    st.floats(0.1, 10.0),
    st.floats(-3.2, 3.2),
)
def test_the_robust_response_scales_and_turns_with_the_set(
    seed: int, kind: Distribution, size: float, angle: float
) -> None:
    """Scales and turns with the set, does not care for its order, never tracks more than all."""
    g = spread(np.random.default_rng(seed), 4, 6)
    response, tracked = robust_response(g, distribution=kind)
    factor = size * np.exp(1j * angle)
    moved, same = robust_response(factor * g, distribution=kind)
    np.testing.assert_allclose(moved, factor * response, rtol=1e-6)
    np.testing.assert_allclose(same, tracked, rtol=1e-6)
    np.testing.assert_allclose(robust_response(g[::-1], distribution=kind)[0], response, rtol=1e-9)
    mirrored, _ = robust_response(g.conj(), distribution=kind)
    np.testing.assert_allclose(mirrored, response.conj(), rtol=1e-6)
    assert np.all((tracked > 0) & (tracked <= 1 + 1e-12))
    # Never below the smallest gain: a robust nominal model is a cautious one.
    assert np.all(np.abs(response) >= np.abs(g).min(axis=0) * (1 - 1e-9))


@pytest.mark.parametrize("kind", DISTRIBUTIONS)
def test_one_plant_is_its_own_nominal_model(kind: Distribution) -> None:
    plant = mode()
    made = robust_nominal([plant, plant], distribution=kind, points=2048)
    np.testing.assert_allclose(made.response, plant.frequency_response(made.f_hz), atol=1e-9)
    np.testing.assert_allclose(made.markov, plant.impulse_response(1024), atol=1e-9)
    np.testing.assert_allclose(made.tracked, 1.0)
    assert made.needed_delay() == 0
    np.testing.assert_array_equal(made.causal(), made.markov)
    expected = lift(plant, 100).dense()
    np.testing.assert_allclose(made.operator(100).dense(), expected, atol=1e-9)


@pytest.mark.parametrize("kind", DISTRIBUTIONS)
def test_impulse_response_has_the_frequency_response(kind: Distribution) -> None:
    members = plant_set(load_machine("taz6-x").axes["x"], DT).members
    made = robust_nominal(members, distribution=kind, points=2048)
    for delay in (0, 37, len(made.ahead)):
        taps = made.delayed(delay)
        lost = np.sum(np.abs(made.ahead[delay:]))
        late = np.exp(-2j * np.pi * made.f_hz * DT)
        answer = np.polynomial.polynomial.polyval(late, taps) * late**-delay
        assert np.abs(answer - made.response).max() <= lost + 2 * abs(made.markov[-1])
    delay = made.needed_delay(1e-5)
    energy = np.sum(made.ahead**2) + np.sum(made.markov**2)
    assert np.sum(made.ahead[delay:] ** 2) <= 1e-5 * energy < np.sum(made.ahead[delay - 1 :] ** 2)
    matrix = made.operator(60).dense()
    assert matrix[5, 2] == made.markov[3]
    assert matrix[2, 5] == made.ahead[2]
    assert 0 < made.ahead_share < 0.01


def test_an_unstable_response_is_seen_and_taken_two_sided() -> None:
    """1 / (1 - 1.25 / q): as a causal filter unstable, as a two-sided one -(0.8 q + ...)."""
    points = 512
    f_hz = np.fft.rfftfreq(points, DT)
    response = 1 / (1 - 1.25 * np.exp(-2j * np.pi * f_hz * DT))
    made = robust_nominal([response, response], points=points, dt_s=DT)
    np.testing.assert_allclose(made.ahead[:20], -(0.8 ** np.arange(1, 21)), atol=1e-9)
    np.testing.assert_allclose(made.markov[:20], 0.0, atol=1e-9)
    with pytest.raises(DesignError, match=r"100\.00% of its response lies ahead .* by 21 samples"):
        made.causal()
    np.testing.assert_allclose(made.delayed(21)[:21], -(0.8 ** np.arange(21, 0, -1)), atol=1e-9)


def test_it_makes_filtered_basis_functions_robust() -> None:
    """The point of it all: less error on average over the set than with its worst members."""
    samples, n = 400, 60
    members = [mode(f, 0.05) for f in (34.0, 37.0, 40.0, 43.0, 46.0)]
    phi = bspline_functions(samples, n, 5)
    t = np.arange(samples)
    y_d = np.sin(t * 0.2) * np.hanning(samples) + np.sin(t * 0.27) * np.hanning(samples)

    def error(nominal: object) -> float:
        u = FullPreview(nominal, phi).command(y_d)  # type: ignore[arg-type]
        return float(np.mean([np.linalg.norm(y_d - lift(p, samples).apply(u)) for p in members]))

    robust = {
        kind: error(robust_nominal(members, distribution=kind).operator(samples))
        for kind in DISTRIBUTIONS
    }
    plain = [error(lift(p, samples)) for p in members]
    assert all(value < min(plain) for value in robust.values())
    assert robust["sampled"] == min(robust.values())


def test_a_design_must_run_on_past_its_path() -> None:
    """Without the samples that G_r looks ahead, the last commands are huge (figure_i5.py)."""
    spec = load_machine("taz6-x").axes["x"].nominal
    members = [
        discretise(ZpkSpec.model_validate(spec.scaled(s, s**-8).model_dump()), DT)
        for s in np.linspace(0.94, 1.06, 7)
    ]
    made = robust_nominal(members)
    rng = np.random.default_rng(3)
    t = np.arange(500)
    y_d = sum(np.sin(2 * np.pi * (f * t * DT + rng.uniform())) for f in range(5, 51, 3))
    y_d *= np.minimum(1.0, np.minimum(t, 499 - t) / 50)

    def largest(run_out: int) -> float:
        length = len(y_d) + run_out
        phi = bspline_functions(length, length // 5, 5)
        u = FullPreview(made.operator(length), phi).command(np.pad(y_d, (0, run_out)))
        return float(np.abs(u[: len(y_d)]).max())

    assert largest(made.needed_delay()) < 0.3 * largest(0)


def test_measured_responses_are_joined_to_a_model() -> None:
    model, real = mode(40.0, 0.1), mode(43.0, 0.07)
    f_hz = np.arange(5.0, 100.5, 0.5)
    full = extended_response(f_hz, real.frequency_response(f_hz), model, 2048)
    grid = np.fft.rfftfreq(2048, DT)
    band = (grid >= 5) & (grid <= 100)
    np.testing.assert_allclose(full[band], real.frequency_response(grid[band]), rtol=5e-3)
    for outside in (grid < 2.5, grid > 200):
        np.testing.assert_allclose(full[outside], model.frequency_response(grid[outside]))
    # Without a jump at the edges of the band.
    steps = np.abs(np.diff(full / model.frequency_response(grid)))
    assert steps[(grid[1:] < 10) | (grid[1:] > 95)].max() < 0.02
    made = robust_nominal(np.stack([full, model.frequency_response(grid)]), points=2048, dt_s=DT)
    assert made.response[0] == pytest.approx(1.0)


def test_responses_that_allow_no_model_are_refused() -> None:
    with pytest.raises(DesignError, match="no distribution is called 'normal'"):
        robust_response(np.ones((2, 3)), distribution="normal")  # type: ignore[arg-type]
    with pytest.raises(DesignError, match="all directions at frequency 1"):
        robust_response(np.array([[1.0, 1.0], [1.0, -1.0]]), distribution="sampled")
    with pytest.raises(DesignError, match="silent at frequency 2"):
        robust_response(np.array([[1.0, 1.0, 0.0]]))
    with pytest.raises(DesignError, match="finite values"):
        robust_response(np.array([[1.0, np.nan]]))
    with pytest.raises(DesignError, match="bandwidth -1"):
        robust_response(np.ones((2, 3)), r_bandwidth=-1.0)
    with pytest.raises(DesignError, match="weights"):
        robust_response(np.ones((2, 3)), [0.5, 0.2])
    with pytest.raises(DesignError, match="beyond half of its 64 points"):
        robust_nominal([mode(10.0, 0.01), mode(11.0, 0.01)], points=64)
    with pytest.raises(DesignError, match="even number"):
        robust_nominal([mode()], points=101)
    with pytest.raises(DesignError, match=r"give \(plants, 33\) and the sampling time"):
        robust_nominal(np.ones((2, 30)), points=64)
    with pytest.raises(DesignError, match="all at the same time"):
        sampled_responses([mode(), discretise(ModesSpec(modes=(Mode(f_hz=9, zeta=0.1),)), 2e-3)], 8)
    with pytest.raises(DesignError, match="delay 700"):
        robust_nominal([mode()], points=1024).delayed(700)
    for f_hz, response, reason in (
        ([5.0], [1.0], "two or more"),
        ([5.0, 4.0], [1.0, 1.0], "must rise"),
        ([5.0, 600.0], [1.0, 1.0], "must rise"),
        ([5.0, 6.0], [1.0, 0.0], "zero or not finite"),
    ):
        with pytest.raises(DesignError, match=reason):
            extended_response(f_hz, response, mode(), 64)
