"""Add shaper and acceleration commands to a print file, leaving its moves unchanged.

The sliced file is measured, settings are tried on excerpts of it, and the choice is written. The
written file is then read and measured by the firmware's rules, with the shaper that its lines set.
A feature that exceeds its bound there is made slower, and the file is written again.
"""

from __future__ import annotations

import io
import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import numpy as np

from stillpath.compensation.defaults import DT_S
from stillpath.gcode.errors import GcodeError
from stillpath.gcode.firmware.registry import adapter
from stillpath.gcode.interpreter import Interpreter
from stillpath.gcode.pacing import FirstLayer
from stillpath.gcode.slicers.facts import SlicerFacts
from stillpath.gcode.slicers.features import feature_name, feature_title
from stillpath.gcode.types import ProgramBlock
from stillpath.models.machine import Machine
from stillpath.models.schedule import OperatingPoint
from stillpath.models.shaping import OFF
from stillpath.pipeline.advising.choosing import AsSliced, Choice, choose
from stillpath.pipeline.advising.inserting import MARK, AdviceWriter, write_advised
from stillpath.pipeline.advising.messages import (
    beyond_bounds,
    is_a_test,
    kept_beyond,
    shaper_warnings,
    stored_settings,
    withdrawn,
)
from stillpath.pipeline.advising.reading import FirstReading
from stillpath.pipeline.clock import StageClock
from stillpath.pipeline.file_dialect import cut_off_warnings, dialect_for, dialect_warnings
from stillpath.pipeline.file_motion import STANDING_S, TextMotion
from stillpath.pipeline.file_rewriting import file_rewriting
from stillpath.pipeline.files import default_cache_dir
from stillpath.pipeline.measuring.earlier import EarlierErrors
from stillpath.pipeline.measuring.layer_files import LayerWriter
from stillpath.pipeline.measuring.measure import CHANNELS, STRIDE, UNCHANGED_CHANNELS, Measurement
from stillpath.pipeline.measuring.points import MotionSamples
from stillpath.pipeline.measuring.reference_shaper import cached_shaper
from stillpath.pipeline.measuring.set_errors import ClassError, SetErrors
from stillpath.pipeline.operating_point import Operation
from stillpath.pipeline.options import Options, stamp
from stillpath.pipeline.pacing.excerpts import take_excerpts
from stillpath.pipeline.progress import ProgressCallback, ProgressReports
from stillpath.pipeline.result import (
    NOTHING_COMPENSATED,
    AdviceFigures,
    AdvisedFeature,
    AdvisedShaper,
    AxisSpectrum,
    GroupFigures,
    Result,
)
from stillpath.pipeline.shaping import ShapedMotion
from stillpath.version import __version__

__all__ = ["advise_file"]

V = TypeVar("V")

_BLOCK_BYTES = 1 << 17
_ROUNDS = 7
_TOLERANCE = 1.001
_ROUNDING_S = 1e-3
_SETTING_S = 0.05
"""Most that setting a shaper takes: the firmware finishes all moves before."""
_UNDO = (
    f"Moves are untouched, and so are the slicer's times in the file; deleting the lines that hold "
    f"{MARK.decode()!r} gives back the original."
)


def advise_file(
    source: Path,
    target: Path,
    machine: Machine,
    options: Options,
    *,
    cache_dir: Path | None = None,
    progress: ProgressCallback | None = None,
    layers: Path | None = None,
) -> Result:
    """Write a file with advice.

    Parameters and errors are those of `pipeline.compensate.compensate_file`. The slicer's times
    in the file stay, whatever `options.times` says, and no option makes the file smaller where it
    exceeds `options.max_mb`: only lines of our own are added.
    """
    opened = file_rewriting(source, target, plate=options.plate, layers=layers, progress=progress)
    with opened as file, EarlierErrors(target.parent, 2) as earlier:
        container = file.container
        # Check before the work starts, too: advice only makes the file larger.
        _check_size(source.name, container.text, options.max_mb)
        job = _AdvisedFile(container.text, file.spool, machine, options, cache_dir, progress)
        result = job.run(source.name, container.facts(), earlier, file.layers)
        _check_size(source.name, file.spool, options.max_mb)
        shutil.copyfileobj(file.spool, file.text, _BLOCK_BYTES)
    return result.model_copy(update=file.sizes)


