"""Limited against full preview, and the recursion over long runs, as `benchmarks/preview.py`."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import expit

from benchmarks.preview import (
    LONG,
    PRICED,
    PRODUCT,
    SHARP,
    SPLINES,
    Case,
    answer,
    compare,
    deviations,
    full_bsplines,
    full_ce_opt,
    limited,
    long_path,
    nine_members,
    one_mode,
    taz,
)
from stillpath.compensation.basis import bspline_basis
from stillpath.compensation.full_preview import FullPreview
from stillpath.compensation.lifted import integrated
from stillpath.compensation.operators import ToeplitzOperator
from stillpath.models.plants import DiscretePlant

PLANTS = {"45 Hz": one_mode, "taz6-x": taz}

# Largest share by which limited preview's error may be above full preview's, and largest rms of
# the outputs' difference as a share of the tracking error.
WORSE = 0.03
APART = {SHARP: 0.4, PRODUCT: 0.12, PRICED: 0.03, LONG: 0.05, SPLINES: 0.08}


def lift_twice(plant: DiscretePlant, samples: int) -> ToeplitzOperator:
    return ToeplitzOperator(integrated(plant.impulse_response(samples)))


def doubled(increments: np.ndarray) -> np.ndarray:
    return np.cumsum(np.cumsum(increments, axis=-1), axis=-1)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


@pytest.mark.parametrize("plant", PLANTS)
@pytest.mark.parametrize("price", [0.0, 0.03])
def test_full_ce_opt_is_a_singular_value_decomposition(plant: str, price: float) -> None:
    """The sum over poles is g(sigma^2) sigma on the singular vectors, with its edge at share n."""
    g, share, q = PLANTS[plant](), 0.2, 6
    path = long_path(6.0)[:, :600]
    u, sigma, vt = np.linalg.svd(lift_twice(g, 600).dense())
    edge = sigma[int(share * 600) - 2 : int(share * 600) + 3]
    found = full_ce_opt(g, path, share, price, q)
    # Where exactly the edge is follows from the frequency response: try all places nearby.
    misses = []
    for s in np.geomspace(edge[-1], edge[0], 41):
        factor = sigma / (sigma**2 + price) * expit(4 * q * np.log(sigma / s))
        expected = doubled((path @ u) * factor @ vt)
        misses.append(np.max(np.abs(found - expected)))
    scale = np.max(np.abs(found - path))
    assert min(misses) < 0.01 * scale


@pytest.mark.parametrize("plant", PLANTS)
def test_full_ce_opt_is_full_preview(plant: str) -> None:
    """And with a sharp edge it is `FullPreview` with as many leading singular vectors."""
    g, samples, n = PLANTS[plant](), 900, 180
    path = long_path(6.0)[:, :samples]
    operator = lift_twice(g, samples)
    _, _, vt = np.linalg.svd(operator.dense())
    full = FullPreview(operator, vt[:n].T)
    expected = path - operator.apply(full.command(path.T)).T
    error = path - answer(g, full_ce_opt(g, path, n / samples, 0.0))
    assert rms(error) == pytest.approx(rms(expected), rel=0.03)


@pytest.mark.parametrize("plant", PLANTS)
def test_full_bsplines_are_full_preview(plant: str) -> None:
    g, samples, spacing = PLANTS[plant](), 601, 5
    path = long_path(6.0)[:, :samples]
    operator = lift_twice(g, samples)
    full = FullPreview(operator, bspline_basis(samples, (samples - 1) // spacing + 3))
    expected = operator.apply(full.command(path.T)).T
    found = answer(g, full_bsplines(g, path, spacing, 0.0))
    # At its end the Taz axis answers some huge commands by nothing: digits are lost there.
    np.testing.assert_allclose(found[:, :-100], expected[:, :-100], rtol=0, atol=1e-6)


def test_price_of_full_bsplines_is_a_ridge() -> None:
    g, samples, price = one_mode(), 301, 0.3
    path = long_path(6.0)[:1, :samples]
    psi = bspline_basis(samples, 63)
    filtered = lift_twice(g, samples).apply(psi)
    stacked = np.concatenate([filtered, np.sqrt(price) * psi])
    c = np.linalg.lstsq(stacked, np.append(path[0], np.zeros(samples)), rcond=1e-14)[0]
    found = full_bsplines(g, path, 5.0, price)
    np.testing.assert_allclose(found[0], doubled(psi @ c), rtol=0, atol=1e-7)


def agree(plant: str, case: Case, seconds: float) -> None:
    found = compare(PLANTS[plant](), case, seconds)
    assert found.tracking_um[0] <= (1 + WORSE) * found.tracking_um[1]
    assert found.contour_um[0] <= (1 + WORSE) * found.contour_um[1]
    assert found.difference_um <= APART[case] * found.tracking_um[1]


@pytest.mark.parametrize("plant", PLANTS)
@pytest.mark.parametrize("case", [PRODUCT, PRICED, SPLINES], ids=str)
def test_limited_is_as_good_as_full_preview(plant: str, case: Case) -> None:
    agree(plant, case, 6.0)


@pytest.mark.slow
@pytest.mark.parametrize("plant", PLANTS)
@pytest.mark.parametrize("case", [SHARP, LONG], ids=str)
def test_limited_is_as_good_as_full_preview_13_s(plant: str, case: Case) -> None:
    agree(plant, case, 13.0)


def test_longer_windows_come_closer() -> None:
    short, long = (compare(one_mode(), case, 6.0) for case in (PRODUCT, LONG))
    assert long.difference_um < 0.8 * short.difference_um


SETS = {"zeta .005": [one_mode(zeta=0.005)], "taz6-x": [taz()], "9 members": nine_members()}


@pytest.mark.parametrize("members", SETS)
@pytest.mark.parametrize("case", [SHARP, PRODUCT], ids=str)
def test_no_drift(members: str, case: Case) -> None:
    found = deviations(case.design(SETS[members]), 200_000)
    assert 0 < found.first < 5.0
    assert found.overall <= found.first + 1e-6
    assert found.last <= found.first + 1e-6


def test_kicked_recursion_comes_back() -> None:
    """What an earlier state leaves in the command fades, for all three sets."""
    path = np.zeros(150 * 400 + 150)
    for plants in SETS.values():
        design = SHARP.design(plants)
        u = limited(design, path, z=np.ones(design.lifted.states))
        assert np.max(np.abs(u[:1000])) > 0.1
        np.testing.assert_allclose(u[-1000:], 0, atol=1e-9)


def test_path_is_closed_and_stands_at_its_ends() -> None:
    path = long_path(52.0)
    np.testing.assert_array_equal(path[:, :100], 0)
    np.testing.assert_array_equal(path[:, -200:], 0)
    assert path.shape == (2, 52_000)
    assert long_path(6.0).shape == (2, 6000)
