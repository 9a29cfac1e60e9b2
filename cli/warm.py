"""`stillpath warm`: compiles during installation what would be compiled at first use."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Annotated

import typer

from stillpath.cli.arguments import MachineOption, check_input

__all__ = ["register"]


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command()(warm)


def warm(
    source: Annotated[
        Path, typer.Argument(metavar="IN", help="A sliced file, as they will come: .gcode, ..")
    ],
    machine: MachineOption,
) -> None:
    """Compile the kernels that a job needs, by doing one; nothing of the job is kept.

    Compiled code lasts until the next version: in the installed package where it may be written,
    else in the user's cache folder (or NUMBA_CACHE_DIR).
    """
    check_input(source)

    from stillpath.cli.console import progress_shown
    from stillpath.cli.own_machines import open_machines
    from stillpath.pipeline.compensate import compensate_file
    from stillpath.pipeline.options import Options
    from stillpath.reports import write_report

    found = open_machines().for_job(machine, files=True)
    with (
        tempfile.TemporaryDirectory(prefix="stillpath-warm-") as folder,
        progress_shown() as progress,
    ):
        report = Path(folder) / "report"
        result = compensate_file(
            source,
            Path(folder) / source.name,
            found.machine,
            Options(),
            cache_dir=Path(folder),
            progress=progress,
            layers=report,
        )
        write_report(result, report)
