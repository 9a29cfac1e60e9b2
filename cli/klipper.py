"""`stillpath klipper ...`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from stillpath.cli.arguments import MachineOption, check_output

__all__ = ["app"]

app = typer.Typer(help="Compensation inside Klipper, while it prints.", rich_markup_mode=None)


@app.callback()
def _group() -> None:
    """Keep `export` a command of its own: there may be others."""


@app.command()
def export(
    machine: MachineOption,
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="OUT", help="stillpath.json")
    ] = Path("stillpath.json"),
) -> None:
    """Write the machine's compensation for the extra of Klipper (docs/klipper-live.md)."""
    target = check_output(output, machine)

    from stillpath.cli.own_machines import open_machines

    found = open_machines().for_job(machine, files=True)

    from stillpath.applications.live.export import write_export

    document = write_export(found.machine, target)
    for warning in found.warnings:
        typer.echo(f"warning: {warning}")
    _tell(document, output)


def _tell(document: dict[str, Any], output: Path) -> None:
    said = document["predictions"]
    labels = {"before": "as planned", "live": "live", "shaper": f"shaper ({said['shaper']})"}
    typer.echo(f"{output}: {document['machine']}, digest {document['digest'][:12]}")
    typer.echo("Predicted contour error, um rms (over the plants that explain the measurement):")
    for name, label in labels.items():
        one = said["channels"][name]
        typer.echo(f"  {label:32} {one['nominal']:6.2f} ({one['least']:.2f} to {one['most']:.2f})")
    ratio = said["against_shaper"]
    typer.echo(
        f"Against the shaper: {ratio['mean']:.2f} in the mean, {ratio['worst']:.2f} on the worst "
        f"plant. Command: {said['peak_accel_mm_s2']} mm/s2 at most on the reference motion."
    )
