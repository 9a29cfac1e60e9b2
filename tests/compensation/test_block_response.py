"""Responses by blocks against scipy's simulation."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import dlsim

from stillpath.compensation.block_response import BlockResponse
from stillpath.models.plants import Mode, ModesSpec, discretise

DT_S = 1e-3


@pytest.mark.parametrize("samples", [1, 15, 16, 1000])
def test_scipy_simulates_the_same(samples: int) -> None:
    modes = (Mode(f_hz=31.0, zeta=0.02, gain=0.7), Mode(f_hz=88.0, zeta=0.2, gain=0.3))
    p = discretise(ModesSpec(modes=modes), DT_S)
    rng = np.random.default_rng(samples)
    command, state, origin = np.cumsum(rng.normal(size=samples)), rng.normal(size=p.order), 7.0
    system = (p.a, p.b[:, None], p.c[None], np.array([[p.d]]), DT_S)
    _, expected, _ = dlsim(system, command - origin, x0=state)
    found = BlockResponse(p)(origin, state, command)
    assert found - origin == pytest.approx(expected.ravel(), abs=1e-9)
