"""Simulate the motion of a file without changing it, as a table of samples or as a report."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stillpath.compensation.defaults import DT_S
from stillpath.compensation.live_filter import LiveFilter
from stillpath.gcode.errors import GcodeError
from stillpath.gcode.firmware.signatures import signed_at
from stillpath.models.machine import Machine
from stillpath.models.schedule import OperatingPoint
from stillpath.models.shaping import OFF
from stillpath.pipeline.caution import has_measured_set
from stillpath.pipeline.clock import StageClock
from stillpath.pipeline.columns import npz_table
from stillpath.pipeline.file_motion import STANDING_S, FileMotion
from stillpath.pipeline.files import check_unchanged, default_cache_dir
from stillpath.pipeline.live_motion import LiveMotion
from stillpath.pipeline.measuring.layer_files import written_layers
from stillpath.pipeline.measuring.measure import CHANNELS, UNCHANGED_CHANNELS, Measurement
from stillpath.pipeline.measuring.points import MotionSamples
from stillpath.pipeline.measuring.reference_shaper import cached_shaper
from stillpath.pipeline.measuring.tracing import Trace
from stillpath.pipeline.operating_point import Operation
from stillpath.pipeline.options import DialectName
from stillpath.pipeline.progress import ProgressCallback
from stillpath.pipeline.result import NOTHING_COMPENSATED, Result
from stillpath.pipeline.shaping import ShapedMotion
from stillpath.version import __version__

__all__ = ["PlannedTime", "measured", "plan_file", "simulate_file", "simulate_motion"]

_COLUMNS = ("t", "x", "y", "z", "e")
_COMPENSATED = (
    "The file is compensated: errors are those against its own lines, which lead the nozzle on "
    "purpose, and tell nothing of the print; simulate the original, or read the report that came "
    "with the file."
)


@dataclass(frozen=True, slots=True)
class PlannedTime:
    """Print time of a file: as planned, and as its slicer states (None: it does not).

    `warnings` name commands that the firmware skips, and doubts about the file.
    """

    time_s: float
    slicer: str
    slicer_time_s: float | None
    warnings: list[str]


def plan_file(
    source: Path,
    target_npz: Path,
    machine: Machine,
    *,
    rate_hz: float = 1000.0,
    plate: int | None = None,
    dialect: DialectName | None = None,
    progress: ProgressCallback | None = None,
) -> PlannedTime:
    """Write the motion of a file, as the firmware executes it, as a table of samples.

    Parameters
    ----------
    source : Path
        A print file of any kind, also a compensated one.
    target_npz : Path
        Arrays ``t`` [s, 0 at the first move], ``x y z`` [mm, machine axes] and ``e`` [mm, the
        firmware's cumulative extruder position], written whole or not at all.
    plate : int, optional
        Which plate of a 3MF package with several.
    dialect : str, optional
        Dialect of the file; None: that of the machine's firmware.
    progress : callable, optional

    Returns
    -------
    PlannedTime

    Raises
    ------
    GcodeError
        The file cannot be read as G-code of this machine, moves nothing, or is `target_npz`.
    """
    if not (np.isfinite(rate_hz) and 0 < rate_hz <= 100_000):
        raise GcodeError(f"the rate of {rate_hz:g} samples per second is outside 0 to 100000")
    if target_npz.exists() and target_npz.samefile(source):
        raise GcodeError(f"{target_npz} is the file that is read; name another one to write")
    motion = FileMotion(source, plate, machine, dialect, 1.0 / rate_hz, progress)
    with npz_table(target_npz, dict.fromkeys(_COLUMNS, "<f8")) as table:
        for part in motion:
            samples = part.samples
            rows = (samples.t_s, *samples.xyz_mm, samples.e_mm)
            table.write(dict(zip(_COLUMNS, rows, strict=True)))
    told = [*motion.warnings, *motion.notes]
    return PlannedTime(motion.time_s, motion.facts.slicer, motion.facts.estimate_s, told)


def simulate_file(
    source: Path,
    machine: Machine,
    *,
    plate: int | None = None,
    dialect: DialectName | None = None,
    cache_dir: Path | None = None,
    progress: ProgressCallback | None = None,
    layers: Path | None = None,
    trace: Callable[[Trace], None] | None = None,
) -> Result:
    """Predict the vibration of a file as it is, and with the best firmware shaper.

    Parameters and errors are those of `pipeline.compensate.compensate_file`.
    """
    signed: set[bool] = set()
    motion = FileMotion(
        *(source, plate, machine, dialect, DT_S, progress),
        longest_stand_s=STANDING_S,
        each=lambda block: signed.add(signed_at(block.text) is not None),
    )
    result = simulate_motion(motion, cache_dir=cache_dir, layers=layers, trace=trace)
    if True in signed:
        result.warnings.insert(0, _COMPENSATED)
    return result


def simulate_motion(
    motion: FileMotion,
    *,
    cache_dir: Path | None = None,
    layers: Path | None = None,
    trace: Callable[[Trace], None] | None = None,
    live: LiveFilter | None = None,
) -> Result:
    """Predict the vibration of an opened file; other parameters are those of `simulate_file`.

    With `live` the motion is also what the extra of Klipper makes of it.
    """
    machine, clock = motion.machine, StageClock()
    with clock.stage("reference shaper"):
        shaper = cached_shaper(machine, cache_dir or default_cache_dir(), DT_S)
    operation = Operation(machine)
    names = UNCHANGED_CHANNELS if live is None else CHANNELS
    began = motion.source.stat()
    with contextlib.ExitStack() as files:
        writer = None if layers is None else files.enter_context(written_layers(layers, names))
        take_layer = writer.add if writer else None
        measurement = Measurement(
            machine, DT_S, shaper, names, take_layer=take_layer, trace=trace, size=began.st_size
        )
        stream = ShapedMotion(DT_S) if live is None else LiveMotion(live)
        seen = measured(motion, stream, measurement, operation, clock)
        measurement.finish()
        check_unchanged(motion.source, began)
        if writer is not None:
            writer.finish(motion.feature_names)
    channels = measurement.channels("printed live")
    if live is not None and has_measured_set(machine):
        channels = measurement.excerpts.ranged(channels, machine, shaper)
    notes = [*operation.notes(), *motion.notes]
    if set(motion.shapers) - {OFF.label}:
        notes.append(f"The file sets the firmware's shaper: {', '.join(motion.shapers)}.")
    return Result(
        version=__version__,
        machine=machine.name,
        machine_title=machine.title,
        machine_revision=machine.revision,
        settings={"method": "simulate" if live is None else "live"},
        source_name=motion.source.name,
        channels=channels,
        best_shaper=shaper.label,
        original_time_s=motion.time_s,
        time_s=motion.time_s,
        slicer=motion.facts.slicer,
        slicer_time_s=motion.facts.estimate_s,
        original_bytes=began.st_size,
        written_bytes=began.st_size,
        peak_accel_mm_s2=0.0,
        peak_velocity_mm_s=seen.peak_velocity_mm_s,
        extruding_s=seen.extruding_s,
        warnings=[*motion.warnings, *measurement.warnings()],
        notes=notes,
        stages=clock.stages(),
        **measurement.details(motion.feature_names),
        **NOTHING_COMPENSATED,
    )


@dataclass(slots=True)
class _Seen:
    """Sums over the measured motion."""

    extruding_s: float = 0.0
    peak_velocity_mm_s: float = 0.0

    def add(self, samples: MotionSamples) -> None:
        self.extruding_s += DT_S * float(np.sum(samples.extruding))
        if len(samples) > 1:
            step = np.hypot(*np.diff(samples.path_mm))
            self.peak_velocity_mm_s = max(self.peak_velocity_mm_s, float(step.max()) / DT_S)


def measured(
    motion: FileMotion,
    stream: ShapedMotion | LiveMotion,
    measurement: Measurement,
    operation: Operation,
    clock: StageClock,
) -> _Seen:
    """Measure a motion after the firmware's shaper, or after the filter in Klipper."""
    seen = _Seen()

    def add(ready: Iterator[tuple[MotionSamples, OperatingPoint]]) -> None:
        for samples, point in ready:
            measurement.operate_at(point)
            measurement.add(samples)

    for part in motion:
        if part.jumped:
            add(stream.flush())
            measurement.jump()
        with clock.stage("measure"):
            samples = part.motion()
            moves = part.own_moves()
            add(stream.push(samples, part.shaping, operation.at(moves)))
            operation.passed(moves)
        seen.add(samples)
    add(stream.flush())
    return seen
