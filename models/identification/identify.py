"""Identify the plants of a machine's axes from measurements.

Measurements are grouped by axis; logs become frequency responses, those become a nominal plant and
a set. What was measured with a weight on the bed or at different places becomes a schedule.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeAlias

from stillpath.models.errors import ModelError
from stillpath.models.identification.alignment import AlignedLog, align, spectrum_along
from stillpath.models.identification.averaging import mean_response, mean_spectrum
from stillpath.models.identification.clocks import Lateness, lateness, timed
from stillpath.models.identification.conditioned import (
    Tested,
    check_labels,
    of_one_test,
    scheduled,
    special,
    usual,
)
from stillpath.models.identification.conditions import Condition
from stillpath.models.identification.estimation import (
    estimate_aligned,
    estimate_driven,
    estimate_response,
)
from stillpath.models.identification.frame import LIKELY, likely_of
from stillpath.models.identification.friction import Friction, better_explained, dry_friction, freed
from stillpath.models.identification.messages import (
    body_notes,
    by_file,
    fit_warnings,
    frame_mode_warnings,
    friction_notes,
    level_warnings,
    mounting_notes,
    no_frame_note,
    parted,
    phase_fault,
    phase_warning,
    scale_warnings,
    strength_notes,
    table_mounting_notes,
    unvaried_notes,
)
from stillpath.models.identification.modal_fit import refit
from stillpath.models.identification.nozzle import Frame, frame_of
from stillpath.models.identification.prompt import prompt
from stillpath.models.identification.readers import (
    ReadSettings,
    date_in_name,
    excitation_for,
    excitation_notes,
    tested_axis,
)
from stillpath.models.identification.sets import (
    Origin,
    model_file_set,
    response_set,
    spectrum_set,
)
from stillpath.models.identification.spectrum_fit import (
    Explanations,
    explanations,
    refit_spectrum,
    same_test,
)
from stillpath.models.identification.trust import (
    check_axes,
    check_directions,
    check_informative,
    check_repeats,
    delays_compared,
)
from stillpath.models.identification.types import (
    AccelerationLog,
    Axis,
    AxisIdentification,
    DrivenLog,
    Excitation,
    Fit,
    FrequencyResponse,
    Measurement,
    PlantModel,
    Spectrum,
)
from stillpath.models.plants import ParametricMembers, PlantSetSpec, PlantSpec
from stillpath.models.provenance import Kind, SourceFile

__all__ = ["Measured", "Progress", "identify"]

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
        groups.setdefault(tested_axis(one.measurement, settings), []).append(one)
    if not groups:
        raise ModelError("nothing to identify: give at least one measurement")
    steps = _Steps(progress, len(measured) + len(groups))
    works = {
        axis: _AxisWork(axis, groups[axis], settings, sources, max_order, steps)
        for axis in sorted(groups)
    }
    frames_hz = {axis: work.explain_spectra() for axis, work in works.items()}
    frame_likely = 0.0 if settings.frame_firm else likely_of(frames_hz.values())
    found = {axis: work.identified(frame_likely) for axis, work in works.items()}
    if 0.0 < frame_likely < LIKELY:
        note = no_frame_note(frames_hz)
        found = {axis: replace(one, notes=(*one.notes, note)) for axis, one in found.items()}
    if not settings.sensor_turned:
        check_directions(found.values(), stated=settings.sensor_axis is not None)
    check_axes(list(found.values()))
    found = timed(found, {axis: work.late for axis, work in works.items()})
    steps.say("done", 1.0)
    return delays_compared(found)


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
    """The identification of one axis."""

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
        self._friction_mm = 0.0
        self._earlier_s = 0.0
        """By how much friction made alignment place the starts of the tests too late."""
        self.late: list[Lateness] = []
        """Of the raw logs that led to plants with their phase."""
        self._spectra: list[Tested] = []
        self._explanations: Explanations | None = None
        kind = next(k for k in _BEST_FIRST if any(isinstance(m.measurement, k) for m in measured))
        self._used = [m for m in measured if isinstance(m.measurement, kind)]
        self._left_out = [m for m in measured if not isinstance(m.measurement, kind)]
        self._kind = _KINDS[kind]
        names = {m.measurement.source for m in self._used}
        self._origin = Origin(
            sources=tuple(s for s in sources if s.name in names),
            measured_on=max(filter(None, map(date_in_name, names)), default=None),
        )

    def explain_spectra(self) -> float | None:
        """Find what explains spectra; return the frequency of what may be the frame's mode."""
        if self._kind != "spectrum":
            return None
        self._spectra = [self._spectrum(one) for one in self._used]
        if not self._settings.sensor_axis:
            check_repeats([s for s, _, _ in self._spectra], self._axis)
        self._explanations = self._explained()
        return self._explanations.frame_hz

    def identified(self, frame_likely: float) -> AxisIdentification:
        """Return the axis with the notes of its files; `explain_spectra` comes first.

        Parameters
        ----------
        frame_likely : float
            Probability that a weak mode in spectra is the frame's.
        """
        if self._kind == "model file":
            found = self._from_model()
        elif self._kind == "spectrum":
            found = self._from_spectra(frame_likely)
        else:
            found = self._from_responses()
            fault = phase_fault(found) if self._kind == "raw log" else None
            if fault is not None:
                self.late = []
                found = self._from_magnitudes(fault, frame_likely)
        self._steps.stepped(f"axis {self._axis}: fitted")
        notes = [*found.notes, *friction_notes(found.plants, self._settings.guides)]
        used = [one.measurement for one in self._used]
        notes += by_file((m.source, n) for m in used for n in m.notes)
        for one in self._left_out:
            notes.append(
                f"{one.measurement.source}: not used, because a {self._kind} of axis {self._axis} "
                "says more"
            )
        notes += by_file((r.source, n) for r in found.measured for n in r.notes)
        told, warned = parted(dict.fromkeys(notes))
        names = list(dict.fromkeys(m.source for m in used))
        of_fit = fit_warnings(found.fit, names, found.warnings) if found.fit else ()
        warnings = (*of_fit, *found.warnings, *warned)
        if found.fit is not None:
            check_informative(found.fit, found.measured, names, warnings)
        return replace(found, notes=told, warnings=warnings)

    def _from_model(self) -> AxisIdentification:
        if len(self._used) > 1:
            names = ", ".join(m.measurement.source for m in self._used)
            raise ModelError(f"axis {self._axis}: {len(self._used)} models ({names}); give one")
        model = self._used[0].measurement
        assert isinstance(model, PlantModel)
        plants = model_file_set(model.spec)
        if plants.provenance is not None:
            about = plants.provenance.model_copy(update={"sources": self._origin.sources})
            plants = plants.model_copy(update={"provenance": about})
        return AxisIdentification(axis=self._axis, plants=plants, notes=unvaried_notes(plants))

    def _from_responses(self) -> AxisIdentification:
        responses = [(self._response(m), m.condition) for m in self._used]
        common = usual([c for _, c in responses], self._axis)
        # A schedule counts the modes of the plant as it was fitted.
        frame_firm = self._settings.frame_firm or bool(special([c for _, c in responses]))
        frame: Frame | None = None
        if self._kind == "raw log":
            frame = None if frame_firm else frame_of([r for r, c in responses if c in common])
            responses = self._without_friction(responses, common, frame)
            if self._friction_mm and not frame_firm:
                frame = frame_of([r for r, c in responses if c in common], near=frame)
        chosen = [r for r, c in responses if c in common]
        if frame is not None:
            chosen = [frame.over_bed(response) for response in chosen]
        found = response_set(
            chosen,
            axis=self._axis,
            kind=self._kind,
            frame_firm=frame_firm,
            frame_hz=frame.f_hz if frame else None,
            max_order=self._max_order,
            origin=self._origin,
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
            warnings = level_warnings(chosen, nominal)
            mounting = [] if self._settings.sensor_axis else mounting_notes(self._axis, chosen)
            notes = [*mounting, *body_notes(self._friction_mm, frame)]
            at = [k for k, (_, c) in enumerate(responses) if c in common]
            self.late = self._lateness(at, chosen, prompt(nominal), found.plants)
        else:
            warnings = scale_warnings(chosen, nominal)
        warnings += frame_mode_warnings(prompt(nominal), found.plants.nominal)
        found = replace(
            found,
            plants=self._rubbing(found.plants),
            measured=(*found.measured, *others),
            warnings=(*found.warnings, *warnings),
            notes=tuple(notes),
        )
        return scheduled(found, nominal, fits, self._kind)

    def _spectrum(self, one: Measured) -> Tested:
        spectrum = one.measurement
        assert isinstance(spectrum, Spectrum)
        self._steps.stepped(f"axis {self._axis}: {spectrum.source}")
        return spectrum, excitation_for(spectrum, self._settings), one.condition

    def _from_spectra(self, frame_likely: float) -> AxisIdentification:
        assert self._explanations is not None
        spectra = self._spectra
        notes = [
            (s.source, note) for s, _, _ in spectra for note in excitation_notes(s, self._settings)
        ]
        if not self._settings.sensor_axis:
            turned = self._settings.sensor_turned
            notes += table_mounting_notes(self._axis, [s for s, _, _ in spectra], turned=turned)
        common = usual([c for _, _, c in spectra], self._axis)
        found = spectrum_set(
            self._explanations,
            axis=self._axis,
            frame_likely=frame_likely,
            guides=self._settings.guides or "rails",
            origin=self._origin,
        )
        nominal = found.fit
        assert nominal is not None
        fits: dict[Condition, Fit] = {}
        for condition in special([c for _, _, c in spectra]):
            under = [s for s, _, c in spectra if c == condition]
            test = same_test(under, [e for _, e, c in spectra if c == condition])
            column = self._settings.sensor_axis
            fits[condition] = refit_spectrum(mean_spectrum(under), test, nominal, column=column)
        others = tuple(s for s, _, c in spectra if c not in common)
        found = replace(found, measured=(*found.measured, *others), notes=tuple(by_file(notes)))
        return scheduled(found, nominal, fits, "spectrum")

    def _from_magnitudes(self, fault: str, frame_likely: float) -> AxisIdentification:
        """Return the axis from spectra of its logs, whose phase no model explains."""
        column = self._settings.sensor_axis or self._axis
        self._spectra = [
            (
                spectrum_along(aligned, log, column),
                self._test(log, aligned),
                one.condition,
            )
            for aligned, one in zip(self._aligned, self._used, strict=True)
            if isinstance(log := one.measurement, AccelerationLog)
        ]
        self._spectra, left_out = of_one_test(self._spectra, self._axis)
        self._explanations = self._explained()
        found = self._from_spectra(frame_likely)
        read = [note for one in self._used for note in one.measurement.notes]
        return replace(
            found,
            plants=self._rubbing(found.plants),
            notes=(*found.notes, *body_notes(self._friction_mm, None), *left_out),
            warnings=(*found.warnings, phase_warning(self._axis, fault, read)),
        )

    def _test(self, log: AccelerationLog, aligned: AlignedLog) -> Excitation:
        test = excitation_for(log, self._settings)
        return replace(test, accel_per_hz_mm_s=aligned.excitation.accel_per_hz_mm_s)

    def _explained(self) -> Explanations:
        """Return what explains the spectra without a condition of their own."""
        common = usual([c for _, _, c in self._spectra], self._axis)
        check_labels(common, self._axis)
        chosen = [(s, e) for s, e, c in self._spectra if c in common]
        return explanations(
            [s for s, _ in chosen],
            [e for _, e in chosen],
            column=self._settings.sensor_axis,
            max_order=self._max_order,
            progress=self._steps.within(f"axis {self._axis}: fitting"),
        )

    def _response(self, one: Measured) -> FrequencyResponse:
        measurement, label = one.measurement, one.condition.label
        what = f"axis {self._axis}: {measurement.source}"
        if isinstance(measurement, AccelerationLog):
            test = excitation_for(measurement, self._settings)
            mounted = _SENSOR_AXES.get(self._settings.sensor_axis or "")
            try:
                known = self._settings.accel_per_hz_mm_s is not None
                aligned = align(
                    measurement, test, sensor_direction=mounted, is_strength_known=known
                )
                test = aligned.excitation
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
            tests = excitation_notes(measurement, self._settings)
            levels = () if known else strength_notes(response, test)
            response = replace(response, notes=(*response.notes, *tests, *levels))
            self._aligned.append(aligned)
        elif isinstance(measurement, DrivenLog):
            response = estimate_driven(measurement, label=label)
        else:
            assert isinstance(measurement, FrequencyResponse)
            response = replace(measurement, label=label or measurement.label)
        self._steps.stepped(what)
        return response

    def _without_friction(
        self,
        responses: Sequence[tuple[FrequencyResponse, Condition]],
        common: Collection[Condition],
        frame: Frame | None,
    ) -> list[tuple[FrequencyResponse, Condition]]:
        """Return responses corrected for dry friction, and keep its size.

        Guides slide relative to the frame, but a sensor also measures the frame's motion.
        """
        used = [k for k, (_, c) in enumerate(responses) if c in common]
        felt = [r for r, _ in responses]
        motions = [felt] if frame is None else [felt, [frame.over_bed(r) for r in felt]]
        found = dry_friction(
            [self._aligned[k] for k in used], [[way[k] for k in used] for way in motions]
        )
        self._friction_mm = found.held_mm
        if not found.held_mm:
            return list(responses)
        self._earlier_s = found.late_s
        return [
            (self._freed(k, response, motions[found.motion][k], found), condition)
            for k, (response, condition) in enumerate(responses)
        ]

    def _freed(
        self,
        number: int,
        response: FrequencyResponse,
        motion: FrequencyResponse,
        friction: Friction,
    ) -> FrequencyResponse:
        """Return the response of a log corrected for dry friction of a motion over the frame."""
        log = self._used[number].measurement
        assert isinstance(log, AccelerationLog)
        sliding, stuck = (
            estimate_aligned(log, aligned, label=response.label)
            for aligned in freed(self._aligned[number], motion, friction)
        )
        return replace(better_explained(sliding, stuck), notes=response.notes)

    def _lateness(
        self,
        numbers: Sequence[int],
        responses: Sequence[FrequencyResponse],
        plant: PlantSpec,
        plants: PlantSetSpec,
    ) -> list[Lateness]:
        """Return how late the axis follows in each log."""
        members = plants.members
        others = () if isinstance(members, ParametricMembers) else [m.plant for m in members]
        out = []
        for number, response in zip(numbers, responses, strict=True):
            log, aligned = self._used[number].measurement, self._aligned[number]
            assert isinstance(log, AccelerationLog)
            started_s = aligned.start_s - self._earlier_s
            test, held_mm = aligned.excitation, self._friction_mm
            out.append(lateness(log, test, started_s, response, plant, others, held_mm))
        return out

    def _rubbing(self, plants: PlantSetSpec) -> PlantSetSpec:
        return plants.with_friction(self._friction_mm) if self._friction_mm else plants
