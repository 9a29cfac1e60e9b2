"""Raw logs of one axis: their responses, free of dry friction, their spectra, and their clocks."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from stillpath.models.errors import ModelError
from stillpath.models.identification.alignment import AlignedLog, align
from stillpath.models.identification.clocks import Lateness, lateness
from stillpath.models.identification.conditioned import SpectrumRun
from stillpath.models.identification.conditions import Condition
from stillpath.models.identification.estimation import estimate_aligned, estimate_response
from stillpath.models.identification.excitation import klipper_psd
from stillpath.models.identification.friction import Friction, better_explained, dry_friction, freed
from stillpath.models.identification.messages import strength_notes
from stillpath.models.identification.nozzle import Frame, frame_of
from stillpath.models.identification.readers import AssumedTest, ReadSettings, assumed_test
from stillpath.models.identification.types import AccelerationLog, FrequencyResponse, Spectrum
from stillpath.models.plants import ParametricMembers, PlantSetSpec, PlantSpec

__all__ = ["RawRun", "estimated", "frame_in", "lateness_in", "spectrum_in", "without_friction"]

_TABLE_HZ = 200.0
"""Where Klipper ends a table."""
_SENSOR_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


@dataclass(frozen=True, slots=True, eq=False)
class RawRun:
    """A raw log, with the test that was found in it.

    Attributes
    ----------
    aligned : AlignedLog
        The part of the log that is the test, beside its command.
    response : FrequencyResponse
        Of the axis, as the sensor felt it.
    assumed : AssumedTest
        The test that was looked for.
    """

    log: AccelerationLog
    aligned: AlignedLog
    response: FrequencyResponse
    condition: Condition
    assumed: AssumedTest


def estimated(
    log: AccelerationLog,
    condition: Condition,
    settings: ReadSettings,
    progress: Callable[[str, float], None],
) -> RawRun:
    """Find the test in a log, and the response of the axis.

    Parameters
    ----------
    progress : callable
        Called with the stage and the share of it that is done.

    Raises
    ------
    ModelError
        If the test is not in the log, or the axis did not follow it (`align`,
        `estimate_response`); with what the reader noticed, which may be the reason.
    """
    assumed = assumed_test(log, settings)
    known = settings.accel_per_hz_mm_s is not None
    mounted = _SENSOR_AXES.get(settings.sensor_axis or "")
    try:
        aligned = align(log, assumed.excitation, sensor_direction=mounted, is_strength_known=known)
        test = aligned.excitation
        response = estimate_response(
            log,
            test,
            aligned=aligned,
            # Tests of different strength are different operating points.
            label=condition.label or f"{test.accel_per_hz_mm_s:g} mm/s",
            progress=progress,
        )
    except ModelError as error:
        raise ModelError("; ".join([str(error), *log.notes])) from None
    levels = () if known else strength_notes(response, test)
    response = replace(response, notes=(*response.notes, *assumed.notes, *levels))
    return RawRun(log, aligned, response, condition, assumed)


def frame_in(
    runs: Sequence[RawRun], common: Collection[Condition], near: Frame | None = None
) -> Frame | None:
    """Return the frame that the logs of the usual conditions show; see `nozzle.frame_of`."""
    return frame_of([run.response for run in runs if run.condition in common], near=near)


def without_friction(
    runs: Sequence[RawRun], common: Collection[Condition], frame: Frame | None
) -> tuple[list[RawRun], Friction]:
    """Return the logs with responses free of dry friction, and the friction that was found.

    Guides slide relative to the frame, but a sensor also measures the frame's motion.

    Parameters
    ----------
    common : collection of Condition
        Those whose logs tell the friction; it is taken out of all.
    frame : Frame, optional
        That the logs show.
    """
    felt = [run.response for run in runs]
    motions = [felt] if frame is None else [felt, [frame.over_bed(r) for r in felt]]
    used = [k for k, run in enumerate(runs) if run.condition in common]
    friction = dry_friction(
        [runs[k].aligned for k in used], [[motion[k] for k in used] for motion in motions]
    )
    if not friction.held_mm:
        return list(runs), Friction()
    slid = motions[friction.motion]
    return [_freed(run, own, friction) for run, own in zip(runs, slid, strict=True)], friction


def _freed(run: RawRun, motion: FrequencyResponse, friction: Friction) -> RawRun:
    """Return a log with its response corrected for dry friction of a motion over the frame."""
    sliding, stuck = (
        estimate_aligned(run.log, aligned, label=run.response.label)
        for aligned in freed(run.aligned, motion, friction)
    )
    response = replace(better_explained(sliding, stuck), notes=run.response.notes)
    return replace(run, response=response)


def spectrum_in(run: RawRun, column: str) -> SpectrumRun:
    """Return the spectrum of a log along its axis, as Klipper computes tables, in such a column."""
    aligned = run.aligned
    strength = aligned.excitation.accel_per_hz_mm_s
    test = replace(run.assumed.excitation, accel_per_hz_mm_s=strength)
    time_s = np.arange(len(aligned.measured_mm_s2)) / aligned.rate_hz
    f_hz, psd = klipper_psd(time_s, aligned.measured_mm_s2)
    told = f_hz <= _TABLE_HZ
    psd_of = {column: psd[told]}
    spectrum = Spectrum(f_hz[told], psd_of, run.log.axis, run.log.source, strength)
    # What is known of the test is what the log says: a spectrum of it says less.
    return SpectrumRun(spectrum, test, run.condition, run.response.notes)


def lateness_in(
    run: RawRun,
    friction: Friction,
    response: FrequencyResponse,
    plant: PlantSpec,
    plants: PlantSetSpec,
) -> Lateness:
    """Return how late the axis follows in a log; see `clocks.lateness`.

    Parameters
    ----------
    friction : Friction
        Because of it, alignment placed the start of the test too late, and is unsure of it.
    response : FrequencyResponse
        Of the nozzle over the bed.
    plant, plants : PlantSpec, PlantSetSpec
        The nominal one, without its delay, and the set.
    """
    members = plants.members
    others = () if isinstance(members, ParametricMembers) else [m.plant for m in members]
    started_s = run.aligned.start_s - friction.late_s
    test, held_mm = run.aligned.excitation, friction.held_mm
    return lateness(run.log, test, started_s, response, plant, others, held_mm)
