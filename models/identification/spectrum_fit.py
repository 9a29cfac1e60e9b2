"""A plant from a power spectral density alone, as Klipper's resonance test writes it.

The drive is known, so |G| is absolute; the phase is not, so the plant is minimum phase by
convention. The window's bandwidth is part of the model: read off the curve, the damping of a
narrow mode comes out several times too large.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from models.errors import ModelError
from models.identification.mode_estimates import (
    band_warnings,
    filler_poles,
    mode_estimates,
    robust_covariance,
)
from models.identification.pair_structure import PairStructure
from models.identification.spectrum_model import (
    SpectrumModel,
    cross_axis_share,
    driven_column,
    spectrum_model,
)
from models.identification.types import Excitation, Fit, OrderTrial, Spectrum
from models.plants import PairsSpec

__all__ = ["fit_spectrum", "refit_spectrum"]

Array = NDArray[np.float64]

_DB = 10 / np.log(10)
_KNEE_DB = 0.6
_PERFECT_DB = 0.05
_CLEARLY = 0.3
"""Beyond the knee each further pair must bring the residual below this share."""
_NO_WORSE = 1.1
_SCALE = 0.15
"""Where a residual of the logarithm counts as an outlier."""
_PRIOR = 0.3
"""Standard deviation of the logarithm of the gain, of one bin's weight."""
_ZETA = (3e-3, 0.5)
_HIGHEST = 2.0
"""Poles may lie above the band by this factor."""
_USUAL_ZETA, _ZETA_SPREAD = 0.08, 1.5
"""Damping where the spectrum does not tell it, and the standard deviation of its logarithm."""
_LEVEL = 0.15
_WEAK_MODE = 0.1
_CROSS = 0.2


