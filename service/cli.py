"""The command line. Heavy imports wait until a command needs them, so that --help is quick.

Exit codes: 0 done, 1 the computer failed us (disk, memory, permission), 2 the request cannot be
met (bad file, machine, model or option), 130 interrupted. Whatever is not 0 leaves no output
file, and the input as it was.
"""

from __future__ import annotations

import errno
import sys
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

from service.backup import commands as backup
from service.commands import advice, serve, trajectories, warm
from service.commands.arguments import (
    METHODS,
    DialectOption,
    Input,
    MachineOption,
    MaxMbOption,
    PlateOption,
    Refused,
    ReportOption,
    WhereOption,
    check_folder,
    check_input,
    check_output,
    chosen_options,
)
from service.controllers import commands as controllers
from service.deliveries import commands as deliveries
from service.environment import prepare_environment
from service.farm import commands as farm
from service.identification import commands as identification
from service.interruption import Interrupted
from service.live import commands as live_commands
from service.machines import commands as machines
from service.proof import commands as proof
from service.remote import KeyOption, ServerOption, compensate_on_server
from service.remote import register as register_jobs
from service.scanning import commands as scanning
from service.security import commands as security

__all__ = ["app", "main", "run"]

app = typer.Typer(
    name="stillpath",
    help="Keeps a printer's nozzle on its path: compensates G-code for the machine's vibration.",
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
app.add_typer(machines.app, name="machines")
app.add_typer(live_commands.app, name="klipper")

_INTERRUPTED = 130
_WITH_WORKERS = (["serve"], ["scheduler"], ["worker"])
"""Commands that compute in processes of their own."""


def main() -> NoReturn:
    """Run the command line and exit; the entry point of the `stillpath` command."""
    prepare_environment(computing=sys.argv[1:2] not in _WITH_WORKERS)
    sys.exit(run(sys.argv[1:]))


def run(arguments: list[str]) -> int:
    """Run one command and return its exit code; every failure is one line on stderr."""
    try:
        code = typer.main.get_command(app).main(
            args=arguments, prog_name="stillpath", standalone_mode=False
        )
        if code != _INTERRUPTED:
            return code if isinstance(code, int) else 0
        return _fail("interrupted; nothing was written", _INTERRUPTED)
    except (KeyboardInterrupt, typer.Abort):
        return _fail("interrupted; nothing was written", _INTERRUPTED)
    except Interrupted as interruption:
        return _fail("interrupted; nothing was written", interruption.exit_code)
    except typer.TyperException as error:
        return _fail(f"{_of_usage(error)} (stillpath COMMAND --help lists the options)", 2)
    except Refused as error:
        return _fail(str(error), 2)
    except MemoryError:
        return _fail("out of memory; close other programs or use a larger machine", 1)
    except OSError as error:
        return _fail(_of_system(error), 1)
    except ValueError as error:
        if not _is_ours(error):
            raise
        return _fail(str(error), 2)
    except Exception as error:  # of a service that was asked: it knows how bad it is
        if not hasattr(error, "exit_code"):
            raise
        return _fail(str(error), error.exit_code)


@app.callback(invoke_without_command=True)
def _root(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Show the version.")] = False,
) -> None:
    if version:
        from service.version import __version__

        typer.echo(f"stillpath {__version__}")
        raise typer.Exit
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())


@app.command()
def compensate(
    source: Input,
    machine: MachineOption,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="OUT", help="The file to write.")
    ] = None,
    in_place: Annotated[
        bool, typer.Option("--in-place", help="Write over IN, as slicers ask of their scripts.")
    ] = False,
    method: Annotated[str, typer.Option(help=METHODS)] = "fbf",
    basis: Annotated[
        str, typer.Option(help="Basis of fbf: ce-opt, robust, bspline or dct.")
    ] = "ce-opt",
    robust: Annotated[
        str,
        typer.Option(
            help="What fbf looks at: auto (all that explains the measurement, no more than that "
            "bears), off (the nominal plant), ensemble or minimax (its set)."
        ),
    ] = "auto",
    along: Annotated[
        float | None,
        typer.Option(
            help="Weight of errors along the path against those across it, .01 to 1. Less than 1 "
            "takes longer. [default: .09 with a set, else 1]"
        ),
    ] = None,
    tolerance_um: Annotated[
        float | None,
        typer.Option(help="How far the written path may be from the computed one. [default: 2]"),
    ] = None,
    where: WhereOption = "all",
    max_mb: MaxMbOption = None,
    budget_um: Annotated[
        float | None,
        typer.Option(
            help="Contour error that every feature may have (rms, worst plant of the set): print "
            "as fast as that allows. [default: keep all speeds]"
        ),
    ] = None,
    plate: PlateOption = None,
    dialect: DialectOption = None,
    keep_times: Annotated[
        bool,
        typer.Option("--keep-times", help="Leave the slicer's times in the file as they are."),
    ] = False,
    report: ReportOption = None,
    server: ServerOption = None,
    key: KeyOption = None,
) -> None:
    """Write a compensated file, and print what was measured on it."""
    if in_place == (output is not None):
        raise Refused("give either -o OUT or --in-place")
    options = chosen_options(
        method=method,
        basis=basis,
        robust=robust,
        along=along,
        tolerance_um=tolerance_um,
        budget_um=budget_um,
        where=where,
        max_mb=max_mb,
        plate=plate,
        dialect=dialect,
        times="kept" if keep_times else None,
    )
    check_input(source)
    target = check_output(output or source)
    if output is not None and target.exists() and target.samefile(source):
        raise Refused(f"{output} is the input; name another file, or say --in-place instead of -o")
    check_folder(report)
    if server:
        compensate_on_server(
            source, target, machine, options, server=server, key=key, report=report
        )
        return
    found = _machine(machine)

    from service.console import print_result, progress_shown
    from service.pipeline.road import compensate_file

    with progress_shown("stillpath") as progress:
        result = compensate_file(
            source, target, found.machine, options, progress=progress, layers=report
        )
    result.warnings.extend(found.warnings)
    _write_report(result, report)
    print_result(result)


