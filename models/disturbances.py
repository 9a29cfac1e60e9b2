"""Disturbances in time as they are written down and sampled, and sensors slower than the loop.

Those that repeat with the position of an axis are `models.ripple`.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from stillpath.models.arrays import Array
from stillpath.models.document import Document, Finite, NonNegative, Positive
from stillpath.models.errors import ModelError

__all__ = [
    "DisturbanceSpec",
    "Narrowband",
    "Peak",
    "Periodic",
    "SensorSpec",
    "Switched",
    "Tone",
    "Wideband",
    "sample",
]


class SensorSpec(Document):
    """What a controller sees of the output.

    Attributes
    ----------
    every : int
        Samples of the loop per sample of the sensor (L of paper 001).
    delay_samples : int
        Age of a value when it arrives, in samples of the sensor.
    quantum : float
        Resolution; 0 for none.
    """

    every: Annotated[int, Field(ge=1, le=10_000)] = 1
    delay_samples: Annotated[int, Field(ge=0, le=1000)] = 0
    quantum: NonNegative = 0.0


class Tone(Document):
    """amplitude * sin(2 pi f t + phase)."""

    f_hz: Positive
    amplitude: Finite = 1.0
    phase_rad: Finite = 0.0


class Narrowband(Document):
    """A few tones at once."""

    kind: Literal["narrowband"] = "narrowband"
    tones: Annotated[tuple[Tone, ...], Field(min_length=1, max_length=64)]


class Switched(Document):
    """Tones that change at once at given times: from `start_s[i]` on, `parts[i]`.

    An empty part is silence. The phase of every tone counts from t = 0.
    """

    kind: Literal["switched"] = "switched"
    start_s: tuple[NonNegative, ...]
    parts: tuple[tuple[Tone, ...], ...]


class Peak(Document):
    """A hump of the spectrum: Gaussian in frequency, `width_hz` at half its power density."""

    f_hz: Positive
    width_hz: Positive
    rms: NonNegative


class Wideband(Document):
    """Random, with humps in the spectrum and a white floor."""

    kind: Literal["wideband"] = "wideband"
    peaks: Annotated[tuple[Peak, ...], Field(max_length=32)] = ()
    floor_rms: NonNegative = 0.0


class Periodic(Document):
    """Harmonics of one frequency; the period need not be a whole number of samples.

    Attributes
    ----------
    amplitudes, phases_rad : tuple of float
        Of harmonics 1, 2, ...; phases 0 if none are given.
    """

    kind: Literal["periodic"] = "periodic"
    f_hz: Positive
    amplitudes: Annotated[tuple[Finite, ...], Field(min_length=1, max_length=256)]
    phases_rad: tuple[Finite, ...] = ()


DisturbanceSpec = Annotated[
    Narrowband | Switched | Wideband | Periodic, Field(discriminator="kind")
]


def sample(
    spec: DisturbanceSpec,
    samples: int,
    dt_s: float,
    generator: np.random.Generator | None = None,
) -> Array:
    """Return `samples` values of a disturbance in time, `dt_s` apart, from t = 0.

    Parameters
    ----------
    generator : numpy.random.Generator, optional
        Needed for `Wideband`.

    Raises
    ------
    ModelError
        If a frequency is not below half the sampling rate, or the generator is missing.
    """
    t: Array = np.arange(samples, dtype=np.float64) * dt_s
    if isinstance(spec, Narrowband):
        return _tones(spec.tones, t, dt_s)
    if isinstance(spec, Switched):
        if len(spec.start_s) != len(spec.parts) or list(spec.start_s) != sorted(spec.start_s):
            raise ModelError("a switched disturbance needs one rising start per part")
        out = np.zeros(samples)
        for start, end, tones in zip(
            spec.start_s, (*spec.start_s[1:], math.inf), spec.parts, strict=True
        ):
            now = (t >= start - 1e-9 * dt_s) & (t < end - 1e-9 * dt_s)
            out[now] = _tones(tones, t[now], dt_s)
        return out
    if isinstance(spec, Periodic):
        return _harmonics(spec, 2 * np.pi * spec.f_hz * t)
    if generator is None:
        raise ModelError("a wideband disturbance is random: give a generator")
    return _coloured(spec, samples, dt_s, generator)


def _tones(tones: tuple[Tone, ...], t: Array, dt_s: float) -> Array:
    out = np.zeros(len(t))
    for tone in tones:
        _check_sampled("tone", tone.f_hz, dt_s)
        out += tone.amplitude * np.sin(2 * np.pi * tone.f_hz * t + tone.phase_rad)
    return out


def _harmonics(spec: Periodic, angle: Array) -> Array:
    phases = spec.phases_rad or (0.0,) * len(spec.amplitudes)
    if len(phases) != len(spec.amplitudes):
        raise ModelError(f"{len(spec.amplitudes)} harmonics, but {len(phases)} phases")
    out = np.zeros(len(angle))
    for h, (amplitude, phase) in enumerate(zip(spec.amplitudes, phases, strict=True), start=1):
        out += amplitude * np.sin(h * angle + phase)
    return out


def _coloured(spec: Wideband, samples: int, dt_s: float, generator: np.random.Generator) -> Array:
    """Shape white noise in the frequency domain, every hump with its own noise."""
    f = np.fft.rfftfreq(samples, dt_s)
    out = spec.floor_rms * generator.standard_normal(samples)
    for peak in spec.peaks:
        _check_sampled("hump", peak.f_hz, dt_s)
        # A narrower hump may lie between two frequencies, and have no power.
        width_hz = max(peak.width_hz, 1.0 / (samples * dt_s))
        # Half the power density at half the width off the centre.
        shape = np.exp(-2 * np.log(2) * ((f - peak.f_hz) / width_hz) ** 2)
        spectrum = shape * np.fft.rfft(generator.standard_normal(samples))
        hump = np.fft.irfft(spectrum, samples)
        power = float(np.sum(shape**2 * np.where((f > 0) & (f < 0.5 / dt_s), 2, 1)) / samples)
        out += peak.rms * hump / math.sqrt(power)
    return out


def _check_sampled(what: str, f_hz: float, dt_s: float) -> None:
    if 2 * f_hz * dt_s >= 1:
        raise ModelError(
            f"{what} of {f_hz:g} Hz: not below half the sampling rate, {0.5 / dt_s:g} Hz"
        )
