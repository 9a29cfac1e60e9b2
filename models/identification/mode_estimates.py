"""Resonances of a fit with their standard deviations; separates real from spurious ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from stillpath.models.arrays import Array
from stillpath.models.identification.pair_structure import PairStructure
from stillpath.models.identification.types import ModeEstimate

__all__ = [
    "band_warnings",
    "correlation_factor",
    "filler_poles",
    "mode_estimates",
    "robust_covariance",
    "with_floor",
]

_FILLER_ZETA = 0.4
_FILLER_DISTANCE = 0.03
_EDGE = 0.03
_SYSTEMATIC = (2e-5, 1.2e-3)
"""Relative deviation of frequency and damping that the estimated response leaves, however little
scatter there is: its local model is damped by the noise in its own equations."""


def robust_covariance(gradient: NDArray[np.inexact], residual: NDArray[np.inexact]) -> Array:
    """Return the covariance of the parameters of a least-squares fit.

    The heteroscedasticity-consistent estimate (White 1980, with the correction m/(m - p)): the
    residuals themselves scale it, weights need not be the true ones. Neighbouring frequencies
    that share data have correlated residuals; the covariance grows by the factor
    1 + 2 sum rho_k that fewer independent points imply.

    Parameters
    ----------
    gradient : ndarray, real or complex, shape (m, p)
        Of the weighted model at every frequency.
    residual : ndarray, shape (m,)
        Weighted.
    """
    m, p = gradient.shape
    numbers = 2 * m if np.iscomplexobj(gradient) else m
    # Columns of equal size, otherwise a pseudo-inverse would cut what is merely small.
    length = np.linalg.norm(gradient, axis=0)
    length[length == 0] = 1.0
    unit = gradient / length
    bread = np.linalg.pinv(np.real(unit.conj().T @ unit), rcond=1e-12, hermitian=True)
    scores = np.real(unit.conj() * residual[:, None])
    meat = scores.T @ scores * (numbers / max(numbers - p, 1)) * correlation_factor(residual)
    return np.asarray(bread @ meat @ bread / np.outer(length, length), np.float64)


def mode_estimates(
    structure: PairStructure, theta: Array, covariance: Array
) -> tuple[ModeEstimate, ...]:
    """Return the pole pairs, rising in frequency.

    Parameters
    ----------
    theta : ndarray, shape (structure.size,)
    covariance : ndarray, shape (structure.size, structure.size)
    """
    n = structure.poles
    _, log_f, log_z, _, _ = structure.split(theta)
    f, zeta = np.exp(log_f) * structure.unit_hz, np.exp(log_z)
    sd = np.sqrt(np.maximum(np.diag(covariance), 0.0))[1 : 1 + 2 * n]
    peak = np.abs(structure.response(theta, f))
    return tuple(
        with_floor(
            ModeEstimate(
                f_hz=float(f[i]),
                zeta=float(zeta[i]),
                f_sd_hz=float(f[i] * sd[i]),
                zeta_sd=float(zeta[i] * sd[n + i]),
                peak=float(peak[i]),
            )
        )
        for i in np.argsort(f)
    )


def with_floor(mode: ModeEstimate, floor: tuple[float, float] = _SYSTEMATIC) -> ModeEstimate:
    """Return the mode with relative deviations of frequency and damping not below a floor.

    Parameters
    ----------
    floor : (float, float), optional
        What estimated responses leave, if not given.
    """
    return replace(
        mode,
        f_sd_hz=float(np.hypot(mode.f_sd_hz, mode.f_hz * floor[0])),
        zeta_sd=float(np.hypot(mode.zeta_sd, mode.zeta * floor[1])),
    )


def filler_poles(structure: PairStructure, theta: Array) -> list[int]:
    """Return the pole pairs that look like no resonance, the least likely first.

    Damped by more than 0.4, or within 3 % of a zero pair that cancels them.
    """
    _, log_f, log_z, log_fz, zz = structure.split(theta)
    poles = _roots(np.exp(log_f), np.exp(log_z))
    zeros = _roots(np.exp(log_fz), zz)
    found: list[tuple[float, int]] = []
    for i, pole in enumerate(poles):
        gap = float(np.min(np.abs(zeros - pole), initial=np.inf) / abs(pole))
        if gap < _FILLER_DISTANCE:
            found.append((gap, i))
        elif np.exp(log_z[i]) > _FILLER_ZETA:
            found.append((_FILLER_DISTANCE + 1 / float(np.exp(log_z[i])), i))
    return [i for _, i in sorted(found)]


def band_warnings(modes: tuple[ModeEstimate, ...], band_hz: tuple[float, float]) -> tuple[str, ...]:
    """Return a warning for every mode at the edge of the measured band or beyond it."""
    low, high = band_hz
    out = []
    for mode in modes:
        name = f"mode at {mode.f_hz:.1f} Hz (damping {mode.zeta:.3f})"
        if mode.f_hz < low or mode.f_hz > high:
            out.append(
                f"{name} lies outside the measured band {low:.1f} to {high:.1f} Hz: only its "
                "flank was seen; measure further to be sure of it"
            )
        elif mode.f_hz < low * (1 + _EDGE) or mode.f_hz > high * (1 - _EDGE):
            out.append(
                f"{name} lies at the edge of the measured band {low:.1f} to {high:.1f} Hz; "
                "measure further to be sure of it"
            )
    return tuple(out)


def correlation_factor(residual: NDArray[np.inexact]) -> float:
    """Return 1 + 2 sum rho_k of residuals (m,) over the first lags with a clear correlation."""
    m = len(residual)
    power = float(np.real(np.vdot(residual, residual)))
    if power == 0:
        return 1.0
    factor, noise = 1.0, 2 / np.sqrt(m)
    for lag in range(1, max(2, m // 5)):
        rho = float(np.real(np.vdot(residual[:-lag], residual[lag:]))) / power
        if rho < noise:
            break
        factor += 2 * rho
    return factor


def _roots(f: Array, zeta: Array) -> NDArray[np.complex128]:
    return np.asarray(f * (-zeta + np.sqrt(np.asarray(zeta**2 - 1, complex))))