def _check_size(name: str, text: BinaryIO, max_mb: float | None) -> None:
    """Check the size of a file, and rewind it."""
    size_mb = 1e-6 * text.seek(0, io.SEEK_END)
    text.seek(0)
    if max_mb is not None and size_mb > max_mb:
        raise GcodeError(
            f"{name} exceeds max_mb {max_mb:g}: with all its moves, which method advise leaves as "
            f"they are, it has {size_mb:.3g} MB; allow more"
        )


class _AdvisedFile:
    """One file being advised."""

    def __init__(
        self,
        source: BinaryIO,
        spool: BinaryIO,
        machine: Machine,
        options: Options,
        cache_dir: Path | None,
        progress: ProgressCallback | None,
    ) -> None:
        self._source, self._spool = source, spool
        self._machine, self._options = machine, options
        self._withdrawn: list[str] = []
        self._say = ProgressReports(progress).say
        self._clock = StageClock()
        self._adapter = adapter(machine)
        self._dialect = dialect_for(machine, options.dialect)
        self._adviser = self._adapter.adviser(self._dialect)
        stated = self._adviser.stated or OFF
        self._before, self._unmodelled = stated.modelled, stated.unknown_types
        self._dialect_warnings = dialect_warnings(source, machine, options.dialect)
        self._say("tuning the shaper to compare with", 0.0)
        with self._clock.stage("reference shaper"):
            self._shaper = cached_shaper(machine, cache_dir or default_cache_dir(), DT_S)

    def run(
        self, name: str, facts: SlicerFacts, earlier: EarlierErrors, layers: LayerWriter | None
    ) -> Result:
        measuring: dict[str, Any] = {"earlier": earlier, "size": self._source.seek(0, io.SEEK_END)}
        original = Measurement(self._machine, DT_S, self._shaper, UNCHANGED_CHANNELS, **measuring)
        before = SetErrors(self._machine, DT_S, stride=STRIDE)
        reading = FirstReading(self._machine, self._adviser)
        with self._clock.stage("measure the original"):
            asked = self._go(
                self._source, [original, before], "measuring the original", (0.0, 0.25), reading.see
            )
        was = before.errors()
        names = asked.reader.feature_names
        with self._clock.stage("choose"):
            choice, first_layer = self._chosen(names, was, reading)
            if reading.test is not None:
                choice.withdrawn()
        with self._clock.stage("verify"):
            rounds = _ROUNDS if reading.test is None else 1
            writer, now = self._within_bounds(choice, was, asked.time_s, first_layer, rounds)
        earlier.rewind()
        take_layer = layers.add if layers else None
        advised = Measurement(
            self._machine, DT_S, self._shaper, ("after",), take_layer=take_layer, **measuring
        )
        with self._clock.stage("measure"):
            written = self._go(self._spool, [advised], "measuring", (0.8, 1.0))
        if layers is not None:
            layers.finish(names)
        self._say("done", 1.0)
        figures = self._figures(choice, names, was, now, writer.lines)
        warnings = self._warnings(reading, choice, names, figures, shaper_left=writer.shaper_left)
        return self._result(name, facts, asked, written, original, advised, figures, warnings)

    def _shapes(self, reading: FirstReading) -> bool:
        """Return whether a shaper may be advised: stored settings must be the printer's own."""
        return not reading.stored_lines or self._adviser.stated is not None

    def _chosen(
        self, names: Sequence[str], was: dict[int, ClassError], reading: FirstReading
    ) -> tuple[Choice, FirstLayer]:
        """Choose accelerations and shapers on excerpts of the file."""
        self._source.seek(0)
        excerpts = take_excerpts(self._source, self._machine, self._dialect)
        errors_um = {f: error.rms_um for f, error in was.items()}
        choice = choose(
            excerpts,
            AsSliced(names, self._before, errors_um, reading.levels),
            self._machine,
            self._adviser,
            self._options.budget_um,
            lambda share: self._say("choosing", 0.3 + 0.3 * share),
            shaped=self._shapes(reading),
        )
        return choice, excerpts.first_layer

    def _warnings(
        self,
        reading: FirstReading,
        choice: Choice,
        names: Sequence[str],
        figures: AdviceFigures,
        *,
        shaper_left: bool,
    ) -> list[str]:
        """Return warnings: stored settings, unknown shapers, features with too large errors."""
        if reading.test is not None:
            return [is_a_test(reading.test)]
        unshaped = "" if self._shapes(reading) else None
        given_back = self._before.label if figures.shapers else unshaped
        helpless = [feature_name(f, names) for f in sorted(choice.helpless)]
        return [
            *stored_settings(reading.stored_lines, shaper=given_back),
            *shaper_warnings(
                self._unmodelled,
                none_known=not self._adviser.shapers,
                stated=self._adviser.stated is not None,
                left=shaper_left,
            ),
            *beyond_bounds(
                figures.features,
                choice.rungs[0],
                helpless,
                has_budget=self._options.budget_um is not None,
            ),
        ]

    def _within_bounds(
        self,
        choice: Choice,
        was: dict[int, ClassError],
        was_s: float,
        first_layer: FirstLayer,
        rounds: int,
    ) -> tuple[AdviceWriter, dict[int, ClassError]]:
        """Write and measure until every feature is within its bound or at its slowest."""
        for attempt in range(rounds):
            writer = self._write(choice, first_layer)
            set_errors = SetErrors(self._machine, DT_S, stride=STRIDE)
            shares = 0.6 + 0.03 * attempt, 0.8
            written = self._go(self._spool, [set_errors], "verifying", shares)
            errors = set_errors.errors()
            over = {
                f: errors[f].rms_um / self._bound_um(f, was)
                for f in choice.rung
                if f in errors and errors[f].rms_um > _TOLERANCE * self._bound_um(f, was)
            }
            # The last round is reserved for writing the file without advice.
            if attempt + 2 < rounds and over and choice.mended(over):
                continue
            worse = bool(over) or _rms_um(errors) > _TOLERANCE * _rms_um(was)
            slower = written.time_s > was_s + _ROUNDING_S + _SETTING_S * writer.shapers_set
            unbudgeted = self._options.budget_um is None and attempt + 1 < rounds
            # No better than as sliced: withdraw the advice.
            if not (unbudgeted and (worse or slower) and choice.withdrawn()):
                break
            self._withdrawn = [withdrawn(written.time_s - was_s, less_exact=worse)]
        return writer, errors

    def _bound_um(self, feature: int, was: dict[int, ClassError]) -> float:
        if self._options.budget_um is not None:
            return self._options.budget_um
        return max(was[feature].rms_um, 1e-3) if feature in was else np.inf

    def _write(self, choice: Choice, first_layer: FirstLayer) -> AdviceWriter:
        reader = Interpreter(self._machine, dialect=self._dialect)
        writer = AdviceWriter(
            self._adviser,
            choice.advice(first_layer),
            reader.feature_names,
            self._adapter.initial_limits(),
            stamp(self._machine, self._options),
        )
        write_advised(self._source, self._spool, reader, writer)
        return writer

    def _go(
        self,
        file: BinaryIO,
        sinks: Sequence[Measurement | SetErrors],
        stage: str,
        shares: tuple[float, float],
        each: Callable[[ProgramBlock], None] = lambda _: None,
    ) -> TextMotion:
        low, high = shares
        motion = TextMotion(
            file,
            self._machine,
            self._dialect,
            DT_S,
            longest_stand_s=STANDING_S,
            shaping=self._before,
            progress=lambda share, at_s: self._say(stage, low + (high - low) * share, at_s),
            each=each,
        )
        operation, shaper = Operation(self._machine), ShapedMotion(DT_S)
        for part in motion:
            if part.jumped:
                _add(shaper.flush(), sinks)
                for sink in sinks:
                    sink.jump()
            moves = part.own_moves()
            _add(shaper.push(part.motion(), part.shaping, operation.at(moves)), sinks)
            operation.passed(moves)
        _add(shaper.flush(), sinks)
        for sink in sinks:
            sink.finish()
        self._notes = operation.notes()
        return motion

    def _figures(
        self,
        choice: Choice,
        names: Sequence[str],
        was: dict[int, ClassError],
        now: dict[int, ClassError],
        lines: int,
    ) -> AdviceFigures:
        bounds = choice.bounds()
        features = []
        for f, error in sorted(now.items()):
            if f not in was:
                continue
            bound = bounds.get(f)
            limit = self._bound_um(f, was) if f in choice.rung else None
            name = feature_name(f, names)
            features.append(
                AdvisedFeature(
                    name=name,
                    title=feature_title(name),
                    accel_mm_s2=bound.at_least if bound else None,
                    exact=f in choice.visible,
                    bound_um=None if limit is None or np.isinf(limit) else limit,
                    within_bound=limit is None or error.rms_um <= _TOLERANCE * limit,
                    before_um=was[f].rms_um,
                    after_um=error.rms_um,
                    before_s=round(was[f].seconds, 3),
                    after_s=round(error.seconds, 3),
                )
            )
        return AdviceFigures(
            before_shaper=self._before.label,
            shapers=[AdvisedShaper(layer=n, label=s.label) for n, s in choice.shapers],
            features=features,
            lines=lines,
        )

    def _result(
        self,
        name: str,
        facts: SlicerFacts,
        asked: TextMotion,
        written: TextMotion,
        original: Measurement,
        advised: Measurement,
        figures: AdviceFigures,
        warnings: Sequence[str],
    ) -> Result:
        machine, names = self._machine, asked.reader.feature_names
        noted = [*self._notes, *asked.notes]
        before, shaper = original.channels()
        if self._before.is_on or any(label != OFF.label for label in asked.shapers):
            before = before.model_copy(update={"label": "as sliced, with the firmware's shaper"})
        after = advised.channels("advised")[0]
        features = _merged(original.features(names), advised.features(names))
        return Result(
            version=__version__,
            machine=machine.name,
            machine_title=machine.title,
            machine_revision=machine.revision,
            settings=self._options.model_dump(exclude_none=True),
            source_name=name,
            channels=[before, after, shaper],
            best_shaper=self._shaper.label,
            original_time_s=asked.time_s,
            time_s=written.time_s,
            slicer=facts.slicer,
            slicer_time_s=facts.estimate_s,
            original_bytes=0,
            written_bytes=0,
            peak_velocity_mm_s=0.0,
            peak_accel_mm_s2=max((f.accel_mm_s2 or 0.0 for f in figures.features), default=0.0),
            extruding_s=sum(group.seconds for group in features),
            warnings=[
                *self._dialect_warnings,
                *cut_off_warnings(facts, asked.reader),
                *asked.warnings,
                *warnings,
                *advised.warnings(),
            ],
            notes=[*self._withdrawn, *noted, *kept_beyond(figures.features), _UNDO],
            layers=_merged(original.layers(), advised.layers()),
            features=features,
            track=advised.track(),
            spectra=_merged_spectra(original.spectra(), advised.spectra()),
            layer_views=advised.layer_views(),
            advice=figures,
            stages=self._clock.stages(),
            **NOTHING_COMPENSATED,
        )


