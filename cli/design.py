"""`stillpath design` and `stillpath track`. Heavy imports wait until a command needs them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from stillpath.cli.arguments import (
    BasisOption,
    MachineOption,
    RobustOption,
    check_folder,
    check_input,
    check_output,
)
from stillpath.cli.own_machines import open_machines
from stillpath.compensation.defaults import DEFAULT_BASIS

__all__ = ["design", "track"]


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


def track(
    path: Annotated[
        Path,
        typer.Argument(
            metavar="PATH",
            help="Positions, a line a millisecond: a number each, or a table with x_mm or y_mm.",
        ),
    ],
    machine: MachineOption,
    axis: Annotated[str, typer.Option(help="x or y.")],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="OUT", help="The table (CSV).")],
    basis: BasisOption = DEFAULT_BASIS,
    functions: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="How many. [default: half of the samples; bspline, dct: within the model's band]",
        ),
    ] = None,
    nominal: Annotated[
        Literal["plant", "ensemble", "optimum", "frequency"],
        typer.Option(
            help="What functions are filtered through: the nominal plant, all plants of the set, "
            "or the nominal model of the set in the lifted or in the frequency domain."
        ),
    ] = "plant",
    rest_s: Annotated[
        float, typer.Option(min=0.0, max=2.0, help="How long the axis is held at the end.")
    ] = 0.2,
) -> None:
    """Track a short path of one axis by filtered basis functions in full preview."""
    check_input(path)
    target = check_output(output, path, machine)
    found = open_machines().to_look_at(machine, files=True).machine

    from stillpath.applications.design import tracking
    from stillpath.cli.design_tables import print_tracked

    made = tracking.track(
        found,
        axis,
        tracking.read_path(path, axis),
        basis=basis,
        functions=functions,
        nominal=nominal,
        rest_s=rest_s,
    )
    tracking.write_tracked(made, target)
    print_tracked(made)
