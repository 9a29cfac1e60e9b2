"""The figures of a controller's design: what `design_controller` returns and the page shows."""

from __future__ import annotations

from typing import Any

from stillpath.models.document import Document

__all__ = [
    "ControllerReport",
    "Envelope",
    "ExtremeFigure",
    "LoopFigures",
    "MemberFigures",
    "PredictorFigures",
    "ResponseFigures",
    "SensitivityCurves",
    "TimeFigures",
]


class ExtremeFigure(Document):
    """The extreme of a curve and where it lies."""

    db: float
    at_hz: float


class SensitivityCurves(Document):
    """Magnitudes over frequency, thinned so that no extreme is lost.

    `s0`, `s`: sensitivity without and with the add-on; `add_on`: |1 - PQ|; `inverse_t`: 1/|T|,
    the relative plant error that small gain allows; `q`: |Q|.
    """

    f_hz: tuple[float, ...]
    s0: tuple[float, ...]
    s: tuple[float, ...]
    add_on: tuple[float, ...]
    inverse_t: tuple[float, ...]
    q: tuple[float, ...]


class Envelope(Document):
    """A signal, thinned to the least and the largest value of every stretch."""

    t_s: tuple[float, ...]
    values: tuple[float, ...]


class ResponseFigures(Document):
    """The machine's output under its disturbance; rms and largest value of the last quarter."""

    rms: float
    peak: float
    whole: Envelope
    end: Envelope


class MemberFigures(Document):
    """A member of the plant set: rms of the last quarter, and its spectral radius with add-on."""

    name: str
    before_rms: float
    after_rms: float
    spectral_radius: float | None


class PredictorFigures(Document):
    """The last samples of the disturbance, what the slow sensor holds of it, and the prediction."""

    t_s: tuple[float, ...]
    true: tuple[float, ...]
    held: tuple[float, ...]
    predicted: tuple[float, ...]
    error_rms: float


class TimeFigures(Document):
    """Simulation of the nominal loop, without noise."""

    disturbance: str
    enters: str
    duration_s: float
    before: ResponseFigures
    after: ResponseFigures
    members: tuple[MemberFigures, ...]
    predictor: PredictorFigures | None = None


class ControllerReport(Document):
    """All figures of a designed controller; same machine, options and version give the same.

    `controller` is what is loaded: `Controller.to_dict`, with the machine and the options it was
    made of and `every`, the ticks of the controller per sample of the loop.
    """

    version: str
    machine: str
    title: str
    source: str
    unit: str
    method: str
    min_inverse_t: ExtremeFigure
    max_add_on: ExtremeFigure
    noise_gain: float
    multiplications: float
    rate_hz: float
    spectral_radius: float
    uncertainty: float | None
    notes: tuple[str, ...]
    curves: SensitivityCurves
    time: TimeFigures
    controller: dict[str, Any]


class LoopFigures(Document):
    """A closed-loop machine and the methods that fit it."""

    name: str
    title: str
    source: str
    unit: str
    rate_hz: float
    sensor_hz: float
    members: int
    methods: tuple[str, ...]
