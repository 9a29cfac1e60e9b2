"""Disturbances: spectra, periods, phases, and what they refuse."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import TypeAdapter
from scipy.signal import welch

from stillpath.models.disturbances import (
    DisturbanceSpec,
    Narrowband,
    Peak,
    Periodic,
    Switched,
    Tone,
    Wideband,
    sample,
)
from stillpath.models.errors import ModelError

TS = 1e-4


def test_tones_have_their_amplitude_and_phase() -> None:
    spec = Narrowband(tones=(Tone(f_hz=500, amplitude=0.1, phase_rad=0.3), Tone(f_hz=1200)))
    spectrum = np.fft.rfft(sample(spec, 10_000, TS)) / 5000
    assert spectrum[500] == pytest.approx(0.1 * np.exp(1j * (0.3 - np.pi / 2)), abs=1e-9)
    assert abs(spectrum[1200]) == pytest.approx(1.0, abs=1e-9)


def test_switched_changes_at_its_times() -> None:
    spec = Switched(start_s=(0.1, 0.2), parts=((Tone(f_hz=1000),), ()))
    d = sample(spec, 3000, TS)
    assert not d[:1000].any()
    assert not d[2000:].any()
    t = np.arange(1000, 2000) * TS
    assert d[1000:2000] == pytest.approx(np.sin(2 * np.pi * 1000 * t), abs=1e-9)
    with pytest.raises(ModelError, match="rising start"):
        sample(Switched(start_s=(0.2, 0.1), parts=((), ())), 10, TS)


def test_period_need_not_be_whole_samples() -> None:
    spec = Periodic(f_hz=1200, amplitudes=(1.0, 0.5), phases_rad=(0.1, 0.2))
    d = sample(spec, 400, 1 / 16000)
    # 13.33 samples per period: three periods are 40 samples.
    assert d[40:] == pytest.approx(d[:-40], abs=1e-9)
    assert np.abs(d[13:-13] - d[:-26]).max() > 0.01
    with pytest.raises(ModelError, match="2 harmonics, but 1 phases"):
        sample(Periodic(f_hz=1, amplitudes=(1, 1), phases_rad=(0,)), 2, TS)


def test_wideband_has_its_humps_and_power() -> None:
    spec = Wideband(
        peaks=(Peak(f_hz=900, width_hz=150, rms=2.0), Peak(f_hz=2500, width_hz=300, rms=1.0)),
        floor_rms=0.1,
    )
    d = sample(spec, 400_000, TS, np.random.default_rng(0))
    f, power = welch(d, 1 / TS, nperseg=4000)
    assert np.std(d) == pytest.approx(np.sqrt(4 + 1 + 0.01), rel=0.02)
    assert f[np.argmax(power)] == pytest.approx(900, abs=20)
    half = power[np.argmin(np.abs(f - 975))] / power[np.argmin(np.abs(f - 900))]
    assert half == pytest.approx(0.5, rel=0.15)
    floor = power[(f > 4000) & (f < 4900)].mean()
    assert floor == pytest.approx(0.1**2 / 5000, rel=0.1)
    again = sample(spec, 400_000, TS, np.random.default_rng(0))
    assert np.array_equal(d, again)
    with pytest.raises(ModelError, match="generator"):
        sample(spec, 10, TS)
    # Between two frequencies of this time.
    narrow = Wideband(peaks=(Peak(f_hz=900.5, width_hz=1e-6, rms=2.0),))
    assert np.std(sample(narrow, 10_000, TS, np.random.default_rng(0))) > 0.5
    beyond = Wideband(peaks=(Peak(f_hz=6000, width_hz=100, rms=1.0),))
    with pytest.raises(ModelError, match="hump of 6000 Hz: not below half the sampling rate"):
        sample(beyond, 10_000, TS, np.random.default_rng(0))


def test_documents_tell_their_kind() -> None:
    adapter: TypeAdapter[DisturbanceSpec] = TypeAdapter(DisturbanceSpec)
    spec = Periodic(f_hz=1200, amplitudes=(1.0,))
    assert adapter.validate_json(adapter.dump_json(spec)) == spec
    with pytest.raises(ModelError, match="half the sampling rate"):
        sample(Narrowband(tones=(Tone(f_hz=5000),)), 10, TS)
