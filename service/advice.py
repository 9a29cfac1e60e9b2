"""`stillpath remove-advice`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

__all__ = ["register"]


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command()(remove_advice)


def remove_advice(
    source: Annotated[Path, typer.Argument(metavar="IN", help="A file with advice.")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="OUT", help="The file to write.")
    ] = None,
    in_place: Annotated[bool, typer.Option("--in-place", help="Write over IN.")] = False,
    plate: Annotated[
        int | None,
        typer.Option("--plate", metavar="N", min=1, help="Which plate of several."),
    ] = None,
) -> None:
    """Take out the lines that `compensate --method advise` has added."""
    if in_place == (output is not None):
        raise typer.BadParameter("give either -o OUT or --in-place")
    if not source.is_file():
        raise typer.BadParameter(f"there is no file {source}")
    target = (output or source).resolve()
    if not target.parent.is_dir():
        raise typer.BadParameter(f"the folder {target.parent} does not exist; make it first")

    from service.pipeline.advising.removing import remove_advice as remove

    count = remove(source.resolve(), target, plate=plate)
    typer.echo(f"{count} lines of advice taken out")
