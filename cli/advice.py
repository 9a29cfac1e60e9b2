"""`stillpath remove-advice`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from stillpath.cli.arguments import CommandRefused, PlateOption, check_input, check_output

__all__ = ["remove_advice"]


def remove_advice(
    source: Annotated[Path, typer.Argument(metavar="IN", help="A file with advice.")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="OUT", help="The file to write.")
    ] = None,
    in_place: Annotated[bool, typer.Option("--in-place", help="Write over IN.")] = False,
    plate: PlateOption = None,
) -> None:
    """Take out the lines that `compensate --method advise` has added."""
    if in_place == (output is not None):
        raise CommandRefused("give either -o OUT or --in-place")
    check_input(source)
    target = check_output(output, source) if output else check_output(source)

    from stillpath.pipeline.advising.removing import remove_advice as remove

    count = remove(source.resolve(), target, plate=plate)
    typer.echo(f"{count} lines of advice taken out")
