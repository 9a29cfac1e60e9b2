"""Fits a plant to a measured frequency response.

Sanathanan-Koerner over a range of delays gives starting points, which nonlinear least squares on
pairs of poles and zeros refines; the number of pairs rises while the residual falls clearly and is
not yet explained by the noise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from stillpath.models.arrays import Array
from stillpath.models.errors import ModelError
from stillpath.models.identification.averaging import low_frequency_delay, mean_response
from stillpath.models.identification.mode_estimates import (
    band_warnings,
    filler_poles,
    mode_estimates,
    robust_covariance,
)
from stillpath.models.identification.pair_structure import PairStructure
from stillpath.models.identification.response_candidate import (
    ResponseCandidate,
    delay_span,
    judged,
    least_error,
    with_gain,
)
from stillpath.models.identification.response_data import ResponseData, response_data
from stillpath.models.identification.sanathanan_koerner import (
    pairs_of,
    polynomial_basis,
    sanathanan_koerner,
)
from stillpath.models.identification.types import Fit, FrequencyResponse, OrderTrial
from stillpath.models.plants import PairsSpec

__all__ = ["fit_response", "refit_response"]

_CLEARLY = 0.7
"""Each further pair must bring the residual below this share."""
_EXPLAINED = 1.3
"""A residual below this multiple of the noise is noise."""
_NO_WORSE = 1.05
"""Largest growth of the residual for a model that is minimum phase, or has a pair less."""
_ZERO_BAND = 0.8
"""Zeros above this share of the band trade off with the delay: to be non-minimum phase they must
pay like a pair of poles, and beyond the band nothing proves it."""
_EARLIER_S = 25e-3
"""The slope of the phase contains the delay of the plant itself, so the dead time is shorter: by
2 zeta/w of every pole pair, 20 ms for two well damped ones at 20 Hz."""
_LATER_S = 2e-3
_DELAY_STEP_S = 0.5e-3
_MOST_DELAYS = 80
_APART_S = 1.5e-3
_START_POINTS = 160
_POLES_BAND = (0.5, 1.6)
"""Poles may lie outside the band by these factors."""
_ZEROS_BAND = (0.5, 10.0)
"""The same for zeros; beyond the upper end they have no effect."""
_ZETA = (3e-3, 3.0)
_TINY = 1e-9
_FAR_ZERO = 3.0
"""A real zero above this multiple of the band can hardly be told from a delay."""


def fit_response(
    measured: FrequencyResponse | Sequence[FrequencyResponse],
    *,
    max_order: int = 4,
    band_hz: tuple[float, float] | None = None,
    progress: Callable[[float], None] | None = None,
) -> Fit:
    """Fit a plant to a frequency response.

    Parameters
    ----------
    measured : FrequencyResponse or sequence of them
        Several are averaged first (`averaging.mean_response`).
    max_order : int
        Most pole pairs to try.
    band_hz : (low, high), optional
        Use only these frequencies.
    progress : callable, optional
        Receives the share done, 0 to 1.

    Returns
    -------
    Fit
        Stable, DC gain 1; `residual` and `trials` hold NRMSE, the root of sum |model - H|^2 over
        sum |H|^2.

    Raises
    ------
    ModelError
        If too few points are left to fit.
    """
    single = measured if isinstance(measured, FrequencyResponse) else mean_response(measured)
    data = response_data(single, band_hz)
    tried: list[_Candidate] = []
    # A fit keeps three complex numbers per pair of poles and zeros.
    for order in range(1, max(1, min(max_order, len(data.f_hz) // 6)) + 1):
        tried.append(_best_of_order(data, order, tried[-1] if tried else None))
        if progress:
            progress(order / max_order)
        if tried[-1].nrmse < _EXPLAINED * data.noise:
            break
    chosen = _without_fillers(data, _by_the_knee(tried, data.noise))
    chosen = _without_far_zero(data, _calm_beyond(data, chosen))
    trials = tuple(OrderTrial(c.structure.poles, c.nrmse) for c in tried)
    return replace(_as_fit(data, chosen), trials=trials)


def refit_response(measured: FrequencyResponse, like: Fit) -> Fit:
    """Fit a plant with the pairs of `like`, starting from it: a member of its set.

    A zero keeps its side of the imaginary axis.

    Raises
    ------
    ModelError
        If too few points are left to fit.
    """
    if not isinstance(like.spec, PairsSpec):
        raise ModelError("a plant of pairs is needed to start from; fit a response first")
    data = response_data(measured)
    structure = PairStructure(len(like.spec.poles), len(like.spec.zeros), data.unit_hz)
    theta = structure.parameters(like.spec)
    ratio = data.response / structure.response(theta, data.f_hz)
    start = with_gain(data, structure, theta, low_frequency_delay(data.f_hz, ratio))
    fitted = _polished(data, start, _sides(start), real_zero=like.spec.real_zero_tau_s != 0.0)
    return replace(_as_fit(data, fitted), trials=(OrderTrial(structure.poles, fitted.nrmse),))


_Candidate: TypeAlias = ResponseCandidate[PairStructure]


def _best_of_order(data: ResponseData, order: int, smaller: _Candidate | None) -> _Candidate:
    starts = _rational_starts(data, order)
    if smaller is None:
        peak = data.f_hz[np.argmax(np.abs(data.response))] / data.unit_hz
        theta = np.array([0.0, np.log(peak), np.log(0.1)])
        starts.append(with_gain(data, PairStructure(1, 0, data.unit_hz), theta, data.delay_s))
    else:
        starts.append(_grown(data, smaller))
    best = min((_polished(data, s) for s in starts), key=lambda c: c.cost)
    return _with_zeros_in_band(data, best)


def _with_zeros_in_band(data: ResponseData, fit: _Candidate) -> _Candidate:
    """Mirror the zeros right of the imaginary axis that the measurement does not prove."""
    kept = np.zeros(fit.structure.size)
    while (beyond := (_sides(fit) < 0) & (_zero_hz(fit) > data.f_hz[-1])).any():
        kept[beyond] = 1.0
        fit = _mirrored(data, fit, kept)
    zero_hz = _zero_hz(fit)
    for zero in np.argsort(-zero_hz):
        sides = _sides(fit)
        if sides[zero] < 0:
            sides[zero] = 1.0
            mirrored = _mirrored(data, fit, sides)
            if _stands(data, mirrored, fit, clearly=zero_hz[zero] > _ZERO_BAND * data.f_hz[-1]):
                fit = mirrored
    return fit


def _stands(data: ResponseData, simpler: _Candidate, fit: _Candidate, *, clearly: bool) -> bool:
    """Whether the measurement does not tell a simpler fit from `fit`, or not `clearly`."""
    share = 1 / _CLEARLY if clearly else _NO_WORSE
    return simpler.nrmse < max(share * fit.nrmse, _EXPLAINED * data.noise)


def _mirrored(data: ResponseData, fit: _Candidate, sides: Array) -> _Candidate:
    """Refit with the zeros kept at `sides` (+1: left half plane)."""
    vector = fit.vector.copy()
    turned = (sides > 0) & (fit.theta < 0)
    vector[2:][turned] *= -1
    # The delay replaces that of a mirrored zero: 4 zeta/w for a pair, 2 tau for a real one.
    vector[1] += 2 * float(np.sum(_zero_delay(fit)[turned]))
    return _polished(data, replace(fit, vector=vector), sides)


def _zero_delay(fit: _Candidate) -> Array:
    """Return the delay of slow motion by the zero whose side each parameter's sign is, else 0."""
    tau, _, _, log_fz, zz = fit.structure.split(fit.theta)
    out = np.zeros(fit.structure.size)
    out[0] = abs(tau)
    out[fit.structure.size - fit.structure.zeros :] = 2 * np.abs(zz) / np.exp(log_fz)
    return out


