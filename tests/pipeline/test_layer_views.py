"""Layers that are drawn: few enough points, and none of the errors hidden."""

from __future__ import annotations

import numpy as np
import pytest

from stillpath.pipeline.measuring.layer_views import LayerViews
from stillpath.pipeline.measuring.layers import LayerTile


def tile(on: np.ndarray) -> LayerTile:
    n = len(on)
    rng = np.random.default_rng(n)
    return LayerTile(
        layer=0,
        z_mm=0.2,
        x_mm=np.arange(n, dtype=np.float32),
        y_mm=np.zeros(n, np.float32),
        line=np.arange(n, dtype=np.uint32),
        error=rng.integers(1, 900, (1, n)).astype(np.uint16),
        feature=np.zeros(n, np.int32),
        on=on.astype(np.uint8),
        rms_um=np.ones(1),
        max_um=np.ones(1),
        seconds=1.0,
    )


@pytest.mark.parametrize(
    "on",
    [
        np.arange(60_000) % 2,
        1 - np.arange(60_000) % 2,
        np.arange(60_000) % 7 > 2,
        np.arange(60_000) % 500 > 0,
        np.ones(60_000),
    ],
    ids=["stipples", "stipples, printing first", "short lines", "long lines", "one line"],
)
def test_layers_of_many_points_are_thinned(on: np.ndarray) -> None:
    views = LayerViews(["before"])
    for _ in range(4):
        views.add(tile(on))
    (view,) = views.views()
    assert 600 < len(view.x_mm) <= 2500
    # Every line that is left begins where it did.
    x, prints = np.array(view.x_mm), np.array(view.extruding)
    begins = np.flatnonzero(prints[1:] & ~prints[:-1]) + 1
    assert all(x[k - 1] % 60_000 < x[k] for k in begins)
    for k in begins[:50]:
        assert on[int(x[k - 1]) : int(x[k])][1:].all()


def test_the_largest_error_of_a_line_is_kept() -> None:
    views = LayerViews(["before"])
    long = tile(np.ones(60_000))
    views.add(long)
    (view,) = views.views()
    assert max(view.contour_um["before"]) == pytest.approx(0.1 * long.error.max())
