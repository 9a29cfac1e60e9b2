"""The one pass over a command against numpy."""

from __future__ import annotations

import numpy as np
import pytest

from service.pipeline._peak_kernels import peaks


@pytest.mark.parametrize("n", [1, 2, 3, 50])
def test_peaks(n: int) -> None:
    command = np.random.default_rng(n).normal(size=(4, n))
    steps = np.diff(command[:2])
    step_mm, bend_mm = peaks(command)
    assert step_mm == pytest.approx(np.max(np.hypot(*steps), initial=0.0), rel=1e-14)
    assert bend_mm == np.max(np.abs(np.diff(steps)), initial=0.0)
