"""From measurements to the plants of a machine's axes.

Measurements are grouped by axis; logs become frequency responses, those become a nominal plant and
a set. What was measured with a weight on the bed or at different places becomes a schedule.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, TypeAlias

import numpy as np

from stillpath.models.errors import ModelError
from stillpath.models.identification.alignment import AlignedLog, align, check_pair
from stillpath.models.identification.averaging import mean_response, mean_spectrum
from stillpath.models.identification.conditioned import scheduled, special, usual
from stillpath.models.identification.conditions import Condition
from stillpath.models.identification.estimation import (
    estimate_aligned,
    estimate_driven,
    estimate_response,
    plateau_gain,
)
from stillpath.models.identification.friction import dry_friction, freed
from stillpath.models.identification.modal_fit import refit
from stillpath.models.identification.nozzle import Frame, frame_of
from stillpath.models.identification.readers import (
    ReadSettings,
    date_in_name,
    direction_of,
    excitation_for,
    excitation_notes,
)
from stillpath.models.identification.sets import (
    delay_warning,
    response_set,
    spectrum_set,
    typed_in_set,
)
from stillpath.models.identification.spectrum_fit import refit_spectrum
from stillpath.models.identification.trust import check_axes, check_informative, keeps_time
from stillpath.models.identification.types import (
    AccelerationLog,
    AxisIdentification,
    DrivenLog,
    Excitation,
    Fit,
    FrequencyResponse,
    Measurement,
    PlantModel,
    Spectrum,
)
from stillpath.models.provenance import Kind, SourceFile

__all__ = ["Measured", "Progress", "identify"]

Axis: TypeAlias = Literal["x", "y"]
Progress: TypeAlias = Callable[[str, float], None]
"""Called with what is being done and how much of all is done, 0 to 1."""

_SENSOR_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
_KINDS: dict[type, Kind] = {
    AccelerationLog: "raw log",
    DrivenLog: "recorded drive",
    FrequencyResponse: "frequency response",
    Spectrum: "spectrum",
    PlantModel: "model file",
}
_BEST_FIRST = (PlantModel, AccelerationLog, DrivenLog, FrequencyResponse, Spectrum)
"""Where an axis has measurements of several kinds, the first kind is used."""

_LEVEL_TOLERANCE = 0.15
_LEVELS = (0.3, 3.0)
_MOSTLY = 0.8
_POOR, _POOR_DB = 0.15, 1.1
_USELESS, _USELESS_DB = 0.5, 6.0
"""Residuals beyond which a fit is no model of what was measured."""
_AHEAD_S = 1e-3
_LEAST_COHERENCE, _LEAST_POINTS, _SLOPE_TOLERANCE = 0.95, 4, 0.2
_WARNING = "warning: "
"""How readers mark notes that the user must look at."""


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """A measurement with the conditions that it was made under."""

    measurement: Measurement
    condition: Condition = field(default_factory=Condition)


def identify(
    measured: Sequence[Measured],
    settings: ReadSettings | None = None,
    *,
    sources: Sequence[SourceFile] = (),
    max_order: int = 4,
    progress: Progress | None = None,
) -> dict[Axis, AxisIdentification]:
    """Find the plants of every axis that was measured.

    Parameters
    ----------
    measured : sequence of Measured
    settings : ReadSettings, optional
        What the files do not carry.
    sources : sequence of SourceFile
        The files; each axis keeps those that its measurements come from.
    max_order : int
        Most pole pairs to try.

    Raises
    ------
    ModelError
        If a measurement cannot be used, its axis is unknown, or nothing is left to identify.
    """
    settings = settings or ReadSettings()
    groups: dict[Axis, list[Measured]] = {}
    for one in measured:
        groups.setdefault(_axis(one.measurement, settings), []).append(one)
    if not groups:
        raise ModelError("nothing to identify: give at least one measurement")
    steps = _Steps(progress, len(measured) + len(groups))
    found = {
        axis: _AxisWork(axis, groups[axis], settings, sources, max_order, steps).identified()
        for axis in sorted(groups)
    }
    if not settings.sensor_turned:
        _check_directions(found)
    check_axes(list(found.values()))
    steps.say("done", 1.0)
    return _delays_compared(found)


class _Steps:
    """Progress over all files and fits."""

    def __init__(self, progress: Progress | None, steps: int) -> None:
        self._progress, self._steps, self._done = progress, steps, 0

    def say(self, what: str, fraction: float) -> None:
        if self._progress is not None:
            self._progress(what, fraction)

    def within(self, what: str) -> Callable[[float], None]:
        return lambda part: self.say(what, (self._done + part) / self._steps)

    def stepped(self, what: str) -> None:
        self._done += 1
        self.say(what, self._done / self._steps)


class _AxisWork:
    """One axis on its way from measurements to plants."""

    def __init__(
        self,
        axis: Axis,
        measured: Sequence[Measured],
        settings: ReadSettings,
        sources: Sequence[SourceFile],
        max_order: int,
        steps: _Steps,
    ) -> None:
        self._axis, self._settings, self._steps = axis, settings, steps
        self._max_order = max_order
        self._aligned: list[AlignedLog] = []
        """Of the raw logs that are used."""
        kind = next(k for k in _BEST_FIRST if any(isinstance(m.measurement, k) for m in measured))
        self._used = [m for m in measured if isinstance(m.measurement, kind)]
        self._left_out = [m for m in measured if not isinstance(m.measurement, kind)]
        self._kind = _KINDS[kind]
        names = {m.measurement.source for m in self._used}
        self._sources = tuple(s for s in sources if s.name in names)
        self._date = max(filter(None, map(date_in_name, names)), default=None)

    def identified(self) -> AxisIdentification:
        """Return the axis with the notes of its files."""
        if self._kind == "model file":
            found = self._from_model()
        elif self._kind == "spectrum":
            found = self._from_spectra()
        else:
            found = self._from_responses()
        self._steps.stepped(f"axis {self._axis}: fitted")
        notes = list(found.notes)
        used = [one.measurement for one in self._used]
        notes += _by_file((m.source, n) for m in used for n in m.notes)
        for one in self._left_out:
            notes.append(
                f"{one.measurement.source}: not used, because a {self._kind} of axis {self._axis} "
                "says more"
            )
        notes += _by_file((r.source, n) for r in found.measured for n in r.notes)
        told, warned = _parted(dict.fromkeys(notes))
        names = list(dict.fromkeys(m.source for m in used))
        fit_warnings = _fit_warnings(found.fit, names) if found.fit else ()
        warnings = (*fit_warnings, *found.warnings, *warned)
        if found.fit is not None:
            check_informative(found.fit, found.measured, names, warnings)
        return replace(found, notes=told, warnings=warnings)

    def _from_model(self) -> AxisIdentification:
        if len(self._used) > 1:
            names = ", ".join(m.measurement.source for m in self._used)
            raise ModelError(f"axis {self._axis}: {len(self._used)} models ({names}); give one")
        model = self._used[0].measurement
        assert isinstance(model, PlantModel)
        plants = typed_in_set(model.spec, kind="model file")
        if plants.provenance is not None:
            about = plants.provenance.model_copy(update={"sources": self._sources})
            plants = plants.model_copy(update={"provenance": about})
        return AxisIdentification(axis=self._axis, plants=plants)

    def _from_responses(self) -> AxisIdentification:
        responses = [(self._response(m), m.condition) for m in self._used]
        common = usual([c for _, c in responses], self._axis)
        friction_mm = self._friction_mm([(r, c in common) for r, c in responses])
        if friction_mm:
            responses = [(self._freed(k, r, friction_mm), c) for k, (r, c) in enumerate(responses)]
        chosen = [r for r, c in responses if c in common]
        # A schedule counts the modes of the plant as it was fitted.
        frame_firm = self._settings.frame_firm or bool(special([c for _, c in responses]))
        frame = None
        if self._kind == "raw log" and not frame_firm:
            frame = frame_of(mean_response(chosen))
        if frame is not None:
            chosen = [frame.over_bed(response) for response in chosen]
        found = response_set(
            chosen,
            axis=self._axis,
            kind=self._kind,
            frame_firm=frame_firm or frame is not None,
            max_order=self._max_order,
            sources=self._sources,
            measured_on=self._date,
            progress=self._steps.within(f"axis {self._axis}: fitting"),
        )
        nominal = found.fit
        assert nominal is not None
        fits = {
            condition: refit(mean_response([r for r, c in responses if c == condition]), nominal)
            for condition in special([c for _, c in responses])
        }
        others = tuple(r for r, c in responses if c not in common)
        notes: list[str] = []
        if self._kind == "raw log":
            warnings = _level_warnings(chosen, nominal)
            notes = [*self._mounting_notes(chosen), *_body_notes(friction_mm, frame)]
        else:
            warnings = _scale_warnings(chosen, nominal)
        found = replace(
            found,
            plants=found.plants.model_copy(update={"friction_mm": friction_mm or None}),
            measured=(*found.measured, *others),
            warnings=(*found.warnings, *warnings),
            notes=tuple(notes),
        )
        return scheduled(found, nominal, fits, self._kind)

    def _from_spectra(self) -> AxisIdentification:
        spectra: list[tuple[Spectrum, Excitation, Condition]] = []
        notes: list[tuple[str, str]] = []
        for one in self._used:
            spectrum = one.measurement
            assert isinstance(spectrum, Spectrum)
            spectra.append((spectrum, excitation_for(spectrum, self._settings), one.condition))
            assumed = excitation_notes(spectrum, self._settings)
            notes += [(spectrum.source, note) for note in assumed]
            self._steps.stepped(f"axis {self._axis}: {spectrum.source}")
        common = usual([c for _, _, c in spectra], self._axis)
        chosen = [(s, e) for s, e, c in spectra if c in common]
        found = spectrum_set(
            [s for s, _ in chosen],
            [e for _, e in chosen],
            axis=self._axis,
            column=self._settings.sensor_axis,
            frame_firm=self._settings.frame_firm,
            max_order=self._max_order,
            sources=self._sources,
            measured_on=self._date,
            progress=self._steps.within(f"axis {self._axis}: fitting"),
        )
        nominal = found.fit
        assert nominal is not None
        fits = {
            condition: refit_spectrum(
                mean_spectrum([s for s, _, c in spectra if c == condition]),
                next(e for _, e, c in spectra if c == condition),
                nominal,
                column=self._settings.sensor_axis,
            )
            for condition in special([c for _, _, c in spectra])
        }
        others = tuple(s for s, _, c in spectra if c not in common)
        found = replace(found, measured=(*found.measured, *others), notes=tuple(_by_file(notes)))
        return scheduled(found, nominal, fits, self._kind)

    def _response(self, one: Measured) -> FrequencyResponse:
        measurement, label = one.measurement, one.condition.label
        what = f"axis {self._axis}: {measurement.source}"
        if isinstance(measurement, AccelerationLog):
            test = excitation_for(measurement, self._settings)
            sensor = self._settings.sensor_axis
            mounted = None if sensor is None else _SENSOR_AXES[sensor]
            try:
                aligned = align(measurement, test, sensor_direction=mounted)
                response = estimate_response(
                    measurement,
                    test,
                    aligned=aligned,
                    # Tests of different strength are different operating points.
                    label=label or f"{test.accel_per_hz_mm_s:g} mm/s",
                    progress=lambda stage, part: self._steps.within(f"{what}, {stage}")(part),
                )
            except ModelError as error:
                # What the reader noticed may be the reason.
                raise ModelError("; ".join([str(error), *measurement.notes])) from None
            notes = excitation_notes(measurement, self._settings)
            response = replace(response, notes=(*response.notes, *notes))
            self._aligned.append(aligned)
        elif isinstance(measurement, DrivenLog):
            response = estimate_driven(measurement, label=label)
        else:
            assert isinstance(measurement, FrequencyResponse)
            response = replace(measurement, label=label or measurement.label)
        self._steps.stepped(what)
        return response

    def _friction_mm(self, responses: Sequence[tuple[FrequencyResponse, bool]]) -> float:
        """Return how far dry friction holds the axis back, from the usual logs."""
        if self._kind != "raw log":
            return 0.0
        logs = zip(self._aligned, responses, strict=True)
        return dry_friction([(aligned, r) for aligned, (r, usual) in logs if usual])

    def _freed(
        self, number: int, response: FrequencyResponse, friction_mm: float
    ) -> FrequencyResponse:
        """Return the response of a log without what dry friction did."""
        log = self._used[number].measurement
        assert isinstance(log, AccelerationLog)
        aligned = freed(self._aligned[number], response, friction_mm)
        test = excitation_for(log, self._settings)
        again = estimate_aligned(log, aligned, test, label=response.label)
        return replace(again, notes=response.notes)

    def _mounting_notes(self, responses: Sequence[FrequencyResponse]) -> list[str]:
        """Say how the sensor sits, where its axes are not the machine's: many are mounted so."""
        if self._settings.sensor_axis is not None:
            return []
        notes = []
        for response in responses:
            along = dict(zip("xyz", map(abs, response.sensor_direction or ()), strict=False))
            most = max(along, key=along.__getitem__, default=self._axis)
            if most != self._axis and along[most] > _MOSTLY:
                text = (
                    f"the sensor's {most} moved in the test of axis {self._axis}, so it was taken "
                    "to be mounted so; if it is not, another axis was measured (sensor_axis "
                    f"{self._axis} refuses such a log)"
                )
                notes.append((response.source, text))
        return _by_file(notes)


