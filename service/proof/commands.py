"""Commands of proof on metal. Heavy imports wait until a command needs them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from service.commands.arguments import MachineOption, check_output
from service.machines.commands import open_machines

if TYPE_CHECKING:
    from service.proof.program import PrintSettings

__all__ = ["register"]

Output = Annotated[
    Path, typer.Option("--output", "-o", metavar="OUT", dir_okay=False, help="The file to write.")
]
NozzleTemp = Annotated[float, typer.Option("--nozzle-temp", help="°C, 150 to 350.")]
BedTemp = Annotated[float, typer.Option("--bed-temp", help="°C, 0 to 150.")]
Fan = Annotated[float, typer.Option("--fan-percent", help="Part cooling above the base.")]
Flow = Annotated[
    float, typer.Option("--max-flow", help="What the hotend melts, mm3/s; bounds the speed.")
]
Centre = Annotated[
    str | None,
    typer.Option("--at", metavar="X,Y", help="Middle of the print. [default: of the travel]"),
]
StartGcode = Annotated[
    Path | None,
    typer.Option(exists=True, dir_okay=False, help="Lines instead of homing and heating."),
]
EndGcode = Annotated[
    Path | None,
    typer.Option(exists=True, dir_okay=False, help="Lines instead of switching off and parking."),
]


def register(app: typer.Typer) -> None:
    """Add coupon, tower and verify to a command line."""
    for command in (coupon, tower, verify):
        app.command()(command)


def coupon(
    machine: MachineOption,
    output: Output,
    nozzle_temp: NozzleTemp = 210.0,
    bed_temp: BedTemp = 60.0,
    fan_percent: Fan = 100.0,
    max_flow: Flow = 12.0,
    at: Centre = None,
    start_gcode: StartGcode = None,
    end_gcode: EndGcode = None,
) -> None:
    """Write a first print: half as planned, half compensated."""
    settings = _settings(nozzle_temp, bed_temp, fan_percent, max_flow, at, start_gcode, end_gcode)
    found = open_machines().for_job(machine, files=True)

    from service.console import progress_shown
    from service.proof.coupon import write_coupon
    from service.proof.tables import print_proof

    with progress_shown("stillpath") as progress:
        made = write_coupon(found.machine, check_output(output), settings, progress=progress)
    print_proof(made, found.warnings)


def tower(
    machine: MachineOption,
    axis: Annotated[Literal["x", "y"], typer.Option(help="Whose ringing is wanted.")],
    output: Output,
    bands: Annotated[int, typer.Option(help="Bands of rising acceleration, 2 to 12.")] = 6,
    nozzle_temp: NozzleTemp = 210.0,
    bed_temp: BedTemp = 60.0,
    fan_percent: Fan = 100.0,
    max_flow: Flow = 12.0,
    at: Centre = None,
    start_gcode: StartGcode = None,
    end_gcode: EndGcode = None,
) -> None:
    """Write a ringing tower: half as planned, half compensated."""
    settings = _settings(nozzle_temp, bed_temp, fan_percent, max_flow, at, start_gcode, end_gcode)
    found = open_machines().for_job(machine, files=True)

    from service.console import progress_shown
    from service.proof.tables import print_proof, print_tower
    from service.proof.tower import write_tower

    with progress_shown("stillpath") as progress:
        made = write_tower(
            found.machine, axis, check_output(output), settings, count=bands, progress=progress
        )
    print_proof(made.written, found.warnings, lines=3)
    print_tower(made)


def verify(
    printed: Annotated[
        Path,
        typer.Argument(metavar="PRINTED", exists=True, dir_okay=False, help="What was printed."),
    ],
    log: Annotated[
        Path,
        typer.Argument(metavar="LOG", exists=True, dir_okay=False, help="Raw accelerations."),
    ],
    machine: MachineOption,
    report: Annotated[
        Path | None,
        typer.Option("--report", metavar="DIR", file_okay=False, help="For readback.html, .json."),
    ] = None,
) -> None:
    """Compare a log of a print with what the model says of it."""
    found = open_machines().to_look_at(machine, files=True).machine

    from service.console import progress_shown
    from service.proof.page import write_readback
    from service.proof.readback import verify_log
    from service.proof.tables import print_readback

    with progress_shown("stillpath") as progress:
        made = verify_log(printed, log, found, progress=progress)
    if report is not None:
        write_readback(made, report)
    print_readback(made)


def _settings(
    nozzle_temp: float,
    bed_temp: float,
    fan_percent: float,
    max_flow: float,
    at: str | None,
    start_gcode: Path | None,
    end_gcode: Path | None,
) -> PrintSettings:
    from service.proof.program import PrintSettings

    return PrintSettings(
        nozzle_temp_c=nozzle_temp,
        bed_temp_c=bed_temp,
        fan_percent=fan_percent,
        max_flow_mm3_s=max_flow,
        centre_mm=None if at is None else _point(at),
        start_gcode=_text(start_gcode),
        end_gcode=_text(end_gcode),
    )


def _text(file: Path | None) -> str | None:
    return None if file is None else file.read_text(encoding="utf-8", errors="replace")


def _point(text: str) -> tuple[float, float]:
    try:
        x, y = (float(part) for part in text.split(","))
    except ValueError:
        raise typer.BadParameter(f"--at {text}: two numbers are needed, as in 110,110") from None
    return x, y
