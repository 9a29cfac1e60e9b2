"""Summarise a job: its figures, warnings and notes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from stillpath.gcode.firmware.writing import StreamWriter
from stillpath.gcode.interpreter import Interpreter
from stillpath.gcode.slicers.facts import SlicerFacts
from stillpath.models.confirmation import confirmation_text, rounded_um
from stillpath.models.machine import Machine
from stillpath.pipeline.caution import Mixture
from stillpath.pipeline.caution_notes import prediction_note, stated_note
from stillpath.pipeline.clock import StageClock
from stillpath.pipeline.file_dialect import cut_off_warnings, skipped_notes, skipped_warnings
from stillpath.pipeline.measuring.measure import Measurement
from stillpath.pipeline.measuring.reference_shaper import BestShaper
from stillpath.pipeline.operating_point import Operation
from stillpath.pipeline.options import Options
from stillpath.pipeline.pacing.budget import SpeedBudget
from stillpath.pipeline.pacing.budget_measure import BudgetMeasurement
from stillpath.pipeline.result import Channel, Result
from stillpath.pipeline.selection import Selection
from stillpath.pipeline.totals import Totals
from stillpath.pipeline.verifying import NEGLIGIBLE_UM
from stillpath.version import __version__

__all__ = ["SHAPER_IS_BETTER", "Summary"]

SHAPER_IS_BETTER = "The firmware's own shaper would serve this file better"
"""Beginning of the warning."""
_ONE_HEAD = "single_extruder_multi_material"
"""Setting of PrusaSlicer and its forks: filaments change, and the head is the same."""
_AS_GOOD = 1.2
"""Ratio to the shaper's error from which a file that imitates that shaper is called worse."""


