"""Spectra of the error against scipy's Welch, and that their cost is bounded."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy import signal

from stillpath.models.store import load_machine
from stillpath.pipeline.measuring.spectra import BLOCK, ErrorSpectra


def noise(rng: np.random.Generator, count: int) -> np.ndarray:
    """Two channels of x and y, coloured [mm]."""
    white = rng.normal(0, 0.02, (2, 2, count))
    return signal.lfilter([1.0], [1.0, -1.6, 0.81], white, axis=2)


def test_against_welch() -> None:
    rng = np.random.default_rng(5)
    count = 40 * BLOCK
    path = np.cumsum(rng.normal(0, 0.1, (2, count)), axis=1)
    error = noise(rng, count)
    spectra = ErrorSpectra(load_machine("ender3"), 1e-3, ["before", "after"])
    cuts = [0, *sorted(rng.integers(0, count, 30).tolist()), count]
    for a, b in pairwise(cuts):
        spectra.add(path[:, a:b], path[:, a:b] + error[:, :, a:b], np.ones(b - a, bool))
    found = spectra.spectra()
    f_hz, density = signal.welch(
        1e3 * error, 1e3, window="hann", nperseg=BLOCK, noverlap=0, detrend="constant"
    )
    assert [s.axis for s in found] == ["x", "y"]
    for i, spectrum in enumerate(found):
        use = slice(1, 1 + len(spectrum.f_hz))
        assert spectrum.f_hz == pytest.approx(f_hz[use], abs=1e-4)
        for c, name in enumerate(("before", "after")):
            expected = np.sqrt(density[c, i, use])
            assert spectrum.um_per_sqrt_hz[name] == pytest.approx(expected, rel=1e-3)
        assert spectrum.resonances_hz == sorted(spectrum.resonances_hz)
        assert spectrum.f_hz[-1] >= 1.3 * spectrum.resonances_hz[-1]


def test_a_long_print_counts_evenly() -> None:
    """A tone that grows along 1000 blocks: its mean square over all, from a few of them."""
    t = 1e-3 * np.arange(1000 * BLOCK)
    growth = np.linspace(0.0, 1.0, len(t))
    tone = 0.05 * growth * np.sin(2 * np.pi * 64 * (1e3 / 1024) * t)
    error = np.stack([tone, np.zeros_like(tone)])[None]
    path = np.zeros((2, len(t)))
    spectra = ErrorSpectra(load_machine("ender3"), 1e-3, ["before"])
    for a in range(0, len(t), 50_000):
        part = slice(a, a + 50_000)
        spectra.add(path[:, part], error[:, :, part], np.ones(len(t[part]), bool))
    x, y = spectra.spectra()
    step_hz = x.f_hz[1] - x.f_hz[0]
    power = step_hz * np.sum(np.square(x.um_per_sqrt_hz["before"]))
    assert power == pytest.approx(np.mean((1e3 * tone) ** 2), rel=0.06)
    assert max(y.um_per_sqrt_hz["before"]) == 0.0


def test_only_what_prints_counts() -> None:
    spectra = ErrorSpectra(load_machine("ender3"), 1e-3, ["before"])
    path = np.zeros((2, 10 * BLOCK))
    error = np.ones((1, 2, 10 * BLOCK))
    spectra.add(path, error, np.zeros(10 * BLOCK, bool))
    assert spectra.spectra() == []
    spectra.add(path[:, :700], error[:, :, :700], np.ones(700, bool))
    spectra.jump()  # half a block is lost
    spectra.add(path[:, :BLOCK], error[:, :, :BLOCK], np.ones(BLOCK, bool))
    (x, _) = spectra.spectra()
    assert max(x.um_per_sqrt_hz["before"]) < 1e-9  # a constant error vibrates at no frequency
