"""Computations besides compensation: each takes a job's task and writes its result."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

from stillpath.pipeline.progress import Progress, ProgressCallback, progress_to
from stillpath.service.jobs.state import JobKind
from stillpath.service.jobs.task import Task

__all__ = ["run_computation"]

# Imports inside the functions take a second, for which the API need not wait.


def run_computation(task: Task, progress: ProgressCallback) -> dict[str, Any]:
    """Write the result of a task to its target; a `service.jobs.task.Runner`.

    Raises
    ------
    DesignError, GcodeError, ModelError
    """
    _WRITERS[task.kind](task, progress)
    return {}


def _identify(task: Task, progress: ProgressCallback) -> None:
    """Write `machine` and `report`, identified from measurement files.

    Options: `files` (name and condition of each), `settings` (of reading), `name`, `title` and
    `order`.
    """
    from stillpath.applications.identification.run import InputFile, identify_files
    from stillpath.models.identification.conditions import Condition
    from stillpath.models.identification.readers import ReadSettings

    asked = task.options
    inputs = [
        InputFile(name, path.read_bytes(), Condition.parse(condition))
        for path, (name, condition) in zip(task.sources, asked["files"], strict=True)
    ]
    found = identify_files(
        inputs,
        task.pinned().machine,
        ReadSettings.model_validate(asked["settings"]),
        name=asked["name"],
        title=asked["title"],
        max_order=asked["order"],
        progress=lambda stage, fraction: progress(Progress(stage, fraction, 0.0, 0.0, None)),
    )
    _write(
        task,
        {
            "machine": found.machine.model_dump(mode="json"),
            "report": found.report.model_dump(mode="json"),
        },
    )


def _design(task: Task, progress: ProgressCallback) -> None:
    """Write the report of the design of one axis; options: `axis`, `basis`, `robust`."""
    from stillpath.applications.design.design import design_report

    progress_to(progress, "designing", 0.0)(0.0)
    asked = task.options
    report = design_report(
        task.pinned().machine, asked["axis"], basis=asked["basis"], robust=asked["robust"]
    )
    _write(task, report.model_dump(mode="json"))


def _design_controller(task: Task, progress: ProgressCallback) -> None:
    """Write `report`, `page` and `c` (the header) of an add-on controller.

    The options are those of the request; the machine is a closed-loop one.
    """
    from stillpath.applications.controllers.design import design_controller
    from stillpath.applications.controllers.options import read_options, resolved
    from stillpath.applications.controllers.page import render_controller

    progress_to(progress, "designing", 0.0)(0.0)
    options = read_options(task.options)
    made = design_controller(resolved(task.machine, options), options)
    _write(
        task,
        {
            "report": made.report.model_dump_json(),
            "page": render_controller(made.report),
            "c": made.controller.to_c_header(),
        },
    )


def _list_loops(task: Task, progress: ProgressCallback) -> None:
    """Write the built-in closed-loop machines and the methods that fit each."""
    from stillpath.applications.controllers.design import loop_figures

    progress_to(progress, "designing", 0.0)(0.0)
    _write(task, [figures.model_dump(mode="json") for figures in loop_figures()])


def _export_live(task: Task, progress: ProgressCallback) -> None:
    """Write the output of `stillpath klipper export`."""
    from stillpath.applications.live.export import write_export

    progress_to(progress, "designing", 0.0)(0.0)
    write_export(task.pinned().machine, task.target, task.cache_dir)


def _trace(task: Task, progress: ProgressCallback) -> None:
    """Write the motion of another job; options: that job's `options`, `format` and times."""
    from stillpath.pipeline.options import Options
    from stillpath.pipeline.trajectories import write_trajectories

    asked = task.options
    settings = Options.model_validate(asked["options"])
    write_trajectories(
        task.source,
        task.target,
        task.pinned().machine,
        settings,
        format=asked["format"],
        window_s=(asked["start_s"], asked["stop_s"]),
        cache_dir=task.cache_dir,
        progress=progress,
    )


_WRITERS: dict[JobKind, Callable[[Task, ProgressCallback], None]] = {
    JobKind.IDENTIFICATION: _identify,
    JobKind.DESIGN: _design,
    JobKind.CONTROLLER: _design_controller,
    JobKind.LOOPS: _list_loops,
    JobKind.LIVE: _export_live,
    JobKind.TRAJECTORIES: _trace,
}


def _write(task: Task, found: Any) -> None:
    task.target.write_text(json.dumps(found))
