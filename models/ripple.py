"""Ripple: errors that repeat with the position of an axis, not with time.

A belt's teeth, a pulley's eccentricity and a motor's poles shift an axis by a periodic function of
where it stands. With s the commanded position of the axis after homing,

    delta(s) = sum_h a_h sin(2 pi h s / p + phi_h),    p the pitch,

and it enters the motion in one of two places (reference: repetitive compensation of print files,
finding (i)):

``input``
    before the machine vibrates: y = G (u + delta(u)). Belt tooth, leadscrew, motor pole.
``output``
    as a deviation of the tool itself: y = G u + d(s). A crooked rail, a measured map.

Phases are absolute: they count from the machine's zero after homing, and a machine that homes
elsewhere the next time has another ripple (`RippleTable.residual_share`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, model_validator

from stillpath.models.arrays import Array, Complex
from stillpath.models.document import Document, Finite, NonNegative
from stillpath.models.errors import ModelError

__all__ = [
    "AxisRipple",
    "MachineRipple",
    "RippleAxis",
    "RippleHarmonic",
    "RippleSide",
    "RippleSource",
    "RippleTable",
]

RippleSide = Literal["input", "output"]
RippleAxis = Literal["x", "y", "a", "b"]
"""X and Y, and the motors of CoreXY: a (x + y) and b (x - y)."""


_STEEPEST = 0.5
"""Largest slope |d delta / d s|: beyond 1 the motor would have to turn back to move on."""
_LARGEST_UM = 5000.0


class RippleHarmonic(Document):
    """amplitude_um sin(2 pi number s / pitch + phase_deg), s from the machine's zero."""

    number: Annotated[int, Field(ge=1, le=400)]
    amplitude_um: NonNegative
    phase_deg: Finite
    sd_um: NonNegative | None = None
    """Standard deviation of the amplitude, if it was measured."""


class RippleSource(Document):
    """One periodic part of the drive.

    Attributes
    ----------
    name : str
        What it is: "belt", "pulley", "motor pole".
    pitch_mm : float
        Travel of the axis after which it repeats.
    enters : str
        ``input`` or ``output``.
    """

    name: Annotated[str, Field(min_length=1, max_length=64)]
    pitch_mm: Annotated[float, Field(gt=1e-3, le=2000, allow_inf_nan=False)]
    enters: RippleSide = "input"
    harmonics: Annotated[tuple[RippleHarmonic, ...], Field(min_length=1, max_length=64)]

    @model_validator(mode="after")
    def _each_once(self) -> RippleSource:
        numbers = [harmonic.number for harmonic in self.harmonics]
        if len(set(numbers)) < len(numbers):
            raise ValueError(f"ripple {self.name!r}: a harmonic is listed twice in {numbers}")
        return self


class AxisRipple(Document):
    """Ripple of one axis.

    Attributes
    ----------
    homing_repeatability_mm : float
        How far apart two homings leave the machine's zero; the phases are off by as much.
    """

    sources: Annotated[tuple[RippleSource, ...], Field(min_length=1, max_length=16)]
    homing_repeatability_mm: NonNegative = 0.0

    @model_validator(mode="after")
    def _gentle(self) -> AxisRipple:
        slope = self.table("input").steepest
        if slope > _STEEPEST:
            raise ValueError(
                f"the input ripple has a slope of up to {slope:.2g} mm per mm, more than "
                f"{_STEEPEST}: check amplitude_um (micrometres) and pitch_mm (millimetres)"
            )
        largest_um = max(h.amplitude_um for source in self.sources for h in source.harmonics)
        if largest_um > _LARGEST_UM:
            raise ValueError(
                f"amplitude_um is {largest_um:g}, at most {_LARGEST_UM:g} is a ripple: it is in "
                "micrometres"
            )
        return self

    def table(self, side: RippleSide) -> RippleTable:
        """Return the waves of all sources that enter at `side`; there may be none."""
        return RippleTable.of(source for source in self.sources if source.enters == side)


