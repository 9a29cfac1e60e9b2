"""Commands of proof on metal. Heavy imports wait until a command needs them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from stillpath.cli.arguments import MachineOption, check_folder, check_output
from stillpath.cli.own_machines import By, Message, open_machines, who

if TYPE_CHECKING:
    from stillpath.applications.machines.resolve import Resolver
    from stillpath.applications.proof.program import PrintSettings
    from stillpath.applications.proof.ring_figures import RingReport
    from stillpath.models.machine import Machine

__all__ = ["coupon", "motor_test", "ring_test", "tower", "verify"]

Output = Annotated[
    Path, typer.Option("--output", "-o", metavar="OUT", dir_okay=False, help="The file to write.")
]
StartGcode = Annotated[
    Path | None,
    typer.Option(exists=True, dir_okay=False, help="Lines instead of homing and heating."),
]


@dataclass(frozen=True, slots=True)
class PrintOptions:
    """How a proof is printed: temperatures, cooling, flow, place, and the lines around it."""

    nozzle_temp: Annotated[float, typer.Option(help="°C, 150 to 350.")] = 210.0
    bed_temp: Annotated[float, typer.Option(help="°C, 0 to 150.")] = 60.0
    fan_percent: Annotated[float, typer.Option(help="Part cooling above the base.")] = 100.0
    max_flow: Annotated[
        float, typer.Option(help="What the hotend melts, mm3/s; bounds the speed.")
    ] = 12.0
    at: Annotated[
        str | None,
        typer.Option(metavar="X,Y", help="Middle of the print. [default: of the travel]"),
    ] = None
    start_gcode: StartGcode = None
    end_gcode: Annotated[
        Path | None,
        typer.Option(
            exists=True, dir_okay=False, help="Lines instead of switching off and parking."
        ),
    ] = None

    def chosen(self) -> PrintSettings:
        """Return the settings of the print."""
        from stillpath.applications.proof.program import PrintSettings

        return PrintSettings(
            nozzle_temp_c=self.nozzle_temp,
            bed_temp_c=self.bed_temp,
            fan_percent=self.fan_percent,
            max_flow_mm3_s=self.max_flow,
            centre_mm=None if self.at is None else _point(self.at),
            start_gcode=_text(self.start_gcode),
            end_gcode=_text(self.end_gcode),
        )


def coupon(
    machine: MachineOption,
    output: Output,
    how: PrintOptions,
) -> None:
    """Write a first print: half as planned, half compensated."""
    settings = how.chosen()
    target = check_output(output, machine, how.start_gcode, how.end_gcode)
    found = open_machines().for_job(machine, files=True)

    from stillpath.applications.proof.coupon import write_coupon
    from stillpath.cli.console import progress_shown
    from stillpath.cli.proof_tables import print_proof

    with progress_shown() as progress:
        made = write_coupon(found.machine, target, settings, progress=progress)
    print_proof(made, found.warnings)


def tower(
    machine: MachineOption,
    axis: Annotated[Literal["x", "y"], typer.Option(help="Whose ringing is wanted.")],
    output: Output,
    *,
    bands: Annotated[int, typer.Option(help="Bands of rising acceleration, 2 to 12.")] = 6,
    how: PrintOptions,
) -> None:
    """Write a ringing tower: half as planned, half compensated."""
    settings = how.chosen()
    target = check_output(output, machine, how.start_gcode, how.end_gcode)
    found = open_machines().for_job(machine, files=True)

    from stillpath.applications.proof.tower import write_tower
    from stillpath.cli.console import progress_shown
    from stillpath.cli.proof_tables import print_proof, print_tower

    with progress_shown() as progress:
        made = write_tower(found.machine, axis, target, settings, count=bands, progress=progress)
    print_proof(made.written, found.warnings, lines=3)
    print_tower(made)


def ring_test(
    machine: MachineOption,
    output: Output,
    chip: Annotated[
        str | None,
        typer.Option(help="Sensor: CHIP of ACCELEROMETER_MEASURE, P of M956. [default: its own]"),
    ] = None,
    chip_y: Annotated[
        str | None, typer.Option("--chip-y", help="The one that moves with Y, if it is another.")
    ] = None,
    start_gcode: StartGcode = None,
    accel: Annotated[
        float | None,
        typer.Option(
            "--accel-mm-s2",
            min=100.0,
            max=50_000.0,
            help="Acceleration of the stops; motors must bear 1.5 times it, and up to 2000 with "
            "Marlin and RepRapFirmware 3 times. [default: the firmware's]",
        ),
    ] = None,
) -> None:
    """Write stops for an accelerometer, half as planned, half compensated. Nothing is printed."""
    target = check_output(output, machine, start_gcode)
    found = open_machines().for_job(machine, files=True)

    from stillpath.applications.proof.recorders import RingSettings
    from stillpath.applications.proof.ring_test import write_ring_test
    from stillpath.cli.console import progress_shown
    from stillpath.cli.proof_tables import print_proof
    from stillpath.models.typed_in import stated_hz

    settings = RingSettings(chip, chip_y, _text(start_gcode), accel)
    with progress_shown() as progress:
        made = write_ring_test(found.machine, target, settings, progress=progress)
    print_proof(made, found.warnings)
    measured = all(stated_hz(axis) is None for axis in found.machine.axes.values())
    then = f"verify {target.name} LOG" if measured else f"identify {target.name} LOG"
    typer.echo(f"when it has run: stillpath {then} --machine {machine}")


def motor_test(
    machine: MachineOption,
    output: Output,
    most: Annotated[
        float, typer.Option("--to", metavar="MM_S2", help="The highest acceleration to try.")
    ] = 20_000.0,
) -> None:
    """Write a search for lost steps at rising limits (Klipper). Nothing is heated or printed.

    Then `stillpath machines motors NAME OUT CONSOLE` reads what the console said.
    """
    target = check_output(output, machine)
    found = open_machines().for_job(machine, files=True)

    from stillpath.applications.proof.motor_test import levels_of
    from stillpath.applications.proof.motor_test import motor_test as written
    from stillpath.pipeline.files import replacing

    text = written(found.machine, most)
    with replacing(target) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")
    for number, level in enumerate(levels_of(text), 1):
        accel, step = level.accel_mm_s2, level.speed_step_mm_s
        typer.echo(f"level {number}: {accel:.0f} mm/s2, steps of {step:.0f} mm/s")
    typer.echo(
        f"Run {output} with a hand on the switch. Then copy the console (or klippy.log) to a file: "
        f"stillpath machines motors {found.machine.name} {output} CONSOLE"
    )


def verify(
    printed: Annotated[
        Path,
        typer.Argument(metavar="PRINTED", exists=True, dir_okay=False, help="What was printed."),
    ],
    logs: Annotated[
        list[Path],
        typer.Argument(
            metavar="LOG...",
            exists=True,
            dir_okay=False,
            help="Raw accelerations; several of a ring test, one of a print.",
        ),
    ],
    machine: MachineOption,
    report: Annotated[
        Path | None,
        typer.Option(
            "--report",
            metavar="DIR",
            file_okay=False,
            help="For readback.html, .json; of a ring test for ring-test.json.",
        ),
    ] = None,
    remember: Annotated[
        bool, typer.Option(help="Let your machine remember what a ring test says of its plants.")
    ] = True,
    by: By = None,
    message: Message = "",
) -> None:
    """Compare a log of a print, or those of a ring test, with what the model says of it."""
    check_folder(report)
    machines = open_machines()
    found = machines.to_look_at(machine, files=True).machine

    from stillpath.applications.proof.ring_motion import is_ring_test

    if is_ring_test(printed):
        said = _verify_ring(printed, logs, found)
        if remember:
            _remember(machines, machine, said, who(by), message)
        if report is not None:
            from stillpath.reports.pages import write_texts

            write_texts(report, {"ring-test.json": said.model_dump_json(indent=1)})
        return
    if len(logs) > 1:
        raise typer.BadParameter("of a print, one log is compared at a time")
    _verify_print(printed, logs[0], found, report)


def _verify_ring(printed: Path, logs: list[Path], machine: Machine) -> RingReport:
    from stillpath.applications.proof.confirming import verify_ring
    from stillpath.cli.proof_tables import print_ring

    made = verify_ring(printed, logs, machine)
    print_ring(made)
    return made


def _verify_print(printed: Path, log: Path, machine: Machine, report: Path | None) -> None:
    from stillpath.applications.proof.page import write_readback
    from stillpath.applications.proof.readback import verify_log
    from stillpath.cli.console import progress_shown
    from stillpath.cli.proof_tables import print_readback

    with progress_shown() as progress:
        made = verify_log(printed, log, machine, progress=progress)
    print_readback(made)
    if report is not None:
        write_readback(made, report)


def _remember(machines: Resolver, name: str, report: RingReport, author: str, message: str) -> None:
    """Put what was said of the axes into the machine's document."""
    said = {a.axis: a.confirmation for a in report.axes if a.confirmation is not None}
    if not said:
        return
    if name not in machines.store:
        typer.echo(
            "note: not remembered: only a machine of your own is (`stillpath machines import FILE "
            "--as NAME`)"
        )
        return
    made = machines.store.confirm(
        name,
        said,
        author=author,
        message=message or f"ring test: {', '.join(f'{a} {c.verdict}' for a, c in said.items())}",
        sources=tuple(dict.fromkeys(s for c in said.values() for s in c.sources)),
    )
    typer.echo(f"{name} revision {made.number}: content {made.machine.revision}")


def _text(file: Path | None) -> str | None:
    return None if file is None else file.read_text(encoding="utf-8-sig", errors="replace")


def _point(text: str) -> tuple[float, float]:
    try:
        x, y = (float(part) for part in text.split(","))
        if not (math.isfinite(x) and math.isfinite(y)):
            raise ValueError
    except ValueError:
        raise typer.BadParameter(f"--at {text}: two numbers are needed, as in 110,110") from None
    return x, y
