"""Compute a scanner's command for a hatch file, and the residual error of each track.

Variants of the prediction, all with the same disturbance: the path as sent, after the prefilter,
and with the add-on controller too.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from stillpath.applications.controllers.loading import LoadedController
from stillpath.applications.controllers.response import answer, disturbance_of, disturbance_text
from stillpath.applications.scanning.figures import ScanReport, TrackFigures, VariantFigures
from stillpath.compensation.base import DesignError
from stillpath.compensation.feedback.preview_command import preview_command
from stillpath.compensation.feedback.zero_phase import design_prefilter
from stillpath.gcode.errors import GcodeError
from stillpath.gcode.hatches import Hatches, ScanSamples, Timing, read_hatches, sample_hatches
from stillpath.models.arrays import Array
from stillpath.models.diagrams import Block
from stillpath.models.disturbances import DisturbanceSpec, SensorSpec, sample
from stillpath.models.loops import Loop, LoopSpec
from stillpath.simulation.closed_loop import simulate
from stillpath.simulation.scanning import TrackErrors, track_errors
from stillpath.version import __version__

__all__ = ["Prefiltering", "Scan", "ScanSettings", "scan_file"]

Prefiltering = Literal["zpetc", "fbf", "none"]

_LARGEST_FILE = 64 << 20
_LONGEST_WARM_UP = 200_000
_FIR_SAMPLES = 5
_SEED = 0
_LEAST_BEYOND = 0.1
"""Excess of the command over the path that is noted, relative to the path's extent."""


@dataclass(frozen=True, slots=True)
class ScanSettings:
    """Settings of a scan.

    Attributes
    ----------
    um_per_unit : float, optional
        Beam travel on the work per unit of the machine; needed unless that is mm or um.
    prefilter : "zpetc", "fbf" or "none"
    cutoff_hz : float, optional
        Of a zero-phase low-pass after zpetc.
    disturbance : optional
        In the machine's unit. Left out, the controller's own, scaled to `disturbance_um`.
    enters : "output" or "input", optional
    disturbance_um : float
        Its rms at the output without an add-on.
    """

    um_per_unit: float | None = None
    prefilter: Prefiltering = "zpetc"
    cutoff_hz: float | None = None
    timing: Timing = field(default_factory=Timing)
    disturbance: DisturbanceSpec | None = None
    enters: Literal["output", "input"] | None = None
    disturbance_um: float = 10.0


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """A scan: its figures, and the command.

    Attributes
    ----------
    t_s : ndarray, shape (n,)
    command : ndarray, shape (2, n)
        References of both axes in the machine's unit.
    track : ndarray of int64, shape (n,)
        Number of the track, -1 with the beam off.
    """

    report: ScanReport
    t_s: Array
    command: Array
    track: NDArray[np.int64]


def scan_file(
    source: Path,
    spec: LoopSpec,
    settings: ScanSettings,
    controller: LoadedController | None = None,
) -> Scan:
    """Compute the command of a hatch file and predict every track; both axes are equal.

    Raises
    ------
    GcodeError
        If the file cannot be read as hatches, or is too long.
    DesignError
        If the prefilter cannot be designed, or the controller is one for another machine.
    ModelError
        If the machine or its disturbance is not valid.
    """
    loop = spec.nominal()
    scale = _scale(spec, settings)
    _check_controller(controller, spec)
    sensor = _in_um(spec.sensor, scale)
    hatches = read_hatches(_text(source))
    prefilter = _Prefilter(loop, settings)
    timing = prefilter.led(settings.timing)
    samples, rows = _numbered(sample_hatches(hatches, loop.dt_s, timing), hatches)
    wanted = 1e3 * samples.xy_mm
    command = np.array([prefilter.apply(axis) for axis in wanted])
    warm_up = 0 if controller is None else min(controller.settling, _LONGEST_WARM_UP)
    disturbed = _disturbance(loop, spec, settings, controller, warm_up + wanted.shape[1], scale)
    plain = _Drive(loop, sensor, (), 1, disturbed, warm_up)
    outputs = {"sent": ("as sent", plain.run(wanted, wanted))}
    if settings.prefilter != "none":
        outputs["prefilter"] = (prefilter.label, plain.run(command, wanted))
    if controller is not None:
        added = _Drive(loop, sensor, controller.blocks, controller.every, disturbed, warm_up)
        label = f"{prefilter.label} and {controller.method}".removeprefix("none and ")
        outputs["add-on"] = (label, added.run(command, wanted))
    errors = {
        k: (label, track_errors(wanted, y, samples.track)) for k, (label, y) in outputs.items()
    }
    report = ScanReport(
        version=__version__,
        source=source.name,
        machine=spec.name,
        title=spec.title,
        unit=spec.unit,
        um_per_unit=scale,
        rate_hz=1.0 / loop.dt_s,
        **prefilter.figures(),
        controller=None if controller is None else controller.method,
        disturbance=None if disturbed is None else disturbed.text,
        enters=None if disturbed is None else disturbed.enters,
        duration_s=len(samples.t_s) * loop.dt_s,
        drawn_s=float(np.sum(samples.track >= 0)) * loop.dt_s,
        drawn_mm=float(np.sum(np.hypot(*(hatches.end_mm - hatches.start_mm).T)[hatches.beam])),
        variants=tuple(_variant(name, *found) for name, found in errors.items()),
        tracks=_tracks(hatches, rows, {name: found for name, (_, found) in errors.items()}),
        notes=_notes(hatches, wanted, command),
    )
    return Scan(report, samples.t_s, command / scale, samples.track)


