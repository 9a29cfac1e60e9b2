"""The plants of an axis from power spectral densities: tables, or logs without their phase."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from stillpath.models.identification.averaging import mean_spectrum
from stillpath.models.identification.conditioned import (
    SpectrumRun,
    check_labels,
    of_one_test,
    scheduled,
    special,
    usual,
)
from stillpath.models.identification.conditions import Condition
from stillpath.models.identification.friction import Friction
from stillpath.models.identification.messages import (
    body_notes,
    mounting_notes,
    phase_warning,
    table_mounting_notes,
)
from stillpath.models.identification.raw_logs import RawRun, spectrum_in
from stillpath.models.identification.readers import ReadSettings
from stillpath.models.identification.sets import Origin, spectrum_set
from stillpath.models.identification.spectrum_fit import (
    Explanations,
    explanations,
    refit_spectrum,
    same_test,
)
from stillpath.models.identification.types import Axis, AxisIdentification, Fit
from stillpath.models.notes import by_file
from stillpath.models.provenance import Kind

__all__ = ["ExplainedRuns", "IdentificationTask", "explain", "from_magnitudes", "from_spectra"]


@dataclass(frozen=True, slots=True)
class IdentificationTask:
    """What is asked of one axis, whatever it was measured with.

    Attributes
    ----------
    kind : Kind
        Of the measurements that are used.
    max_order : int
        Most pole pairs to try.
    progress : callable
        Called with the share of the fit that is done.
    """

    axis: Axis
    kind: Kind
    settings: ReadSettings
    origin: Origin
    max_order: int
    progress: Callable[[float], None]


class ExplainedRuns(NamedTuple):
    """Spectra of an axis, their usual conditions, and what explains those of these."""

    runs: Sequence[SpectrumRun]
    common: Sequence[Condition]
    by: Explanations


def explain(task: IdentificationTask, runs: Sequence[SpectrumRun]) -> ExplainedRuns:
    """Find what explains the spectra that were measured under the usual conditions."""
    common = usual([run.condition for run in runs], task.axis)
    check_labels(common, task.axis)
    chosen = [run for run in runs if run.condition in common]
    by = explanations(
        [run.spectrum for run in chosen],
        [run.test for run in chosen],
        column=task.settings.sensor_axis,
        max_order=task.max_order,
        progress=task.progress,
    )
    return ExplainedRuns(runs, common, by)


def from_spectra(
    task: IdentificationTask, explained: ExplainedRuns, frame_likely: float
) -> AxisIdentification:
    """Return the axis with plants that explain its spectra.

    Parameters
    ----------
    frame_likely : float
        Probability that a weak mode in them is the frame's.
    """
    runs, common = explained.runs, explained.common
    settings, column = task.settings, task.settings.sensor_axis
    notes = [(run.spectrum.source, note) for run in runs for note in run.notes]
    if not column:
        spectra = [run.spectrum for run in runs]
        notes += table_mounting_notes(task.axis, spectra, turned=settings.sensor_turned)
    found = spectrum_set(
        explained.by,
        axis=task.axis,
        frame_likely=frame_likely,
        guides=settings.guides or "rails",
        origin=task.origin,
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
    found = replace(found, measured=(*found.measured, *others), notes=tuple(by_file(notes)))
    return scheduled(found, nominal, fits, "spectrum")


def from_magnitudes(
    task: IdentificationTask,
    logs: Sequence[RawRun],
    friction: Friction,
    fault: str,
    frame_likely: float,
) -> AxisIdentification:
    """Return the axis from the spectra of its logs.

    Parameters
    ----------
    friction : Friction
        That the logs show.
    fault : str
        Why their phase cannot be used (`phase_fault`).
    frame_likely : float
        As for `from_spectra`.
    """
    column = task.settings.sensor_axis or task.axis
    spectra, left_out = of_one_test([spectrum_in(run, column) for run in logs], task.axis)
    found = from_spectra(task, explain(task, spectra), frame_likely)
    read = [note for run in logs for note in run.log.notes]
    turned = mounting_notes(task.axis, [run.response for run in logs])
    mounting = [] if task.settings.sensor_axis else turned
    return replace(
        found,
        plants=friction.on(found.plants),
        notes=(*found.notes, *mounting, *body_notes(friction.held_mm, None), *left_out),
        warnings=(*found.warnings, phase_warning(task.axis, fault, read)),
    )
