"""Plants that explain a frequency response: fits to random draws from its uncertainty.

The response is perturbed within its uncertainty, repeats are reweighted (Bayesian bootstrap, Rubin
1981), and fits with one mode more or less are included where they explain as much. Every plant is
also varied by the typical change of an axis from run to run.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from stillpath.models.arrays import Complex
from stillpath.models.identification.averaging import aligned_to, mean_response, on_grid
from stillpath.models.identification.frame import LIKELY, shaken, without_frame
from stillpath.models.identification.modal_fit import alternatives, refit
from stillpath.models.identification.mode_estimates import correlation_factor
from stillpath.models.identification.prompt import advanced, delay_of, prompt
from stillpath.models.identification.representatives import Population, representatives
from stillpath.models.identification.response_data import coherent
from stillpath.models.identification.types import Fit, FrequencyResponse
from stillpath.models.plants import PairsSpec, PlantSpec, RelativeModesSpec, frequency_response

__all__ = ["explain_response"]

_SEED = 21
_DRAWS = 32
_POINTS = 120
_LEAST_SD = 0.005
"""Relative; no axis is more linear than that."""
_LOST, _NOTHING = 3.0, 0.9
"""A fit has failed if its residual exceeds this multiple of a draw's typical one, or this share of
the response."""
_RUN_TO_RUN = (0.007, 0.12)
"""Relative standard deviation of frequencies and damping within a session, on real axes."""


def explain_response(
    measured: Sequence[FrequencyResponse],
    fit: Fit,
    *,
    frame_firm: bool = False,
    frame_hz: float | None = None,
    progress: Callable[[float], None] | None = None,
) -> tuple[Population[PlantSpec], tuple[float, float]]:
    """Return plants that stand for all that explain repeats of one response.

    Parameters
    ----------
    measured : sequence of FrequencyResponse
        Repeats, their delays free.
    fit : Fit
        To their mean.
    frame_firm : bool
        Whether the frame is known to stand firm; else four fifths of the plants are without what
        may be its mode.
    frame_hz : float, optional
        Of a frame that was found and removed from the responses.
    progress : callable, optional
        Told the share done, 0 to 1.

    Returns
    -------
    population : Population
        Slow motion of every plant is on time (`prompt`).
    delay_s : (float, float)
        Range of the delay at low frequency that may be the plant's own.
    """
    mean = mean_response(measured)
    others = alternatives(_thinned(_within(mean, fit)), fit)
    draws = _Draws(measured, mean, fit)
    crowd: list[PlantSpec] = [prompt(fit), *map(prompt, others)]
    delays_s = [delay_of(one.spec) for one in (fit, *others)]
    rng = np.random.default_rng(_SEED)
    drawn: list[tuple[Fit, PlantSpec]] = []
    for k in range(_DRAWS):
        # Every second one has another structure, as the right one is unknown.
        like = others[k // 2 % len(others)] if others and k % 2 else fit
        found = refit(draws.draw(rng), like)
        f, zeta = 1 + np.array(_RUN_TO_RUN) * np.clip(rng.standard_normal(2), -2.0, 2.0)
        drawn.append((found, _moved(found.spec, float(f), float(zeta))))
        if progress:
            progress((k + 1) / _DRAWS)
    most = min(_LOST * float(np.median([found.residual for found, _ in drawn])), _NOTHING)
    explaining = [(found, moved) for found, moved in drawn if found.residual <= most]
    crowd += [advanced(moved) for _, moved in explaining]
    delays_s += [delay_of(found.spec) for found, _ in explaining]
    centres = [prompt(fit)]
    if not frame_firm:
        crowd = shaken(crowd, rng, LIKELY, frame_hz)
        centres.append(without_frame(centres[0], frame_hz))
    population = representatives(centres, crowd)
    return population, (float(min(delays_s)), float(max(delays_s)))


def _moved(plant: PlantSpec, frequency: float, damping: float) -> PlantSpec:
    assert isinstance(plant, (PairsSpec, RelativeModesSpec))
    return plant.scaled(frequency, damping)


class _Draws:
    """Random draws of a response within its uncertainty."""

    def __init__(
        self, measured: Sequence[FrequencyResponse], mean: FrequencyResponse, fit: Fit
    ) -> None:
        self._mean = mean = _within(mean, fit)
        f = mean.f_hz
        rows = [on_grid(aligned_to(r, mean), f) for r in measured]
        self._rows = np.array([_turned(r.response, mean.response) for r in rows])
        size = np.abs(mean.response)
        model = fit.gain * np.exp(-2j * np.pi * f * fit.delay_s) * frequency_response(fit.spec, f)
        # The fit may have turned a sensor round.
        error = _turned(mean.response, model) - model
        known = np.where(np.isfinite(mean.sd), mean.sd, 0.0)
        sd = np.maximum(known, _LEAST_SD * size)
        self._sd = sd * max(1.0, float(np.sqrt(np.mean(np.abs(error / sd) ** 2))))
        # Neighbours share data, and what a model misses is smooth.
        width = round(correlation_factor(error / sd))
        self._shared = np.ones(min(max(width, 1), max(len(f) // 8, 1)))
        self._shared /= np.sqrt(len(self._shared))

    def draw(self, rng: np.random.Generator) -> FrequencyResponse:
        weights = rng.dirichlet(np.ones(len(self._rows)))
        count = len(self._sd) + len(self._shared) - 1
        white = (rng.standard_normal(count) + 1j * rng.standard_normal(count)) / np.sqrt(2)
        noise = self._sd * np.convolve(white, self._shared, mode="valid")
        return _thinned(replace(self._mean, response=weights @ self._rows + noise, sd=self._sd))


def _within(response: FrequencyResponse, fit: Fit) -> FrequencyResponse:
    """Return the fitted part of a response, all of it coherent."""
    f, low_high = response.f_hz, fit.band_hz
    used = coherent(response.coherence) & (f >= low_high[0]) & (f <= low_high[1])
    used &= np.isfinite(response.response) & (np.abs(response.response) > 0)
    order = np.flatnonzero(used)[np.argsort(f[used], kind="stable")]
    return replace(_rows(response, order), coherence=np.full(len(order), np.nan))


def _thinned(response: FrequencyResponse) -> FrequencyResponse:
    return _rows(response, slice(None, None, max(1, len(response.f_hz) // _POINTS)))


def _rows(response: FrequencyResponse, rows: slice | NDArray[np.int64]) -> FrequencyResponse:
    return replace(
        response,
        f_hz=response.f_hz[rows],
        response=response.response[rows],
        sd=response.sd[rows],
        coherence=response.coherence[rows],
    )


def _turned(response: Complex, reference: Complex) -> Complex:
    """Return the response with the sign of the reference."""
    return response if np.vdot(reference, response).real >= 0 else -response