def _sides(fit: _Candidate) -> Array:
    """Return +1 or -1 at the parameters whose sign is a zero's side (-1: right), else 0."""
    sides = np.zeros(fit.structure.size)
    signed = [0, *range(fit.structure.size - fit.structure.zeros, fit.structure.size)]
    sides[signed] = np.where(fit.theta[signed] < 0, -1.0, 1.0)
    return sides


def _zero_hz(fit: _Candidate) -> Array:
    """Return the frequency of the zero at each parameter that holds its side, else 0."""
    structure = fit.structure
    tau, _, _, log_fz, zz = structure.split(fit.theta)
    out = np.zeros(structure.size)
    out[0] = structure.unit_hz / max(abs(tau), 1e-9)
    # Of two real zeros the slower one.
    slower = np.where(np.abs(zz) > 1, np.abs(zz) - np.sqrt(np.maximum(zz**2 - 1, 0)), 1.0)
    out[structure.size - structure.zeros :] = np.exp(log_fz) * structure.unit_hz * slower
    return out


def _by_the_knee(tried: list[_Candidate], noise: float) -> _Candidate:
    """Return the smallest order on which no larger one improves clearly."""
    chosen = tried[0]
    for larger in tried[1:]:
        pairs = larger.structure.poles - chosen.structure.poles
        clearly = larger.nrmse < _CLEARLY**pairs * chosen.nrmse
        if chosen.nrmse > _EXPLAINED * noise and clearly:
            chosen = larger
    return chosen


def _without_fillers(data: ResponseData, fit: _Candidate) -> _Candidate:
    """Drop the pairs that are no resonances, unless the measurement needs them."""
    for pole in filler_poles(fit.structure, fit.theta) if fit.structure.poles > 1 else ():
        structure, theta = fit.structure.without(fit.theta, pole)
        smaller = _with_zeros_in_band(
            data, _polished(data, with_gain(data, structure, theta, fit.delay_s))
        )
        if _stands(data, smaller, fit, clearly=False):
            return _without_fillers(data, smaller)
    return fit


