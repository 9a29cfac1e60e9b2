"""Identify the plants of a machine's axes from measurements.

Measurements are grouped by axis; logs become frequency responses, those become a nominal plant and
a set (`axis_from_responses`), as do spectra (`axis_from_spectra`). What was measured with a weight
on the bed or at different places becomes a schedule.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeAlias

from stillpath.models.errors import ModelError
from stillpath.models.identification.axis_from_responses import (
    ResponseRun,
    StopsRun,
    from_logs,
    from_responses,
    from_stops,
)
from stillpath.models.identification.axis_from_spectra import (
    ExplainedRuns,
    IdentificationTask,
    explain,
    from_spectra,
)
from stillpath.models.identification.clocks import Lateness, timed
from stillpath.models.identification.conditioned import SpectrumRun
from stillpath.models.identification.conditions import Condition
from stillpath.models.identification.estimation import estimate_driven
from stillpath.models.identification.frame import LIKELY, likely_of
from stillpath.models.identification.messages import (
    fit_warnings,
    friction_notes,
    no_frame_note,
    unvaried_notes,
)
from stillpath.models.identification.raw_logs import RawRun, estimated
from stillpath.models.identification.readers import (
    ReadSettings,
    assumed_test,
    date_in_name,
    tested_axis,
)
from stillpath.models.identification.sets import Origin, model_file_set
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
    FrequencyResponse,
    Measurement,
    PlantModel,
    Spectrum,
    StopsLog,
)
from stillpath.models.notes import by_file, parted
from stillpath.models.provenance import Kind, SourceFile

__all__ = ["Measured", "Progress", "identify"]

Progress: TypeAlias = Callable[[str, float], None]
"""Called with what is being done and how much of all is done, 0 to 1."""

_KINDS: dict[type, Kind] = {
    AccelerationLog: "raw log",
    StopsLog: "ring test",
    DrivenLog: "recorded drive",
    FrequencyResponse: "frequency response",
    Spectrum: "spectrum",
    PlantModel: "model file",
}
_BEST_FIRST = (PlantModel, AccelerationLog, StopsLog, DrivenLog, FrequencyResponse, Spectrum)
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
    """The identification of one axis, in two steps: `explain_spectra`, then `identified`.

    Between them all axes are looked at: a weak mode that is alike in X and Y is the frame's.

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
        self._explained: ExplainedRuns | None = None
        self.late: list[Lateness] = []
        kind = next(k for k in _BEST_FIRST if any(isinstance(m.measurement, k) for m in measured))
        self._used = [m for m in measured if isinstance(m.measurement, kind)]
        self._left_out = [m for m in measured if not isinstance(m.measurement, kind)]
        names = {m.measurement.source for m in self._used}
        origin = Origin(
            sources=tuple(s for s in sources if s.name in names),
            measured_on=max(filter(None, map(date_in_name, names)), default=None),
        )
        fitting = steps.within(f"axis {axis}: fitting")
        self._task = IdentificationTask(axis, _KINDS[kind], settings, origin, max_order, fitting)

    def explain_spectra(self) -> float | None:
        """Find what explains spectra; return where the frame's mode may be in it, in Hz."""
        if self._task.kind != "spectrum":
            return None
        runs = [self._spectrum(one) for one in self._used]
        if not self._settings.sensor_axis:
            check_repeats([run.spectrum for run in runs], self._axis)
        self._explained = explain(self._task, runs)
        return self._explained.by.frame_hz

    def identified(self, frame_likely: float) -> AxisIdentification:
        """Return the axis with the notes of its files; `explain_spectra` comes first.

        Parameters
        ----------
        frame_likely : float
            Probability that a weak mode in spectra is the frame's.
        """
        match self._task.kind:
            case "model file":
                found = self._from_model()
            case "spectrum":
                assert self._explained is not None
                found = from_spectra(self._task, self._explained, frame_likely)
            case "raw log":
                felt = [self._log(one) for one in self._used]
                found, self.late = from_logs(self._task, felt, frame_likely)
            case "ring test":
                found = from_stops(self._task, [self._stops(one) for one in self._used])
            case _:
                found = from_responses(self._task, [self._response(one) for one in self._used])
        self._steps.stepped(f"axis {self._axis}: fitted")
        return self._with_notes_of_files(found)

    def _with_notes_of_files(self, found: AxisIdentification) -> AxisIdentification:
        """Add what the files say; refuse a model that they do not determine."""
        used = [one.measurement for one in self._used]
        notes = [*found.notes, *friction_notes(found.plants, self._settings.guides)]
        notes += by_file((m.source, n) for m in used for n in m.notes)
        notes += [
            f"{one.measurement.source}: not used, because a {self._task.kind} of axis {self._axis} "
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

    def _from_model(self) -> AxisIdentification:
        if len(self._used) > 1:
            names = ", ".join(m.measurement.source for m in self._used)
            raise ModelError(f"axis {self._axis}: {len(self._used)} models ({names}); give one")
        model = self._used[0].measurement
        assert isinstance(model, PlantModel)
        plants = model_file_set(model.spec)
        if plants.provenance is not None:
            about = plants.provenance.model_copy(update={"sources": self._task.origin.sources})
            plants = plants.model_copy(update={"provenance": about})
        return AxisIdentification(axis=self._axis, plants=plants, notes=unvaried_notes(plants))

    # From a measurement to a run

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

    def _stops(self, one: Measured) -> StopsRun:
        assert isinstance(one.measurement, StopsLog)
        self._steps.stepped(f"axis {self._axis}: {one.measurement.source}")
        return StopsRun(one.measurement, one.condition)

    def _response(self, one: Measured) -> ResponseRun:
        measurement, label = one.measurement, one.condition.label
        if isinstance(measurement, DrivenLog):
            response = estimate_driven(measurement, label=label)
        else:
            assert isinstance(measurement, FrequencyResponse)
            response = replace(measurement, label=label or measurement.label)
        self._steps.stepped(f"axis {self._axis}: {measurement.source}")
        return ResponseRun(response, one.condition)

    def _spectrum(self, one: Measured) -> SpectrumRun:
        spectrum = one.measurement
        assert isinstance(spectrum, Spectrum)
        self._steps.stepped(f"axis {self._axis}: {spectrum.source}")
        test = assumed_test(spectrum, self._settings)
        return SpectrumRun(spectrum, test.excitation, one.condition, test.notes)