def _axis(measurement: Measurement, settings: ReadSettings) -> Axis:
    text = settings.axis or measurement.axis
    if text is None:
        raise ModelError(
            f"{measurement.source}: neither the file nor its name says which axis it is of; give "
            "the axis, x or y"
        )
    try:
        x, y = direction_of(text)
    except ModelError as error:
        raise ModelError(f"{measurement.source}: {error}") from None
    if min(abs(x), abs(y)) > 1e-6:
        raise ModelError(
            f"{measurement.source}: measured along {text}, which moves both axes at once; identify "
            "X and Y from tests along X and along Y"
        )
    return "x" if abs(x) > abs(y) else "y"


def _by_file(told: Iterable[tuple[str, str]]) -> list[str]:
    """Put the names of all files before what is said of them, each text once."""
    sources: dict[str, list[str]] = {}
    for source, text in dict.fromkeys(told):
        sources.setdefault(text, []).append(source)
    return [f"{', '.join(names)}: {text}" for text, names in sources.items()]


def _body_notes(friction_mm: float, frame: Frame | None) -> list[str]:
    """Say what else than the axis was seen."""
    notes = []
    if friction_mm:
        notes.append(
            f"dry friction holds the axis {1e3 * friction_mm:.1f} um behind its command: the "
            "response is freed of it, and commands make up for it"
        )
    if frame is not None:
        notes.append(
            f"the frame shakes on its feet at {frame.f_hz:.1f} Hz (what moves is "
            f"{frame.mass_ratio:.0%} of its mass): the sensor feels it, the nozzle over the bed "
            "does not, so the response is freed of it (frame_firm leaves it in)"
        )
    return notes