@app.command()
def plan(
    source: Input,
    machine: MachineOption,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="OUT", help="motion.npz")],
    rate: Annotated[float, typer.Option(min=1.0, max=100_000.0, help="Samples per second.")] = 1e3,
    plate: PlateOption = None,
    dialect: DialectOption = None,
) -> None:
    """Write the motion the machine will make. Columns t, x, y, z, e."""
    check_input(source)
    target = check_output(output)
    if target == source.resolve():
        raise Refused("OUT must not be IN: the motion is no G-code")
    read_as = chosen_options(dialect=dialect).dialect
    found = _machine(machine)

    from service.console import print_planned, progress_shown
    from service.pipeline.road import plan_file

    with progress_shown("stillpath") as progress:
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


@app.command()
def simulate(
    source: Input,
    machine: MachineOption,
    report: Annotated[
        Path,
        typer.Option(
            "--report",
            metavar="DIR",
            help="Folder for report.html and .json, layers.json and .bin.",
        ),
    ],
    live: Annotated[
        bool,
        typer.Option("--live", help="With the compensation inside Klipper (klipper export)."),
    ] = False,
    plate: PlateOption = None,
    dialect: DialectOption = None,
) -> None:
    """Report how far the nozzle will be from its path. No G-code is written."""
    check_input(source)
    check_folder(report)
    read_as = chosen_options(dialect=dialect).dialect
    found = _machine(machine)

    from service.console import print_result, progress_shown
    from service.pipeline.road import simulate_file

    found_filter = None
    if live:
        from service.live.design import filter_of

        found_filter = filter_of(found.machine)
    with progress_shown("stillpath") as progress:
        result = simulate_file(
            source,
            found.machine,
            plate=plate,
            dialect=read_as,
            progress=progress,
            layers=report,
            live=found_filter,
        )
    result.warnings.extend(found.warnings)
    _write_report(result, report)
    print_result(result)


@app.command()
def design(
    machine: MachineOption,
    axis: Annotated[str, typer.Option(help="x or y.")],
    basis: Annotated[str, typer.Option(help="ce-opt, robust, bspline or dct.")] = "ce-opt",
    robust: Annotated[str, typer.Option(help="auto, off, ensemble or minimax.")] = "off",
    report: Annotated[
        Path | None, typer.Option("--report", metavar="DIR", help="Folder for design.html, .json.")
    ] = None,
) -> None:
    """Look at the design for one axis. Plant, metrics, ladder, and what errors of it cost."""
    check_folder(report)
    found = machines.open_machines().to_look_at(machine, files=True).machine

    from service.design.design import design_report
    from service.design.page import write_design
    from service.design.tables import print_design

    made = design_report(found, axis, basis=basis, robust=robust)
    if report is not None:
        write_design(made, report)
    print_design(made)


identification.register(app)
proof.register(app)
controllers.register(app)
scanning.register(app)
trajectories.register(app)
advice.register(app)
security.register(app)
farm.register(app)
serve.register(app)
backup.register(app)
deliveries.register(app)
register_jobs(app)
warm.register(app)


def _machine(name: str) -> Any:
    """Find the machine for a job, with warnings about it."""
    return machines.open_machines().for_job(name, files=True)


def _write_report(result: Any, folder: Path | None) -> None:
    if folder is not None:
        from service.reports import write_report

        write_report(result, folder)


def _is_ours(error: ValueError) -> bool:
    from compensation.base import DesignError
    from gcode.errors import GcodeError
    from models.errors import ModelError

    return isinstance(error, GcodeError | ModelError | DesignError)


def _of_usage(error: typer.TyperException) -> str:
    """Return what is wrong with the command line; a value that typer refused in our words."""
    from pydantic import ValidationError

    from models.complaints import complaint

    refused, parameter = error.__cause__, getattr(error, "param", None)
    if not isinstance(refused, ValidationError) or parameter is None:
        return error.format_message()
    name = next((name for name in parameter.opts if name.startswith("--")), parameter.metavar)
    return f"{name or parameter.name}: {complaint(refused.errors(include_url=False)[0])}"


def _of_system(error: OSError) -> str:
    place = f"{error.filename}: " if error.filename else ""
    full = error.errno in (errno.ENOSPC, errno.EDQUOT)
    remedy = "; make room there, or write to another disk" if full else ""
    return f"{place}{error.strerror or error}{remedy}"


def _fail(message: str, code: int) -> int:
    sys.stderr.write(f"stillpath: error: {' '.join(message.split())}\n")
    return code
