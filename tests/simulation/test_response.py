"""Plant streams against plain numpy, scipy and python-control."""

from __future__ import annotations

import control
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stillpath.models.modal import modal_form
from stillpath.models.plants import (
    FirSpec,
    Mode,
    ModesSpec,
    PairsSpec,
    PlantSpec,
    PolePair,
    TfSpec,
    ZeroPair,
    discretise,
)
from stillpath.models.store import builtin_machines, load_machine
from stillpath.simulation.response import PlantStream, response
from tests.plants import answer

PAIRS = PairsSpec(
    poles=(PolePair(f_hz=34, zeta=0.28), PolePair(f_hz=44.7, zeta=0.046)),
    zeros=(ZeroPair(f_hz=41.2, zeta=-0.2),),
    real_zero_tau_s=0.0012,
)
DOUBLE = ModesSpec(modes=(Mode(f_hz=40, zeta=0.1, gain=0.5), Mode(f_hz=40, zeta=0.1, gain=0.5)))
SPECS: dict[str, PlantSpec] = {
    "pairs": PAIRS,
    "one mode": ModesSpec(modes=(Mode(f_hz=45, zeta=0.05),)),
    "two equal modes": DOUBLE,
    "real pole": TfSpec(num=(0.1,), den=(1, -0.9), dt_s=1e-3),
    "delay": FirSpec(taps=(0.0, 0.0, 1.0), dt_s=1e-3),
    "gain": FirSpec(taps=(1.0,), dt_s=1e-3),
}


@pytest.mark.parametrize("name", sorted(SPECS))
@given(
    st.lists(st.floats(-300, 300), min_size=2, max_size=50), st.integers(0, 50), st.integers(0, 50)
)
@settings(max_examples=25)
def test_stream_is_the_recursion(name: str, values: list[float], cut: int, more: int) -> None:
    plant = discretise(SPECS[name], 1e-3)
    u = np.array(values)
    stream = PlantStream([plant])
    blocks = np.split(u, sorted((min(cut, len(u)), min(more, len(u)))))
    y = np.concatenate([stream.push(block[None])[0] for block in blocks])
    np.testing.assert_allclose(y, answer(plant, u - u[0]) + u[0], atol=1e-9)


@pytest.mark.parametrize("name", builtin_machines())
def test_modal_form_of_the_library(name: str) -> None:
    rng = np.random.default_rng(2)
    u = 150 + np.cumsum(np.cumsum(rng.normal(size=4000))) * 1e-4
    for axis in ("x", "y"):
        plant = discretise(load_machine(name).axes[axis].nominal, 1e-3)
        assert modal_form(plant) is not None
        np.testing.assert_allclose(
            response([plant], u[None])[0], answer(plant, u - u[0]) + u[0], atol=1e-10
        )


@pytest.mark.parametrize("near", [0.0, 1e-11, 1.552e-13, 1e-9, 1e-6])
def test_poles_that_are_nearly_one(near: float) -> None:
    """A fit of raw logs ended like this, and predicted 20 um of error that were none."""
    spec = PairsSpec(
        poles=(
            PolePair(f_hz=57.093315747143414, zeta=0.08732785203799766),
            PolePair(f_hz=202.24484304374235, zeta=0.8489525974929566),
            PolePair(f_hz=211.59999999541353, zeta=1.0 - near),
        ),
        zeros=(
            ZeroPair(f_hz=109.77317576821473, zeta=1.0904922787744404),
            ZeroPair(f_hz=140.27144134544702, zeta=0.39303199716021553),
        ),
        real_zero_tau_s=-0.0007266633611885042,
    )
    u = np.minimum(0.1 * np.arange(2000), 100.0)
    for dt_s in (1e-4, 2.5e-4, 1e-3):
        plant = discretise(spec, dt_s)
        np.testing.assert_allclose(response([plant], u[None])[0], answer(plant, u), atol=2e-6)


def test_long_rest_decays_to_the_command_exactly() -> None:
    plant = discretise(PAIRS, 1e-3)
    u = np.concatenate([np.zeros(10), np.full(60_000, 7.25)])
    assert response([plant], u[None])[0, -1] == pytest.approx(7.25, abs=1e-13)


def test_a_fine_grid_is_the_continuous_plant() -> None:
    rng = np.random.default_rng(5)
    u = rng.normal(size=(1, 40))
    w = [2 * np.pi * 34, 2 * np.pi * 44.7, 2 * np.pi * 41.2]
    den = np.polymul([w[0] ** -2, 0.56 / w[0], 1], [w[1] ** -2, 0.092 / w[1], 1])
    num = np.polymul([0.0012, 1], [w[2] ** -2, -0.4 / w[2], 1])
    fine = np.interp(np.arange(391) / 10, np.arange(40), u[0])[None]
    reference = control.forced_response(
        control.tf(num, den), np.arange(391) * 1e-4, fine[0] - u[0, 0]
    )
    y = response([discretise(PAIRS, 1e-4)], fine)
    np.testing.assert_allclose(y[0], np.asarray(reference.outputs) + u[0, 0], atol=1e-8)
    # A command linear between milliseconds is answered alike on both grids.
    coarse = response([discretise(PAIRS, 1e-3)], u)
    np.testing.assert_allclose(y[:, ::10], coarse, atol=1e-9)


def test_bad_shapes() -> None:
    plant = discretise(PAIRS, 1e-3)
    with pytest.raises(ValueError, match="expected"):
        PlantStream([plant]).push(np.zeros((2, 3)))
    with pytest.raises(ValueError, match="sampling time"):
        PlantStream([plant, discretise(PAIRS, 1e-4)])
    assert PlantStream([plant]).push(np.zeros((1, 0))).shape == (1, 0)


def test_blocks_answer_as_sample_after_sample() -> None:
    modes = Mode(f_hz=41.0, zeta=0.05, gain=0.6), Mode(f_hz=97.0, zeta=0.1, gain=0.4)
    plant = discretise(ModesSpec(modes=modes), 1e-3)
    rng = np.random.default_rng(3)
    u = 150.0 + np.cumsum(rng.normal(0.0, 0.05, (1, 1003)), axis=1)
    u[0, 300:700] = u[0, 300]
    stream = PlantStream([plant])
    one_by_one = np.hstack([stream.push(u[:, k : k + 1]) for k in range(u.shape[1])])
    np.testing.assert_allclose(PlantStream([plant]).push(u), one_by_one, rtol=0.0, atol=1e-11)
    cut = PlantStream([plant])
    parts = [cut.push(u[:, a:b]) for a, b in ((0, 333), (333, 350), (350, 1003))]
    np.testing.assert_allclose(np.hstack(parts), one_by_one, rtol=0.0, atol=1e-11)
