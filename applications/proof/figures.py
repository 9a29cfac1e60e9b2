"""Figures of a log that was read back."""

from __future__ import annotations

from stillpath.models.document import Document

__all__ = ["AxisReadback", "Corners", "Curve", "ReadbackReport"]


class Curve(Document):
    """A curve of the page."""

    x: list[float]
    measured: list[float]
    predicted: list[float]
    fitted: list[float]


class Corners(Document):
    """Vibration near the mode, 20 to 120 ms after the command has slowed down: rms."""

    count: int
    measured_mm_s2: float
    predicted_mm_s2: float
    measured_um: float
    predicted_um: float


class AxisReadback(Document):
    """One axis.

    `nrmse` is the rms of measured minus predicted acceleration over that of the measured one, 5 to
    200 Hz, `nrmse_fitted` the same with the frequency, damping and gain found here.
    """

    axis: str
    model_hz: float
    model_zeta: float
    f_hz: float
    f_sd_hz: float
    zeta: float
    zeta_sd: float
    gain: float
    correlation: float
    nrmse: float
    nrmse_fitted: float
    corners: Corners
    spectrum: Curve
    excerpt: Curve
    verdict: str
    holds: bool


class ReadbackReport(Document):
    """What `stillpath verify` found.

    `outcome`: the model holds, the machine has changed, the shaper is not known, or another print.
    """

    version: str
    machine: str
    machine_title: str
    machine_revision: str
    printed: str
    log: str
    outcome: str
    verdicts: list[str]
    notes: list[str]
    explained: float
    log_s: float
    compared_s: float
    plan_start_s: float
    clock_ppm: float
    sensor: list[list[float]]
    """Rows: directions of the machine's X and Y in the sensor's axes."""
    axes: list[AxisReadback]
