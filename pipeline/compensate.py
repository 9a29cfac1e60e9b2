"""The pipeline: a print file in, a compensated and verified file out, in bounded memory.

Each `PipelineRun` writes the file once. It is written again with less compensation or speed where
it is too large, exceeds a budget, or is refused by the last check.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from stillpath.gcode.errors import GcodeError
from stillpath.models.machine import Machine
from stillpath.pipeline.file_rewriting import FileRewriting, file_rewriting
from stillpath.pipeline.files import check_unchanged
from stillpath.pipeline.last_check.errors import LastCheckError
from stillpath.pipeline.live_printing import keep_file, predict_live, simulate_live
from stillpath.pipeline.measuring.tracing import Trace
from stillpath.pipeline.options import Options, unused
from stillpath.pipeline.order import Order
from stillpath.pipeline.pacing.budget import SpeedBudget
from stillpath.pipeline.pipeline_run import COMPENSATED, PipelineRun
from stillpath.pipeline.progress import ProgressCallback, within
from stillpath.pipeline.result import Result
from stillpath.pipeline.selection import TooLarge, smaller

__all__ = ["compensate_file"]


def compensate_file(
    source: Path,
    target: Path,
    machine: Machine,
    options: Options,
    *,
    cache_dir: Path | None = None,
    progress: ProgressCallback | None = None,
    layers: Path | None = None,
    trace: Callable[[Trace], None] | None = None,
) -> Result:
    """Compensate a print file; the figures are measured on the written file.

    Parameters
    ----------
    source, target : Path
        Plain or binary G-code or a 3MF package; the target is of the same kind, or plain if its
        name says so and the source's does not; with method `live` it is a copy. It is renamed when
        it is complete; the source is only read. They may be the same file.
    cache_dir : Path, optional
        Where the tuned shaper of a machine revision is kept.
    progress : callable, optional
        Called from time to time; may raise `StopWork`.
    layers : Path, optional
        Folder for layers.json and layers.bin (`pipeline.measuring.layer_files`).
    trace : callable, optional
        Receives the motion as it is measured; again from the first sample if the last check
        reverts a piece.

    Raises
    ------
    GcodeError
        The file cannot be read as G-code of this machine, moves nothing, or was processed before;
        its container is damaged, or cannot be what the target is called.
    DesignError, ModelError
        The method cannot be designed for this machine.
    """
    began = source.stat()
    how: dict[str, Any] = {"cache_dir": cache_dir, "progress": progress}
    if options.method == "live":
        how.update(plate=options.plate, dialect=options.dialect)
        result = simulate_live(source, machine, **how, layers=layers, trace=trace)
        keep_file(source, target, began)
    elif options.method == "advise":
        if trace is not None:
            raise GcodeError(
                "method advise gives moves new times: ask for trajectories of the written file"
            )
        from stillpath.pipeline.advising.advise import advise_file

        result = advise_file(source, target, machine, options, **how, layers=layers)
    else:
        # Before rewriting: the target may be the source.
        live = predict_live(source, machine, options, **how) if options.compare_live else None
        check_unchanged(source, began)
        order = Order(machine, options, cache_dir, progress)
        result = _rewrite(source, target, order, layers, trace)
        result = live.beside(result) if live else result
    result.warnings.extend(unused(options))
    return result


def _rewrite(
    source: Path,
    target: Path,
    order: Order,
    layers: Path | None,
    trace: Callable[[Trace], None] | None,
) -> Result:
    plate, progress = order.options.plate, order.progress
    opened = file_rewriting(source, target, plate=plate, layers=layers, progress=progress)
    with opened as file:
        run, result = _final_run(file, order, source.name, trace)
        run.deliver(file.text)
        if order.options.times == "new":
            file.container.delay(run.delay_s)
    return result.model_copy(update=file.sizes)


def _final_run(
    file: FileRewriting,
    order: Order,
    name: str,
    trace: Callable[[Trace], None] | None,
) -> tuple[PipelineRun, Result]:
    """Run the pipeline until the file fits, keeps the budget and passes the check; return that run.

    A piece that the last check refuses stays as sliced, like one that any other check refuses.
    """
    # With a budget a file may be written several times: only the last one is traced.
    again = order.options.paced or order.options.max_mb is not None
    traced = None if again else trace
    budget: SpeedBudget | None = None
    layers = file.layers
    times = _each_time(order.progress, several=again)
    while True:
        asked = replace(order, progress=next(times))
        run = PipelineRun(file.container.text, file.spool, asked, layers, traced, budget)
        try:
            result = run.write(name, file.container.facts())
            gentler = run.gentler
            if gentler is None and traced is trace:
                return run, run.checked(result)
        except (TooLarge, LastCheckError) as error:
            if isinstance(error, TooLarge):
                order = replace(order, options=_fitting(order.options, name))
            else:
                order = order.reverting(error, run.compensated)
            budget = budget and budget.again()
        else:
            if gentler is None:
                traced = trace  # accepted: repeat it unchanged for the trace
            budget = gentler or run.same
        file.spool.seek(0)
        file.spool.truncate()
        layers = layers.anew() if layers is not None else None


def _each_time(
    progress: ProgressCallback | None, *, several: bool
) -> Iterator[ProgressCallback | None]:
    """Yield a callback for every time that a file is written; how often is not known before."""
    begun = 0.0
    if not several:
        yield progress
        begun = COMPENSATED
    while True:
        end = 0.5 * (begun + 1.0)
        yield _but_done(progress, within(progress, begun, end))
        begun = end


def _but_done(
    progress: ProgressCallback | None, part: ProgressCallback | None
) -> ProgressCallback | None:
    """Return a callback for a part of the work that may be the last one, and say so then."""
    if progress is None or part is None:
        return None
    whole, of_part = progress, part
    return lambda now: whole(now) if now.stage == "done" else of_part(now)


def _fitting(options: Options, name: str) -> Options:
    """Return options that write a smaller file."""
    if options.method == "none":
        raise GcodeError(
            f"{name} exceeds max_mb {options.max_mb:g}, and method none writes it as sliced: "
            "allow more"
        )
    less = smaller(options)
    if less is None:
        raise GcodeError(
            f"{name} exceeds max_mb {options.max_mb:g} even if only its outer walls are "
            f"compensated, with a tolerance of {options.tolerance_um:g} µm: allow more"
        )
    return less
