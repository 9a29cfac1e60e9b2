"""The command `identify`. Heavy imports wait until it is needed."""

from __future__ import annotations

import time
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, TypeAlias

import typer

from stillpath.cli.arguments import CommandRefused, check_folder, check_output
from stillpath.cli.own_machines import RevisionNote, open_documents, open_machines, who
from stillpath.models.errors import ModelError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from stillpath.applications.machines.resolve import Resolver
    from stillpath.applications.machines.revision import Revision
    from stillpath.models.identification.readers import ReadSettings
    from stillpath.models.machine import Machine
    from stillpath.models.provenance import SourceFile
    from stillpath.pipeline.progress import ProgressCallback

    Store = Callable[[Machine, Sequence[SourceFile]], Revision | None]
    """Makes a revision of a machine that was measured, if it has a name."""

__all__ = ["identify"]

Files = Annotated[
    list[str],
    typer.Argument(
        metavar="FILE[@CONDITION]...",
        help="Measurements. Conditions: +0.5kg (a weight on the bed), z=150 or x=50,y=100 (where "
        "the nozzle was), or any label; files with the same label are repeats.",
    ),
]
Report = Annotated[
    Path | None, typer.Option("--report", metavar="DIR", help="Folder for identification.html.")
]
Axis: TypeAlias = Literal["x", "y", "a", "b"] | None
AxisOption = Annotated[
    Axis,
    typer.Option(help="Axis, if neither files nor their names say it. a, b: CoreXY's (--ripple)."),
]


@dataclass(frozen=True, slots=True)
class TargetOptions:
    """The machine that is made or changed, and what it is made from."""

    machine: Annotated[
        str | None,
        typer.Option("--machine", "-m", help="Your machine: made, or given a new revision."),
    ] = None
    base: Annotated[
        str | None,
        typer.Option(
            help="What a new machine starts from: a name of `stillpath machines`, or a file."
        ),
    ] = None
    title: Annotated[str | None, typer.Option(help="What people call the machine.")] = None
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="OUT", help="Write the machine to a JSON file too."),
    ] = None


@dataclass(frozen=True, slots=True)
class ReaderOptions:
    """What the files of measurements do not say: fields of `ReadSettings`, and `columns`."""

    accel_per_hz_mm_s: Annotated[
        float | None,
        typer.Option("--accel-per-hz", help="accel_per_hz of [resonance_tester]."),
    ] = None
    f_start_hz: Annotated[
        float | None, typer.Option("--min-freq", help="min_freq of [resonance_tester], Hz.")
    ] = None
    f_end_hz: Annotated[
        float | None, typer.Option("--max-freq", help="max_freq of [resonance_tester], Hz.")
    ] = None
    hz_per_s: Annotated[
        float | None, typer.Option("--hz-per-sec", help="hz_per_sec of [resonance_tester].")
    ] = None
    sweeping_accel_mm_s2: Annotated[
        float | None, typer.Option("--sweeping-accel", help="sweeping_accel; 0: none.")
    ] = None
    firmware_date: Annotated[
        str | None, typer.Option(metavar="YYYY-MM-DD", help="Of the Klipper version that measured.")
    ] = None
    sensor_axis: Annotated[
        Literal["x", "y", "z"] | None, typer.Option(help="Sensor axis along the tested axis.")
    ] = None
    sensor_turned: Annotated[
        bool, typer.Option("--sensor-turned", help="It was mounted differently for X and for Y.")
    ] = False
    frame_firm: Annotated[
        bool,
        typer.Option(
            "--frame-firm",
            help="The frame does not move (bolted down, heavy): what the sensor feels is what "
            "prints.",
        ),
    ] = False
    guides: Annotated[
        Literal["wheels", "rails"] | None,
        typer.Option(
            help="What the axes run on, for the friction that tables do not show. Default: wheels "
            "(or bushings) where kinematics are cartesian, else rails."
        ),
    ] = None
    columns: Annotated[
        str | None,
        typer.Option(metavar="T,U,Y", help="Columns of time, command and measurement of a drive."),
    ] = None
    repair_rounding: Annotated[
        bool, typer.Option("--repair-rounding", help="Move printed coefficients to DC gain 1.")
    ] = False
    dc_gain: Annotated[
        float | None,
        typer.Option(help="DC gain that a model may have: steps per mm are off by it."),
    ] = None
    sampling_s: Annotated[
        float | None, typer.Option(help="Sampling time, s, of a discrete model that does not say.")
    ] = None

    def chosen(self, axis: Axis) -> ReadSettings:
        """Return the settings of the readers, checked."""
        from pydantic import ValidationError

        from stillpath.cli.wrong_options import wrong_option
        from stillpath.models.identification.readers import ReadSettings

        given = asdict(self)
        given |= {"axis": axis, **_columns(given.pop("columns"))}
        try:
            return ReadSettings.model_validate({k: v for k, v in given.items() if v is not None})
        except ValidationError as error:
            raise ModelError(wrong_option(error, _CALLED)) from None


