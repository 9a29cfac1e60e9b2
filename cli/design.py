"""`stillpath design`. Heavy imports wait until the command needs them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from stillpath.cli.arguments import MachineOption, check_folder
from stillpath.cli.machines import open_machines

__all__ = ["register"]


def register(app: typer.Typer) -> None:
    """Add design to a command line."""
    app.command()(design)


def design(
    machine: MachineOption,
    axis: Annotated[str, typer.Option(help="x or y.")],
    basis: Annotated[str, typer.Option(help="ce-opt, robust, bspline or dct.")] = "ce-opt",
    robust: Annotated[str, typer.Option(help="auto, off, ensemble or minimax.")] = "off",
    report: Annotated[
        Path | None, typer.Option("--report", metavar="DIR", help="Folder for design.html, .json.")
    ] = None,
) -> None:
    """Look at the design for one axis. Plant, metrics, ladder, and what errors of it cost."""
    check_folder(report)
    found = open_machines().to_look_at(machine, files=True).machine

    from stillpath.applications.design.design import design_report
    from stillpath.applications.design.page import write_design
    from stillpath.cli.design_tables import print_design

    made = design_report(found, axis, basis=basis, robust=robust)
    if report is not None:
        write_design(made, report)
    print_design(made)