def _without_far_zero(data: ResponseData, fit: _Candidate) -> _Candidate:
    """Drop a real zero far above the band, which trades off with the delay that is set aside."""
    if abs(fit.theta[0]) * data.f_hz[-1] * _FAR_ZERO > data.unit_hz:
        return fit
    sides = _sides(fit)
    sides[0] = 0.0
    without = _polished(data, fit, sides, real_zero=False)
    no_worse = without.nrmse < max(_NO_WORSE * fit.nrmse, _EXPLAINED * data.noise)
    return without if no_worse else fit


def _calm_beyond(data: ResponseData, fit: _Candidate) -> _Candidate:
    """Refit if a pole pair above the band rings, unless its flank shows clearly that it does."""
    least = fit.structure.least_damping(fit.theta, _ZETA[0], float(data.f_hz[-1]))
    if np.all(np.exp(fit.structure.split(fit.theta)[2]) >= least):
        return fit
    calm = _polished(data, fit, _sides(fit), least)
    return calm if _stands(data, calm, fit, clearly=True) else fit


def _as_fit(data: ResponseData, found: _Candidate) -> Fit:
    gradient = data.weight[:, None] * found.gradient(data.f_hz)
    residual = data.weight * (found.model(data.f_hz) - data.response)
    covariance = robust_covariance(gradient, residual)[2:, 2:]
    modes = mode_estimates(found.structure, found.theta, covariance)
    return Fit(
        spec=found.structure.spec(found.theta),
        residual=found.nrmse,
        gain=float(np.exp(found.vector[0])),
        delay_s=found.delay_s,
        band_hz=data.band_hz,
        modes=modes,
        warnings=(*data.warnings, *band_warnings(modes, data.band_hz)),
    )


def _rational_starts(data: ResponseData, order: int) -> list[_Candidate]:
    """Return the best Sanathanan-Koerner fit over the delays, and the best one away from it."""
    some = data.thinned(_START_POINTS)
    basis = polynomial_basis(np.asarray(1j * some.f_hz / data.unit_hz, np.complex128), 2 * order)
    structure = PairStructure(order, order - 1, data.unit_hz)
    found: list[_Candidate] = []
    for delay in _delays(data):
        h = some.response * np.exp(2j * np.pi * some.f_hz * delay)
        b, a, _ = sanathanan_koerner(basis, h, some.weight, 2 * order - 1, 2 * order)
        theta = _pairs_theta(structure, b, a)
        if theta is not None:
            found.append(judged(some, with_gain(some, structure, theta, float(delay))))
    found.sort(key=lambda c: c.cost)
    apart = [c for c in found if abs(c.delay_s - found[0].delay_s) > _APART_S]
    return [*found[:1], *apart[:1]]


def _delays(data: ResponseData) -> Array:
    """Return delays to try: those before the phase's slope, and, should noise tilt that, 0."""
    low, high = min(data.delay_s - _EARLIER_S, 0.0), max(data.delay_s, 0.0) + _LATER_S
    count = min(_MOST_DELAYS, 1 + round((high - low) / _DELAY_STEP_S))
    return np.linspace(low, high, count)


def _pairs_theta(structure: PairStructure, b: Array, a: Array) -> Array | None:
    """Turn polynomials into parameters, unstable poles mirrored; None if pairs are missing."""
    poles, _ = pairs_of(a)
    zeros, tau = pairs_of(b)
    if len(poles) != structure.poles or len(zeros) < structure.zeros:
        return None
    # Of too many zeros the slowest matter within the band.
    zeros = zeros[: structure.zeros]
    return np.concatenate(
        [
            tau[:1] if len(tau) else [0.0],
            np.log(poles[:, 0]),
            np.log(np.clip(np.abs(poles[:, 1]), *_ZETA)),
            np.log(zeros[:, 0]),
            np.clip(zeros[:, 1], -1.5, 1.5),
        ]
    )


def _grown(data: ResponseData, smaller: _Candidate) -> _Candidate:
    """Add a pair where the residual is largest."""
    at_hz = data.most_missed_hz(smaller.model(data.f_hz))
    structure, theta = smaller.structure.extended(smaller.theta, at_hz)
    return ResponseCandidate(structure, np.concatenate([smaller.vector[:2], theta]))


def _polished(
    data: ResponseData,
    start: _Candidate,
    sides: Array | None = None,
    least_zeta: Array | None = None,
    *,
    real_zero: bool = True,
) -> _Candidate:
    """Minimise the weighted error, the zeros kept at `sides` (0: free)."""
    structure, f = start.structure, data.f_hz
    least = np.full(structure.poles, _ZETA[0]) if least_zeta is None else least_zeta
    poles_hz, zeros_hz = ((b[0] * f[0], b[1] * f[-1]) for b in (_POLES_BAND, _ZEROS_BAND))
    low, high = structure.bounds(poles_hz, (least, _ZETA[1]), zeros_hz=zeros_hz)
    if sides is not None:
        low[sides > 0], high[sides < 0] = 1e-3, -1e-3
    if not real_zero:
        low[0], high[0] = -_TINY, _TINY
    found = least_error(data, start, low, high, delay_span(data, _EARLIER_S))
    if not real_zero:
        found.vector[2] = 0.0
        found = judged(data, found)
    return found
