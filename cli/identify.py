"""The command `identify`. Heavy imports wait until it is needed."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from stillpath.cli.arguments import check_folder, check_output
from stillpath.cli.machines import By, Message, open_documents, open_machines, who
from stillpath.models.errors import ModelError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from stillpath.applications.machines.resolve import Resolver
    from stillpath.applications.machines.revision import Revision
    from stillpath.models.identification.readers import ReadSettings
    from stillpath.models.machine import Machine
    from stillpath.models.provenance import SourceFile
    from stillpath.pipeline.progress import ProgressCallback

__all__ = ["register"]

Files = Annotated[
    list[str],
    typer.Argument(
        metavar="FILE[@CONDITION]...",
        help="Measurements. Conditions: +0.5kg (a weight on the bed), z=150 or x=50,y=100 (where "
        "the nozzle was), or any label; files with the same label are repeats.",
    ),
]
Name = Annotated[
    str | None,
    typer.Option("--machine", "-m", help="Your machine: made, or given a new revision."),
]
Base = Annotated[
    str | None,
    typer.Option(help="What a new machine starts from: a name of `stillpath machines`, or a file."),
]
Output = Annotated[
    Path | None,
    typer.Option("--output", "-o", metavar="OUT", help="Write the machine to a JSON file too."),
]
Report = Annotated[
    Path | None, typer.Option("--report", metavar="DIR", help="Folder for identification.html.")
]
AxisOption = Annotated[
    Literal["x", "y", "a", "b"] | None,
    typer.Option(help="Axis, if neither files nor their names say it. a, b: CoreXY's (--ripple)."),
]
PerHz = Annotated[float | None, typer.Option(help="accel_per_hz of [resonance_tester].")]
Low = Annotated[float | None, typer.Option(help="min_freq of [resonance_tester], Hz.")]
High = Annotated[float | None, typer.Option(help="max_freq of [resonance_tester], Hz.")]
Rate = Annotated[float | None, typer.Option(help="hz_per_sec of [resonance_tester].")]
Sweep = Annotated[float | None, typer.Option(help="sweeping_accel; 0: none.")]
Firmware = Annotated[
    str | None, typer.Option(metavar="YYYY-MM-DD", help="Of the Klipper version that measured.")
]
Sensor = Annotated[
    Literal["x", "y", "z"] | None, typer.Option(help="Sensor axis along the tested axis.")
]
Turned = Annotated[
    bool, typer.Option("--sensor-turned", help="It was mounted differently for X and for Y.")
]
Columns = Annotated[
    str | None,
    typer.Option(metavar="T,U,Y", help="Columns of time, command and measurement of a drive."),
]
Repair = Annotated[
    bool, typer.Option("--repair-rounding", help="Move printed coefficients to DC gain 1.")
]
Firm = Annotated[
    bool,
    typer.Option(
        "--frame-firm",
        help="The frame stands firm (bolted down, heavy): what the sensor feels is what prints.",
    ),
]
DcGain = Annotated[
    float | None, typer.Option(help="DC gain that a model may have: steps per mm are off by it.")
]
Sampling = Annotated[
    float | None, typer.Option(help="Sampling time, s, of a discrete model that does not say.")
]
Ripple = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME:PITCH[:1,2,3][@output]",
        help="Learn ripple instead of plants: a part that repeats, its pitch in mm and harmonics. "
        "FILEs are passes with time_s, position_mm and measured_mm or accel_mm_s2.",
    ),
]
Gain = Annotated[
    float, typer.Option(help="Share by which passes move ripple that is known already.")
]
Remaining = Annotated[
    bool, typer.Option("--remaining", help="The passes ran with the known ripple undone.")
]
Homing = Annotated[float, typer.Option(metavar="MM", help="How exactly homing repeats.")]


def register(app: typer.Typer) -> None:
    """Add identify to a command line."""
    app.command("identify")(run)


def run(
    files: Files,
    machine: Name = None,
    base: Base = None,
    title: Annotated[str | None, typer.Option(help="Of the machine.")] = None,
    output: Output = None,
    report: Report = None,
    axis: AxisOption = None,
    accel_per_hz: PerHz = None,
    min_freq: Low = None,
    max_freq: High = None,
    hz_per_sec: Rate = None,
    sweeping_accel: Sweep = None,
    firmware_date: Firmware = None,
    sensor_axis: Sensor = None,
    sensor_turned: Turned = False,
    frame_firm: Firm = False,
    columns: Columns = None,
    repair_rounding: Repair = False,
    dc_gain: DcGain = None,
    sampling_s: Sampling = None,
    max_order: Annotated[int, typer.Option(min=1, max=8, help="Most modes to try.")] = 4,
    ripple: Ripple = None,
    gain: Gain = 0.5,
    remaining: Remaining = False,
    homing_repeatability: Homing = 0.0,
    by: By = None,
    message: Message = "",
) -> None:
    """Make a machine of measurements. Resonance tests, recorded drives, responses, models.

    Without --machine and --output nothing is stored: the figures are printed.
    """
    settings = _settings(
        axis=None if ripple else axis,
        accel_per_hz_mm_s=accel_per_hz,
        f_start_hz=min_freq,
        f_end_hz=max_freq,
        hz_per_s=hz_per_sec,
        sweeping_accel_mm_s2=sweeping_accel,
        firmware_date=firmware_date,
        sensor_axis=sensor_axis,
        sensor_turned=sensor_turned,
        frame_firm=frame_firm,
        repair_rounding=repair_rounding,
        dc_gain=dc_gain,
        sampling_s=sampling_s,
        **_columns(columns),
    )
    if output is not None:
        check_output(output)
    check_folder(report)
    machines = open_machines()
    start, expected = _start(machines, machine, base)
    if ripple:
        from stillpath.applications.identification.ripple import learn_from_files

        learnt = learn_from_files(
            files,
            start,
            axis,
            ripple,
            gain=gain,
            remaining=remaining,
            homing_repeatability_mm=homing_repeatability,
            name=machine,
            title=title,
        )
        made = _stored(
            machines, machine, learnt.machine, learnt.sources, who(by), message, expected
        )
        _write(output, learnt.machine)
        typer.echo(learnt.summary)
        _tell(made)
        return

    from stillpath.applications.identification.archive import Archive
    from stillpath.applications.identification.page import write_identification
    from stillpath.applications.identification.run import identify_files, read_inputs
    from stillpath.cli.console import progress_shown
    from stillpath.cli.identification_tables import print_identification

    with progress_shown("stillpath") as progress:
        found = identify_files(
            read_inputs(files),
            start,
            settings,
            name=machine,
            title=title,
            max_order=max_order,
            progress=_told(progress),
        )
    sources = found.report.sources
    made = _stored(machines, machine, found.machine, sources, who(by), message, expected)
    if made is not None:
        # Where the service looks for them.
        Archive(open_documents("identifications")).keep(found.report)
    if report is not None:
        write_identification(found.report, report)
    _write(output, found.machine)
    print_identification(found.report)
    _tell(made)


def _write(output: Path | None, machine: Machine) -> None:
    from stillpath.pipeline.files import replacing

    if output is not None:
        with replacing(output.resolve()) as temporary:
            temporary.write_text(machine.model_dump_json(indent=1) + "\n", encoding="utf-8")


_CALLED = {
    "accel_per_hz_mm_s": "accel_per_hz",
    "f_start_hz": "min_freq",
    "f_end_hz": "max_freq",
    "hz_per_s": "hz_per_sec",
    "sweeping_accel_mm_s2": "sweeping_accel",
    "time_column": "columns",
    "command_column": "columns",
    "measured_column": "columns",
}
"""Settings of readers that are called otherwise on the command line."""


def _settings(**given: Any) -> ReadSettings:
    from pydantic import ValidationError

    from stillpath.models.identification.readers import ReadSettings
    from stillpath.service.wrong_options import wrong_option

    try:
        return ReadSettings.model_validate({k: v for k, v in given.items() if v is not None})
    except ValidationError as error:
        raise ModelError(wrong_option(error, _CALLED)) from None


def _columns(text: str | None) -> dict[str, str]:
    if text is None:
        return {}
    names = [part.strip() for part in text.split(",")]
    if len(names) != 3 or not all(names):
        raise ModelError(f"--columns {text!r}: three names or numbers (from 0) are needed: t,u,y")
    return dict(zip(("time_column", "command_column", "measured_column"), names, strict=True))


def _start(machines: Resolver, name: str | None, base: str | None) -> tuple[Machine, int]:
    """Return the machine to start from, and the revision that the change is made on."""
    if name is not None and name in machines.store:
        if base is not None:
            raise ModelError(
                f"machine {name!r} exists, so it is what the change starts from; leave out --base, "
                "or take another name"
            )
        current = machines.store.current(name)
        return current.machine, current.number
    if base is None and name is not None:
        raise ModelError(
            f"there is no machine {name!r} yet: say by --base what it starts from (a machine of "
            "`stillpath machines` with the limits of yours, or a file), or make it with "
            "`stillpath machines from-config printer.cfg`"
        )
    return machines.to_look_at(base or "generic-bedslinger", files=True).machine, 0


def _stored(
    machines: Resolver,
    name: str | None,
    machine: Machine,
    sources: Sequence[SourceFile],
    author: str,
    message: str,
    expected: int,
) -> Revision | None:
    """Make a revision, before anything else is written: the store may refuse."""
    if name is None:
        return None
    return machines.store.add_revision(
        name,
        machine,
        author=author,
        message=message or f"identified from {', '.join(s.name for s in sources)}",
        sources=sources,
        expected=expected,
    )


def _tell(made: Revision | None) -> None:
    if made is not None:
        name = made.machine.name
        typer.echo(f"{name} revision {made.number}: content {made.machine.revision}")


def _told(progress: ProgressCallback) -> Callable[[str, float], None]:
    from stillpath.pipeline.progress import Progress

    began = time.monotonic()

    def tell(stage: str, fraction: float) -> None:
        elapsed = time.monotonic() - began
        eta = elapsed * (1 - fraction) / fraction if fraction > 0.05 else None
        progress(Progress(stage, fraction, 0.0, elapsed, eta))

    return tell
