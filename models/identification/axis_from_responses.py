"""The plants of an axis from frequency responses: of drives, logs, stops, or measured elsewhere."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import NamedTuple

from stillpath.models.identification.averaging import mean_response
from stillpath.models.identification.axis_from_spectra import IdentificationTask, from_magnitudes
from stillpath.models.identification.clocks import Lateness
from stillpath.models.identification.conditioned import scheduled, special, usual
from stillpath.models.identification.conditions import Condition
from stillpath.models.identification.messages import (
    body_notes,
    frame_mode_warnings,
    level_warnings,
    mounting_notes,
    phase_fault,
    scale_warnings,
)
from stillpath.models.identification.modal_fit import refit
from stillpath.models.identification.nozzle import Frame
from stillpath.models.identification.prompt import prompt
from stillpath.models.identification.raw_logs import (
    RawRun,
    frame_in,
    lateness_in,
    without_friction,
)
from stillpath.models.identification.sets import response_set
from stillpath.models.identification.stops import responses_of_stops
from stillpath.models.identification.types import (
    AxisIdentification,
    Fit,
    FrequencyResponse,
    StopsLog,
)

__all__ = ["ResponseRun", "StopsRun", "from_logs", "from_responses", "from_stops"]


class ResponseRun(NamedTuple):
    """A response, and under what condition it was measured."""

    response: FrequencyResponse
    condition: Condition


class StopsRun(NamedTuple):
    """A log of stops, and under what condition it was measured."""

    log: StopsLog
    condition: Condition


def from_responses(task: IdentificationTask, runs: Sequence[ResponseRun]) -> AxisIdentification:
    """Return the axis with plants that explain its responses."""
    common = usual([run.condition for run in runs], task.axis)
    chosen = [run.response for run in runs if run.condition in common]
    found, nominal = _fitted(task, chosen, frame_firm=_is_frame_firm(task, runs))
    warnings = scale_warnings(chosen, nominal)
    warnings += frame_mode_warnings(prompt(nominal), found.plants.nominal)
    found = replace(found, warnings=(*found.warnings, *warnings))
    return _scheduled(task, found, nominal, runs, common)


def from_stops(task: IdentificationTask, runs: Sequence[StopsRun]) -> AxisIdentification:
    """Return the axis with plants and dry friction that explain its stops in ring tests."""
    conditions = [run.condition for run in runs]
    found = responses_of_stops(
        [run.log for run in runs],
        [condition.label for condition in conditions],
        frame_firm=task.settings.frame_firm or bool(special(conditions)),
    )
    axis = from_responses(task, list(map(ResponseRun, found.responses, conditions)))
    plants = axis.plants.with_friction(found.held_mm) if found.held_mm else axis.plants
    notes = (*axis.notes, *body_notes(found.held_mm, found.frame))
    return replace(axis, plants=plants, notes=notes)


def from_logs(
    task: IdentificationTask, felt: Sequence[RawRun], frame_likely: float
) -> tuple[AxisIdentification, list[Lateness]]:
    """Return the axis with plants that explain its raw logs, and how late it follows in each.

    Where no model explains the phase of the logs, only their magnitude is used, and they tell no
    lateness.

    Parameters
    ----------
    felt : sequence of RawRun
        With the responses of what the sensor felt: friction and frame included.
    frame_likely : float
        Probability that a weak mode is the frame's, if only the magnitude is used.
    """
    common = usual([run.condition for run in felt], task.axis)
    frame_firm = _is_frame_firm(task, felt)
    frame = None if frame_firm else frame_in(felt, common)
    runs, friction = without_friction(felt, common, frame)
    if friction.held_mm and not frame_firm:
        frame = frame_in(runs, common, near=frame)
    usual_runs = [run for run in runs if run.condition in common]
    chosen = [run.response for run in usual_runs]
    if frame is not None:
        chosen = [frame.over_bed(response) for response in chosen]
    found, nominal = _fitted(task, chosen, frame_firm=frame_firm, frame=frame)
    plant, plants = prompt(nominal), found.plants
    warnings = level_warnings(chosen, nominal) + frame_mode_warnings(plant, plants.nominal)
    mounting = [] if task.settings.sensor_axis else mounting_notes(task.axis, chosen)
    found = replace(
        found,
        plants=friction.on(plants),
        warnings=(*found.warnings, *warnings),
        notes=(*mounting, *body_notes(friction.held_mm, frame)),
    )
    found = _scheduled(task, found, nominal, runs, common)
    fault = phase_fault(found)
    if fault is not None:
        return from_magnitudes(task, runs, friction, fault, frame_likely), []
    late = [
        lateness_in(run, friction, response, plant, plants)
        for run, response in zip(usual_runs, chosen, strict=True)
    ]
    return found, late


def _is_frame_firm(task: IdentificationTask, runs: Sequence[RawRun | ResponseRun]) -> bool:
    # A schedule counts the modes of the plant as it was fitted.
    return task.settings.frame_firm or bool(special([run.condition for run in runs]))


def _fitted(
    task: IdentificationTask,
    chosen: Sequence[FrequencyResponse],
    *,
    frame_firm: bool,
    frame: Frame | None = None,
) -> tuple[AxisIdentification, Fit]:
    """Return the plants of responses under the usual conditions, and the nominal fit."""
    found = response_set(
        chosen,
        axis=task.axis,
        kind=task.kind,
        frame_firm=frame_firm,
        frame_hz=frame.f_hz if frame else None,
        max_order=task.max_order,
        origin=task.origin,
        progress=task.progress,
    )
    assert found.fit is not None
    return found, found.fit


def _scheduled(
    task: IdentificationTask,
    found: AxisIdentification,
    nominal: Fit,
    runs: Sequence[RawRun | ResponseRun],
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
    return scheduled(found, nominal, fits, task.kind)
