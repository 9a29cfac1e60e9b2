"""Members that stand for a crowd."""

from __future__ import annotations

import numpy as np
import pytest

from stillpath.models.identification.representatives import mode_spread, representatives
from stillpath.models.identification.scatter import SCATTERS
from stillpath.models.identification.spectrum_model import SpectrumModel
from stillpath.models.plants import RelativeMode, RelativeModesSpec, frequency_response

F = np.linspace(1.0, 150.0, 300)


def one(f_hz: float, zeta: float = 0.06) -> RelativeModesSpec:
    return RelativeModesSpec(modes=(RelativeMode(f_hz=f_hz, zeta=zeta, share=1.0),))


def crowd() -> list[RelativeModesSpec]:
    rng = np.random.default_rng(3)
    return [
        one(float(45.0 + rng.standard_normal()), float(0.06 * np.exp(0.2 * rng.standard_normal())))
        for _ in range(80)
    ]


def apart(a: RelativeModesSpec, b: RelativeModesSpec) -> float:
    return float(np.linalg.norm((frequency_response(a, F) - frequency_response(b, F)) / F**2))


def test_weights_add_up_and_the_middle_comes_first() -> None:
    some = crowd()
    found = representatives([one(52.0), one(45.0), one(40.0)], some)
    assert found.members[0] == one(45.0)
    assert found.middle == 1
    assert len(found.members) == len(found.weights) == 16
    assert sum(found.weights) == pytest.approx(1.0)
    assert min(found.weights) > 0
    # The middle stands for more than most.
    assert found.weights[0] >= np.quantile(found.weights, 0.8)


def test_each_member_is_the_one_least_like_those_before() -> None:
    """Distances to those chosen before never grow: farthest first (Gonzalez 1985)."""
    members = representatives([one(45.0)], crowd()).members
    gaps = [min(apart(m, b) for b in members[:k]) for k, m in enumerate(members) if k]
    assert gaps == sorted(gaps, reverse=True)


def test_the_order_of_the_crowd_does_not_matter() -> None:
    some = crowd()
    there, back = (representatives([one(45.0)], c) for c in (some, some[::-1]))
    assert there.members == back.members
    assert there.weights == pytest.approx(back.weights)


def test_few_plants_are_all_there_is() -> None:
    found = representatives([one(45.0)], [one(45.0), one(45.0)])
    assert found.members == (one(45.0),)
    assert found.weights == (1.0,)
    assert found.agree_below_hz() == 150.0


def test_spread_of_a_mode_is_that_of_the_crowd() -> None:
    (mode,) = mode_spread(representatives([one(45.0)], crowd()))
    assert mode.f_sd_hz == pytest.approx(1.0, rel=0.3)
    assert mode.zeta_sd == pytest.approx(0.2 * 0.06, rel=0.3)


@pytest.mark.parametrize("scatter", SCATTERS)
def test_covariance_of_a_spectrum_is_positive_definite(scatter: object) -> None:
    f = np.arange(8.0, 130.0, 1.5625)
    rng = np.random.default_rng(1)
    for height in (0.0, 3.0, 6.0):
        peak = height / (1 + ((f - 50.0) / 3.0) ** 2)
        model = SpectrumModel(f, peak + 0.3 * rng.standard_normal(len(f)), np.eye(len(f)), f)
        covariance = scatter.covariance(model)  # type: ignore[attr-defined]
        np.testing.assert_allclose(covariance, covariance.T)
        assert np.linalg.eigvalsh(covariance).min() > 0
