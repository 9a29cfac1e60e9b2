"""The command `scan`. Heavy imports wait until it is needed."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from stillpath.cli.arguments import check_folder, check_output

if TYPE_CHECKING:
    from stillpath.applications.scanning.scan import ScanSettings
    from stillpath.models.disturbances import DisturbanceSpec

__all__ = ["scan"]


@dataclass(frozen=True, slots=True)
class DrawingOptions:
    """How the file is drawn: fields of `ScanSettings`."""

    um_per_unit: Annotated[
        float | None, typer.Option(help="How far the beam moves per unit of the machine.")
    ] = None
    prefilter: Annotated[
        Literal["zpetc", "fbf", "none"], typer.Option(help="From the path to the command.")
    ] = "zpetc"
    cutoff_hz: Annotated[float | None, typer.Option(help="zpetc: zero-phase low-pass on top.")] = (
        None
    )
    jump_mm_s: Annotated[
        float, typer.Option(min=1e-3, max=1e6, help="Speed with the beam off.")
    ] = 2000.0
    settle_ms: Annotated[
        float, typer.Option(min=0.0, max=1e3, help="Wait at the end of a jump.")
    ] = 0.5
    disturbance: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            exists=True,
            dir_okay=False,
            help="In the machine's unit, as JSON. [default: the controller's]",
        ),
    ] = None
    enters: Annotated[
        Literal["output", "input"] | None, typer.Option(help="Where the disturbance enters.")
    ] = None
    disturbance_um: Annotated[
        float,
        typer.Option(min=0.0, max=1e6, help="rms that the controller's disturbance would leave."),
    ] = 10.0

    def chosen(self) -> ScanSettings:
        """Return the settings, the disturbance read."""
        from stillpath.applications.scanning.scan import ScanSettings
        from stillpath.gcode.hatches import Timing

        return ScanSettings(
            um_per_unit=self.um_per_unit,
            prefilter=self.prefilter,
            cutoff_hz=self.cutoff_hz,
            timing=Timing(self.jump_mm_s, 1e-3 * self.settle_ms),
            disturbance=None if self.disturbance is None else _read(self.disturbance),
            enters=self.enters,
            disturbance_um=self.disturbance_um,
        )


def scan(
    source: Annotated[
        Path, typer.Argument(metavar="IN", exists=True, dir_okay=False, help="Hatches as G-code.")
    ],
    machine: Annotated[
        str,
        typer.Option("--machine", "-m", help="A name of `stillpath loops`, or a JSON file's path."),
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="OUT", help="The command: OUT.csv or OUT.npz.")
    ],
    *,
    controller: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            exists=True,
            dir_okay=False,
            help="Add-on, as `stillpath controller --json` wrote it.",
        ),
    ] = None,
    drawing: DrawingOptions,
    report: Annotated[
        Path | None, typer.Option("--report", metavar="DIR", help="For scan.html and scan.json.")
    ] = None,
) -> None:
    """Make the command of a hatch file for a scanner. Every track is predicted."""
    if output.suffix not in (".csv", ".npz"):
        raise typer.BadParameter(f"{output}: the command is written as .csv or .npz")
    check_output(output, source, machine, controller, drawing.disturbance)
    check_folder(report)

    from stillpath.applications.controllers.loading import load_controller
    from stillpath.applications.scanning.page import write_command, write_scan
    from stillpath.applications.scanning.scan import scan_file
    from stillpath.cli.scan_tables import print_scan
    from stillpath.models.loops import load_loop

    add_on = None if controller is None else load_controller(controller)
    made = scan_file(source, load_loop(machine), drawing.chosen(), add_on)
    if report is not None:
        write_scan(made.report, report)
    write_command(made, output.resolve())
    print_scan(made.report)


def _read(file: Path) -> DisturbanceSpec:
    from pydantic import TypeAdapter, ValidationError

    from stillpath.models.complaints import complaint
    from stillpath.models.disturbances import DisturbanceSpec

    adapter: TypeAdapter[DisturbanceSpec] = TypeAdapter(DisturbanceSpec)
    try:
        return adapter.validate_python(json.loads(file.read_bytes()))
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        raise typer.BadParameter(f"{file}: {where}: {complaint(first)}") from None
    except ValueError as error:
        raise typer.BadParameter(f"{file}: not JSON ({error})") from None
