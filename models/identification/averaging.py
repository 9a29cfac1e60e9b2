"""Average repeats into one measurement."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from stillpath.models.arrays import Array, Complex
from stillpath.models.errors import ModelError
from stillpath.models.identification.types import LEAST_COHERENCE, FrequencyResponse, Spectrum

__all__ = ["aligned_to", "low_frequency_delay", "mean_response", "mean_spectrum", "on_grid"]

_DELAYS_S = 20e-3
_FLAT = 0.2
"""Logarithm of the modulus that a mode must add before its phase counts."""
_BELOW_PEAK, _AGREES = 0.7, 0.8
"""Share of the frequency of the highest peak below which phases should agree with a delay, and how
well, 0 to 1."""
_SEARCH_S, _SEARCH_STEP_S = 0.02, 0.25e-3


def mean_response(responses: Sequence[FrequencyResponse]) -> FrequencyResponse:
    """Return the mean weighted by 1/sd^2, on the frequencies that all share.

    Differing delays (each recording starts at its own instant) are matched to the first. The
    standard deviation is the larger of that of the members and that of their scatter.

    Raises
    ------
    ModelError
        If there is no response, or the bands do not overlap.
    """
    if not responses:
        raise ModelError("no frequency response to average: give one or more")
    first = responses[0]
    if len(responses) == 1:
        return first
    f = _shared_hz(responses, "responses")
    moved = [on_grid(aligned_to(r, first), f) for r in responses]
    h = np.stack([r.response for r in moved])
    sd = np.stack([r.sd for r in moved])
    known = np.isfinite(sd) & (sd > 0)
    weight = np.where(known.all(axis=0), 1 / np.where(known, sd, 1.0) ** 2, 1.0)
    share = weight / weight.sum(axis=0)
    mean = (share * h).sum(axis=0)
    propagated = np.where(known.all(axis=0), np.sqrt(1 / weight.sum(axis=0)), np.nan)
    scatter = np.sqrt((share * np.abs(h - mean) ** 2).sum(axis=0) / (len(h) - 1))
    return replace(
        first,
        f_hz=f,
        response=mean,
        sd=np.fmax(propagated, scatter),
        coherence=np.mean([r.coherence for r in moved], axis=0),
        label=f"mean of {len(responses)}",
        notes=tuple(dict.fromkeys(n for r in responses for n in r.notes)),
    )


def mean_spectrum(spectra: Sequence[Spectrum]) -> Spectrum:
    """Return the mean of the logarithms of the columns that all share, on the first's grid.

    Raises
    ------
    ModelError
        If there is no spectrum, no column is in all of them, or their bands do not overlap.
    """
    if not spectra:
        raise ModelError("no spectrum to average: give one or more")
    first = spectra[0]
    if len(spectra) == 1:
        return first
    shared = [name for name in first.psd if all(name in s.psd for s in spectra)]
    if not shared:
        raise ModelError(
            f"the {len(spectra)} spectra share no column (the first has {', '.join(first.psd)}); "
            "fit them one by one"
        )
    f = _shared_hz(spectra, "spectra")
    tiny = np.finfo(float).tiny
    logs = {
        name: np.mean(
            [np.interp(f, s.f_hz, np.log(np.maximum(s.psd[name], tiny))) for s in spectra], axis=0
        )
        for name in shared
    }
    return replace(
        first,
        f_hz=f,
        psd={name: np.exp(log) for name, log in logs.items()},
        notes=tuple(dict.fromkeys(n for s in spectra for n in s.notes)),
    )


def _shared_hz(measured: Sequence[FrequencyResponse | Spectrum], what: str) -> Array:
    """Return the frequencies of the first measurement that lie in the bands of all."""
    low = max(float(one.f_hz.min()) for one in measured)
    high = min(float(one.f_hz.max()) for one in measured)
    own = measured[0].f_hz
    shared: Array = own[(own >= low) & (own <= high)]
    if len(shared) < 2:
        raise ModelError(
            f"the {len(measured)} {what} share no frequencies (the highest start is {low:.1f} Hz, "
            f"the lowest end {high:.1f} Hz); fit them one by one"
        )
    return shared


def aligned_to(response: FrequencyResponse, reference: FrequencyResponse) -> FrequencyResponse:
    """Return the response with the delay of the reference.

    The delay maximises the agreement over all coherent frequencies: low frequencies alone would be
    too noisy.
    """
    used = ~(response.coherence < LEAST_COHERENCE)
    low, high = reference.f_hz[0], reference.f_hz[-1]
    used &= (response.f_hz >= low) & (response.f_hz <= high)
    f = response.f_hz[used]
    if len(f) < 2:
        return response
    alike = response.response[used] * on_grid(reference, f).response.conj()
    turn = 2j * np.pi * f

    def likeness(delays_s: Array) -> Array:
        return np.asarray(np.abs(np.exp(np.outer(delays_s, turn)) @ alike), np.float64)

    coarse = low_frequency_delay(f, alike) + np.linspace(-_DELAYS_S, _DELAYS_S, 801)
    best = coarse[np.argmax(likeness(coarse))]
    fine = best + np.linspace(-1.0, 1.0, 201) * (coarse[1] - coarse[0])
    shift = fine[np.argmax(likeness(fine))]
    turned = response.response * np.exp(2j * np.pi * response.f_hz * shift)
    return replace(response, response=turned)


def low_frequency_delay(f_hz: Array, response: Complex) -> float:
    """Return the delay [s] from the slope of the phase where the modulus is still flat.

    There the modes add little, each only 2 zeta/w. Where a frame on its feet shakes there, its
    flanks turn the phase by as much as tens of milliseconds would: then the delay with which most
    frequencies below the highest peak agree.
    """
    size = np.abs(response)
    leaves = np.abs(np.log(size / np.median(size[:3]))) > _FLAT
    few = max(6, int(np.argmax(leaves)) if leaves.any() else len(size))
    phase = np.unwrap(np.angle(response[:few]))
    slope = np.polyfit(f_hz[:few], phase, 1)[0] if len(phase) > 1 else 0.0
    delay_s = float(-slope / (2 * np.pi))
    below = f_hz < _BELOW_PEAK * f_hz[np.argmax(size)]
    if np.count_nonzero(below) <= few:
        return delay_s
    w = 2 * np.pi * f_hz[below]
    alike = np.exp(1j * np.angle(response[below]))

    def agreement(delays_s: Array) -> Array:
        return np.asarray(np.abs(np.exp(1j * np.outer(delays_s, w)) @ alike) / len(w), np.float64)

    if agreement(np.array([delay_s]))[0] >= _AGREES:
        return delay_s
    # Most steps are beside the flanks.
    rises = np.diff(w) > 0.0
    steps_s = -np.diff(np.unwrap(np.angle(alike)))[rises] / np.diff(w)[rises]
    tried_s = float(np.median(steps_s)) + np.arange(-_SEARCH_S, _SEARCH_S, _SEARCH_STEP_S)
    return float(tried_s[np.argmax(agreement(tried_s))])


def on_grid(response: FrequencyResponse, f_hz: Array) -> FrequencyResponse:
    """Return the response at `f_hz`, shape (n,), linear between its points."""
    own = response.f_hz
    if np.array_equal(own, f_hz):
        return response
    return replace(
        response,
        f_hz=f_hz,
        response=np.interp(f_hz, own, response.response),
        sd=np.interp(f_hz, own, response.sd),
        coherence=np.interp(f_hz, own, response.coherence),
    )
