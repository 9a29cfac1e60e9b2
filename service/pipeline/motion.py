"""The motion that a file makes, without changing it: to a table of samples, or to a report."""

from __future__ import annotations

import contextlib
import io
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from itertools import chain
from pathlib import Path

import numpy as np

from gcode.containers.opening import open_text
from gcode.errors import GcodeError
from gcode.firmware.planning import check_moves_end, check_print_ends
from gcode.firmware.registry import kit
from gcode.interpreter import Interpreter
from gcode.sampler import Sampler, Samples
from gcode.slicers.facts import SlicerFacts
from gcode.types import EventKind, Moves, Phases, ProgramBlock
from models.machine import Machine
from service.pipeline.clock import StageClock
from service.pipeline.columns import npz_table
from service.pipeline.compensating import DT_S
from service.pipeline.files import default_cache_dir
from service.pipeline.layer_files import written_layers
from service.pipeline.length import LengthGuard
from service.pipeline.measure import Measurement, MotionSamples, Trace, channel_names
from service.pipeline.operating import Operation
from service.pipeline.progress import Progress, ProgressCallback, telling
from service.pipeline.reading import DialectName, dialect_for, doubts, passed_over
from service.pipeline.result import Result, StageTime
from service.pipeline.yardstick import cached_shaper
from service.version import __version__

__all__ = ["STANDING_S", "PlannedTime", "plan_file", "simulate_file"]

STANDING_S = 2.0
"""How long a stand is measured: all vibration has died down after that."""
_BLOCK_BYTES = 1 << 17
_COLUMNS = ("t", "x", "y", "z", "e")


