"""Predict live printing (the extra inside Klipper), alone or beside the compensated file."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from stillpath.compensation.base import DesignError
from stillpath.compensation.defaults import DT_S
from stillpath.gcode.errors import GcodeError
from stillpath.models.machine import Machine
from stillpath.pipeline.caution import has_measured_set
from stillpath.pipeline.clock import StageClock
from stillpath.pipeline.file_motion import STANDING_S, FileMotion
from stillpath.pipeline.files import check_unchanged, default_cache_dir, replacing
from stillpath.pipeline.live_design import LiveDesign, cached_live_design, live_filter
from stillpath.pipeline.live_motion import LiveMotion
from stillpath.pipeline.measuring.measure import Measurement
from stillpath.pipeline.measuring.tracing import Trace
from stillpath.pipeline.operating_point import Operation
from stillpath.pipeline.options import DialectName, Options
from stillpath.pipeline.parts import refuse_processed
from stillpath.pipeline.progress import Progress, ProgressCallback
from stillpath.pipeline.result import PrintWay, Result, StageTime
from stillpath.pipeline.simulate import measured, simulate_motion
from stillpath.pipeline.ways import file_way, live_way

__all__ = ["LivePrediction", "keep_file", "predict_live", "simulate_live"]

_PACKED = (".bgcode", ".3mf")
_STAGE = "live prediction"


def simulate_live(
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
    """Predict the print of the sliced file with the extra inside Klipper.

    Parameters and errors are those of `pipeline.simulate.simulate_file`.

    Raises
    ------
    DesignError
        The machine cannot print live, or the file sets the firmware's shaper.
    """
    clock = StageClock()
    with clock.stage("design"):
        design = cached_live_design(machine, cache_dir or default_cache_dir())
    motion = _sliced_motion(source, plate, machine, dialect, progress)
    live = live_filter(machine, design.taps)
    result = simulate_motion(motion, cache_dir=cache_dir, layers=layers, trace=trace, live=live)
    (after,) = (channel for channel in result.channels if channel.name == "after")
    way = live_way(after, result.original_time_s, result.original_bytes)
    stages = [StageTime(stage="design", cpu_s=round(clock.cpu_s["design"], 4)), *result.stages]
    return result.model_copy(update={"ways": [way], "stages": stages})


def keep_file(source: Path, target: Path, began: os.stat_result) -> None:
    """Copy a file unchanged to where a compensated one would be written.

    Parameters
    ----------
    began : os.stat_result
        State of the source when its prediction began.

    Raises
    ------
    GcodeError
        The target's name is that of another kind of file.
    OSError
        Also when another program has changed the source since.
    """
    ends = source.suffix.lower(), target.suffix.lower()
    if ends[0] != ends[1] and any(end in _PACKED for end in ends):
        raise GcodeError(
            f"method live leaves the file unchanged: {target.name} must end like {source.name}"
        )
    with replacing(target) as temporary:
        shutil.copyfile(source, temporary)
        check_unchanged(source, began)


@dataclass(frozen=True, slots=True)
class LivePrediction:
    """What the report of a compensated file says about live printing.

    Attributes
    ----------
    way : PrintWay or None
        None: it cannot be printed live, and `refusal` says why.
    cpu_s : float
        CPU time of the prediction.
    """

    way: PrintWay | None
    refusal: str = ""
    cpu_s: float = 0.0

    def beside(self, result: Result) -> Result:
        """Return the report of the compensated file with both ways to print."""
        if self.way is None:
            return result.model_copy(update={"not_live": self.refusal})
        stage = StageTime(stage=_STAGE, cpu_s=round(self.cpu_s, 4))
        ways, stages = [file_way(result), self.way], [*result.stages, stage]
        return result.model_copy(update={"ways": ways, "stages": stages})


def predict_live(
    source: Path,
    machine: Machine,
    options: Options,
    *,
    cache_dir: Path | None = None,
    progress: ProgressCallback | None = None,
) -> LivePrediction:
    """Predict how a file that is being compensated would print live instead.

    The figures are those of `simulate_live`.

    Raises
    ------
    GcodeError
        The file cannot be read as G-code of this machine, or moves nothing.
    """
    if machine.live_refusal is not None:
        return LivePrediction(None, machine.live_refusal)
    clock = StageClock()
    with clock.stage(_STAGE):
        try:
            design = cached_live_design(machine, cache_dir or default_cache_dir())
            way = _way(source, machine, options, design, _before(progress))
        except DesignError as error:
            return LivePrediction(None, str(error))
    return LivePrediction(way, cpu_s=clock.cpu_s[_STAGE])


def _way(
    source: Path,
    machine: Machine,
    options: Options,
    design: LiveDesign,
    progress: ProgressCallback | None,
) -> PrintWay:
    size = source.stat().st_size
    motion = _sliced_motion(source, options.plate, machine, options.dialect, progress)
    measurement = Measurement(machine, DT_S, design.shaper, ("after",), size=size)
    live = LiveMotion(live_filter(machine, design.taps))
    measured(motion, live, measurement, Operation(machine), StageClock())
    measurement.finish()
    channels = measurement.channels()
    if has_measured_set(machine):
        channels = measurement.excerpts.ranged(channels, machine, design.shaper)
    return live_way(channels[0], motion.time_s, size)


def _sliced_motion(
    source: Path,
    plate: int | None,
    machine: Machine,
    dialect: DialectName | None,
    progress: ProgressCallback | None,
) -> FileMotion:
    return FileMotion(
        *(source, plate, machine, dialect, DT_S, progress),
        longest_stand_s=STANDING_S,
        each=partial(refuse_processed, do="print"),
    )


def _before(progress: ProgressCallback | None) -> ProgressCallback | None:
    """Return a callback for the time before the job, which only shows that work goes on."""
    if progress is None:
        return None
    tell = progress

    def say(now: Progress) -> None:
        tell(replace(now, stage="predicting the live print", fraction=0.0, eta_s=None))

    return say
