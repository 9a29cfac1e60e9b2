"""`stillpath design`. Heavy imports wait until the command needs them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from stillpath.cli.arguments import BasisOption, MachineOption, RobustOption, check_folder
from stillpath.cli.own_machines import open_machines
from stillpath.compensation.defaults import DEFAULT_BASIS

__all__ = ["design"]


def design(
    machine: MachineOption,
    axis: Annotated[str, typer.Option(help="x or y.")],
    basis: BasisOption = DEFAULT_BASIS,
    robust: RobustOption = "auto",
    report: Annotated[
        Path | None, typer.Option("--report", metavar="DIR", help="Folder for design.html, .json.")
    ] = None,
) -> None:
    """Show the design for one axis: plant, metrics, ladder of designs, cost of model errors."""
    check_folder(report)
    found = open_machines().to_look_at(machine, files=True).machine

    from stillpath.applications.design.design import design_report
    from stillpath.applications.design.page import write_design
    from stillpath.cli.design_tables import print_design

    made = design_report(found, axis, basis=basis, robust=robust)
    if report is not None:
        write_design(made, report)
    print_design(made)