def _check_controller(controller: LoadedController | None, spec: LoopSpec) -> None:
    if controller is not None and _machine(controller.spec) != _machine(spec):
        raise DesignError(
            f"the controller was designed for {controller.spec.name!r}, not for the loop of "
            f"{spec.name!r}; design it again"
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Disturbed:
    d_um: Array
    enters: str
    text: str


class _Prefilter:
    """Turns the wanted path into the reference, with figures for the report."""

    def __init__(self, loop: Loop, settings: ScanSettings) -> None:
        self._loop = loop
        self.label: str = settings.prefilter
        self.preview, self.peak = 0, None
        self._filter = None
        if settings.cutoff_hz is not None and settings.prefilter != "zpetc":
            raise DesignError("a cutoff belongs to the prefilter zpetc")
        if settings.prefilter == "zpetc":
            half = 1 if settings.cutoff_hz is None else _FIR_SAMPLES
            self._filter = design_prefilter(loop, cutoff_hz=settings.cutoff_hz, length=half)
            self.preview, self.peak = self._filter.preview, self._filter.peak.value
        elif settings.prefilter == "fbf":
            self.preview = 64

    def figures(self) -> dict[str, Any]:
        """Return the figures of the report."""
        parts = () if self._filter is None else self._filter.coefficients
        return {
            "coefficients": tuple({"name": c.name, "kind": c.kind, **c.values} for c in parts),
            "prefilter": self.label,
            "preview_samples": self.preview,
            "peak_gain": self.peak,
        }

    def led(self, timing: Timing) -> Timing:
        """Let the machine stand still for as long as the command looks ahead.

        Otherwise the command would begin with a jump.
        """
        lead_s = (self.preview + 1) * self._loop.dt_s
        return replace(timing, lead_s=max(timing.lead_s, lead_s))

    def apply(self, wanted: Array) -> Array:
        if self._filter is not None:
            return self._filter.apply(wanted)
        if self.label == "fbf":
            return preview_command(self._loop, wanted)
        return wanted


class _Drive:
    """A loop with an add-on that has settled against the disturbance before the scan begins."""

    def __init__(
        self,
        loop: Loop,
        sensor: SensorSpec | None,
        blocks: Sequence[Block],
        every: int,
        disturbed: _Disturbed | None,
        warm_up: int,
    ) -> None:
        self._loop, self._sensor, self._blocks = loop, sensor, blocks
        self._every, self._disturbed, self._warm_up = every, disturbed, warm_up

    def run(self, reference: Array, wanted: Array) -> Array:
        """Return the output, shape (2, n), of a machine at rest at the start of the path."""
        return np.array(
            [self._axis(r - r[0]) + y_d[0] for r, y_d in zip(reference, wanted, strict=True)]
        )

    def _axis(self, r: Array) -> Array:
        inputs = {"r": np.repeat(np.pad(r, (self._warm_up, 0)), self._every)}
        if self._disturbed is not None:
            place = "d_out" if self._disturbed.enters == "output" else "d_in"
            inputs[place] = np.repeat(self._disturbed.d_um, self._every)
        y = simulate(self._loop, self._blocks, inputs, every=self._every, sensor=self._sensor)["y"]
        return y[:: self._every][self._warm_up :]


def _machine(spec: LoopSpec) -> tuple[object, object]:
    """Return the properties of a machine that a controller depends on."""
    return spec.loop, spec.sensor


def _scale(spec: LoopSpec, settings: ScanSettings) -> float:
    scale = settings.um_per_unit
    if scale is None:
        scale = {"mm": 1e3, "um": 1.0, "µm": 1.0}.get(spec.unit)
    if scale is None:
        raise DesignError(
            f"the machine's unit is {spec.unit!r}: say how far the beam moves per {spec.unit} "
            "(--um-per-unit)"
        )
    if not (math.isfinite(scale) and scale > 0):
        raise DesignError(f"{scale:g} um per {spec.unit}: it must be above 0")
    return scale


def _in_um(sensor: SensorSpec | None, scale: float) -> SensorSpec | None:
    """Return the sensor as the prediction sees it, whose signals are in um."""
    return sensor and sensor.model_copy(update={"quantum": scale * sensor.quantum})


def _text(source: Path) -> str:
    size = source.stat().st_size
    if size > _LARGEST_FILE:
        raise GcodeError(f"the file has {size} bytes, up to {_LARGEST_FILE} are read: give a layer")
    return source.read_text(encoding="utf-8", errors="replace")


def _numbered(
    samples: ScanSamples, hatches: Hatches
) -> tuple[ScanSamples, list[NDArray[np.int64]]]:
    """Count the tracks that have samples from 0 on; return the moves of each too."""
    kept, numbers = np.unique(samples.track, return_inverse=True)
    first = int(kept[0] < 0)
    if len(kept) == first:
        raise GcodeError("no track is long enough for a sample; is F in mm/min?")
    tracks = hatches.tracks()
    rows = [np.flatnonzero(tracks == number) for number in kept[first:]]
    return replace(samples, track=numbers - first), rows


def _disturbance(
    loop: Loop,
    spec: LoopSpec,
    settings: ScanSettings,
    controller: LoadedController | None,
    count: int,
    scale: float,
) -> _Disturbed | None:
    generator = np.random.default_rng(_SEED)
    if settings.disturbance is not None:
        d = scale * sample(settings.disturbance, count, loop.dt_s, generator)
        return _Disturbed(d, settings.enters or "output", disturbance_text(settings.disturbance))
    if controller is None or settings.disturbance_um == 0:
        return None
    kind, enters = disturbance_of(controller.options, loop)
    enters = settings.enters or enters
    d = sample(kind, count, loop.dt_s, generator)
    # Of size 1, which says nothing of what the sensor resolves.
    left = answer(loop, (), d, enters, sensor=_in_um(spec.sensor, 0.0))["y"]
    rms = float(np.sqrt(np.mean(left[count // 4 :] ** 2)))
    if rms == 0:
        raise DesignError("the controller's disturbance does not reach the output; give another")
    return _Disturbed(d * settings.disturbance_um / rms, enters, disturbance_text(kind))


def _notes(hatches: Hatches, wanted: Array, command: Array) -> tuple[str, ...]:
    notes = [f"{name} is not used by scanners: ignored" for name in hatches.passed_over]
    beyond_um = np.maximum(wanted.min(1) - command.min(1), command.max(1) - wanted.max(1))
    axis = int(np.argmax(beyond_um))
    if beyond_um[axis] > _LEAST_BEYOND * np.ptp(wanted, axis=1).max():
        notes.append(
            f"the command of {'XY'[axis]} goes {1e-3 * beyond_um[axis]:.3g} mm beyond the path, "
            f"which spans {1e-3 * np.ptp(wanted[axis]):.3g} mm: where the machine cannot follow, "
            "the prediction is void. A lower F, slower jumps (--jump-mm-s) and a low-pass (of "
            "zpetc, --cutoff-hz) make it smaller"
        )
    return tuple(notes)


def _variant(name: str, label: str, found: TrackErrors) -> VariantFigures:
    return VariantFigures(
        name=name,
        label=label,
        rms_um=found.total_rms,
        largest_um=found.total_largest,
        across_um=found.total_across,
    )


def _tracks(
    hatches: Hatches, rows: Sequence[NDArray[np.int64]], errors: dict[str, TrackErrors]
) -> tuple[TrackFigures, ...]:
    out = []
    for k, moves in enumerate(rows):
        corners = np.concatenate([hatches.start_mm[moves[:1]], hatches.end_mm[moves]])
        out.append(
            TrackFigures(
                line=int(hatches.line[moves[0]]),
                last_line=int(hatches.line[moves[-1]]),
                length_mm=float(np.sum(np.hypot(*np.diff(corners, axis=0).T))),
                x_mm=tuple(corners[:, 0].tolist()),
                y_mm=tuple(corners[:, 1].tolist()),
                rms_um={name: float(e.rms[k]) for name, e in errors.items()},
                largest_um={name: float(e.largest[k]) for name, e in errors.items()},
                across_um={name: float(e.across[k]) for name, e in errors.items()},
            )
        )
    return tuple(out)
