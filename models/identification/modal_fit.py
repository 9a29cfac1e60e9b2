"""Fit modes, with a delay no larger than guides cause, to a measured frequency response.

Pairs of poles and zeros (`fitting`) explain any response, but their delay of slow motion trades off
with the start of the recording, and is unbounded. Where modes damped by relative speed
(`modal_structure`) explain as much, they are used: part of their damping may act against the frame,
so that slow motion is delayed by at most d/k.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from stillpath.models.arrays import Array
from stillpath.models.errors import ModelError
from stillpath.models.identification.averaging import low_frequency_delay, mean_response
from stillpath.models.identification.fitting import fit_response, refit_response
from stillpath.models.identification.modal_structure import ModalStructure
from stillpath.models.identification.mode_estimates import (
    band_warnings,
    robust_covariance,
    with_floor,
)
from stillpath.models.identification.prompt import delay_of, prompt
from stillpath.models.identification.response_candidate import (
    ResponseCandidate,
    delay_span,
    judged,
    least_error,
    with_gain,
)
from stillpath.models.identification.response_data import ResponseData, response_data
from stillpath.models.identification.trust import main_mode_known
from stillpath.models.identification.types import (
    UNSEEN_ZETA,
    Fit,
    FrequencyResponse,
    ModeEstimate,
    OrderTrial,
)
from stillpath.models.plants import PairsSpec, RelativeModesSpec, frequency_response

__all__ = ["alternatives", "fit_modes", "of_poles", "refit"]

Modal: TypeAlias = ResponseCandidate[ModalStructure]

_AS_GOOD, _EXPLAINED, _IRRELEVANT = 1.05, 1.3, 0.005
"""A fit is as good as another within 5 % of its residual, within 1.3 times the noise, or within
half a percent: no axis is more linear than that."""
_CLEARLY = 0.7
_LEAST_PEAK, _LEAST_SHARE = 0.1, 0.005
"""Least that a mode must add to |G|: at its own frequency, or far below it."""
_ASSUMED = (1e-3, 0.01)
"""Relative change of frequency and damping due to the assumption of where damping acts."""
_POLES_BAND, _ZETA, _SHARE = (1.1, 1.6), (3e-3, 1.0), (-2.0, 2.5)
_EARLIER_S, _DELAY_STEP_S = 10e-3, 0.25e-3
_START_ZETA, _BEYOND = 0.08, 1.3
_START_POINTS = 160
_GROSS = 0.5
"""Residual from which modes without their delay are another plant (chosen, not measured)."""
_LATE_S = (-0.5e-3, 1e-3)
"""Delay of slow motion that modes may have: viscous guides make it as late as twice a mode's
damping over its frequency, and nothing makes it early."""


def fit_modes(
    measured: FrequencyResponse | Sequence[FrequencyResponse],
    *,
    max_order: int = 4,
    progress: Callable[[float], None] | None = None,
) -> Fit:
    """Fit modes to a frequency response, or pairs where modes do not explain it as well.

    Parameters and errors as of `fitting.fit_response`.
    """
    single = measured if isinstance(measured, FrequencyResponse) else mean_response(measured)
    data = response_data(single)
    fitted = fit_response(single, max_order=max_order, progress=progress)
    pairs = _as_used(data, fitted)
    found = _orders(data, pairs, max_order)
    if not found:
        return pairs
    trials = tuple(OrderTrial(c.structure.modes, c.nrmse) for c in found)
    modes = [replace(_as_used(data, _as_fit(data, c)), trials=trials) for c in found]
    # Modes that cancel each other explain much, and nobody knows where they are.
    modes = [fit for fit in modes if main_mode_known(fit)] or modes
    # Pairs whose slow motion is late by much explain a response, but are not used as fitted.
    least = min(pairs.residual, max(fitted.residual, min(fit.residual for fit in modes)))
    enough = _enough(data, least)
    chosen = modes[0]
    for larger in modes[1:]:
        if chosen.residual > enough and larger.residual < _CLEARLY * chosen.residual:
            chosen = larger
    explained = chosen.residual <= max(enough, pairs.residual)
    return chosen if explained or not main_mode_known(pairs) else pairs


def refit(measured: FrequencyResponse, like: Fit) -> Fit:
    """Fit a plant of the structure of `like`, starting from it: modes, or pairs.

    Raises
    ------
    ModelError
        If too few points are left to fit.
    """
    if isinstance(like.spec, PairsSpec):
        return _as_used(response_data(measured), refit_response(measured, like))
    if not isinstance(like.spec, RelativeModesSpec):
        raise ModelError("a plant of modes or pairs is needed to start from; fit a response first")
    data = response_data(measured)
    structure = ModalStructure(len(like.spec.modes), data.unit_hz, grounded=True)
    theta = structure.parameters_of(like.spec)
    ratio = data.response / structure.response(theta, data.f_hz)
    start = with_gain(data, structure, theta, low_frequency_delay(data.f_hz, ratio))
    fitted = _polished(data, start, _least_damping(data, start))
    fit = _as_used(data, _as_fit(data, fitted))
    return replace(fit, trials=(OrderTrial(structure.modes, fitted.nrmse),))


def alternatives(measured: FrequencyResponse, fit: Fit) -> tuple[Fit, ...]:
    """Return fits with a mode more and a mode less than `fit`, where they explain as much."""
    if not isinstance(fit.spec, RelativeModesSpec):
        return ()
    data = response_data(measured, fit.band_hz)
    enough = _enough(data, fit.residual)
    modes = fit.spec.modes
    starts = [_grown(data, fit.spec, fit.delay_s)]
    if len(modes) > 1:
        weakest = min(modes, key=lambda m: abs(m.share) / m.zeta)
        kept = [m for m in modes if m is not weakest]
        starts.append(of_poles(data, [(m.f_hz, m.zeta) for m in kept]))
    tried = [_calm(data, _polished(data, s)) for s in starts if s is not None]
    return tuple(_as_fit(data, t) for t in tried if t.nrmse <= enough and _all_ring(t))


def _as_used(data: ResponseData, fit: Fit) -> Fit:
    """Return the fit with the residual of the plant that is made of it (`prompt`).

    Pairs may fit with a delay of many milliseconds. Without it, they are another plant. Modes
    delay slow motion by their grounded damping only: they count as fitted unless that is more than
    guides do, or the plant is grossly another one.
    """
    turned = np.exp(-2j * np.pi * data.f_hz * (fit.delay_s + delay_of(fit.spec)))
    model = fit.gain * turned * frequency_response(prompt(fit), data.f_hz)
    missed = np.linalg.norm(model - data.response) / np.linalg.norm(data.response)
    likely = missed <= _GROSS and _LATE_S[0] <= delay_of(fit.spec) <= _LATE_S[1]
    if isinstance(fit.spec, RelativeModesSpec) and likely:
        return fit
    return replace(fit, residual=max(fit.residual, float(missed)))


def _all_ring(fit: Modal) -> bool:
    """Return whether every mode has a measurable effect."""
    _, zeta, share = fit.structure.split(fit.theta)
    return bool(np.all((np.abs(share) > _LEAST_PEAK * 2 * zeta) & (np.abs(share) > _LEAST_SHARE)))


def _enough(data: ResponseData, residual: float) -> float:
    """Return the residual with which a fit explains as much as one with `residual`."""
    return max(_AS_GOOD * residual, _EXPLAINED * data.noise, _IRRELEVANT)


def _orders(data: ResponseData, pairs: Fit, max_order: int) -> list[Modal]:
    """Return the best fit of each number of modes, until one explains enough."""
    some = data.thinned(_START_POINTS)
    found: list[Modal] = []
    for order in range(1, max(1, min(max_order, len(data.f_hz) // 6)) + 1):
        starts = [s for s in _starts(some, pairs, order, found) if s is not None]
        tried = [_polished(some, start) for start in starts]
        if not tried:
            continue
        best = _polished(data, min(tried, key=lambda c: c.cost))
        found.append(_calm(data, best))
        if found[-1].nrmse < _EXPLAINED * data.noise:
            break
    return found


def _starts(
    data: ResponseData, pairs: Fit, order: int, found: Sequence[Modal]
) -> Iterator[Modal | None]:
    """Yield starts: the modes of the pairs, and those of one order less with one more."""
    highest = sorted(pairs.modes, key=lambda m: -m.peak)[:order]
    if len(highest) == order:
        yield of_poles(data, [(m.f_hz, m.zeta) for m in highest])
    if order == 1:
        peak = float(data.f_hz[np.argmax(np.abs(data.response))])
        yield of_poles(data, [(peak, _START_ZETA)])
    elif found:
        smaller = found[-1]
        plant = smaller.structure.spec(smaller.theta)
        yield _grown(data, plant, smaller.delay_s)
        poles = [(m.f_hz, m.zeta) for m in plant.modes]
        yield of_poles(data, [*poles, (_BEYOND * float(data.f_hz[-1]), _START_ZETA)])


def _grown(data: ResponseData, plant: RelativeModesSpec, delay_s: float) -> Modal | None:
    """Return a start with one more mode, where the plant misses most."""
    seen = frequency_response(plant, data.f_hz) * np.exp(-2j * np.pi * data.f_hz * delay_s)
    gain = np.vdot(seen, data.response).real / np.vdot(seen, seen).real
    at_hz = data.most_missed_hz(gain * seen)
    return of_poles(data, [*((m.f_hz, m.zeta) for m in plant.modes), (at_hz, _START_ZETA)])


def of_poles(data: ResponseData, poles: Sequence[tuple[float, float]]) -> Modal | None:
    """Return the best shares, gain and delay for given modes; they are linear but for the delay."""
    structure = ModalStructure(len(poles), data.unit_hz, grounded=True)
    f_hz, zeta = np.array(poles).T
    zeta = np.clip(zeta, *_ZETA)
    s = 1j * data.f_hz[:, None] / f_hz
    best: tuple[float, Array, float, float] | None = None
    span_s = abs(data.delay_s) + _EARLIER_S
    for grounded in (0.0, 1.0):
        modes = (1 + 2 * zeta * (1 - grounded) * s) / (1 + 2 * zeta * s + s * s)
        for delay_s in np.arange(-span_s, span_s, _DELAY_STEP_S):
            turned = np.exp(-2j * np.pi * data.f_hz * delay_s)
            columns = (data.weight * turned)[:, None] * modes
            target = data.weight * data.response
            normal = (columns.conj().T @ columns).real + 1e-9 * np.eye(len(poles))
            share = np.linalg.solve(normal, (columns.conj().T @ target).real)
            error = float(np.linalg.norm(columns @ share - target))
            if share.sum() > 0 and (best is None or error < best[0]):
                best = error, share / share.sum(), grounded, float(delay_s)
    if best is None:
        return None
    _, share, grounded, delay_s = best
    share = np.clip(share, *_SHARE)
    # Inside its bounds, so that it can move.
    theta = structure.parameters(f_hz, zeta, share, 0.05 + 0.9 * grounded)
    return with_gain(data, structure, theta, delay_s)


def _polished(data: ResponseData, start: Modal, least_zeta: Array | None = None) -> Modal:
    """Minimise the weighted error."""
    n = start.structure.modes
    band_hz = (_POLES_BAND[0] * float(data.f_hz[0]), _POLES_BAND[1] * float(data.f_hz[-1]))
    low, high = start.structure.bounds(band_hz, _ZETA, _SHARE)
    if least_zeta is not None:
        low[n : 2 * n] = np.log(least_zeta)
    return least_error(data, start, low, high, delay_span(data, _EARLIER_S))


def _least_damping(data: ResponseData, fit: Modal) -> Array:
    """Return the least damping of every mode, as it is where that is less and was chosen."""
    zeta = fit.structure.split(fit.theta)[1]
    return np.asarray(np.minimum(_calm_damping(data, fit), zeta), np.float64)


def _calm_damping(data: ResponseData, fit: Modal) -> Array:
    """Return a least damping for modes above the band, of which only the flank was measured."""
    beyond = fit.structure.split(fit.theta)[0] * data.unit_hz > data.f_hz[-1]
    return np.where(beyond, UNSEEN_ZETA, _ZETA[0])


def _calm(data: ResponseData, fit: Modal) -> Modal:
    """Refit if a mode above the band rings, unless its flank shows clearly that it does."""
    least = _calm_damping(data, fit)
    if np.all(fit.structure.split(fit.theta)[1] >= least):
        return fit
    calm = _polished(data, fit, least)
    return fit if calm.nrmse > _EXPLAINED * max(fit.nrmse, data.noise) else calm


def _as_fit(data: ResponseData, found: Modal) -> Fit:
    found = judged(data, found)
    gradient = data.weight[:, None] * found.gradient(data.f_hz)
    residual = data.weight * (found.model(data.f_hz) - data.response)
    n, theta = found.structure.modes, found.theta
    sd = np.sqrt(np.maximum(np.diag(robust_covariance(gradient, residual)), 0.0))[2 : 2 + 2 * n]
    f, zeta, _ = found.structure.split(theta)
    peak = np.abs(found.structure.response(theta, f * data.unit_hz))
    modes = tuple(
        with_floor(
            ModeEstimate(
                f_hz=float(f[i] * data.unit_hz),
                zeta=float(zeta[i]),
                f_sd_hz=float(f[i] * data.unit_hz * sd[i]),
                zeta_sd=float(zeta[i] * sd[n + i]),
                peak=float(peak[i]),
            ),
            _ASSUMED,
        )
        for i in np.argsort(f)
    )
    return Fit(
        spec=found.structure.spec(theta),
        residual=found.nrmse,
        gain=float(np.exp(found.vector[0])),
        delay_s=found.delay_s,
        band_hz=data.band_hz,
        modes=modes,
        warnings=(*data.warnings, *band_warnings(modes, data.band_hz)),
    )
