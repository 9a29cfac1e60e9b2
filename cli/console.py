"""Output of the command line: progress on stderr, figures on stdout."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Table

from stillpath.service.interruption import Interrupted, interruptible

if TYPE_CHECKING:
    from pathlib import Path

    from stillpath.pipeline.progress import Progress
    from stillpath.pipeline.result import AdviceFigures, BudgetFigures, PrintWay, Result
    from stillpath.pipeline.simulate import PlannedTime

__all__ = [
    "budget_line",
    "print_planned",
    "print_result",
    "progress_shown",
    "shown",
    "told_after",
]

_PLAIN_EVERY_S = 5.0


@contextmanager
def progress_shown() -> Iterator[Callable[[Progress], None]]:
    """Yield a progress callback: a bar on a terminal, now and then a plain line elsewhere.

    It raises `Interrupted` when the process was asked to stop.
    """
    from stillpath.service.compiling import compiling_reported

    with interruptible() as check, shown("stillpath") as show, compiling_reported(show) as told:

        def tell(progress: Progress) -> None:
            check()
            told(progress)

        yield tell


@contextmanager
def told_after(target: Path | str, missing: str) -> Iterator[None]:
    """Do what comes once the output is in its place: failing, it is a warning on stderr.

    Parameters
    ----------
    target : Path or str
        The output: a file, or a machine's revision.
    missing : str
        What there is not if it fails, such as "report".
    """
    try:
        yield
    except Interrupted:
        why = "interrupted"
    except OSError as error:
        why = ": ".join(part for part in (error.filename, error.strerror) if part) or str(error)
    except Exception as error:
        why = f"{type(error).__name__}: {error}"
    else:
        return
    sys.stderr.write(f"stillpath: warning: {target} is written; no {missing}: {why}\n")


def print_result(result: Result) -> None:
    """Print what was measured: one column per channel, then time, size and warnings."""
    # Names are no markup: part[bold].gcode, :x:.gcode.
    console = Console(highlight=False, markup=False, emoji=False)
    console.print(_error_table(result))
    console.print(f"best shaper for this machine: {result.best_shaper}")
    if result.confirmation:
        console.print(f"the machine's model: {result.confirmation}")
    if any(channel.name == "after" for channel in result.channels):
        change = 100 * (result.time_s / result.original_time_s - 1) if result.original_time_s else 0
        console.print(
            f"print time {result.original_time_s:.1f} -> {result.time_s:.1f} s ({change:+.2f} %), "
            f"size {result.original_bytes / 1e6:.2f} -> {result.written_bytes / 1e6:.2f} MB"
            + (
                f", {result.segments_per_s:.0f} segments/s (peak {result.peak_segments_per_s:.0f})"
                if result.segments
                else ""
            )
        )
        if result.budget is not None:
            console.print(budget_line(result.budget))
        if result.advice is not None:
            console.print(_advice_line(result.advice))
    for way in result.ways:
        console.print(_way_line(way))
    if result.not_live:
        console.print(f"not live: {result.not_live}")
    if result.pieces:
        console.print(
            f"reverted to the sliced lines: {len(result.put_back)} of {result.pieces} pieces "
            f"({100 * result.put_back_extruding_share:.2f} % of the extruding time); left alone by "
            f"rule: {left_alone(result)}"
        )
    if result.slicer_time_s is not None:
        console.print(
            f"{result.slicer or 'the slicer'} says {result.slicer_time_s:.0f} s for the sliced file"
        )
    for warning in result.warnings:
        console.print(f"warning: {warning}")


def _error_table(result: Result) -> Table:
    table = Table(title=f"{result.source_name} on {result.machine_title}", title_justify="left")
    table.add_column("error, µm")
    for channel in result.channels:
        table.add_column(channel.label.split(" (")[0], justify="right")
    for part, scope in (("extruding", "extruding"), ("all motion", "all_motion")):
        for kind in ("contour", "tracking"):
            for measure in ("rms", "max"):
                cells = [
                    f"{getattr(getattr(channel, scope), f'{kind}_{measure}_um'):.2f}"
                    for channel in result.channels
                ]
                table.add_row(f"{kind} {measure}, {part}", *cells)
    if any(c.selected_rms_um is not None for c in result.channels):
        table.add_row(
            "contour rms, compensated features",
            *[f"{c.selected_rms_um or 0.0:.2f}" for c in result.channels],
        )
    if any(c.contour_range_um for c in result.channels):
        table.add_row(
            "contour rms, all plants",
            *["{:.2f} - {:.2f}".format(*(c.contour_range_um or ())) for c in result.channels],
        )
    if any(c.contour_rubbing_um for c in result.channels):
        table.add_row(
            "contour rms, if guides rub",
            *[f"< {c.contour_rubbing_um or 0.0:.2f}" for c in result.channels],
        )
    table.add_row("residual rms", *[f"{c.residual_rms_um:.2f}" for c in result.channels])
    return table


def _way_line(way: PrintWay) -> str:
    range_um = way.contour_range_um
    plants = "" if range_um is None else f", all plants {range_um[0]:.2f} - {range_um[1]:.2f}"
    return (
        f"{'printed as a file' if way.name == 'file' else 'printed live'}: contour rms "
        f"{way.contour_rms_um:.2f} µm{plants}, max {way.contour_max_um:.2f} µm; print time "
        f"{way.time_s:.1f} s, file {way.file_bytes / 1e6:.2f} MB"
    )


def left_alone(result: Result) -> str:
    """Return how much of the print keeps its own lines by rule."""
    share = result.left_alone_s / result.time_s if result.time_s else 0.0
    return (
        f"{100 * share:.2f} % of the print time ({result.left_alone_s:.1f} s, "
        f"{result.left_alone_extruding_s:.1f} s extruding)"
    )


def budget_line(budget: BudgetFigures) -> str:
    """Return what a budget of contour error bought, and at which accelerations."""
    against = (
        f"{budget.against_shaper} with the best shaper within it ({budget.shaper_time_s:.1f} s)"
        if budget.shaper_time_s is not None
        else "the best shaper cannot keep it"
    )
    classes = ", ".join(
        f"{one.name} {one.acceleration_factor:.3g}x ({one.contour_rms_um:.2f} µm)"
        for one in budget.classes
    )
    return (
        f"budget {budget.budget_um:g} µm: {budget.against_sliced} the sliced file, {against}; "
        f"accelerations: {classes}"
    )


def _advice_line(advice: AdviceFigures) -> str:
    shapers = "; ".join(
        f"{'' if one.layer <= 0 else f'from layer {one.layer} on '}{one.label}"
        for one in advice.shapers
    )
    features = ", ".join(
        f"{one.name} {'as sliced' if one.accel_mm_s2 is None else f'{one.accel_mm_s2:.0f} mm/s2'} "
        f"({one.before_um:.2f} -> {one.after_um:.2f} µm)"
        for one in advice.features
    )
    return (
        f"advice: shaper {shapers or f'as it is ({advice.before_shaper})'}; {features}; "
        f"{advice.lines} lines added"
    )


def print_planned(planned: PlannedTime) -> None:
    """Print how long a file takes, and what its slicer says."""
    said = ""
    if planned.slicer_time_s is not None:
        said = f"; {planned.slicer or 'the slicer'} says {planned.slicer_time_s:.0f} s"
    Console(highlight=False).print(f"print time {planned.time_s:.1f} s{said}")
    for warning in planned.warnings:
        sys.stderr.write(f"warning: {warning}\n")


def shown(title: str) -> AbstractContextManager[Callable[[Progress], None]]:
    """Give a progress callback as `progress_shown` does, and leave signals alone."""
    return _bar(title) if sys.stderr.isatty() else nullcontext(_plain_lines(title))


@contextmanager
def _bar(title: str) -> Iterator[Callable[[Progress], None]]:
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bars

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeElapsedColumn(),
        TextColumn("{task.fields[eta]}"),
    )
    with Bars(*columns, console=Console(stderr=True), transient=True) as bars:
        task = bars.add_task(title, total=1.0, eta="")

        def tell(progress: Progress) -> None:
            eta = "" if progress.eta_s is None else f"{progress.eta_s:.0f} s left"
            bars.update(task, completed=progress.fraction, description=progress.stage, eta=eta)

        yield tell


def _plain_lines(title: str) -> Callable[[Progress], None]:
    last = time.monotonic()

    def tell(progress: Progress) -> None:
        nonlocal last
        now = time.monotonic()
        if now - last < _PLAIN_EVERY_S:
            return
        last = now
        eta = "" if progress.eta_s is None else f", {progress.eta_s:.0f} s left"
        sys.stderr.write(f"{title}: {progress.stage} {100 * progress.fraction:.0f} %{eta}\n")

    return tell