@dataclass(frozen=True, slots=True, eq=False)
class RippleTable:
    """Waves along an axis: sum of Im(coefficient exp(j wavenumber s)).

    Attributes
    ----------
    wavenumber : ndarray, shape (m,)
        2 pi h / pitch, rad/mm.
    coefficient_mm : ndarray of complex128, shape (m,)
        a_h exp(j phi_h).
    """

    wavenumber: Array
    coefficient_mm: Complex

    @classmethod
    def of(cls, sources: Iterable[RippleSource]) -> RippleTable:
        """Collect the harmonics of `sources`."""
        waves = [(source.pitch_mm, h) for source in sources for h in source.harmonics]
        return cls(
            np.array([2 * math.pi * h.number / pitch for pitch, h in waves], np.float64),
            np.array(
                [1e-3 * h.amplitude_um * np.exp(1j * math.radians(h.phase_deg)) for _, h in waves],
                np.complex128,
            ),
        )

    def __len__(self) -> int:
        return len(self.wavenumber)

    @property
    def steepest(self) -> float:
        """Bound of |d delta / d s|."""
        return float(self.wavenumber @ np.abs(self.coefficient_mm))

    def deviation_mm(self, position_mm: ArrayLike, weight: Array | None = None) -> Array:
        """Return delta at the positions, shape (n,).

        Parameters
        ----------
        position_mm : array_like, shape (n,)
        weight : ndarray, shape (m, n), optional
            Share of every wave at every position; default: all of it.
        """
        s = np.asarray(position_mm, np.float64)
        out = np.zeros_like(s)
        for k, (number, c) in enumerate(zip(self.wavenumber, self.coefficient_mm, strict=True)):
            wave = abs(c) * np.sin(number * s + np.angle(c))
            out += wave if weight is None else weight[k] * wave
        return out

    def slope(self, position_mm: ArrayLike, weight: Array | None = None) -> Array:
        """Return d delta / d s at the positions, shape (n,); see `deviation_mm`."""
        rates = self.wavenumber * self.coefficient_mm * 1j
        return RippleTable(self.wavenumber, rates).deviation_mm(position_mm, weight)

    def residual_share(self, offset_mm: float) -> float:
        """Return what compensation leaves if the table lies `offset_mm` beside the ripple.

        rms of delta(s + offset) - delta(s) over that of delta: 2 sin(k offset / 2) for one wave.
        Above 1 the compensation does harm.
        """
        power = np.abs(self.coefficient_mm) ** 2
        if power.sum() == 0.0:
            return 0.0
        left = 4 * np.sin(0.5 * self.wavenumber * offset_mm) ** 2
        return math.sqrt(float(power @ left / power.sum()))


class MachineRipple:
    """Ripple of a whole machine: at its motors on the input side, at X and Y on the output side.

    Parameters
    ----------
    kinematics : str
        Of the machine; ``corexy`` has motors a and b, all others x and y.
    ripple : mapping of str to AxisRipple

    Attributes
    ----------
    motors : tuple of str
        Their names.
    to_motors : ndarray, shape (2, 2)
        Motor positions from X and Y.
    inputs, outputs : tuple of RippleTable
        Of both motors, of X and Y; may be empty tables.

    Raises
    ------
    ModelError
        If ripple is given for an axis where it cannot enter.
    """

    def __init__(self, kinematics: str, ripple: Mapping[RippleAxis, AxisRipple]) -> None:
        corexy = kinematics == "corexy"
        self.motors: tuple[RippleAxis, RippleAxis] = ("a", "b") if corexy else ("x", "y")
        self.to_motors = np.array([[1.0, 1.0], [1.0, -1.0]]) if corexy else np.eye(2)
        fitting: dict[RippleSide, tuple[RippleAxis, RippleAxis]] = {
            "input": self.motors,
            "output": ("x", "y"),
        }
        for axis, of_axis in ripple.items():
            for side, names in fitting.items():
                if len(of_axis.table(side)) and axis not in names:
                    raise ModelError(
                        f"axis {axis}: {side} ripple of a {kinematics} machine belongs to "
                        f"{' or '.join(names)}"
                    )
        self.inputs = tuple(_table(ripple, name, "input") for name in self.motors)
        self.outputs = tuple(_table(ripple, name, "output") for name in fitting["output"])

    def received_mm(self, command_mm: Array) -> Array:
        """Return what X and Y receive of a command, both of shape (2, n)."""
        if not any(len(table) for table in self.inputs):
            return command_mm
        motors = self.to_motors @ command_mm
        shifts = [t.deviation_mm(row) for t, row in zip(self.inputs, motors, strict=True)]
        return np.asarray(command_mm + np.linalg.solve(self.to_motors, np.stack(shifts)))

    def added_mm(self, path_mm: Array) -> Array:
        """Return the deviation of the tool along a path, both of shape (2, n)."""
        rows = zip(self.outputs, path_mm, strict=True)
        return np.stack([table.deviation_mm(row) for table, row in rows])


def _table(
    ripple: Mapping[RippleAxis, AxisRipple], axis: RippleAxis, side: RippleSide
) -> RippleTable:
    return ripple[axis].table(side) if axis in ripple else RippleTable.of(())
