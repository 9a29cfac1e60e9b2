"""What of a planned motion lies beyond a machine's band does not depend on how it arrives."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from stillpath.models.store import load_machine
from stillpath.pipeline.band import BLOCK, BandContent

_SAMPLES = 80 * BLOCK


@given(st.lists(st.integers(0, _SAMPLES), max_size=6))
@settings(max_examples=10)
def test_blocks_of_any_length(cuts: list[int]) -> None:
    rng = np.random.default_rng(1)
    path = np.cumsum(np.cumsum(rng.normal(scale=1e-3, size=(2, _SAMPLES)), axis=1), axis=1)
    prints = np.arange(_SAMPLES) % 7000 < 5000
    machine = load_machine("ender3")
    whole, parts = BandContent(machine, 1e-3), BandContent(machine, 1e-3)
    whole.add(path, prints)
    for a, b in pairwise([0, *sorted(cuts), _SAMPLES]):
        parts.add(path[:, a:b], prints[a:b])
    np.testing.assert_array_equal(parts.beyond_um(60.0), whole.beyond_um(60.0))
    assert np.all(whole.beyond_um(60.0) > 0.0)
