"""Frequency response by local least squares: a rational function of frequency, band by band.

Around each frequency the response is (h0 + h1 x + h2 x^2) / (1 + d1 x + d2 x^2), found from all
bins of the whole-record transforms in the band (McKelvey and Guerin, Non-parametric frequency
response estimation using a local rational model, IFAC SYSID 2012; multiplied out, it is linear).
Unlike Welch's method it does not smear resonances, because a single pole describes one locally,
two a pair of close ones, and the residual of each band gives the standard deviation.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from stillpath.models.arrays import Array, Complex
from stillpath.models.errors import ModelError

__all__ = ["LocalResponse", "Transformed", "bins_needed", "local_response", "log_residual"]

_POWERS = 3
_SHARED = 2 * _POWERS - 1
_OWN = 2
_Band: TypeAlias = tuple[Array, Complex, Complex]


@dataclass(frozen=True, slots=True, eq=False)
class Transformed:
    """Whole-record transforms of a command and what followed.

    Attributes
    ----------
    spacing_hz : float
        Between bins; the first bin is 0 Hz.
    command, measured : ndarray of complex128, shape (n,)
    """

    spacing_hz: float
    command: Complex
    measured: Complex


@dataclass(frozen=True, slots=True, eq=False)
class LocalResponse:
    """Response, standard deviation of its complex error, and coherence, shape (m,) each."""

    response: Complex
    sd: Array
    coherence: Array


def local_response(
    records: Sequence[Transformed], f_hz: Array, half_band_hz: float, *, transient: bool = False
) -> LocalResponse:
    """Fit a local response to the bins within `half_band_hz` of every frequency.

    Parameters
    ----------
    records : sequence of Transformed
        All of the same plant; their equations are added up.
    f_hz : ndarray, shape (m,)
    transient : bool
        Also fit a linear transient to each band of each record: for records that do not begin
        and end at rest.

    Raises
    ------
    ModelError
        If a band holds too few bins for the unknowns: the records are too short.
    """
    bands = [_bands(record, f_hz, half_band_hz) for record in records]
    unknowns = _SHARED + (_OWN * len(records) if transient else 0)
    bins = sum(x.shape[1] for x, _, _ in bands)
    if bins < unknowns + 3:
        raise ModelError(
            f"{bins} frequency bins within +-{half_band_hz:.3g} Hz are too few for a response; "
            "record longer, or widen the band"
        )
    columns = [
        _regressors(band, unknowns, i if transient else None) for i, band in enumerate(bands)
    ]
    normal = _added(_products(r, r) for r in columns)
    right = _added(_products(r, y[:, :, None]) for r, (_, _, y) in zip(columns, bands, strict=True))
    energy = sum(np.sum(np.abs(y) ** 2, axis=1) for _, _, y in bands)
    inverse = _inverse(normal)
    solution = (inverse @ right)[:, :, 0]
    explained = np.sum((right[:, :, 0].conj() * solution).real, axis=1)
    # The equations are multiplied by the denominator, and so is the noise in them.
    lower = solution[:, _POWERS:_SHARED]
    factors = [np.abs(1.0 + _denominator(x, lower)) ** 2 for x, _, _ in bands]
    multiplied = sum(np.sum(f, axis=1) for f in factors) / bins
    noise = np.maximum(energy - explained, 0.0) / (bins - unknowns) / multiplied
    meat = _added(_products(r, f[:, :, None] * r) for r, f in zip(columns, factors, strict=True))
    spread = (inverse[:, :1] @ meat @ inverse[:, :, :1])[:, 0, 0].real
    total = energy / bins
    share = np.divide(noise, total, out=np.ones_like(total), where=total > 0)
    # Rounding makes the variance of a band that nothing drives negative: its error is unknown.
    sd = np.sqrt(np.where(spread >= 0.0, noise * spread, np.inf))
    return LocalResponse(solution[:, 0], sd, np.clip(1.0 - share, 0.0, 1.0))


def bins_needed(records: int, *, transient: bool) -> int:
    """Return how many bins of each record a band should hold: twice the unknowns, and some."""
    unknowns = _SHARED + (_OWN * records if transient else 0)
    return -(-(2 * unknowns + 4) // records)


def log_residual(coherence: Array) -> Array:
    """Return the logarithm of the share of the power that a response leaves unexplained, (n,)."""
    return np.asarray(np.log(np.maximum(1.0 - coherence, 1e-9)), np.float64)


def _regressors(band: _Band, unknowns: int, own: int | None) -> Complex:
    """Return the columns of numerator, denominator and (of record `own`) its transient."""
    x, u, y = band
    powers = x[:, :, None] ** np.arange(_POWERS)
    columns = np.zeros((*x.shape, unknowns), complex)
    columns[:, :, :_POWERS] = powers * u[:, :, None]
    columns[:, :, _POWERS:_SHARED] = -powers[:, :, 1:] * y[:, :, None]
    if own is not None:
        # In units of the command, so that the equations stay well scaled.
        size = np.sqrt(np.mean(np.abs(u) ** 2, axis=1))[:, None, None]
        first = _SHARED + _OWN * own
        columns[:, :, first : first + _OWN] = powers[:, :, :_OWN] * size
    return columns


def _products(left: Complex, right: Complex) -> Complex:
    return np.asarray(left.conj().swapaxes(1, 2) @ right, np.complex128)


def _added(terms: Iterable[Complex]) -> Complex:
    """Return the sum over the records."""
    return np.asarray(np.sum(list(terms), axis=0), np.complex128)


def _inverse(normal: Complex) -> Complex:
    """Invert the normal equations of all bands; those without drive stay solvable."""
    trace = np.trace(normal, axis1=1, axis2=2).real
    floor = np.where(trace > 0, 1e-13 * trace, 1.0)
    return np.asarray(np.linalg.inv(normal + floor[:, None, None] * np.eye(normal.shape[1])))


def _denominator(x: Array, coefficients: Complex) -> Complex:
    """Return d1 x + d2 x^2 at the bins of every band."""
    powers = x[:, :, None] ** np.arange(1, _POWERS)
    return np.asarray((powers @ coefficients[:, :, None])[:, :, 0])


def _bands(record: Transformed, f_hz: Array, half_band_hz: float) -> _Band:
    """Return x = (f - centre)/half_band, command and measurement of every band, shape (m, bins).

    Bands that reach below 0 Hz go on in the conjugate.
    """
    reach = int(half_band_hz / record.spacing_hz * (1 + 1e-9))
    centre = np.round(f_hz / record.spacing_hz).astype(int)
    index = centre[:, None] + np.arange(-reach, reach + 1)
    if index.max() >= len(record.command):
        raise ModelError(
            f"{f_hz[-1]:.4g} Hz with a band of +-{half_band_hz:.3g} Hz exceeds the record, which "
            f"ends at {record.spacing_hz * (len(record.command) - 1):.4g} Hz"
        )
    x = (index * record.spacing_hz - f_hz[:, None]) / half_band_hz
    u, y = (
        np.where(index < 0, values[np.abs(index)].conj(), values[index])
        for values in (record.command, record.measured)
    )
    return x, u, y
