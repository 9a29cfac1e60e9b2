"""The figures of a design: what `design_report` returns, and what design.json holds.

Nothing here is computed; every list is plain, so that the document is the same in any language.
"""

from __future__ import annotations

from typing import Literal

from stillpath.models.document import Document
from stillpath.pipeline.options import BasisName, RobustMode

__all__ = [
    "AxisFigures",
    "Curve",
    "DesignReport",
    "Frequencies",
    "LiftedFigures",
    "Member",
    "Metrics",
    "ModeFigures",
    "RobustMetric",
    "Robustness",
    "RungFigures",
    "ZeroFigures",
]


class ModeFigures(Document):
    """A resonance."""

    f_hz: float
    zeta: float


class ZeroFigures(Document):
    """A zero of the sampled plant outside the unit circle; `f_hz` belongs to its angle."""

    real: float
    imag: float
    radius: float
    f_hz: float


class Member(Document):
    """One plant of the axis' set; weights sum to 1 over the members."""

    modes: tuple[ModeFigures, ...]
    weight: float
    minimax_weight: float | None
    """Its weight with `robust` minimax, None without a set."""


class AxisFigures(Document):
    """The plant of the axis and its set, sampled.

    `settling_s` is the time in which the slowest pole decays to 1 %.
    """

    order: int
    settling_s: float
    modes: tuple[ModeFigures, ...]
    zeros_outside: tuple[ZeroFigures, ...]
    members: tuple[Member, ...]
    notes: tuple[str, ...]


class Frequencies(Document):
    """Frequency response of the axis: its nominal plant, and the range of its set.

    Gains in mm/mm, phases in degrees, unwrapped from the lowest frequency on; without a set
    low and high are the nominal plant's. Delays of the whole axis count in neither, as no command
    is designed against them.
    """

    f_hz: tuple[float, ...]
    gain: tuple[float, ...]
    gain_low: tuple[float, ...]
    gain_high: tuple[float, ...]
    phase_deg: tuple[float, ...]
    phase_low_deg: tuple[float, ...]
    phase_high_deg: tuple[float, ...]
    phase_measured: bool
    """Whether a measurement told the phase, or only the structure of the model does."""


class LiftedFigures(Document):
    """Singular values, falling, of the plants the design looks at, lifted over the window.

    `position` in mm/mm; `increments`, with two integrators in front, in mm per mm/sample^2.
    """

    samples: int
    position: tuple[float, ...]
    increments: tuple[float, ...]


class RobustMetric(Document):
    """J_e,r of the n = 1, 2, .. most robust functions and its parts, whose squares add up (4.9).

    `best` functions are best by remark 4.5; `left_out` directions are answered by less than 1e-7
    of the best and have no functions. `singular_values` of Delta_nom,s, rising.
    """

    nominal: Literal["plant", "optimum"]
    """G_nom: the axis' nominal plant, or the lifted optimum (4.28)."""
    best: int
    left_out: int
    singular_values: tuple[float, ...]
    error: tuple[float, ...]
    nominal_part: tuple[float, ...]
    uncertainty_part: tuple[float, ...]


class Metrics(Document):
    """Closed forms for n = 1, 2, .. functions and white paths.

    `error` is J_e (2.26). Efforts are J_c of CE-Opt functions (3.23): of a position command in
    mm/mm, of increments in mm/s^2 per um; None where the plant answers no more functions.
    """

    error: tuple[float, ...]
    effort_position: tuple[float | None, ...]
    effort_increments: tuple[float | None, ...]
    robust: tuple[RobustMetric, ...]
    """Empty for an axis without a set."""


class RungFigures(Document):
    """A design of the ladder: accepted with its figures, or refused with the reason.

    `error` and `robust_error` are J_e on the nominal plant and J_e,r over the set (None without
    one), `effort` J_c of increments in mm/s^2 per um; all from the matrices, price included.
    """

    n: int
    cutoff_hz: float
    price: float
    refused: str | None = None
    spectral_radius: float | None = None
    condition: float | None = None
    error: float | None = None
    robust_error: float | None = None
    effort: float | None = None


class Curve(Document):
    """One way to drive the machine along the reference motion.

    Contour errors, rms while extruding, in um; accelerations of this axis' command in mm/s^2.
    """

    name: str
    """`none`, `fbf-off`, `fbf-ensemble`, `fbf-minimax`, or a shaper's name."""
    label: str
    setting: str
    contour_um: tuple[float, ...]
    """One for each of `Robustness.errors_percent`."""
    nominal_um: float
    members_um: tuple[float, ...]
    members_mean_um: float
    """Mean with the weights of the set."""
    members_best_um: float
    members_worst_um: float
    peak_accel_mm_s2: float
    rms_accel_mm_s2: float


class Robustness(Document):
    """What every command leaves when the axis' frequencies are off by so many percent.

    `errors_percent` is empty for a plant whose frequencies cannot be scaled.
    """

    errors_percent: tuple[float, ...]
    curves: tuple[Curve, ...]
    missing: tuple[str, ...]
    """Commands that could not be designed, and why."""


class DesignReport(Document):
    """All figures of `design_report`; the same machine, settings and version give the same."""

    version: str
    machine: str
    machine_title: str
    machine_revision: str
    axis: Literal["x", "y"]
    basis: BasisName
    robust: RobustMode
    sampling_s: float
    window_s: float
    update_s: float
    plant: AxisFigures
    frequencies: Frequencies
    lifted: LiftedFigures
    metrics: Metrics
    ladder: tuple[RungFigures, ...]
    chosen: int | None
    """The rung that the reference motion takes; None if the machine has no such design."""
    path_peak_accel_mm_s2: float
    """Of this axis' planned reference motion."""
    path_rms_accel_mm_s2: float
    accel_limit_mm_s2: float | None
    robustness: Robustness
