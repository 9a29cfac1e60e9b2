"""Identify the plants of a machine's axes from measurements.

Measurements are grouped by axis; logs become frequency responses, those become a nominal plant and
a set. What was measured with a weight on the bed or at different places becomes a schedule.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple, TypeAlias

from stillpath.models.errors import ModelError
from stillpath.models.identification.averaging import mean_response, mean_spectrum
from stillpath.models.identification.clocks import Lateness, timed
from stillpath.models.identification.conditioned import (
    SpectrumRun,
    check_labels,
    of_one_test,
    scheduled,
    special,
    usual,
)
from stillpath.models.identification.conditions import Condition
from stillpath.models.identification.estimation import estimate_driven
from stillpath.models.identification.frame import LIKELY, likely_of
from stillpath.models.identification.friction import Friction
from stillpath.models.identification.messages import (
    body_notes,
    fit_warnings,
    frame_mode_warnings,
    friction_notes,
    level_warnings,
    mounting_notes,
    no_frame_note,
    phase_fault,
    phase_warning,
    scale_warnings,
    table_mounting_notes,
    unvaried_notes,
)
from stillpath.models.identification.modal_fit import refit
from stillpath.models.identification.nozzle import Frame
from stillpath.models.identification.prompt import prompt
from stillpath.models.identification.raw_logs import (
    RawRun,
    estimated,
    frame_in,
    lateness_in,
    spectrum_in,
    without_friction,
)
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
    Fit,
    FrequencyResponse,
    Measurement,
    PlantModel,
    Spectrum,
)
from stillpath.models.notes import by_file, parted
from stillpath.models.plants import PlantSetSpec
from stillpath.models.provenance import Kind, SourceFile

__all__ = ["Measured", "Progress", "identify"]

Progress: TypeAlias = Callable[[str, float], None]
"""Called with what is being done and how much of all is done, 0 to 1."""

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


class _ResponseRun(NamedTuple):
    """A response, and under what condition it was measured."""

    response: FrequencyResponse
    condition: Condition


class _Explained(NamedTuple):
    """Spectra of an axis, their usual conditions, and what explains those of these."""

    runs: Sequence[SpectrumRun]
    common: Sequence[Condition]
    by: Explanations


class _AxisWork:
    """The identification of one axis, in two steps: `explain_spectra`, then `identified`.

    Attributes
    ----------
    late : list of Lateness
        Of the raw logs that led to plants with their phase, once the axis is identified.
    """

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
        self._explained: _Explained | None = None
        self.late: list[Lateness] = []
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
        """Find what explains spectra; return where the frame's mode may be in it, in Hz."""
        if self._kind != "spectrum":
            return None
        runs = [self._spectrum(one) for one in self._used]
        if not self._settings.sensor_axis:
            check_repeats([run.spectrum for run in runs], self._axis)
        self._explained = self._explain(runs)
        return self._explained.by.frame_hz

    def identified(self, frame_likely: float) -> AxisIdentification:
        """Return the axis with the notes of its files; `explain_spectra` comes first.

        Parameters
        ----------
        frame_likely : float
            Probability that a weak mode in spectra is the frame's.
        """
        match self._kind:
            case "model file":
                found = self._from_model()
            case "spectrum":
                assert self._explained is not None
                found = self._from_tables(self._explained, frame_likely)
            case "raw log":
                found = self._from_logs(frame_likely)
            case _:
                found = self._from_responses()
        self._steps.stepped(f"axis {self._axis}: fitted")
        return self._with_notes_of_files(found)

    def _with_notes_of_files(self, found: AxisIdentification) -> AxisIdentification:
        """Add what the files say; refuse a model that they do not determine."""
        used = [one.measurement for one in self._used]
        notes = [*found.notes, *friction_notes(found.plants, self._settings.guides)]
        notes += by_file((m.source, n) for m in used for n in m.notes)
        notes += [
            f"{one.measurement.source}: not used, because a {self._kind} of axis {self._axis} "
            "says more"
            for one in self._left_out
        ]
        notes += by_file((r.source, n) for r in found.measured for n in r.notes)
        told, warned = parted(dict.fromkeys(notes))
        names = list(dict.fromkeys(m.source for m in used))
        of_fit = fit_warnings(found.fit, names, found.warnings) if found.fit else ()
        warnings = (*of_fit, *found.warnings, *warned)
        if found.fit is not None:
            check_informative(found.fit, found.measured, names, warnings)
        return replace(found, notes=told, warnings=warnings)

    # A model that was read

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

    # Responses

    def _from_responses(self) -> AxisIdentification:
        """Return the axis from responses, recorded drives or measured by others."""
        runs = [_ResponseRun(self._response(one), one.condition) for one in self._used]
        common = usual([run.condition for run in runs], self._axis)
        chosen = [run.response for run in runs if run.condition in common]
        found, nominal = self._fitted(chosen, frame_firm=self._is_frame_firm(runs))
        warnings = scale_warnings(chosen, nominal)
        warnings += frame_mode_warnings(prompt(nominal), found.plants.nominal)
        found = replace(found, warnings=(*found.warnings, *warnings))
        return self._scheduled(found, nominal, runs, common)

    def _from_logs(self, frame_likely: float) -> AxisIdentification:
        """Return the axis from raw logs; by their magnitude alone where no model explains them."""
        felt = [self._log(one) for one in self._used]
        common = usual([run.condition for run in felt], self._axis)
        frame_firm = self._is_frame_firm(felt)
        frame = None if frame_firm else frame_in(felt, common)
        runs, friction = without_friction(felt, common, frame)
        if friction.held_mm and not frame_firm:
            frame = frame_in(runs, common, near=frame)
        usual_runs = [run for run in runs if run.condition in common]
        chosen = [run.response for run in usual_runs]
        if frame is not None:
            chosen = [frame.over_bed(response) for response in chosen]
        found, nominal = self._fitted(chosen, frame_firm=frame_firm, frame=frame)
        plant, plants = prompt(nominal), found.plants
        warnings = level_warnings(chosen, nominal) + frame_mode_warnings(plant, plants.nominal)
        mounting = [] if self._settings.sensor_axis else mounting_notes(self._axis, chosen)
        found = replace(
            found,
            plants=_rubbing(plants, friction),
            warnings=(*found.warnings, *warnings),
            notes=(*mounting, *body_notes(friction.held_mm, frame)),
        )
        found = self._scheduled(found, nominal, runs, common)
        fault = phase_fault(found)
        if fault is not None:
            return self._from_magnitudes(runs, friction, fault, frame_likely)
        self.late = [
            lateness_in(run, friction, response, plant, plants)
            for run, response in zip(usual_runs, chosen, strict=True)
        ]
        return found

    def _is_frame_firm(self, runs: Sequence[RawRun | _ResponseRun]) -> bool:
        # A schedule counts the modes of the plant as it was fitted.
        return self._settings.frame_firm or bool(special([run.condition for run in runs]))

    def _fitted(
        self, chosen: Sequence[FrequencyResponse], *, frame_firm: bool, frame: Frame | None = None
    ) -> tuple[AxisIdentification, Fit]:
        """Return the plants of responses under the usual conditions, and the nominal fit."""
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
        assert found.fit is not None
        return found, found.fit

    def _scheduled(
        self,
        found: AxisIdentification,
        nominal: Fit,
        runs: Sequence[RawRun | _ResponseRun],
        common: Collection[Condition],
    ) -> AxisIdentification:
        """Return the axis with what its responses under special conditions say."""
        fits = {
            condition: refit(
                mean_response([run.response for run in runs if run.condition == condition]), nominal
            )
            for condition in special([run.condition for run in runs])
        }
        others = (run.response for run in runs if run.condition not in common)
        found = replace(found, measured=(*found.measured, *others))
        return scheduled(found, nominal, fits, self._kind)

    def _log(self, one: Measured) -> RawRun:
        log = one.measurement
        assert isinstance(log, AccelerationLog)
        what = f"axis {self._axis}: {log.source}"
        run = estimated(
            log,
            one.condition,
            self._settings,
            progress=lambda stage, part: self._steps.within(f"{what}, {stage}")(part),
        )
        self._steps.stepped(what)
        return run

    def _response(self, one: Measured) -> FrequencyResponse:
        measurement, label = one.measurement, one.condition.label
        if isinstance(measurement, DrivenLog):
            response = estimate_driven(measurement, label=label)
        else:
            assert isinstance(measurement, FrequencyResponse)
            response = replace(measurement, label=label or measurement.label)
        self._steps.stepped(f"axis {self._axis}: {measurement.source}")
        return response

    # Spectra

    def _spectrum(self, one: Measured) -> SpectrumRun:
        spectrum = one.measurement
        assert isinstance(spectrum, Spectrum)
        self._steps.stepped(f"axis {self._axis}: {spectrum.source}")
        return SpectrumRun(spectrum, excitation_for(spectrum, self._settings), one.condition)

    def _explain(self, runs: Sequence[SpectrumRun]) -> _Explained:
        """Find what explains the spectra without a condition of their own."""
        common = usual([run.condition for run in runs], self._axis)
        check_labels(common, self._axis)
        chosen = [run for run in runs if run.condition in common]
        by = explanations(
            [run.spectrum for run in chosen],
            [run.test for run in chosen],
            column=self._settings.sensor_axis,
            max_order=self._max_order,
            progress=self._steps.within(f"axis {self._axis}: fitting"),
        )
        return _Explained(runs, common, by)

    def _from_tables(self, explained: _Explained, frame_likely: float) -> AxisIdentification:
        settings, spectra = self._settings, [run.spectrum for run in explained.runs]
        notes = [(one.source, note) for one in spectra for note in excitation_notes(one, settings)]
        if not settings.sensor_axis:
            notes += table_mounting_notes(self._axis, spectra, turned=settings.sensor_turned)
        found = self._from_spectra(explained, frame_likely)
        return replace(found, notes=(*by_file(notes), *found.notes))

    def _from_spectra(self, explained: _Explained, frame_likely: float) -> AxisIdentification:
        runs, common = explained.runs, explained.common
        settings, column = self._settings, self._settings.sensor_axis
        found = spectrum_set(
            explained.by,
            axis=self._axis,
            frame_likely=frame_likely,
            guides=settings.guides or "rails",
            origin=self._origin,
        )
        nominal = found.fit
        assert nominal is not None
        fits: dict[Condition, Fit] = {}
        for condition in special([run.condition for run in runs]):
            under = [run for run in runs if run.condition == condition]
            spectra = [run.spectrum for run in under]
            test = same_test(spectra, [run.test for run in under])
            fits[condition] = refit_spectrum(mean_spectrum(spectra), test, nominal, column=column)
        others = (run.spectrum for run in runs if run.condition not in common)
        found = replace(found, measured=(*found.measured, *others))
        return scheduled(found, nominal, fits, "spectrum")

    def _from_magnitudes(
        self, logs: Sequence[RawRun], friction: Friction, fault: str, frame_likely: float
    ) -> AxisIdentification:
        """Return the axis from spectra of its logs, whose phase no model explains."""
        column = self._settings.sensor_axis or self._axis
        spectra = [spectrum_in(run, self._settings, column) for run in logs]
        spectra, left_out = of_one_test(spectra, self._axis)
        found = self._from_spectra(self._explain(spectra), frame_likely)
        read = [note for run in logs for note in run.log.notes]
        # What is known of the tests is what the logs say: spectra say less.
        tests = by_file((run.log.source, note) for run in logs for note in run.response.notes)
        turned = mounting_notes(self._axis, [run.response for run in logs])
        mounting = [] if self._settings.sensor_axis else turned
        about = (*tests, *mounting, *body_notes(friction.held_mm, None), *left_out)
        return replace(
            found,
            plants=_rubbing(found.plants, friction),
            notes=(*found.notes, *about),
            warnings=(*found.warnings, phase_warning(self._axis, fault, read)),
        )


def _rubbing(plants: PlantSetSpec, friction: Friction) -> PlantSetSpec:
    return plants.with_friction(friction.held_mm) if friction.held_mm else plants