@dataclass(frozen=True, slots=True)
class RippleOptions:
    """Which ripple is learnt, and how."""

    ripple: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME:PITCH[:1,2,3][@output]",
            help="Learn ripple instead of plants: a part that repeats, its pitch in mm and "
            "harmonics. FILEs are passes with time_s, position_mm and measured_mm or accel_mm_s2.",
        ),
    ] = None
    gain: Annotated[
        float, typer.Option(help="Share by which passes move ripple that is known already.")
    ] = 0.5
    remaining: Annotated[
        bool,
        typer.Option(
            "--remaining", help="The passes were recorded with the known ripple compensated."
        ),
    ] = False
    homing_repeatability: Annotated[
        float, typer.Option(metavar="MM", help="How exactly homing repeats.")
    ] = 0.0


def identify(
    files: Files,
    *,
    target: TargetOptions,
    report: Report = None,
    axis: AxisOption = None,
    readers: ReaderOptions,
    max_order: Annotated[int, typer.Option(min=1, max=8, help="Most modes to try.")] = 4,
    ripple: RippleOptions,
    note: RevisionNote,
) -> None:
    """Build a machine model from measurements: resonance tests, drives, responses, models.

    Also from a ring test: its G-code, and what was logged while it ran.

    Without --machine and --output nothing is stored: the figures are printed.
    """
    settings = readers.chosen(None if ripple.ripple else axis)
    if target.output is not None:
        check_output(target.output, *files, *(file.rpartition("@")[0] for file in files))
    if ripple.ripple and report is not None:
        raise CommandRefused("--report shows plants, and --ripple learns none: leave --report out")
    check_folder(report)
    machines = open_machines()
    start, expected = _start(machines, target.machine, target.base)
    store = partial(_stored, machines, target, note, expected)
    if ripple.ripple:
        _learn_ripple(files, start, target, axis, ripple, store)
    else:
        _identify_plants(files, start, target, settings, max_order, store, report)


def _learn_ripple(
    files: list[str],
    start: Machine,
    target: TargetOptions,
    axis: Axis,
    chosen: RippleOptions,
    store: Store,
) -> None:
    from stillpath.applications.identification.ripple import learn_from_files

    learnt = learn_from_files(
        files,
        start,
        axis,
        chosen.ripple or [],
        gain=chosen.gain,
        remaining=chosen.remaining,
        homing_repeatability_mm=chosen.homing_repeatability,
    )
    machine = learnt.named(target.machine, target.title)
    _print_revision(store(machine, learnt.sources))
    _write(target.output, machine)
    typer.echo(learnt.summary)


def _identify_plants(
    files: list[str],
    start: Machine,
    target: TargetOptions,
    settings: ReadSettings,
    max_order: int,
    store: Store,
    report: Path | None,
) -> None:
    from stillpath.applications.identification.archive import Archive
    from stillpath.applications.identification.page import write_identification
    from stillpath.applications.identification.run import identify_files, read_inputs
    from stillpath.cli.console import progress_shown, told_after
    from stillpath.cli.identification_tables import print_identification

    with progress_shown() as progress:
        found = identify_files(
            read_inputs(files),
            start,
            settings,
            name=target.machine,
            title=target.title,
            max_order=max_order,
            progress=_with_times(progress),
        )
    made = store(found.machine, found.report.sources)
    _print_revision(made)
    _write(target.output, found.machine)
    print_identification(found.report)
    kept = target.output or (made and f"{made.machine.name} revision {made.number}")
    with told_after(kept, "report") if kept else nullcontext():
        if made is not None:
            # Where the service looks for them.
            Archive(open_documents("identifications")).keep(found.report)
        if report is not None:
            write_identification(found.report, report)


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
    if name is not None:
        from stillpath.applications.machines.store import check_name

        check_name(name)  # before the work, not after it
    if base is None and name is not None:
        raise ModelError(
            f"there is no machine {name!r} yet: say by --base what it starts from (a machine of "
            "`stillpath machines` with the limits of yours, or a file), or make it with "
            "`stillpath machines from-config printer.cfg`"
        )
    return machines.to_look_at(base or "generic-bedslinger", files=True).machine, 0


def _stored(
    machines: Resolver,
    target: TargetOptions,
    note: RevisionNote,
    expected: int,
    machine: Machine,
    sources: Sequence[SourceFile],
) -> Revision | None:
    """Make a revision, before anything else is written: the store may refuse."""
    from stillpath.applications.machines.revision import identified_from

    if target.machine is None:
        return None
    return machines.store.add_revision(
        target.machine,
        machine,
        author=who(note.by),
        message=note.message or identified_from(sources),
        sources=sources,
        expected=expected,
    )


def _print_revision(made: Revision | None) -> None:
    if made is not None:
        name = made.machine.name
        typer.echo(f"{name} revision {made.number}: content {made.machine.revision}")


def _with_times(progress: ProgressCallback) -> Callable[[str, float], None]:
    from stillpath.pipeline.progress import Progress

    began = time.monotonic()

    def tell(stage: str, fraction: float) -> None:
        elapsed = time.monotonic() - began
        eta = elapsed * (1 - fraction) / fraction if fraction > 0.05 else None
        progress(Progress(stage, fraction, 0.0, elapsed, eta))

    return tell