def fit_spectrum(
    spectrum: Spectrum,
    excitation: Excitation,
    *,
    column: str | None = None,
    max_order: int = 4,
    progress: Callable[[float], None] | None = None,
) -> Fit:
    """Fit a plant to a spectrum of acceleration.

    Parameters
    ----------
    excitation : Excitation
        The test that made it.
    column : str, optional
        Default: the one that follows the drive from 8 to 15 Hz.
    max_order : int
        Most pole pairs to try; the smallest that leaves 0.6 dB is taken, more if they clearly
        pay.
    progress : callable, optional
        Told the share done, 0 to 1.

    Returns
    -------
    Fit
        Stable, DC gain 1, minimum phase, `magnitude_only`; `residual` and `trials` in dB;
        `gain` is the level against the stated accel_per_hz; `notes` hold warnings.

    Raises
    ------
    ModelError
        If the column does not exist or is dead, or too few bins are left.
    """
    name = _column(spectrum, column)
    model = spectrum_model(spectrum, name, excitation)
    tried: list[_Candidate] = []
    for order in range(1, max(1, min(max_order, len(model.f_hz) // 8)) + 1):
        starts = _larger(model, tried[-1]) if tried else _single(model)
        tried.append(min((_polished(model, s) for s in starts), key=lambda c: c.cost))
        if progress:
            progress(order / max_order)
        if tried[-1].residual_db < _PERFECT_DB:
            break
    chosen = _calm_beyond(model, _without_fillers(model, _by_the_knee(tried)))
    notes = (
        *_level_warning(float(np.exp(chosen.vector[0])), excitation),
        *_cross_warning(*cross_axis_share(spectrum, name, model.band_hz), name),
    )
    trials = tuple(OrderTrial(c.structure.poles, c.residual_db) for c in tried)
    return _as_fit(model, chosen, trials, notes)


def refit_spectrum(
    spectrum: Spectrum, excitation: Excitation, like: Fit, *, column: str | None = None
) -> Fit:
    """Fit a plant with the pairs of `like`, starting from it: a member of its set.

    Raises
    ------
    ModelError
        As `fit_spectrum`.
    """
    model = spectrum_model(spectrum, _column(spectrum, column), excitation)
    structure = PairStructure(len(like.spec.poles), len(like.spec.zeros), _unit_hz(model))
    theta = structure.parameters(like.spec)
    fitted = _polished(model, _Candidate(structure, np.append(_nuisances(model), theta)))
    trials = (OrderTrial(structure.poles, fitted.residual_db),)
    return _as_fit(model, fitted, trials, ())


@dataclass(frozen=True, slots=True, eq=False)
class _Candidate:
    """Parameters [log gain, log noise, pairs ...] of a structure."""

    structure: PairStructure
    vector: Array
    residual_db: float = np.inf
    cost: float = np.inf

    @property
    def theta(self) -> Array:
        return self.vector[2:]


def _column(spectrum: Spectrum, column: str | None) -> str:
    if column is None:
        return driven_column(spectrum)
    if column not in spectrum.psd:
        raise ModelError(
            f"{spectrum.source or 'spectrum'}: no column {column!r}; there are "
            f"{', '.join(spectrum.psd)}"
        )
    return column


def _single(model: SpectrumModel) -> list[_Candidate]:
    """Start one mode at the largest |G| and at the largest f |G|^2."""
    structure = PairStructure(1, 0, _unit_hz(model))
    size = model.log_psd - np.log(model.kernel.sum(axis=1))
    peaks = {int(np.argmax(size)), int(np.argmax(size + np.log(model.f_hz)))}
    return [
        _Candidate(structure, np.append(_nuisances(model), _one_mode(structure, model.f_hz[i])))
        for i in sorted(peaks)
    ]


def _one_mode(structure: PairStructure, f_hz: float) -> Array:
    return np.array([0.0, np.log(f_hz / structure.unit_hz), np.log(0.08)])


def _larger(model: SpectrumModel, smaller: _Candidate) -> list[_Candidate]:
    """Add a pair where the spectrum is most above, and most off, the smaller model."""
    error = model.log_psd - model.log_spectrum(smaller.structure, smaller.vector)
    smooth = np.convolve(error, np.ones(3) / 3, mode="same")
    strongest = np.exp(smaller.structure.split(smaller.theta)[1].mean()) * _unit_hz(model)
    places = {
        round(float(model.f_hz[np.argmax(smooth)]), 6),
        round(float(model.f_hz[np.argmax(np.abs(smooth))]), 6),
        round(float(strongest) * 1.1, 6),
    }
    out = []
    for place in sorted(places):
        structure, theta = smaller.structure.extended(smaller.theta, place)
        out.append(_Candidate(structure, np.append(smaller.vector[:2], theta)))
    return out


def _by_the_knee(tried: list[_Candidate]) -> _Candidate:
    """Return the smallest order that leaves 0.6 dB, or a larger one that betters it clearly."""
    least = min(c.residual_db for c in tried)
    enough = max(_KNEE_DB, least * _NO_WORSE)
    chosen = next(c for c in tried if c.residual_db <= enough)
    for larger in tried[chosen.structure.poles :]:
        pairs = larger.structure.poles - chosen.structure.poles
        if larger.residual_db < _CLEARLY**pairs * chosen.residual_db:
            chosen = larger
    return chosen


def _without_fillers(model: SpectrumModel, fit: _Candidate) -> _Candidate:
    """Drop the pairs that are no resonances, unless the spectrum needs them."""
    for pole in filler_poles(fit.structure, fit.theta) if fit.structure.poles > 1 else ():
        structure, theta = fit.structure.without(fit.theta, pole)
        smaller = _polished(model, _Candidate(structure, np.append(fit.vector[:2], theta)))
        clearly_worse = min(_KNEE_DB, fit.residual_db / _CLEARLY)
        if smaller.residual_db < max(_NO_WORSE * fit.residual_db, clearly_worse):
            return _without_fillers(model, smaller)
    return fit


def _calm_beyond(model: SpectrumModel, fit: _Candidate) -> _Candidate:
    """Refit if a pole pair above the band rings more than the spectrum can tell."""
    least = fit.structure.least_damping(fit.theta, _ZETA[0], float(model.f_hz[-1]))
    if np.all(np.exp(fit.structure.split(fit.theta)[2]) >= least):
        return fit
    return _polished(model, fit, least)


def _polished(
    model: SpectrumModel, start: _Candidate, least_zeta: Array | None = None
) -> _Candidate:
    structure = start.structure
    least = np.full(structure.poles, _ZETA[0]) if least_zeta is None else least_zeta
    low, high = structure.bounds(
        (0.7 * model.f_hz[0], _HIGHEST * model.f_hz[-1]), (least, _ZETA[1]), minimum_phase=True
    )
    quiet = float(model.log_psd.min())
    low, high = np.append([-3.0, quiet - 12.0], low), np.append([3.0, quiet + 0.5], high)

    def residual(vector: Array) -> Array:
        error = model.log_spectrum(structure, vector) - model.log_psd
        damping = (vector[damped] - np.log(_USUAL_ZETA)) / _ZETA_SPREAD
        return np.concatenate([error / _SCALE, vector[:1] / _PRIOR, damping])

    def jacobian(vector: Array) -> Array:
        unit = np.eye(len(vector))
        priors = [unit[:1] / _PRIOR, unit[damped] / _ZETA_SPREAD]
        return np.vstack([model.log_gradient(structure, vector) / _SCALE, *priors])

    # Gain, noise, tau and the frequencies of the poles come first.
    damped = slice(3 + structure.poles, 3 + 2 * structure.poles)
    inside = np.clip(start.vector, low + 1e-6, high - 1e-6)
    solution = least_squares(
        residual, inside, jacobian, (low, high), loss="soft_l1", x_scale="jac", max_nfev=60
    )
    error = _SCALE * residual(solution.x)[: len(model.log_psd)]
    return replace(
        start,
        vector=np.asarray(solution.x, np.float64),
        residual_db=float(_DB * np.sqrt(np.mean(error**2))),
        cost=float(solution.cost),
    )


def _as_fit(
    model: SpectrumModel, found: _Candidate, trials: tuple[OrderTrial, ...], notes: tuple[str, ...]
) -> Fit:
    residual = model.log_spectrum(found.structure, found.vector) - model.log_psd
    gradient = model.log_gradient(found.structure, found.vector)
    covariance = robust_covariance(gradient, residual)[2:, 2:]
    modes = mode_estimates(found.structure, found.theta, covariance)
    spec = found.structure.spec(found.theta)
    return Fit(
        spec=spec,
        residual=found.residual_db,
        gain=float(np.exp(found.vector[0])),
        delay_s=0.0,
        band_hz=model.band_hz,
        modes=modes,
        trials=trials,
        magnitude_only=True,
        trust_below_hz=_trust_below_hz(spec, model.band_hz),
        notes=(*notes, *band_warnings(modes, model.band_hz)),
    )


def _trust_below_hz(spec: PairsSpec, band_hz: tuple[float, float]) -> float:
    """Return half the lowest frequency of a zero that might be non-minimum phase.

    A minimum-phase inverse of a zero that is not leaves 12 % at 0.6 and 3 % at 0.4 of the zero's
    frequency. A zero next to a pole belongs to a mode that hardly moves this point: on the other
    side of the axis it would need a mode several times as strong.
    """
    roots = spec.roots()
    zeros = [
        float(abs(zero))
        for zero in roots.zeros
        if np.min(np.abs(roots.poles - zero)) > _WEAK_MODE * abs(zero)
    ]
    return float(min(0.5 * min(zeros, default=np.inf) / (2 * np.pi), band_hz[1]))


def _level_warning(gain: float, excitation: Excitation) -> tuple[str, ...]:
    stated = excitation.accel_per_hz_mm_s
    if abs(gain - 1) <= _LEVEL:
        return ()
    return (
        (
            f"the level at low frequency implies accel_per_hz = {gain * stated:.0f}, stated are "
            f"{stated:g} ({gain - 1:+.0%}); check accel_per_hz, and that this axis was tested and "
            "its sensor reads right (the shape of the model hardly depends on it)"
        ),
    )


def _cross_warning(share: float, other: str, column: str) -> tuple[str, ...]:
    if share <= _CROSS:
        return ()
    return (
        (
            f"sensor axis {other!r} has {share:.0%} of the power of {column!r}: the axes are "
            "coupled (CoreXY belts of unequal tension?), the frame rocks, or the sensor is turned; "
            f"the model describes {column!r} alone"
        ),
    )


def _nuisances(model: SpectrumModel) -> Array:
    return np.array([np.log(model.gain_of_plateau()), float(model.log_psd.min()) - 3.0])


def _unit_hz(model: SpectrumModel) -> float:
    return float(np.sqrt(model.f_hz[0] * model.f_hz[-1]))
