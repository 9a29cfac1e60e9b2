"""A parametric plant, seen through gain and delay of a recording, and its refinement."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Generic, Protocol, TypeVar

import numpy as np
from scipy.optimize import least_squares

from stillpath.models.arrays import Array, Complex
from stillpath.models.identification.response_data import ResponseData

__all__ = [
    "GAIN",
    "ResponseCandidate",
    "Structure",
    "delay_span",
    "judged",
    "least_error",
    "with_gain",
]

GAIN = (1e-9, 1e9)
"""Bounds of the gain, wide enough for any two units."""
_ROUNDS = 60


class Structure(Protocol):
    """What `PairStructure` and `ModalStructure` have in common."""

    @property
    def unit_hz(self) -> float:
        """Unit of frequencies."""

    def response(self, theta: Array, f_hz: Array) -> Complex:
        """Return G at the frequencies, shape (len(f_hz),)."""

    def log_gradient(self, theta: Array, f_hz: Array) -> Complex:
        """Return the derivatives of log G, shape (len(f_hz), len(theta))."""


S = TypeVar("S", bound=Structure)


@dataclass(frozen=True, slots=True, eq=False)
class ResponseCandidate(Generic[S]):
    """Parameters [log gain, delay (unit 1/(2 pi unit_hz)), theta ...] of a structure."""

    structure: S
    vector: Array
    nrmse: float = np.inf
    cost: float = np.inf

    @property
    def theta(self) -> Array:
        """Parameters of the plant."""
        return self.vector[2:]

    @property
    def delay_s(self) -> float:
        """Delay of the recording."""
        return float(self.vector[1] / (2 * np.pi * self.structure.unit_hz))

    def model(self, f_hz: Array) -> Complex:
        """Return the response that would be measured, shape (len(f_hz),)."""
        nuisance = np.exp(self.vector[0] - 1j * f_hz / self.structure.unit_hz * self.vector[1])
        return np.asarray(nuisance * self.structure.response(self.theta, f_hz))

    def gradient(self, f_hz: Array) -> Complex:
        """Return the derivatives of the model, shape (len(f_hz), len(vector))."""
        delay = -1j * f_hz / self.structure.unit_hz
        logs = [np.ones(len(f_hz)), delay, self.structure.log_gradient(self.theta, f_hz)]
        return np.asarray(self.model(f_hz)[:, None] * np.column_stack(logs))


def with_gain(
    data: ResponseData, structure: S, theta: Array, delay_s: float
) -> ResponseCandidate[S]:
    """Put gain (by least squares) and delay in front of the parameters of the plant."""
    raw = ResponseCandidate(
        structure, np.concatenate([[0.0, delay_s * 2 * np.pi * data.unit_hz], theta])
    )
    shape = data.weight * raw.model(data.f_hz)
    gain = float(np.vdot(shape, data.weight * data.response).real / np.vdot(shape, shape).real)
    raw.vector[0] = np.log(max(gain, GAIN[0]))
    return raw


def judged(data: ResponseData, candidate: ResponseCandidate[S]) -> ResponseCandidate[S]:
    """Return the candidate with its residual.

    Candidates are ranked by the modulus of the error, which no phase of reference changes; the fit
    softens real and imaginary part one by one (`least_error`), as scipy does.
    """
    error = candidate.model(data.f_hz) - data.response
    soft = np.sqrt(1 + np.abs(data.weight * error) ** 2) - 1
    nrmse = float(np.linalg.norm(error) / np.linalg.norm(data.response))
    return replace(candidate, nrmse=nrmse, cost=float(soft.sum()))


def least_error(
    data: ResponseData, start: ResponseCandidate[S], low: Array, high: Array, span: float
) -> ResponseCandidate[S]:
    """Minimise the weighted error, outliers softened.

    Parameters
    ----------
    low, high : ndarray, shape (len(theta),)
        Bounds of the plant's parameters.
    span : float
        Largest delay of the recording, in the unit of the vector.
    """
    f = data.f_hz
    low = np.append([np.log(GAIN[0]), -span], low)
    high = np.append([np.log(GAIN[1]), span], high)

    def residual(vector: Array) -> Array:
        error = data.weight * (replace(start, vector=vector).model(f) - data.response)
        return np.concatenate([error.real, error.imag])

    def jacobian(vector: Array) -> Array:
        slope = data.weight[:, None] * replace(start, vector=vector).gradient(f)
        return np.concatenate([slope.real, slope.imag])

    margin = np.minimum(1e-6, 0.25 * (high - low))
    inside = np.clip(start.vector, low + margin, high - margin)
    solution = least_squares(
        residual, inside, jacobian, (low, high), loss="soft_l1", x_scale="jac", max_nfev=_ROUNDS
    )
    return judged(data, replace(start, vector=np.asarray(solution.x, np.float64)))


def delay_span(data: ResponseData, earlier_s: float) -> float:
    """Return the largest delay to allow, in the unit of the vector."""
    return float(2 * np.pi * data.unit_hz * (abs(data.delay_s) + 1.5 * earlier_s))
