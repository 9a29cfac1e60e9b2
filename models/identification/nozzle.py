"""The motion of the nozzle relative to the bed, from what a sensor measures against the ground.

The moving mass excites the frame on its feet: the frame's motion is -R times the measured one,

    R(s) = mu s^2 / (s^2 + 2 z w s + w^2),

mu the ratio of moving to frame mass, w and z those of the frame on its feet. With P the response of
the axis on a fixed frame, as modes damped by relative speed (`modal_structure`), the sensor
measures H = P / (1 + R P), and the nozzle moves by G = (1 + R) H over the bed. P and R are fitted
together, and the measured response is multiplied by 1 + R. This does not delay slow motion, and
later fits need not tell the frame from a mode.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import find_peaks

from stillpath.models.arrays import Array, Complex
from stillpath.models.identification.averaging import mean_response
from stillpath.models.identification.last_kept import last_kept
from stillpath.models.identification.modal_fit import of_poles
from stillpath.models.identification.modal_structure import ModalStructure
from stillpath.models.identification.response_data import ResponseData, response_data
from stillpath.models.identification.types import FrequencyResponse

__all__ = ["Frame", "frame_of"]

_POINTS = 160
_STARTS_HZ = (9.0, 13.0, 18.0, 25.0)
_START = (0.15, 0.08)
"""Start values: damping of the feet, mass ratio."""
_F_HZ, _ZETA, _MU = (6.0, 35.0), (0.03, 0.5), (0.0, 0.5)
_ZETA_SPREAD = 0.4
"""Prior standard deviation of log damping of the feet: a response may hardly show it."""
_MODES_ZETA, _MODES_SHARE, _MODES_BAND = (5e-3, 0.8), (-2.0, 2.5), (0.9, 1.6)
_LATE_S = 10e-3
_MODES_START, _BEYOND, _PROMINENCE = 0.06, 1.3, 0.2
_BELOW = 0.8
"""Highest frequency of a frame, relative to the main mode."""
_ALONE, _TAKES_PART = 0.6, 0.25
"""Below this share of the main mode's frequency there is the frame, and what shakes weakly: a mode
of the axis with so large a share would undo the frame."""
_LEAST_MU, _CLEARLY = 0.01, 0.9
"""A frame exists from this mass ratio on, if it brings the residual below the second share."""


@dataclass(frozen=True, slots=True)
class Frame:
    """A frame on its feet.

    Attributes
    ----------
    f_hz, zeta : float
        Of the frame on its feet, with the axes fixed.
    mass_ratio : float
        Ratio of the moving mass to the frame's.
    level : float
        Ratio of measured to commanded motion at low frequency.
    """

    f_hz: float
    zeta: float
    mass_ratio: float
    level: float = 1.0

    def reaction(self, f_hz: Array) -> Complex:
        """Return R at the frequencies, shape (len(f_hz),)."""
        s = 1j * f_hz / self.f_hz
        return np.asarray(self.mass_ratio * s * s / (s * s + 2 * self.zeta * s + 1))

    def reaction_gradient(self, f_hz: Array) -> Complex:
        """Return dR by log f, log zeta and the mass ratio, shape (len(f_hz), 3)."""
        s = 1j * f_hz / self.f_hz
        unit = s * s / (s * s + 2 * self.zeta * s + 1)
        slope = -2 * self.mass_ratio * unit * unit
        return np.stack(
            [slope * (self.zeta * s + 1) / (s * s), slope * self.zeta / s, unit], axis=1
        )

    def over_bed(self, measured: FrequencyResponse) -> FrequencyResponse:
        """Return the response of the nozzle over the bed."""
        more = 1 + self.reaction(measured.f_hz)
        return replace(measured, response=measured.response * more, sd=measured.sd * np.abs(more))


def frame_of(
    measured: FrequencyResponse | Sequence[FrequencyResponse], near: Frame | None = None
) -> Frame | None:
    """Return the frame that a response shows; None if there is none that is clear.

    Parameters
    ----------
    measured : FrequencyResponse or sequence of them
        Several are averaged first.
    near : Frame, optional
        What the response showed before friction was removed from it: look for this one again.
    """
    single = measured if isinstance(measured, FrequencyResponse) else mean_response(measured)
    data = response_data(single).thinned(_POINTS)
    held = _start(data)
    starts = [Frame(f_hz, *_START) for f_hz in _STARTS_HZ] if near is None else [near]
    tried = [_polished(data, held.on_its_feet(frame)) for frame in starts]
    main_hz = float(data.f_hz[np.argmax(np.abs(data.response))])
    possible = [one for one in tried if one.lowest_hz >= _ALONE * main_hz]
    if not possible:
        return None
    found = min(possible, key=lambda one: one.cost)
    frame = found.frame
    if frame is None or frame.mass_ratio <= _LEAST_MU or frame.f_hz >= _BELOW * main_hz:
        return None
    firm = _polished(data, held)
    return frame if found.cost < _CLEARLY**2 * firm.cost else None


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """Parameters [log gain, delay (s), (log f, log zeta, mu of the frame), modes ...]."""

    vector: Array
    structure: ModalStructure
    shaken: bool
    cost: float = np.inf

    @property
    def frame(self) -> Frame | None:
        if not self.shaken:
            return None
        (f, zeta), mu = np.exp(self.vector[2:4]), self.vector[4]
        return Frame(float(f), float(zeta), float(mu), float(np.exp(self.vector[0])))

    @property
    def lowest_hz(self) -> float:
        """Lowest frequency of the axis's modes that take part in the motion."""
        f, _, share = self.structure.split(self.vector[5 if self.shaken else 2 :])
        return float(f[np.abs(share) >= _TAKES_PART].min()) * self.structure.unit_hz

    def on_its_feet(self, frame: Frame) -> _Found:
        """Return the same with this frame."""
        shaking = [np.log(frame.f_hz), np.log(frame.zeta), frame.mass_ratio]
        vector = np.concatenate([self.vector[:2], shaking, self.vector[2:]])
        return replace(self, vector=vector, shaken=True)

    def model_and_gradient(self, f_hz: Array) -> tuple[Complex, Complex]:
        """Return the response, shape (len(f_hz),), and its derivatives, (len(f_hz), parameters)."""
        late = np.exp(self.vector[0] - 2j * np.pi * f_hz * self.vector[1])
        frame, first = self.frame, 5 if self.shaken else 2
        felt, gradient = self.structure.response_and_gradient(self.vector[first:], f_hz)
        if frame is not None:
            held, part = felt, 1 / (1 + frame.reaction(f_hz) * felt)
            felt = held * part
            by_frame = -frame.reaction_gradient(f_hz) * (felt * felt)[:, None]
            gradient = np.concatenate([by_frame, gradient * (part * part)[:, None]], axis=1)
        by_level = np.stack([felt, -2j * np.pi * f_hz * felt], axis=1)
        return late * felt, late[:, None] * np.concatenate([by_level, gradient], axis=1)


