"""What a job found, in figures measured on the written file."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict

__all__ = [
    "AxisSpectrum",
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
    # The texts below the fields are the descriptions of the published schema.
    model_config = ConfigDict(extra="forbid", use_attribute_docstrings=True)


class ErrorFigures(_Figures):
    """Error of the nozzle against the planned path, in micrometres."""

    contour_rms_um: float
    """Distance to the planned path, root mean square over time [um]."""
    contour_max_um: float
    """Distance to the planned path, largest [um]."""
    tracking_rms_um: float
    """Distance to where the nozzle was planned to be at that moment, root mean square [um]."""
    tracking_max_um: float
    """Distance to where the nozzle was planned to be at that moment, largest [um]."""


class Channel(_Figures):
    """One way to drive the machine: as the file came, compensated, or with the best shaper."""

    name: str
    """`before`, `after` or `shaper`."""
    label: str
    """The same for a person."""
    extruding: ErrorFigures
    """While something is extruded [um]."""
    all_motion: ErrorFigures
    """Over all motion, travel included [um]."""
    residual_rms_um: float
    """Vibration in the 0.1 s after each rest begins, root mean square [um]."""


class GroupFigures(_Figures):
    """Contour error while extruding, for one layer or feature, by channel name."""

    name: str
    """Number of the layer from 0, or the slicer's name of the feature."""
    seconds: float
    """Time in which it is extruded [s]."""
    contour_rms_um: dict[str, float]
    """Root mean square [um] by channel."""
    contour_max_um: dict[str, float] = {}
    """Largest [um] by channel."""


class PutBack(_Figures):
    """A piece of the file that left as it came."""

    line_first: int
    """First line in the original file, counted from 1."""
    line_last: int
    """Last line in the original file."""
    seconds: float
    """How long it lasts [s]."""
    extruding_seconds: float
    """How much of that it extrudes [s]."""
    reason: str
    """Why, for a person."""


class Track(_Figures):
    """Error along the print, one value per bin of time."""

    bin_s: float
    """Width of a bin [s]; the first begins at 0. Stands longer than 2 s count as 2 s."""
    contour_rms_um: dict[str, list[float]]
    """Contour error, root mean square [um], by channel."""


class AxisSpectrum(_Figures):
    """Spectrum of the nozzle's error along one axis while it prints."""

    axis: str
    """`x` or `y`."""
    f_hz: list[float]
    """Frequencies [Hz], rising evenly."""
    um_per_sqrt_hz: dict[str, list[float]]
    """Amplitude spectral density of position minus planned position [um/sqrt(Hz)], one-sided, at
    each of `f_hz`, by channel. Its square adds up over frequency to the mean square."""
    resonances_hz: list[float]
    """Resonances of the axis' model [Hz], rising."""


class LayerView(_Figures):
    """Path of one layer, thinned for display; layers.bin holds the whole."""

    layer: int
    """Number of the layer, from 0."""
    z_mm: float
    """Height [mm]."""
    x_mm: list[float]
    """Corners of the path, machine axes [mm]."""
    y_mm: list[float]
    """Corners of the path, machine axes [mm]."""
    extruding: list[bool]
    """Whether the stretch that ends at the corner extrudes."""
    line: list[int]
    """Line of the original file, counted from 1."""
    contour_um: dict[str, list[float]]
    """Largest contour error of the stretch that ends at the corner [um], by channel."""


class StageTime(_Figures):
    """CPU seconds that one stage of the road took."""

    stage: str
    """Name of the stage."""
    cpu_s: float
    """CPU time [s]."""


class Result(_Figures):
    """Report of one job; `service.reports` turns it into HTML, the API returns it as JSON."""

    version: str
    """Version of Stillpath."""
    machine: str
    """Name of the machine."""
    machine_title: str
    """The machine's name for a person."""
    machine_revision: str
    """Digest of the machine's document: the same digest, the same model."""
    settings: dict[str, str | float]
    """Options of the job by name; `method` is always there."""
    source_name: str
    """Name of the file."""
    channels: list[Channel]
    """Figures of the whole print."""
    best_shaper: str
    """The best-tuned firmware shaper of this machine, with its frequencies [Hz]."""
    original_time_s: float
    """How long the file as it came takes, by the firmware's rules [s]."""
    time_s: float
    """How long the written file takes [s]."""
    slicer: str = ""
    """The program that made the file, where it says so."""
    slicer_time_s: float | None = None
    """The slicer's own estimate for the file as it came, where it has one [s]."""
    original_bytes: int
    """Size of the file as it came [bytes]."""
    written_bytes: int
    """Size of the written file [bytes]."""
    segments: int
    """Straight segments written for what was compensated."""
    segments_per_s: float
    """The same per second of compensated print [1/s]."""
    peak_segments_per_s: float
    """The most in any second [1/s]."""
    peak_velocity_mm_s: float
    """Highest speed of the command [mm/s]."""
    peak_accel_mm_s2: float
    """Highest acceleration of the command [mm/s^2]."""
    emission_rms_um: float
    """Written motion against computed command, root mean square [um]."""
    emission_max_um: float
    """Written motion against computed command, largest [um]."""
    filament_error_mm: float
    """Filament of a piece against the original's, largest [mm]."""
    compensated_s: float
    """Time of the pieces that are compensated [s]."""
    extruding_s: float
    """Time in which something is extruded [s]."""
    pieces: int
    """Pieces that the file was cut into."""
    put_back: list[PutBack]
    """Those that left as they came, in order."""
    put_back_extruding_share: float
    """Their share of the extruding time, 0 to 1."""
    warnings: list[str]
    """What asks for attention, for a person."""
    notes: list[str] = []
    """What is worth knowing and no trouble, for instance how plants followed a schedule."""
    layers: list[GroupFigures]
    """Figures by layer, in order."""
    features: list[GroupFigures]
    """Figures by feature."""
    track: Track
    """Error along the print."""
    spectra: list[AxisSpectrum] = []
    """Spectra of the error along x and y; none where nothing is printed for a second."""
    layer_views: list[LayerView]
    """Some layers to draw."""
    stages: list[StageTime]
    """CPU time by stage."""