@dataclass(frozen=True, slots=True)
class Summary:
    """What a job knows when it ends.

    Attributes
    ----------
    writer : StreamWriter or None
        None: the file stays as it is, and is only measured.
    choice : Mixture or None
        The mixture chosen for the machine's set, if any.
    budget : (SpeedBudget, BudgetMeasurement) or None
    """

    machine: Machine
    options: Options
    totals: Totals
    measurement: Measurement
    selection: Selection
    operation: Operation
    reader: Interpreter
    writer: StreamWriter | None
    shaper: BestShaper
    choice: Mixture | None
    budget: tuple[SpeedBudget, BudgetMeasurement] | None

    def result(self, name: str, size: int, facts: SlicerFacts, clock: StageClock) -> Result:
        """Return the result for a file of that name and size in bytes."""
        channels = self._channels()
        figures = None
        if self.budget is not None:
            budget, pairs = self.budget
            total_s = self.totals.original_s, self.totals.time_s
            figures = budget.figures(pairs.sums(), self.reader.feature_names, *total_s)
        return Result(
            version=__version__,
            machine=self.machine.name,
            machine_title=self.machine.title,
            machine_revision=self.machine.revision,
            settings=self.options.model_dump(exclude_none=True, exclude={"compare_live"}),
            source_name=name,
            channels=channels,
            best_shaper=self.shaper.label,
            slicer=facts.slicer,
            slicer_time_s=facts.estimate_s,
            original_bytes=size,
            **self.totals.figures(compensates=self.writer is not None),
            warnings=list(self._warnings(channels, facts)),
            notes=list(self._notes()),
            confirmation=confirmation_text(self.machine) if self.writer is not None else "",
            stages=clock.stages(),
            budget=figures,
            **self.measurement.details(self.reader.feature_names),
        )

    def _channels(self) -> list[Channel]:
        """Return the figures of the print and, if only a part is compensated, of that part."""
        after = "as written" if self.writer is None else "compensated"
        channels = self.measurement.channels(after)
        if self.options.where != "all":
            features = self.measurement.features(self.reader.feature_names)
            rms_um = self.selection.rms_um(features)
            channels = [
                c.model_copy(update={"selected_rms_um": rms_um.get(c.name)}) for c in channels
            ]
        if self.choice is not None:
            channels = self.measurement.excerpts.ranged(channels, self.machine, self.shaper)
        return channels

    def _warnings(self, channels: list[Channel], facts: SlicerFacts) -> Iterator[str]:
        typed = None
        if self.choice is not None and self.totals.compensated_share > 0.0:
            typed = stated_note(self.machine, self.shaper)
        if self.writer is not None:
            # First, because it advises against printing the file.
            rms_um = {c.name: c.judged_rms_um for c in channels}
            yield from self._outdone(rms_um, 1.0 if typed is None else _AS_GOOD)
        if typed is not None:
            yield typed
        yield from self.totals.warnings
        yield from cut_off_warnings(facts, self.reader)
        yield from skipped_warnings(self.reader)
        yield from self.measurement.warnings()
        if self.writer is not None:
            yield from self.writer.shaper_warnings()
            yield from self.totals.left_alone_warnings()
            yield from self._other_heads(facts)
        if self.budget is not None:
            budget, pairs = self.budget
            yield from budget.warnings(pairs.sums(), self.reader.feature_names)

    def _notes(self) -> Iterator[str]:
        if self.choice is not None and any(self.choice.shares):
            yield prediction_note(self.machine, self.choice)
        yield from self.operation.notes()
        yield from skipped_notes(self.reader)
        if self.writer is not None:
            yield from self._macro_with_limits()
            yield from self._no_shaper()
            yield from self.totals.left_out_notes(self.options.where)
            if self.options.max_mb is not None:
                yield (
                    f"max_mb={self.options.max_mb:g}: written with where={self.options.where} and "
                    f"tolerance_um={self.options.tolerance_um:g}"
                )
        if self.budget is not None:
            yield self.budget[1].note

    def _macro_with_limits(self) -> Iterator[str]:
        """Yield a note where a macro may have set the acceleration that was meant."""
        firmware, called = self.machine.firmware, self.reader.macro_with_limits
        if firmware.kind == "klipper" and called is not None and self.totals.extruding_s > 0.0:
            name, line = called
            yield (
                f"The file states no acceleration, so it is planned with printer.cfg's "
                f"{firmware.largest_accel_mm_s2:g} mm/s2, which compensated stretches put in force "
                f"behind them. If {name} (line {line}) or another macro sets another, its setting "
                "is not seen, and lost: let the slicer write it (SET_VELOCITY_LIMIT ACCEL=...)"
            )

    def _no_shaper(self) -> Iterator[str]:
        """Yield a note where the printer has no shaper as far as is known."""
        firmware = self.machine.firmware
        if firmware.kind == "klipper" and firmware.no_input_shaper and self.totals.segments:
            yield (
                "printer.cfg had no [input_shaper] when the machine was made (no_input_shaper in "
                "its firmware section). If it has one now, make the machine again, or else that "
                "shaper is off after the print until Klipper restarts"
            )

    def _other_heads(self, facts: SlicerFacts) -> Iterator[str]:
        """Yield a warning where several tools print that may be heads of their own."""
        tools = sorted(self.totals.tools)
        if len(tools) > 1 and facts.settings.get(_ONE_HEAD) != "1":
            yield (
                f"Tools {', '.join(map(str, tools))} print, and all are compensated and predicted "
                "as the one that was measured. Where each is a head of its own (tool changer, two "
                "carriages), leave the others as sliced, between STILLPATH_OFF and STILLPATH_ON"
            )

    def _outdone(self, rms_um: dict[str, float], least_ratio: float) -> Iterator[str]:
        """Yield a warning where the firmware's shaper, without compensation, would do better."""
        ours, shaper = rms_um["after"], rms_um["shaper"]
        compared = self.budget is None and not self.options.method.startswith("shaper:")
        if compared and ours >= max(least_ratio * shaper, NEGLIGIBLE_UM):
            yield (
                f"{SHAPER_IS_BETTER}: {self.shaper.label} alone would leave "
                f"{rounded_um(shaper)} µm rms of contour error, this file {rounded_um(ours)} µm. "
                "Print it as sliced with that shaper, or let method advise write the commands"
            )
