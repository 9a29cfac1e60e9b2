"""`stillpath compensate`, `simulate`. Heavy imports wait until a command needs them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from stillpath.cli.arguments import (
    CommandRefused,
    CompensationOptions,
    DialectOption,
    Input,
    KeyOption,
    MachineOption,
    PlateOption,
    ReportOption,
    ServerOption,
    check_folder,
    check_input,
    check_output,
    chosen_options,
)
from stillpath.cli.own_machines import open_machines
from stillpath.cli.remote import compensate_on_server

__all__ = ["compensate", "simulate"]


def compensate(
    source: Input,
    machine: MachineOption,
    *,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="OUT", help="The file to write.")
    ] = None,
    in_place: Annotated[
        bool,
        typer.Option(
            "--in-place", help="Overwrite IN, as slicers expect of post-processing scripts."
        ),
    ] = False,
    how: CompensationOptions,
    plate: PlateOption = None,
    report: ReportOption = None,
    server: ServerOption = None,
    key: KeyOption = None,
) -> None:
    """Write a compensated file, and print what was measured on it."""
    if in_place == (output is not None):
        raise CommandRefused("give either -o OUT or --in-place")
    options = how.chosen(plate)
    check_input(source)
    target = check_output(output or source, machine)
    if output is not None and target.exists() and target.samefile(source):
        raise CommandRefused(
            f"{output} is the input; name another file, or use --in-place instead of -o"
        )
    check_folder(report)
    _check_apart(report, target)
    if server:
        compensate_on_server(
            source, target, machine, options, server=server, key=key, report=report
        )
        return
    found = _machine(machine)

    from stillpath.cli.console import print_result, progress_shown, told_after
    from stillpath.pipeline.compensate import compensate_file
    from stillpath.service.interruption import interruptible

    with interruptible():  # a first signal that comes once the file is in its place has no effect
        with progress_shown() as progress:
            result = compensate_file(
                source, target, found.machine, options, progress=progress, layers=report
            )
        result.warnings.extend(found.warnings)
        with told_after(target, "report"):
            _write_report(result, report)
        with told_after(target, "figures"):
            print_result(result)


def simulate(
    source: Input,
    machine: MachineOption,
    report: Annotated[
        Path,
        typer.Option(
            "--report",
            metavar="DIR",
            help="Folder for report.html and .json, layers.json and .bin.",
        ),
    ],
    live: Annotated[
        bool,
        typer.Option("--live", help="With the compensation inside Klipper (klipper export)."),
    ] = False,
    plate: PlateOption = None,
    dialect: DialectOption = None,
) -> None:
    """Report how far the nozzle will be from its path. No G-code is written."""
    check_input(source)
    check_folder(report)
    read_as = chosen_options(dialect=dialect).dialect
    found = _machine(machine)

    from stillpath.cli.console import print_result, progress_shown

    if live:
        from stillpath.pipeline.live_printing import simulate_live as simulated
    else:
        from stillpath.pipeline.simulate import simulate_file as simulated
    with progress_shown() as progress:
        result = simulated(
            source,
            found.machine,
            plate=plate,
            dialect=read_as,
            progress=progress,
            layers=report,
        )
    result.warnings.extend(found.warnings)
    _write_report(result, report)
    print_result(result)


_OF_REPORT = ("report.html", "report.json", "layers.json", "layers.bin")


def _check_apart(report: Path | None, target: Path) -> None:
    """Refuse a result that the report would be, or lie over."""
    if report is None:
        return
    folder = report.resolve()
    if target == folder or (target.parent == folder and target.name.lower() in _OF_REPORT):
        raise CommandRefused(
            f"{target} would be the report's own; name another file, or folder (--report)"
        )


def _machine(name: str) -> Any:
    """Find the machine for a job, with warnings about it."""
    return open_machines().for_job(name, files=True)


def _write_report(result: Any, folder: Path | None) -> None:
    if folder is not None:
        from stillpath.reports import write_report

        write_report(result, folder)