def _rms_um(errors: dict[int, ClassError]) -> float:
    """Return the error of all features together."""
    seconds = sum(one.seconds for one in errors.values())
    squares = sum(one.seconds * one.rms_um**2 for one in errors.values())
    return float(np.sqrt(squares / (seconds or 1.0)))


def _add(
    ready: Iterator[tuple[MotionSamples, OperatingPoint]], sinks: Sequence[Measurement | SetErrors]
) -> None:
    for samples, point in ready:
        for sink in sinks:
            sink.operate_at(point)
            if isinstance(sink, Measurement):
                sink.add(samples)
            else:
                feature = samples.moves.feature[samples.row]
                sink.add(samples.path_mm, samples.executed_mm, samples.extruding, feature)


def _merged(before: Sequence[GroupFigures], after: Sequence[GroupFigures]) -> list[GroupFigures]:
    """Put the figures of both files side by side."""
    known = {group.name: group for group in after}
    return [
        GroupFigures(
            name=group.name,
            title=group.title,
            seconds=other.seconds,
            contour_rms_um=_in_order(group.contour_rms_um | other.contour_rms_um),
            contour_max_um=_in_order(group.contour_max_um | other.contour_max_um),
        )
        for group in before
        if (other := known.get(group.name)) is not None
    ]


def _in_order(values: dict[str, V]) -> dict[str, V]:
    return {n: values[n] for n in CHANNELS if n in values}


def _merged_spectra(
    before: Sequence[AxisSpectrum], after: Sequence[AxisSpectrum]
) -> list[AxisSpectrum]:
    return [
        one.model_copy(
            update={"um_per_sqrt_hz": _in_order(one.um_per_sqrt_hz | other.um_per_sqrt_hz)}
        )
        for one, other in zip(before, after, strict=False)
    ]
