"""`stillpath trajectories`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

__all__ = ["register"]


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command()(trajectories)


def trajectories(
    source: Annotated[
        Path, typer.Argument(metavar="IN", help="The sliced file: .gcode, .bgcode or .gcode.3mf.")
    ],
    machine: Annotated[
        str,
        typer.Option(
            "--machine", "-m", help="A name of `stillpath machines`, or a JSON file's path."
        ),
    ],
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
    method: Annotated[str, typer.Option(help="As `compensate` has it; none: as it came.")] = "fbf",
    robust: Annotated[str, typer.Option(help="As `compensate` has it.")] = "off",
    budget_um: Annotated[
        float | None, typer.Option("--budget-um", help="As `compensate` has it.")
    ] = None,
    plate: Annotated[
        int | None,
        typer.Option("--plate", metavar="N", min=1, help="Which plate of several."),
    ] = None,
    dialect: Annotated[
        str | None, typer.Option("--dialect", metavar="NAME", help="How the file is read.")
    ] = None,
) -> None:
    """Write planned, commanded and simulated motion with the errors, 1000 rows a second."""
    chosen = form or ("npz" if output.suffix == ".npz" else "csv")
    if chosen not in ("csv", "npz"):
        raise typer.BadParameter(f"--format {form}: there is csv and npz")
    if not source.is_file():
        raise typer.BadParameter(f"there is no file {source}")
    target = output.resolve()
    if target.is_dir() or (target.exists() and target.samefile(source)):
        raise typer.BadParameter(f"{output} is a folder or IN; name the file to write")
    if not target.parent.is_dir():
        raise typer.BadParameter(f"the folder {target.parent} does not exist; make it first")

    from pydantic import ValidationError

    from service.machines.commands import open_machines
    from service.pipeline.options import Options

    try:
        options = Options.model_validate(
            {
                "method": method,
                "robust": robust,
                "budget_um": budget_um,
                "plate": plate,
                "dialect": dialect,
            }
        )
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        raise typer.BadParameter(f"{place}: {first['msg']} (given: {first['input']!r})") from None
    found = open_machines().for_job(machine, files=True)

    from service.console import progress_shown
    from service.pipeline.trajectories import write_trajectories

    with progress_shown("stillpath") as progress:
        rows = write_trajectories(
            source,
            target,
            found.machine,
            options,
            format="npz" if chosen == "npz" else "csv",
            start_s=start,
            stop_s=stop,
            progress=progress,
        )
    typer.echo(f"{rows} rows, {rows / 1000:.3f} s")
