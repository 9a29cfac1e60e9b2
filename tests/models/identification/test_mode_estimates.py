"""Standard deviations against theory, and which pairs are no resonances."""

from __future__ import annotations

import numpy as np
import pytest

from stillpath.models.identification.mode_estimates import (
    band_warnings,
    filler_poles,
    mode_estimates,
    robust_covariance,
)
from stillpath.models.identification.pair_structure import PairStructure
from stillpath.models.identification.types import ModeEstimate
from stillpath.models.plants import PairsSpec, PolePair, ZeroPair


def test_covariance_of_a_linear_fit() -> None:
    """Noise of two sizes: the textbook covariance of weighted data, whatever the weights."""
    rng = np.random.default_rng(5)
    x = np.linspace(-1, 1, 4000)
    design = np.column_stack([np.ones(len(x)), x])
    sd = np.where(x > 0, 2.0, 0.5)
    noise = sd * rng.standard_normal(len(x))
    solution = np.linalg.lstsq(design, noise, rcond=None)[0]
    found = robust_covariance(design, design @ solution - noise)
    bread = np.linalg.inv(design.T @ design)
    exact = bread @ (design.T * sd**2) @ design @ bread
    np.testing.assert_allclose(np.diag(found), np.diag(exact), rtol=0.1)


def test_shared_data_widen_the_intervals() -> None:
    """Every value given five times is known no better than once."""
    rng = np.random.default_rng(6)
    once = rng.standard_normal(800)
    alone = robust_covariance(np.ones((800, 1)), once - once.mean())
    repeated = np.repeat(once - once.mean(), 5)
    together = robust_covariance(np.ones((4000, 1)), repeated)
    assert together[0, 0] == pytest.approx(alone[0, 0], rel=0.3)


def test_modes_rise_in_frequency_with_their_deviations() -> None:
    structure = PairStructure(2, 0, 30.0)
    spec = PairsSpec(poles=(PolePair(f_hz=80.0, zeta=0.1), PolePair(f_hz=40.0, zeta=0.05)))
    covariance = np.diag([0.0, 0.01, 0.02, 0.1, 0.2]) ** 2
    low, high = mode_estimates(structure, structure.parameters(spec), covariance)
    assert (low.f_hz, low.zeta) == (pytest.approx(40.0), pytest.approx(0.05))
    # Parameters are logarithms: 2 % and 20 % of the 40 Hz mode.
    for mode in (low, high):
        assert (mode.f_sd_hz, mode.zeta_sd) == pytest.approx((0.8, 0.01), rel=1e-4)
    # Without scatter, what the estimate of the response leaves.
    sure, _ = mode_estimates(structure, structure.parameters(spec), 0 * covariance)
    assert sure.f_sd_hz == pytest.approx(40.0 * 2e-5)
    assert sure.zeta_sd == pytest.approx(0.05 * 1.2e-3)
    assert low.peak == pytest.approx(10.0 / 0.75, rel=0.01)


def test_fillers() -> None:
    structure = PairStructure(3, 1, 30.0)
    spec = PairsSpec(
        poles=(
            PolePair(f_hz=40.0, zeta=0.05),
            PolePair(f_hz=60.0, zeta=0.60),
            PolePair(f_hz=90.0, zeta=0.05),
        ),
        zeros=(ZeroPair(f_hz=91.0, zeta=0.05),),
    )
    assert filler_poles(structure, structure.parameters(spec)) == [2, 1]


@pytest.mark.parametrize(
    ("f_hz", "says"),
    [(50.0, None), (3.0, "outside"), (170.0, "outside"), (131.0, "at the edge")],
)
def test_modes_at_the_edge_are_told(f_hz: float, says: str | None) -> None:
    told = band_warnings((ModeEstimate(f_hz, 0.05, 0.1, 0.01, 5.0),), (5.0, 134.0))
    assert (says is None and told == ()) or (says is not None and says in told[0])
