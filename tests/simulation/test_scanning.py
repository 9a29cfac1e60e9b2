"""Errors of tracks, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from stillpath.simulation.scanning import track_errors


def test_along_and_across() -> None:
    x = np.arange(100.0)
    wanted = np.array([np.r_[x, x[::-1]], np.r_[np.zeros(100), np.ones(100)]])
    actual = wanted + np.array([[3.0], [4.0]])
    track = np.repeat([0, 1], 100)
    track[:10] = -1
    found = track_errors(wanted, actual, track)
    np.testing.assert_allclose(found.rms, 5)
    np.testing.assert_allclose(found.largest, 5)
    np.testing.assert_allclose(found.across[0], 4, rtol=0.02)
    assert found.total_rms == pytest.approx(5)
    assert found.total_largest == pytest.approx(5)


def test_tracks_are_weighted_by_time() -> None:
    wanted = np.array([np.arange(40.0), np.zeros(40)])
    actual = wanted.copy()
    actual[1, 30:] = 2.0
    found = track_errors(wanted, actual, np.repeat([0, 1], [30, 10]))
    np.testing.assert_allclose(found.rms, [0, 2])
    assert found.total_rms == pytest.approx(1.0)
    assert found.total_across == pytest.approx(1.0)


def test_nothing_drawn() -> None:
    with pytest.raises(ValueError, match="no sample"):
        track_errors(np.zeros((2, 3)), np.zeros((2, 3)), np.full(3, -1))
