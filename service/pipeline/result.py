"""What a job found, in figures measured on the written file."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict

__all__ = [
    "Channel",
    "ErrorFigures",
    "GroupFigures",
    "LayerView",
    "PutBack",
    "Result",
    "StageTime",
    "Track",
]


class _Figures(BaseModel):
    model_config = ConfigDict(extra="forbid")


class ErrorFigures(_Figures):
    """Error of the nozzle against the planned path, in micrometres."""

    contour_rms_um: float
    contour_max_um: float
    tracking_rms_um: float
    tracking_max_um: float


class Channel(_Figures):
    """One way to drive the machine: as the file came, compensated, or with the best shaper."""

    name: str
    """`before`, `after` or `shaper`."""
    label: str
    extruding: ErrorFigures
    all_motion: ErrorFigures
    residual_rms_um: float
    """Vibration in the 0.1 s after each rest begins."""


class GroupFigures(_Figures):
    """Contour error while extruding, for one layer or feature, by channel name."""

    name: str
    seconds: float
    contour_rms_um: dict[str, float]
    contour_max_um: dict[str, float] = {}


class PutBack(_Figures):
    """A piece of the file that left as it came."""

    line_first: int
    line_last: int
    seconds: float
    extruding_seconds: float
    reason: str


class Track(_Figures):
    """Error along the print, one row per bin of time: rms contour error by channel name."""

    bin_s: float
    contour_rms_um: dict[str, list[float]]


class LayerView(_Figures):
    """Decimated path of one layer with the contour error of each channel at each vertex."""

    layer: int
    z_mm: float
    x_mm: list[float]
    y_mm: list[float]
    extruding: list[bool]
    line: list[int]
    contour_um: dict[str, list[float]]


class StageTime(_Figures):
    """CPU seconds that one stage of the road took."""

    stage: str
    cpu_s: float


class Result(_Figures):
    """Report of one job; `service.reports` turns it into HTML, the API returns it as JSON."""

    version: str
    machine: str
    machine_title: str
    machine_revision: str
    settings: dict[str, str | float]
    source_name: str
    channels: list[Channel]
    best_shaper: str
    original_time_s: float
    time_s: float
    slicer: str = ""
    slicer_time_s: float | None = None
    """The slicer's own estimate for the file as it came, where it has one."""
    original_bytes: int
    written_bytes: int
    segments: int
    segments_per_s: float
    peak_segments_per_s: float
    peak_velocity_mm_s: float
    peak_accel_mm_s2: float
    emission_rms_um: float
    emission_max_um: float
    filament_error_mm: float
    compensated_s: float
    extruding_s: float
    pieces: int
    put_back: list[PutBack]
    put_back_extruding_share: float
    warnings: list[str]
    notes: list[str] = []
    """What is worth knowing and no trouble, for instance how plants followed a schedule."""
    layers: list[GroupFigures]
    features: list[GroupFigures]
    track: Track
    layer_views: list[LayerView]
    stages: list[StageTime]