@dataclass(frozen=True, slots=True)
class PlannedTime:
    """How long a file takes: as planned, and as its slicer says (None: it does not).

    `warnings` say what the firmware passes over, or what of the file raises doubts.
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
    """Write the motion that the firmware makes of a file as a table of samples.

    Parameters
    ----------
    source : Path
        Any print file of any kind, also one that was compensated.
    target_npz : Path
        Arrays ``t`` [s, 0 at the first move], ``x y z`` [mm, machine axes] and ``e`` [mm, the
        firmware's cumulative extruder position], written whole or not at all.
    machine : Machine
    rate_hz : float
        Samples per second.
    plate : int, optional
        Which plate of a 3MF package with several.
    dialect : str, optional
        How the file is read; None: as the machine's firmware reads it.
    progress : callable, optional

    Returns
    -------
    PlannedTime

    Raises
    ------
    GcodeError
        The file cannot be read as G-code of this machine, or moves nothing.
    """
    if not (np.isfinite(rate_hz) and 0 < rate_hz <= 100_000):
        raise GcodeError(f"the rate of {rate_hz:g} samples per second is outside 0 to 100000")
    motion = _Motion(source, plate, machine, dialect, 1.0 / rate_hz, progress)
    with npz_table(target_npz, dict.fromkeys(_COLUMNS, "<f8")) as table:
        for part in motion:
            samples = part.samples
            rows = (samples.t_s, *samples.xyz_mm, samples.e_mm)
            table.write(dict(zip(_COLUMNS, rows, strict=True)))
    return PlannedTime(motion.time_s, motion.facts.slicer, motion.facts.estimate_s, motion.warnings)


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

    Parameters and errors are those of `service.pipeline.road.compensate_file`.
    """
    clock = StageClock()
    with clock.stage("yardstick"):
        shaper = cached_shaper(machine, cache_dir or default_cache_dir(), DT_S)
    motion = _Motion(source, plate, machine, dialect, DT_S, progress, longest_stand_s=STANDING_S)
    operation = Operation(machine)
    extruding_s = 0.0
    peak_velocity = 0.0
    with contextlib.ExitStack() as files:
        writer = None
        if layers is not None:
            names = channel_names(compensated=False)
            writer = files.enter_context(written_layers(layers, names))
        measurement = Measurement(
            machine,
            DT_S,
            shaper,
            compensated=False,
            take_layer=writer.add if writer else None,
            trace=trace,
        )
        for part in motion:
            if part.jumped:
                measurement.jump()
            with clock.stage("measure"):
                samples = part.motion()
                moves = part.own_moves()
                measurement.operate_at(operation.at(moves))
                measurement.add(samples)
                operation.passed(moves)
            extruding_s += DT_S * float(np.sum(samples.extruding))
            if len(samples) > 1:
                step = np.hypot(*np.diff(samples.path_mm))
                peak_velocity = max(peak_velocity, float(step.max()) / DT_S)
        measurement.finish()
        if writer is not None:
            writer.finish(motion.feature_names)
    size = source.stat().st_size
    return Result(
        version=__version__,
        machine=machine.name,
        machine_title=machine.title,
        machine_revision=machine.revision,
        settings={"method": "simulate"},
        source_name=source.name,
        channels=measurement.channels(),
        best_shaper=shaper.label,
        original_time_s=motion.time_s,
        time_s=motion.time_s,
        slicer=motion.facts.slicer,
        slicer_time_s=motion.facts.estimate_s,
        original_bytes=size,
        written_bytes=size,
        segments=0,
        segments_per_s=0.0,
        peak_segments_per_s=0.0,
        peak_velocity_mm_s=peak_velocity,
        peak_accel_mm_s2=0.0,
        emission_rms_um=0.0,
        emission_max_um=0.0,
        filament_error_mm=0.0,
        compensated_s=0.0,
        extruding_s=extruding_s,
        pieces=0,
        put_back=[],
        put_back_extruding_share=0.0,
        warnings=[*motion.warnings, *measurement.warnings()],
        notes=operation.notes(),
        layers=measurement.layers(),
        features=measurement.features(motion.feature_names),
        track=measurement.track(),
        spectra=measurement.spectra(),
        layer_views=measurement.layer_views(),
        stages=[StageTime(stage=k, cpu_s=round(v, 4)) for k, v in clock.cpu_s.items()],
    )


@dataclass(frozen=True, slots=True)
class _Part:
    """Samples with the moves they belong to; `jumped`: the position was lost before them."""

    samples: Samples
    moves: Moves
    first_move: int
    jumped: bool

    def own_moves(self) -> Moves:
        """Return the moves in which the samples lie."""
        first, last = self.samples.move_index[[0, -1]] - self.first_move
        moves = self.moves
        return Moves(**{f.name: getattr(moves, f.name)[first : last + 1] for f in fields(moves)})

    def motion(self) -> MotionSamples:
        """Return the samples with line, layer and feature."""
        row = self.samples.move_index - self.first_move
        moves = self.moves
        travel = moves.end_mm - moves.start_mm
        feeds = ((travel[:, 0] != 0.0) | (travel[:, 1] != 0.0)) & (travel[:, 3] > 0.0)
        return MotionSamples(
            path_mm=self.samples.xyz_mm[:2],
            executed_mm=self.samples.xyz_mm[:2],
            z_mm=self.samples.xyz_mm[2],
            extruding=feeds[row] & self.samples.moving,
            row=row,
            moves=moves,
            first_move=self.first_move,
        )


class _Motion:
    """Iterate over the sampled motion of a file in bounded memory."""

    def __init__(
        self,
        source: Path,
        plate: int | None,
        machine: Machine,
        dialect: DialectName | None,
        dt_s: float,
        progress: ProgressCallback | None,
        *,
        longest_stand_s: float = np.inf,
    ) -> None:
        self._longest_stand_s = longest_stand_s
        self._left_out_s = self._end_s = 0.0
        self._source, self._plate, self._machine = source, plate, machine
        self._dialect = dialect_for(machine, dialect)
        self._asked = dialect
        self._dt_s, self._progress = dt_s, progress
        self._began = time.monotonic()
        self._held: list[tuple[int, Moves]] = []
        self._jumps: list[int] = []
        """Moves in front of which the position was lost, by their index in the file."""
        self.time_s = 0.0
        self.feature_names: list[str] = []
        self.facts = SlicerFacts()
        self.warnings: list[str] = []

    def __iter__(self) -> Iterator[_Part]:
        reader = Interpreter(self._machine, dialect=self._dialect)
        planner = kit(self._machine).planner()
        sampler = Sampler(self._dt_s)
        self.feature_names = reader.feature_names
        moves = 0
        unpacking = telling(self._progress, "unpacking", 0.0)
        with open_text(self._source, plate=self._plate, told=unpacking) as container:
            self.facts = container.facts()
            file = container.text
            doubtful = doubts(file, self._machine, self._asked)
            guard = LengthGuard(file, self._machine, self._dialect)
            size = max(file.seek(0, io.SEEK_END), 1)
            file.seek(0)
            while True:
                data = file.read(_BLOCK_BYTES)
                for block in reader.push(data) if data else reader.flush():
                    moves += len(block.moves)
                    self._hold(block)
                    phases = planner.push(block)
                    self._check(phases, planner.time_s, guard.check)
                    for samples in sampler.push(self._shortened(phases)):
                        yield from self._parts(samples)
                self.time_s = planner.time_s
                self._say(file.tell() / size)
                if not data:
                    break
        phases = planner.flush()
        self._check(phases, planner.time_s, check_print_ends)
        for samples in chain(sampler.push(self._shortened(phases)), sampler.flush()):
            yield from self._parts(samples)
        self.time_s = planner.time_s
        self.warnings = [*doubtful, *passed_over(reader)]
        if moves == 0:
            raise GcodeError("the file contains no moves: is it G-code?")

    def _hold(self, block: ProgramBlock) -> None:
        if len(block.moves):
            self._held.append((block.first_move, block.moves))
        lost = block.events.kind == EventKind.UNKNOWN
        self._jumps += block.events.move_index[lost].tolist()

    def _check(
        self, phases: Phases, time_s: float, check_length: Callable[[float, int], None]
    ) -> None:
        if self._held:
            check_moves_end(phases, self._line)
            check_length(time_s, int(self._held[-1][1].line[-1]))

    def _line(self, move_index: int) -> int:
        first, moves = [held for held in self._held if held[0] <= move_index][-1]
        return int(moves.line[move_index - first])

    def _shortened(self, phases: Phases) -> Phases:
        """Leave out what the machine stands longer than it must."""
        if len(phases) == 0 or np.isinf(self._longest_stand_s):
            return phases
        end_s = phases.t_s + phases.accel_s + phases.cruise_s + phases.decel_s
        stands_s = phases.t_s - np.append(self._end_s, end_s[:-1])
        left_out_s = np.cumsum(np.maximum(stands_s - self._longest_stand_s, 0.0)) + self._left_out_s
        self._left_out_s, self._end_s = float(left_out_s[-1]), float(end_s[-1])
        return replace(phases, t_s=phases.t_s - left_out_s)

    def _parts(self, samples: Samples) -> Iterator[_Part]:
        """Cut samples where the position is lost between two moves."""
        begun, jumped = 0, False
        while self._jumps and self._jumps[0] <= samples.move_index[-1]:
            at = int(np.searchsorted(samples.move_index, self._jumps.pop(0)))
            if at > begun:
                yield self._part(samples.part(begun, at), jumped)
            begun, jumped = at, True
        yield self._part(samples.part(begun, len(samples)), jumped)

    def _part(self, samples: Samples, jumped: bool) -> _Part:
        first = int(samples.move_index[0])
        while len(self._held) > 1 and self._held[1][0] <= first:
            self._held.pop(0)
        return _Part(samples, _joined([m for _, m in self._held]), self._held[0][0], jumped)

    def _say(self, fraction: float) -> None:
        if self._progress is None:
            return
        elapsed = time.monotonic() - self._began
        eta = elapsed * (1.0 - fraction) / fraction if fraction > 0.02 else None
        self._progress(Progress("planning", min(fraction, 1.0), self.time_s, elapsed, eta))


def _joined(parts: list[Moves]) -> Moves:
    if len(parts) == 1:
        return parts[0]
    names = Moves.__dataclass_fields__
    return Moves(**{name: np.concatenate([getattr(p, name) for p in parts]) for name in names})
