"""Selects and weights the points of a measured response for a fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillpath.models.arrays import Array, Complex
from stillpath.models.errors import ModelError
from stillpath.models.identification.averaging import low_frequency_delay
from stillpath.models.identification.types import LEAST_COHERENCE, FrequencyResponse
from stillpath.models.runs import runs

__all__ = ["ResponseData", "coherent", "coherent_part", "response_data"]

_RELATIVE_FLOOR = 0.02
"""Nonlinearity of a real axis: no point counts as better known than this share of the response
or, where it has fallen below that, of its value at low frequency."""
_LEAST_POINTS = 12
_AROUND = 5
"""Points over which an error is averaged."""
_LEAST_RUN = 0.01
"""Share of all points that must be coherent side by side: a few among noise are so by chance."""
_UNKNOWN_NOISE = 0.005
_RESONANCE_COHERENCE = 0.8
"""From which the strongest response is fitted. Of a Voron's log 0.5 makes the same plant; on two
plants fitted to its whole responses, prints have 0.8 and 0.5 of the error (2026-11-30)."""


@dataclass(frozen=True, slots=True, eq=False)
class ResponseData:
    """Points that are fitted, rising in frequency.

    Attributes
    ----------
    noise : float
        NRMSE that the noise alone leaves.
    delay_s : float
        First guess, right to a millisecond or so.
    """

    f_hz: Array
    response: Complex
    weight: Array
    noise: float
    delay_s: float
    warnings: tuple[str, ...]

    @property
    def unit_hz(self) -> float:
        """Centre of the band."""
        return float(np.sqrt(self.f_hz[0] * self.f_hz[-1]))

    @property
    def band_hz(self) -> tuple[float, float]:
        """Lowest and highest frequency."""
        return float(self.f_hz[0]), float(self.f_hz[-1])

    def most_missed_hz(self, modelled: Complex) -> float:
        """Return the frequency around which a model, shape (n,), misses the response most."""
        error = np.abs(self.weight * (modelled - self.response))
        around = np.convolve(error, np.ones(_AROUND) / _AROUND, mode="same")
        return float(self.f_hz[np.argmax(around)])

    def thinned(self, points: int) -> ResponseData:
        """Return about `points` of them, evenly."""
        some = slice(None, None, max(1, len(self.f_hz) // points))
        return ResponseData(
            self.f_hz[some],
            self.response[some],
            self.weight[some],
            self.noise,
            self.delay_s,
            self.warnings,
        )


def response_data(
    measured: FrequencyResponse, band_hz: tuple[float, float] | None = None
) -> ResponseData:
    """Choose the points with a coherence of 0.95 or more (or unknown) within `band_hz`.

    Guides that rub cost coherence first where an axis moves most. Where what rings most would be
    left out, 0.8 is enough: without its resonance, a fit may make anything of it (an undamped mode
    of 8 times what was measured, on a Voron of 2025-02).

    Raises
    ------
    ModelError
        If fewer than 12 are left.
    """
    f, h = measured.f_hz, measured.response
    low, high = band_hz or (0.0, np.inf)
    inside = (f > 0) & (f >= low) & (f <= high) & np.isfinite(h) & (np.abs(h) > 0)
    least = _least_coherence(measured, inside)
    unclear = inside & ~coherent(measured.coherence, least)
    use = np.flatnonzero(inside & ~unclear)
    if len(use) < _LEAST_POINTS:
        raise ModelError(
            f"{measured.source or measured.label or 'response'}: {len(use)} of {len(f)} "
            f"frequencies can be fitted, at least {_LEAST_POINTS} are needed "
            f"({int(unclear.sum())} have a coherence below {least}); check that the "
            "command belongs to this recording, or measure with more acceleration"
        )
    warnings = []
    if unclear.any():
        warnings.append(
            f"{int(unclear.sum())} of {int(inside.sum())} frequencies left out (coherence below "
            f"{least}), {f[unclear].min():.1f} to {f[unclear].max():.1f} Hz"
        )
    use = use[np.argsort(f[use])]
    f, h, sd = f[use], h[use], measured.sd[use]
    delay = low_frequency_delay(f, h)
    start = h[: max(3, len(f) // 20)] * np.exp(2j * np.pi * f[: max(3, len(f) // 20)] * delay)
    if start.real.sum() < 0:
        h = -h
        warnings.append("the response had the opposite sign (sensor turned round); turned back")
    size, known = np.abs(h), np.isfinite(sd)
    noise = np.where(known, sd, min(_roughness(h), _UNKNOWN_NOISE) * size)
    floor = _RELATIVE_FLOOR * np.maximum(size, np.median(size[:9]))
    weight = 1 / np.maximum(np.where(known, sd, 0.0), floor)
    share = float(np.linalg.norm(noise) / np.linalg.norm(size))
    return ResponseData(f, h, np.asarray(weight, np.float64), share, delay, tuple(warnings))


def _least_coherence(measured: FrequencyResponse, inside: NDArray[np.bool_]) -> float:
    """Return the coherence that a point needs: less if the resonance has less."""
    told = inside & coherent(measured.coherence, _RESONANCE_COHERENCE)
    if not told.any():
        return LEAST_COHERENCE
    strongest = np.argmax(np.where(told, np.abs(measured.response), 0.0))
    clear = coherent(measured.coherence)
    return LEAST_COHERENCE if clear[strongest] else _RESONANCE_COHERENCE


def coherent(coherence: Array, least: float = LEAST_COHERENCE) -> NDArray[np.bool_]:
    """Return which points are coherent, or not known not to be; short runs of them are not."""
    coherent = ~(coherence < least)
    for first, end in runs(coherent):
        if end - first < _LEAST_RUN * len(coherence):
            coherent[first:end] = False
    return np.asarray(coherent, np.bool_)


def coherent_part(
    measured: Sequence[FrequencyResponse],
) -> tuple[float | None, tuple[float, float] | None]:
    """Return the share of frequencies that are coherent, and from where to where they are.

    The least share of those whose coherence is known, and the band that all of them have.
    """
    known = [one for one in measured if np.isfinite(one.coherence).any()]
    if not known:
        return None, None
    clear = [coherent(one.coherence) for one in known]
    share = min(float(np.mean(one)) for one in clear)
    ends = [one.f_hz[c] for one, c in zip(known, clear, strict=True) if c.any()]
    low, high = (max((e.min() for e in ends), default=0), min((e.max() for e in ends), default=0))
    return share, (float(low), float(high)) if high > low else None


def _roughness(h: Complex) -> float:
    """Return the relative noise that third differences show, where no deviation is known."""
    third = np.abs(np.diff(h, 3)) / np.abs(h[2:-1])
    # Weights 1, 3, 3, 1; the median of a complex normal's modulus is sqrt(ln 2).
    return float(np.median(third) / np.sqrt(20 * np.log(2.0)))
