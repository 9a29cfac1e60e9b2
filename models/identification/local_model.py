"""Frequency response by local least squares: a rational function of frequency, band by band.

Around each frequency the response is (h0 + h1 x + h2 x^2) / (1 + d x), found from all bins of the
whole-record transforms in the band (McKelvey and Guerin, Non-parametric frequency response
estimation using a local rational model, IFAC SYSID 2012; multiplied out, it is linear). Unlike
Welch's method it does not smear resonances, because a single pole describes one locally, and the
residual of each band gives the standard deviation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from models.errors import ModelError

__all__ = ["LocalResponse", "Transformed", "bins_needed", "local_response"]

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

_SHARED = 4
_OWN = 2


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
    unknowns = _SHARED + (_OWN * len(records) if transient else 0)
    normal = np.zeros((len(f_hz), unknowns, unknowns), complex)
    right = np.zeros((len(f_hz), unknowns), complex)
    energy, bins = np.zeros(len(f_hz)), 0
    for i, record in enumerate(records):
        x, u, y = _bands(record, f_hz, half_band_hz)
        powers = x[:, :, None] ** np.arange(3)
        regressors = np.zeros((*x.shape, unknowns), complex)
        regressors[:, :, :3] = powers * u[:, :, None]
        regressors[:, :, 3] = -x * y
        if transient:
            # In units of the command, so that the equations stay well scaled.
            size = np.sqrt(np.mean(np.abs(u) ** 2, axis=1))[:, None, None]
            own = _SHARED + _OWN * i
            regressors[:, :, own : own + _OWN] = powers[:, :, :_OWN] * size
        conjugate = regressors.conj().swapaxes(1, 2)
        normal += conjugate @ regressors
        right += (conjugate @ y[:, :, None])[:, :, 0]
        energy += np.sum(np.abs(y) ** 2, axis=1)
        bins += x.shape[1]
    if bins < unknowns + 3:
        raise ModelError(
            f"{bins} frequency bins within +-{half_band_hz:.3g} Hz are too few for a response; "
            "record longer, or widen the band"
        )
    return _solved(normal, right, energy, bins)


def bins_needed(records: int, *, transient: bool) -> int:
    """Return how many bins of each record a band should hold: twice the unknowns, and some."""
    unknowns = _SHARED + (_OWN * records if transient else 0)
    return -(-(2 * unknowns + 4) // records)


def _solved(normal: Complex, right: Complex, energy: Array, bins: int) -> LocalResponse:
    """Solve the normal equations of all bands; bands without drive have coherence 0."""
    unknowns = normal.shape[1]
    trace = np.trace(normal, axis1=1, axis2=2).real
    floor = np.where(trace > 0, 1e-13 * trace, 1.0)
    inverse = np.linalg.inv(normal + floor[:, None, None] * np.eye(unknowns))
    solution = (inverse @ right[:, :, None])[:, :, 0]
    explained = np.sum((right.conj() * solution).real, axis=1)
    unexplained = np.maximum(energy - explained, 0.0) / (bins - unknowns)
    sd = np.sqrt(unexplained * inverse[:, 0, 0].real)
    total = energy / bins
    share = np.divide(unexplained, total, out=np.ones_like(total), where=total > 0)
    return LocalResponse(solution[:, 0], sd, np.clip(1.0 - share, 0.0, 1.0))


def _bands(record: Transformed, f_hz: Array, half_band_hz: float) -> tuple[Array, Complex, Complex]:
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
