"""The result of a job: figures measured on the written file."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict, field_validator

__all__ = [
    "NOTHING_COMPENSATED",
    "AdviceFigures",
    "AdvisedFeature",
    "AdvisedShaper",
    "AxisSpectrum",
    "BudgetClass",
    "BudgetFigures",
    "Channel",
    "ErrorFigures",
    "GroupFigures",
    "LastCheckFigures",
    "LayerView",
    "PrintWay",
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
    """Distance to the planned path, largest [um]; while the nozzle stands after the end of a line
    and rings, 0.1 s at most, it counts for that line."""
    tracking_rms_um: float
    """Distance to where the nozzle was planned to be at that moment, root mean square [um]."""
    tracking_max_um: float
    """Distance to where the nozzle was planned to be at that moment, largest [um]."""


class Channel(_Figures):
    """One way to drive the machine: as sliced, compensated, or with the best shaper."""

    name: str
    """`before`, `after` or `shaper`."""
    label: str
    """The same, for display."""
    extruding: ErrorFigures
    """While something is extruded [um]."""
    contour_range_um: tuple[float, float] | None = None
    """Least and largest contour error while extruding, root mean square, of all plants that explain
    the machine's measurement [um]; null for a machine without such a set."""
    contour_friction_um: float | None = None
    """Part of the upper end of that range, in quadrature: what guides that rub more, less or
    otherwise than they were found to may add [um]; null without a range."""
    contour_rubbing_um: float | None = None
    """Upper end of the range if guides rub with 1.5 N per kg of moving mass, which resonance tables
    do not show [um]; null where friction was measured."""
    selected_rms_um: float | None = None
    """Contour error while extruding, root mean square, of the features that are compensated [um];
    null where all are. The range is theirs then."""
    all_motion: ErrorFigures
    """Over all motion, travel included [um]."""
    residual_rms_um: float
    """Vibration in the 0.1 s after each rest begins, root mean square [um]."""

    @property
    def judged_rms_um(self) -> float:
        """Contour error of what is compensated, root mean square while extruding [um]."""
        selected_um = self.selected_rms_um
        return self.extruding.contour_rms_um if selected_um is None else selected_um


class GroupFigures(_Figures):
    """Contour error while extruding, for one layer or feature, by channel name."""

    name: str
    """Number of the layer from 0, or the slicer's name of the feature."""
    title: str
    """The same, for display."""
    seconds: float
    """Time in which it is extruded [s]."""
    contour_rms_um: dict[str, float]
    """Root mean square [um] by channel."""
    contour_max_um: dict[str, float] = {}
    """Largest [um] by channel."""


class PutBack(_Figures):
    """A piece of the file that was reverted."""

    line_first: int
    """First line in the original file, counted from 1."""
    line_last: int
    """Last line in the original file."""
    seconds: float
    """How long it lasts [s]."""
    extruding_seconds: float
    """How much of that it extrudes [s]."""
    reason: str
    """The reason, as text."""


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
    """CPU seconds that one stage of the pipeline took."""

    stage: str
    """Name of the stage."""
    cpu_s: float
    """CPU time [s]."""


class BudgetClass(_Figures):
    """How quick one class of moves became within a budget, and its error."""

    name: str
    """The slicer's name of the feature, `travel`, or `all that stays as sliced`: the first layer,
    and lines that stay as sliced."""
    title: str
    """The same, for display."""
    acceleration_factor: float
    """Ratio of its accelerations to the file's, before the machine's limits, geometric mean over
    the print; 1: as in the file."""
    shaper_acceleration_factor: float
    """The same with the best firmware shaper at the same budget."""
    contour_rms_um: float
    """Contour error of what it extrudes, root mean square of the worst plant of the machine's set
    [um]; for travel of what is extruded in the 50 ms after one, where it may be two budgets (it
    counts for its feature as well)."""
    seconds: float
    """Time in which that was measured [s]."""


class BudgetFigures(_Figures):
    """What a contour error budget gained."""

    budget_um: float
    """Contour error that every feature may have [um]."""
    saved_share: float
    """Part of the original's print time that is saved; below 0: it takes longer."""
    shaper_time_s: float | None
    """How long the print takes with the best firmware shaper instead, as quick as the same budget
    allows [s]; null where it cannot keep the budget."""
    saved_share_against_shaper: float | None
    """Part of that time that is saved."""
    classes: list[BudgetClass]
    """By class of moves."""

    @property
    def against_sliced(self) -> str:
        """How the time compares with that of the sliced file, in words."""
        return _compared(self.saved_share)

    @property
    def against_shaper(self) -> str:
        """How the time compares with that of the best shaper, in words."""
        return _compared(self.saved_share_against_shaper or 0.0)


def _compared(saved_share: float) -> str:
    percent = f"{100 * abs(saved_share):.1f}"
    if percent == "0.0":
        return "the same as"
    return f"{percent} % {'less' if saved_share > 0 else 'more'} than"


class AdvisedShaper(_Figures):
    """An advised firmware shaper."""

    layer: int
    """First layer; the first shaper holds from the beginning of the file."""
    label: str
    """Type and frequencies, for display."""


class AdvisedFeature(_Figures):
    """Advice for one feature, and its effect."""

    name: str
    """The slicer's name of the feature, or `unnamed`."""
    title: str
    """The same, for display."""
    accel_mm_s2: float | None
    """Acceleration [mm/s^2]; null: as the file has it."""
    exact: bool
    """Whether it is exactly this, as for walls, or only where the file has less."""
    bound_um: float | None
    """Contour error that it may have, root mean square of the worst plant of the machine's set
    [um]; null where the file's accelerations are kept whatever they do."""
    within_bound: bool
    """Whether it keeps the bound."""
    before_um: float
    """Contour error as sliced, root mean square of the worst plant of the machine's set [um]."""
    after_um: float
    """The same of the advised file [um]."""
    before_s: float
    """Time in which it is extruded as sliced [s]."""
    after_s: float
    """The same of the advised file [s]."""