def _parted(told: Iterable[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Part notes from those that a reader calls a warning."""
    told = tuple(told)
    warned = tuple(text for text in told if _WARNING in text)
    notes = tuple(text for text in told if text not in warned)
    return notes, tuple(text.replace(_WARNING, "", 1) for text in warned)


def _fit_warnings(fit: Fit, sources: Sequence[str]) -> tuple[str, ...]:
    """Tell of a model that should not be relied on; refuse one that is none."""
    if fit.magnitude_only:
        limits, missed = (_POOR_DB, _USELESS_DB), f"{fit.residual:.1f} dB"
    else:
        limits, missed = (_POOR, _USELESS), f"{fit.residual:.0%}"
    remedy = (
        "Allow more modes (max_order), leave out files of another state of the machine, or "
        "measure again"
    )
    if fit.residual > limits[1]:
        raise ModelError(
            f"{', '.join(sources)}: no stable model of {fit.order} modes explains this: it misses "
            f"{missed}. Check that file, axis and test belong together. {remedy}"
        )
    if fit.residual > limits[0]:
        text = f"the model misses {missed} of what was measured: look at the curves before it is"
        return (f"{text} used. {remedy}",)
    return ()


def _level_warnings(responses: Sequence[FrequencyResponse], fit: Fit) -> list[str]:
    """Judge the level by the fit, where nothing followed at the frequencies that tell it."""
    names = ", ".join(r.source for r in responses if plateau_gain(r) is None)
    if not names or abs(fit.gain - 1.0) <= _LEVEL_TOLERANCE:
        return []
    seen = f"{names}: by the fit the sensor moved {fit.gain:.2g} times as much as commanded"
    if not _LEVELS[0] < fit.gain < _LEVELS[1]:
        raise ModelError(
            f"{seen}: it does not sit on what moves, or accel_per_hz or its scale is wrong; "
            "measure at the part that the axis moves"
        )
    return [f"{seen}; check accel_per_hz in printer.cfg and the sensor's scale"]


def _scale_warnings(responses: Sequence[FrequencyResponse], fit: Fit) -> list[str]:
    """Tell of a command and a measurement that are hardly those of one axis in one unit."""
    names, warnings = ", ".join(dict.fromkeys(r.source for r in responses)), []
    if abs(fit.gain - 1.0) > _LEVEL_TOLERANCE:
        warnings.append(
            f"{names}: at low frequencies the measurement is {fit.gain:.3g} times the command, and "
            "was divided by that: an axis that keeps its steps ends where it is told; check that "
            "both have the same unit, and which columns they are"
        )
    warnings += _by_file((r.source, text) for r in responses if (text := _slope_text(r)))
    if fit.delay_s < -_AHEAD_S:
        warnings.append(
            f"{names}: the measurement is {-fit.delay_s * 1e3:.2g} ms ahead of the command: check "
            "that the two are not exchanged, and their clocks"
        )
    return warnings


def _slope_text(response: FrequencyResponse) -> str:
    """Tell of a response that rises or falls like a power of f over its lowest octave."""
    f_hz = response.f_hz
    known = (f_hz > 0) & (np.abs(response.response) > 0) & ~(response.coherence < _LEAST_COHERENCE)
    if np.count_nonzero(known) < _LEAST_POINTS:
        return ""
    lowest = known & (f_hz <= 2.0 * f_hz[known].min())
    if np.count_nonzero(lowest) < _LEAST_POINTS:
        return ""
    slope = np.polyfit(np.log(f_hz[lowest]), np.log(np.abs(response.response[lowest])), 1)[0]
    power = round(float(slope))
    if power == 0 or abs(slope - power) > _SLOPE_TOLERANCE:
        return ""
    return (
        f"towards low frequencies the response goes like f^{power:d} instead of being level: "
        "command and measurement must be the same quantity (both position, or both acceleration); "
        f"multiply the response by (2 pi j f)^{-power:d}"
    )


def _check_directions(found: Mapping[Axis, AxisIdentification]) -> None:
    along = [
        (r.source, r.sensor_direction)
        for one in found.values()
        for r in one.measured[:1]
        if isinstance(r, FrequencyResponse) and r.sensor_direction is not None
    ]
    if len(along) == 2:
        (x, x_direction), (y, y_direction) = along
        try:
            check_pair(x_direction, y_direction)
        except ModelError as error:
            raise ModelError(f"{x}, {y}: {error}") from None


def _delays_compared(found: dict[Axis, AxisIdentification]) -> dict[Axis, AxisIdentification]:
    """Warn about delays that differ, where they are known: a log does not say when it began."""
    fits = [one.fit for _, one in sorted(found.items()) if keeps_time(one) and one.fit]
    warning = delay_warning(fits[0], fits[1]) if len(fits) == 2 else None
    if warning is None:
        return found
    return {a: replace(one, warnings=(*one.warnings, warning)) for a, one in found.items()}
