"""The tasks themselves: plain values in, plain values out; run in a process of their own."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

__all__ = ["design", "design_controller", "identify", "list_loops", "trajectories"]

# What is imported in the functions takes a second, which the API need not wait for.


def identify(given: dict[str, Any]) -> dict[str, Any]:
    """Identify a machine from measurement files.

    Parameters
    ----------
    given : dict
        `files` (path, name and condition of each), `start` (the machine), `settings` (of reading),
        `name`, `title`, `order`.

    Returns
    -------
    dict
        `machine` and `report`, as documents.

    Raises
    ------
    ModelError
    """
    from models.identification.conditions import Condition
    from models.identification.readers import ReadSettings
    from models.machine import Machine
    from service.identification.run import InputFile, identify_files

    inputs = [
        InputFile(name, Path(path).read_bytes(), Condition.parse(condition))
        for path, name, condition in given["files"]
    ]
    found = identify_files(
        inputs,
        Machine.model_validate(given["start"]),
        ReadSettings.model_validate(given["settings"]),
        name=given["name"],
        title=given["title"],
        max_order=given["order"],
    )
    return {
        "machine": found.machine.model_dump(mode="json"),
        "report": found.report.model_dump(mode="json"),
    }


def design(given: dict[str, Any]) -> dict[str, Any]:
    """Design one axis of a `machine`: `axis`, `basis`, `robust`; return the report.

    Raises
    ------
    DesignError, ModelError
    """
    from models.machine import Machine
    from service.design.design import design_report

    machine = Machine.model_validate(given["machine"])
    report = design_report(machine, given["axis"], basis=given["basis"], robust=given["robust"])
    return report.model_dump(mode="json")


def design_controller(given: dict[str, Any]) -> dict[str, Any]:
    """Design an add-on controller with `options` for the closed-loop machine `name`.

    Returns
    -------
    dict
        `report`, `page` and `c`: the figures, the page and the C header.

    Raises
    ------
    DesignError, ModelError
    """
    from service.controllers.design import design_controller as designed
    from service.controllers.options import read_options, resolved
    from service.controllers.page import render_controller

    options = read_options(given["options"])
    made = designed(resolved(given["name"], options), options)
    return {
        "report": made.report.model_dump_json(),
        "page": render_controller(made.report),
        "c": made.controller.to_c_header(),
    }


def list_loops(_: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the built-in closed-loop machines and the methods that fit each."""
    from service.controllers.design import loop_figures

    return [figures.model_dump(mode="json") for figures in loop_figures()]


def trajectories(given: dict[str, Any]) -> None:
    """Write the motion of a job to the file `target`.

    Parameters
    ----------
    given : dict
        `source`, `machine_file` and `target` (paths), `machine` and `options` of the job, `cache`
        (a folder), and what was `chosen`: format and times.

    Raises
    ------
    GcodeError
    """
    from service.machines.resolve import PinnedMachine
    from service.pipeline.options import Options
    from service.pipeline.trajectories import write_trajectories

    settings = Options.model_validate(given["options"])
    target = Path(given["target"])
    # Whoever deletes this folder deletes all, also of a process that was ended.
    tempfile.tempdir = str(target.parent)
    write_trajectories(
        Path(given["source"]),
        target,
        PinnedMachine.read(Path(given["machine_file"]), given["machine"]).machine,
        settings,
        dialect=settings.dialect,
        plate=settings.plate,
        cache_dir=Path(given["cache"]),
        **given["chosen"],
    )
