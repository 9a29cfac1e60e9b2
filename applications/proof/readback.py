"""Compare an accelerometer log taken during a print with the model's prediction for it."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from stillpath.applications.proof.figures import AxisReadback, ReadbackReport
from stillpath.applications.proof.judging import AxisMotion, judge
from stillpath.applications.proof.matching import (
    Match,
    Signal,
    band_pass,
    log_signal,
    match,
    read_log,
)
from stillpath.gcode.containers.opening import open_text
from stillpath.gcode.firmware.registry import adapter
from stillpath.models.arrays import Array
from stillpath.models.friction import DryFriction
from stillpath.models.machine import Machine
from stillpath.models.plants import PlantSpec, discretise
from stillpath.models.schedule import EMPTY
from stillpath.models.shaping import OFF
from stillpath.pipeline.file_dialect import dialect_for
from stillpath.pipeline.file_motion import TextMotion
from stillpath.pipeline.progress import ProgressCallback, ProgressReports
from stillpath.pipeline.shaping import ShapedMotion
from stillpath.simulation.response import PlantStream
from stillpath.version import __version__

__all__ = ["verify_log"]

_RECORD = "record with ACCELEROMETER_MEASURE (Klipper) or M956 (RepRapFirmware) during the print"
_RATE_HZ = 1000.0
_LONGEST_S = 240.0
"""Longest part of a log that is compared; more gives no new information."""
_MOUNT_BAND_HZ = (3.0, 20.0)
_SEEN = 0.3
"""Least response of the sensor to an axis, relative to the other, to count as logged."""
_MATCHED = 0.5
_UNKNOWN_SHAPER = (
    "The machine does not say which shaper the firmware had (firmware.shaper), and up to the part "
    "that was compared the file sets none: state it in the machine's document."
)


def verify_log(
    printed: Path, log: Path, machine: Machine, *, progress: ProgressCallback | None = None
) -> ReadbackReport:
    """Compare a log that was recorded during a print with the prediction for it.

    Parameters
    ----------
    printed : Path
        The G-code that was printed, compensated or not.
    log : Path
        Klipper's or RepRapFirmware's raw accelerations; any part of the print.
    progress : callable, optional
        Called while the file is planned.

    Raises
    ------
    GcodeError
        The G-code cannot be read.
    ModelError
        The log cannot be read, or holds no accelerations.
    """
    recorded = read_log(log, _RECORD)
    measured = log_signal(recorded)
    command, known_from_s = _commanded(printed, machine, progress)
    specs = {a: machine.axes[a].nominal for a in ("x", "y")}
    answer = PlantStream([discretise(s, command.dt_s) for s in specs.values()]).push(command.rows)
    predicted = Signal(0.0, command.dt_s, _acceleration(answer, command.dt_s))
    found = match(predicted, measured)
    report: dict[str, Any] = {
        "version": __version__,
        "machine": machine.name,
        "machine_title": machine.title,
        "machine_revision": machine.revision,
        "printed": printed.name,
        "log": log.name,
        "explained": found.explained,
        "log_s": found.log_s,
    }
    if found.explained < _MATCHED or found.plan_end_s <= found.plan_start_s:
        return _another_print(report, found)
    axes, sensor, notes = _in_machine_axes(command, predicted, measured, found, specs)
    judged = [judge(axis, command.dt_s) for axis in axes]
    otherwise = "the machine has changed"
    if found.plan_start_s < known_from_s:
        otherwise = "the shaper is not known"
        notes.append(_UNKNOWN_SHAPER)
        judged = [_shaper_or_machine(axis) for axis in judged]
    return ReadbackReport(
        **report,
        outcome="the model holds" if all(a.holds for a in judged) else otherwise,
        verdicts=[a.verdict for a in judged],
        notes=[*recorded.notes, *_notes(found, machine), *notes],
        compared_s=len(axes[0].measured) * command.dt_s,
        plan_start_s=found.plan_start_s,
        clock_ppm=1e6 * (found.rate - 1.0),
        sensor=[[float(v) for v in column] for column in sensor.T],
        axes=judged,
    )


def _shaper_or_machine(axis: AxisReadback) -> AxisReadback:
    """Return an axis without a verdict on the machine where the shaper may be what differs."""
    if axis.holds:
        return axis
    text = (
        f"{axis.axis.upper()}: this log does not fit the model without the firmware's shaper, and "
        "which one was on is not known: nothing is said of the machine."
    )
    return axis.model_copy(update={"verdict": text})


def _another_print(report: dict[str, Any], found: Match) -> ReadbackReport:
    verdict = (
        "This log is not of this print: the best place explains "
        f"{100 * found.explained:.0f} % of what the sensor felt between 2 and 22 Hz."
    )
    return ReadbackReport(
        **report,
        outcome="another print",
        verdicts=[verdict],
        notes=[],
        compared_s=0.0,
        plan_start_s=0.0,
        clock_ppm=0.0,
        sensor=[],
        axes=[],
    )


def _commanded(
    printed: Path, machine: Machine, progress: ProgressCallback | None
) -> tuple[Signal, float]:
    """Return what X and Y receive, after the firmware's shaper and dry friction.

    It is without the jumps of homing and macros. The second value is the time from which on the
    shaper is known.
    """
    dialect = dialect_for(machine, None)
    stated = adapter(machine).adviser(dialect).stated
    before = (stated or OFF).modelled
    known = stated is not None and not stated.unknown_types
    known_from_s = 0.0
    by_axis = [machine.command.of(axis).velocity_mm_s for axis in ("x", "y")]
    fastest = max(*by_axis, machine.firmware.fastest_mm_s)
    shaper, rows = ShapedMotion(1.0 / _RATE_HZ), []
    last: Array | None = None
    place = np.zeros((2, 1))
    with open_text(printed) as container:
        say = partial(ProgressReports(progress).say, "planning")
        motion = TextMotion(
            container.text, machine, dialect, 1.0 / _RATE_HZ, shaping=before, progress=say
        )
        for part in motion:
            samples = part.motion()
            before_mm = samples.executed_mm[:, :1] if last is None else last
            step = np.diff(samples.executed_mm, axis=1, prepend=before_mm)
            last = samples.executed_mm[:, -1:]
            step[np.abs(step) > 2.0 * fastest / _RATE_HZ] = 0.0
            samples = replace(samples, executed_mm=place + np.cumsum(step, axis=1))
            place = samples.executed_mm[:, -1:]
            rows += [r.executed_mm for r, _ in shaper.push(samples, part.shaping, EMPTY)]
            # A line that sets the shaper makes another object, even of the same values.
            if not known and part.shaping is before:
                known_from_s = float(part.samples.t_s[-1])
    rows += [r.executed_mm for r, _ in shaper.flush()]
    friction = DryFriction(machine.friction_mm, 1.0 / _RATE_HZ)
    received = friction.received_mm(np.concatenate(rows, axis=1))
    return Signal(0.0, 1.0 / _RATE_HZ, received), known_from_s


def _acceleration(position: Array, dt_s: float) -> Array:
    inner = np.diff(position, 2) / dt_s**2
    return np.pad(inner, ((0, 0), (1, 1)))


def _in_machine_axes(
    command: Signal, predicted: Signal, log: Signal, found: Match, specs: dict[str, PlantSpec]
) -> tuple[list[AxisMotion], Array, list[str]]:
    """Turn the log into the machine's axes: the orthogonal matrix nearest to D of m = D p."""
    dt = command.dt_s
    start = max(round(found.plan_start_s / dt), 1)
    count = min(round((found.plan_end_s - found.plan_start_s) / dt), round(_LONGEST_S / dt))
    count = min(count, command.rows.shape[1] - start)
    t = dt * (start + np.arange(count))
    own = log.t0_s + log.dt_s * np.arange(log.rows.shape[1])
    inside = (found.log_time_s(t) >= own[0]) & (found.log_time_s(t) <= own[-1])
    t, part = t[inside], slice(start + int(np.argmax(inside)), None)
    part = slice(part.start, part.start + len(t))
    # Remove what could alias into the compared band.
    smooth = Signal(log.t0_s, log.dt_s, band_pass(log.rows, log.dt_s, 0.5, 0.4 * _RATE_HZ))
    m = smooth.at(found.log_time_s(t))
    p = predicted.rows[:, part]
    low_p, low_m = (band_pass(rows, dt, *_MOUNT_BAND_HZ) for rows in (p, m))
    moving = [k for k in range(2) if np.std(low_p[k]) > 0.02 * np.std(low_p)]
    d = np.linalg.lstsq(low_p[moving].T, low_m.T, rcond=None)[0].T
    gains = np.linalg.norm(d, axis=0)
    seen = [k for k, gain in enumerate(gains) if gain > _SEEN * gains.max()]
    names = [list(specs)[moving[k]] for k in seen]
    u, _, vt = np.linalg.svd(d[:, seen], full_matrices=False)
    sensor = u @ vt
    measured = sensor.T @ m
    accel = _acceleration(command.rows[:, part.start - 1 : part.stop + 1], dt)[:, 1:-1]
    notes = [
        f"The log holds no motion of {a.upper()}: is the sensor on the other moving part?"
        for a in specs
        if a not in names
    ]
    if len(seen) == 2:
        cosine = float(d[:, 0] @ d[:, 1] / (gains[0] * gains[1]))
        if abs(cosine) > 0.2:
            angle = float(np.degrees(np.arccos(cosine)))
            notes.append(
                f"X and Y appear {angle:.0f} degrees apart: coupled axes, or a loose sensor"
            )
    axes = [
        AxisMotion(name, specs[name], accel[k], p[k], measured[row])
        for row, (name, k) in enumerate(zip(names, (moving[i] for i in seen), strict=True))
    ]
    return axes, sensor, notes


def _notes(found: Match, machine: Machine) -> list[str]:
    notes = []
    if machine.schedules:
        notes.append(
            "The machine's model follows mass or position; compared is its nominal plant: a mode "
            "may be lower here because the print is heavy."
        )
    if found.places > 1:
        notes.append(
            f"The log fits at {found.places} places of the print about as well (layers repeat); "
            f"the one from {found.plan_start_s:.0f} s on was compared."
        )
    compared = found.plan_end_s - found.plan_start_s
    if compared < 0.7 * found.log_s and found.log_s - compared > 8.0:
        notes.append(
            f"{compared:.0f} s of the log's {found.log_s:.0f} s follow the plan without a gap; "
            "the rest was left out: heating, homing, pauses, little motion, or not in the file."
        )
    return notes
