"""The figures of an identification: what identification.json holds and the page draws.

Nothing here is computed; every list is plain, so that the document is the same in any language.
"""

from __future__ import annotations

from typing import Literal

from stillpath.applications.machines.frequency import ModelCurve
from stillpath.models.document import Document
from stillpath.models.provenance import MeasuredMode, SourceFile

__all__ = [
    "AxisFigures",
    "IdentificationReport",
    "ModelCurve",
    "ResponseFigures",
    "ShaperFigures",
    "SpectrumFigures",
    "TrialFigures",
]


class ResponseFigures(Document):
    """A measured response, the sensor's gain and delay taken out; None: not usable there.

    `residual` is |measured / model - 1|.
    """

    label: str
    f_hz: tuple[float, ...]
    magnitude: tuple[float | None, ...]
    phase_deg: tuple[float | None, ...]
    coherence: tuple[float | None, ...]
    residual: tuple[float | None, ...]


class SpectrumFigures(Document):
    """A measured power spectral density and what the model says it should be, (mm/s^2)^2/Hz."""

    label: str
    f_hz: tuple[float, ...]
    measured: tuple[float, ...]
    predicted: tuple[float, ...]


class TrialFigures(Document):
    """What so many pole pairs reached."""

    order: int
    residual: float


class ShaperFigures(Document):
    """What a firmware shaper would do on this axis, by Klipper's own rules."""

    name: str
    f_hz: float
    vibrations_percent: float
    smoothing_mm: float
    max_accel_mm_s2: float
    recommended: bool


class AxisFigures(Document):
    """One axis.

    Attributes
    ----------
    residual : float, optional
        NRMSE of a response (0.01 is 1 %), rms in dB of a spectrum.
    before : tuple of MeasuredMode
        Modes of the model that was replaced.
    """

    axis: Literal["x", "y"]
    kind: str
    band_hz: tuple[float, float] | None
    trust_below_hz: float | None
    residual: float | None
    delay_ms: float | None
    gain: float | None
    modes: tuple[MeasuredMode, ...]
    peaks: tuple[float, ...]
    before: tuple[MeasuredMode, ...]
    trials: tuple[TrialFigures, ...]
    model: ModelCurve
    members: tuple[ModelCurve, ...]
    responses: tuple[ResponseFigures, ...]
    spectra: tuple[SpectrumFigures, ...]
    shapers: tuple[ShaperFigures, ...]
    notes: tuple[str, ...]
    warnings: tuple[str, ...]


class IdentificationReport(Document):
    """Everything that was found, for one machine."""

    version: str
    machine: str
    machine_title: str
    machine_revision: str
    base_revision: str
    sources: tuple[SourceFile, ...]
    axes: tuple[AxisFigures, ...]