class AdviceFigures(_Figures):
    """Advice for a file: firmware commands inserted into it."""

    before_shaper: str
    """The firmware's shaper before the file's first line, as the machine states it."""
    shapers: list[AdvisedShaper]
    """Those that the file sets now; empty: it leaves the firmware's."""
    features: list[AdvisedFeature]
    """By feature."""
    lines: int
    """Number of lines added."""


class LastCheckFigures(_Figures):
    """How the written file was compared with the original, by a reader of its own."""

    kept_lines: int
    """Lines with commands that both files share."""
    compared_lines: int
    """Those at which place, filament and modes were compared; within streams the head is on its
    way, and only the file's own retractions and Z hops are."""
    not_compared: list[str]
    """Where the place was not compared, and why."""


class PrintWay(_Figures):
    """A way to print a file compensated: its predictions, requirements and limitations."""

    name: str
    """`file`: print the written file; `live`: print the file as sliced, which an extra inside
    Klipper compensates while it prints."""
    contour_rms_um: float
    """Contour error while extruding, root mean square [um]; of all motion where nothing is
    extruded."""
    contour_range_um: tuple[float, float] | None
    """The same, least and largest of all plants that explain the machine's measurement [um]; null
    where that is not known."""
    contour_max_um: float
    """The same, largest [um]."""
    time_s: float
    """How long the print takes [s]."""
    file_bytes: int
    """Size of the file to print [bytes]."""
    needs: list[str]
    """Requirements, as text."""
    lacks: list[str]
    """Limitations, as text."""


class Result(_Figures):
    """Report of one job; `reports` writes it as HTML and JSON."""

    version: str
    """Version of Stillpath."""
    machine: str
    """Name of the machine."""
    machine_title: str
    """The machine's name, for display."""
    machine_revision: str
    """Digest of the machine's document: the same digest, the same model."""
    settings: dict[str, str | float]
    """Options of the job by name; `method` is always there."""
    source_name: str
    """Name of the file; each byte of it that is not UTF-8 is a question mark."""
    channels: list[Channel]
    """Figures of the whole print, by channel."""
    best_shaper: str
    """The best-tuned firmware shaper of this machine, with its frequencies [Hz]."""
    original_time_s: float
    """How long the sliced file takes, by the firmware's rules [s]."""
    time_s: float
    """How long the written file takes [s]."""
    slicer: str = ""
    """The program that made the file, where it says so."""
    slicer_time_s: float | None = None
    """The slicer's own estimate for the sliced file, where it has one [s]."""
    original_bytes: int
    """Size of the sliced file [bytes]."""
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
    """Highest acceleration of the command, ms by ms [mm/s^2]. What the plan's steps of speed at
    corners ask within a ms counts, and may exceed the machine's limit."""
    emission_rms_um: float
    """Written motion against computed command, root mean square [um]."""
    emission_max_um: float
    """Written motion against computed command, largest [um]."""
    filament_error_mm: float
    """Largest difference between a piece's filament and the original's [mm]."""
    compensated_s: float
    """Time of the pieces that are compensated [s]."""
    extruding_s: float
    """Time in which something is extruded [s]."""
    pieces: int
    """Pieces that the file was cut into."""
    put_back: list[PutBack]
    """Pieces that stayed as sliced, in order."""
    put_back_extruding_share: float
    """Their share of the extruding time, 0 to 1."""
    left_alone_s: float = 0.0
    """Time of the moves that keep their own lines by rule [s]: those after homing, of Z or the
    extruder between streams, steep ones, and others whose place or state is not known; reverted
    pieces not counted."""
    left_alone_extruding_s: float = 0.0
    """How much of that extrudes [s]."""
    left_out_s: float = 0.0
    """Time of what stays as sliced because the job asked for less than all (`where`) [s]."""
    left_out_extruding_s: float = 0.0
    """How much of that extrudes [s]."""
    warnings: list[str]
    """Warnings, as text."""
    notes: list[str] = []
    """Notes that need no action, for instance how plants followed a schedule."""
    confirmation: str = ""
    """What ring tests on the machine said of its model; empty where nothing was compensated."""
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
    budget: BudgetFigures | None = None
    """What the contour error budget gained, if there was one."""
    advice: AdviceFigures | None = None
    """Advice of method `advise`."""
    ways: list[PrintWay] = []
    """Ways to print the file: both if they were compared, one if it is to be printed live, else
    none."""
    not_live: str = ""
    """Why the file cannot be printed live, if a comparison was requested; empty: it can."""
    last_check: LastCheckFigures | None = None
    """What the last check compared; null where nothing was compensated."""

    @field_validator("source_name")
    @classmethod
    def _printable(cls, name: str) -> str:
        # Python has surrogates for such bytes, which neither JSON nor a console can hold.
        return name.encode("utf-8", "replace").decode("utf-8")


NOTHING_COMPENSATED: dict[str, Any] = {
    "segments": 0,
    "segments_per_s": 0.0,
    "peak_segments_per_s": 0.0,
    "emission_rms_um": 0.0,
    "emission_max_um": 0.0,
    "filament_error_mm": 0.0,
    "compensated_s": 0.0,
    "pieces": 0,
    "put_back": [],
    "put_back_extruding_share": 0.0,
}
"""Figures of a `Result` whose moves stay as they are."""
