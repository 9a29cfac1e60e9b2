"""Frequency responses of a machine's plants, thinned for display."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from stillpath.applications.machines.resonances import resonances
from stillpath.models.document import Document
from stillpath.models.machine import Machine
from stillpath.models.plants import PlantSetSpec, PlantSpec, frequency_response
from stillpath.models.provenance import MeasuredMode

__all__ = ["AxisResponse", "ModelCurve", "axis_responses"]

_POINTS = 320
_MEMBERS_SHOWN = 15
_DIGITS = 5
_FIRST_HZ, _LEAST_HZ, _BEYOND = 1.0, 100.0, 1.25


class ModelCurve(Document):
    """A model over frequency: modulus, and phase in degrees."""

    f_hz: tuple[float, ...]
    magnitude: tuple[float, ...]
    phase_deg: tuple[float, ...]


class AxisResponse(BaseModel):
    """The plants of one axis, from commanded to actual position, over frequency."""

    model_config = ConfigDict(frozen=True)

    axis: Literal["x", "y"]
    band_hz: tuple[float, float] | None = Field(
        description="Where the model was measured [Hz]; it is a guess outside."
    )
    modes: tuple[MeasuredMode, ...] = Field(
        description="Resonances, with standard deviations where they were measured."
    )
    nominal: ModelCurve
    members: tuple[ModelCurve, ...] = Field(
        description="Plants that the axis may turn into, at most 15 of them."
    )


def axis_responses(machine: Machine) -> list[AxisResponse]:
    """Return the responses of both axes.

    Raises
    ------
    ModelError
        If a plant has no response at a frequency that is shown.
    """
    return [_axis("x", machine.axes["x"]), _axis("y", machine.axes["y"])]


def _axis(axis: Literal["x", "y"], plants: PlantSetSpec) -> AxisResponse:
    found = resonances(plants.nominal)
    measured = plants.provenance.modes if plants.provenance is not None else ()
    modes = measured or tuple(MeasuredMode(f_hz=_short(f), zeta=_short(zeta)) for f, zeta in found)
    band_top = plants.band_hz[1] if plants.band_hz is not None else 0.0
    top_hz = _BEYOND * max(_LEAST_HZ, band_top, *(f for f, _ in found))
    if plants.nominal.sampling_s is not None:
        top_hz = min(top_hz, 0.5 / plants.nominal.sampling_s)
    f_hz = np.linspace(_FIRST_HZ, top_hz, _POINTS)
    members = plants.weighted_members() if plants.members else ()
    step = -(-len(members) // _MEMBERS_SHOWN) if members else 1
    return AxisResponse(
        axis=axis,
        band_hz=plants.band_hz,
        modes=modes,
        nominal=_curve(plants.nominal, f_hz),
        members=tuple(_curve(m.plant, f_hz) for m in members[::step]),
    )


def _curve(plant: PlantSpec, f_hz: NDArray[np.float64]) -> ModelCurve:
    response = frequency_response(plant, f_hz)
    phase = np.degrees(np.unwrap(np.angle(response)))
    return ModelCurve(
        f_hz=_plain(f_hz), magnitude=_plain(np.abs(response)), phase_deg=_plain(phase)
    )


def _plain(values: NDArray[np.float64]) -> tuple[float, ...]:
    return tuple(_short(float(v)) for v in values)


def _short(value: float) -> float:
    return float(f"{value:.{_DIGITS}g}")
