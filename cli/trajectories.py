"""`stillpath plan` and `stillpath trajectories`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from stillpath.cli.arguments import (
    BudgetOption,
    DialectOption,
    Input,
    MachineOption,
    MethodOption,
    PlateOption,
    RobustOption,
    check_input,
    check_output,
    chosen_options,
)
from stillpath.cli.own_machines import open_machines
from stillpath.compensation.defaults import DEFAULT_METHOD

__all__ = ["plan", "trajectories"]


def trajectories(
    source: Input,
    machine: MachineOption,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="OUT", help="The table.")],
    form: Annotated[
        str, typer.Option("--format", help="csv or npz. [default: as OUT is called, else csv]")
    ] = "",
    start: Annotated[
        float, typer.Option("--from", metavar="S", min=0.0, help="Second of the print.")
    ] = 0.0,
    stop: Annotated[
        float | None, typer.Option("--to", metavar="S", help="Second of the print. [default: end]")
    ] = None,
    method: MethodOption = DEFAULT_METHOD,
    robust: RobustOption = "auto",
    budget_um: BudgetOption = None,
    plate: PlateOption = None,
    dialect: DialectOption = None,
) -> None:
    """Write planned, commanded and simulated motion with the errors, 1000 rows a second."""
    chosen = form or ("npz" if output.suffix.lower() == ".npz" else "csv")
    if chosen not in ("csv", "npz"):
        raise typer.BadParameter(f"--format {form}: choose csv or npz")
    check_input(source)
    target = check_output(output, source, machine)
    options = chosen_options(
        method=method, robust=robust, budget_um=budget_um, plate=plate, dialect=dialect
    )

    found = open_machines().for_job(machine, files=True)

    from stillpath.cli.console import progress_shown
    from stillpath.pipeline.options import unused
    from stillpath.pipeline.trajectories import write_trajectories

    with progress_shown() as progress:
        rows = write_trajectories(
            source,
            target,
            found.machine,
            options,
            format="npz" if chosen == "npz" else "csv",
            window_s=(start, stop),
            progress=progress,
        )
    for warning in unused(options):
        typer.echo(f"stillpath: {warning}", err=True)
    typer.echo(f"{rows} rows, {rows / 1000:.3f} s")


def plan(
    source: Input,
    machine: MachineOption,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="OUT", help="motion.npz")],
    rate: Annotated[float, typer.Option(min=1.0, max=100_000.0, help="Samples per second.")] = 1e3,
    plate: PlateOption = None,
    dialect: DialectOption = None,
) -> None:
    """Write the motion the machine will make. Columns t (s), x, y, z, e (mm)."""
    check_input(source)
    target = check_output(output, source, machine)
    read_as = chosen_options(dialect=dialect).dialect
    found = open_machines().for_job(machine, files=True)

    from stillpath.cli.console import print_planned, progress_shown
    from stillpath.pipeline.simulate import plan_file

    with progress_shown() as progress:
        planned = plan_file(
            source,
            target,
            found.machine,
            rate_hz=rate,
            plate=plate,
            dialect=read_as,
            progress=progress,
        )
    print_planned(planned)