def _start(data: ResponseData) -> _Found:
    """Start from the highest peak, the next one above it, and a mode beyond the band.

    The frame is held.
    """
    size, top_hz = np.abs(data.response), float(data.f_hz[-1])
    main = int(np.argmax(size))
    peaks = find_peaks(np.log(size), prominence=_PROMINENCE)[0]
    others = [i for i in peaks if i != main and data.f_hz[i] > _BELOW * data.f_hz[main]]
    main_hz = float(data.f_hz[main])
    next_hz = float(data.f_hz[max(others, key=lambda i: size[i])]) if others else 0.0
    poles_hz = [main_hz, next_hz or math.sqrt(main_hz * top_hz), _BEYOND * top_hz]
    known = of_poles(data, [(float(f_hz), _MODES_START) for f_hz in poles_hz])
    structure = ModalStructure(len(poles_hz), data.unit_hz)
    if known is None:
        share = np.eye(len(poles_hz))[0]
        theta = structure.parameters(np.array(poles_hz), np.full(len(share), _MODES_START), share)
        level, delay_s = float(np.log(np.median(size[:9]))), data.delay_s
    else:
        # The last of its parameters is what acts against the frame.
        theta, level, delay_s = known.theta[:-1], float(known.vector[0]), known.delay_s
    return _Found(np.concatenate([[level, delay_s], theta]), structure, shaken=False)


def _polished(data: ResponseData, start: _Found) -> _Found:
    band_hz = (_MODES_BAND[0] * float(data.f_hz[0]), _MODES_BAND[1] * float(data.f_hz[-1]))
    low, high = start.structure.bounds(band_hz, _MODES_ZETA, _MODES_SHARE)
    frame = np.array([np.log(_F_HZ), np.log(_ZETA), _MU]) if start.shaken else np.zeros((0, 2))
    level, late_s = start.vector[:2]
    ends = np.array([[level - 1.0, level + 1.0], [late_s - _LATE_S, late_s + _LATE_S]])
    low = np.concatenate([ends[:, 0], frame[:, 0], low])
    high = np.concatenate([ends[:, 1], frame[:, 1], high])

    @last_kept
    def known(vector: Array) -> tuple[Complex, Complex]:
        return replace(start, vector=vector).model_and_gradient(data.f_hz)

    def residual(vector: Array) -> Array:
        error = known(vector)[0] - data.response
        unusual = (vector[3:4] - np.log(_START[0])) / _ZETA_SPREAD if start.shaken else vector[:0]
        return np.concatenate([data.weight * error.real, data.weight * error.imag, unusual])

    def jacobian(vector: Array) -> Array:
        slope = data.weight[:, None] * known(vector)[1]
        unusual = np.eye(len(vector))[3:4] / _ZETA_SPREAD if start.shaken else slope.real[:0]
        return np.concatenate([slope.real, slope.imag, unusual])

    margin = 1e-6 * (high - low)
    inside = np.clip(start.vector, low + margin, high - margin)
    solution = least_squares(
        residual, inside, jacobian, (low, high), loss="soft_l1", x_scale="jac", max_nfev=80
    )
    return replace(start, vector=np.asarray(solution.x, np.float64), cost=float(solution.cost))
