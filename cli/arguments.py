"""Arguments and options that several commands share, and the checks of their values."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stillpath.compensation.defaults import DEFAULT_BASIS, DEFAULT_METHOD

if TYPE_CHECKING:
    from stillpath.pipeline.options import Options

__all__ = [
    "METHODS",
    "BasisOption",
    "BudgetOption",
    "CommandRefused",
    "CompensationOptions",
    "DialectOption",
    "Input",
    "KeyOption",
    "MachineOption",
    "MethodOption",
    "PlateOption",
    "ReportOption",
    "RobustOption",
    "ServerOption",
    "check_folder",
    "check_input",
    "check_output",
    "chosen_options",
]

METHODS = (
    "fbf, npz-ignore, zmetc, zpetc, ebzpetc, ts, none, "
    "shaper:zv, shaper:mzv, shaper:ei, shaper:2hump_ei, shaper:3hump_ei; any with +ripple "
    "appended undoes the machine's ripple too; or advise: leave all moves as they are and add "
    "firmware commands for shaper and acceleration; or live: leave the file as it is and predict "
    "the compensation inside Klipper"
)
"""The methods of `compensate`, in words."""

Input = Annotated[
    Path, typer.Argument(metavar="IN", help="The sliced file: .gcode, .bgcode or .gcode.3mf.")
]
PlateOption = Annotated[
    int | None,
    typer.Option("--plate", metavar="N", min=1, help="Which plate of a .gcode.3mf with several."),
]
MachineOption = Annotated[
    str,
    typer.Option("--machine", "-m", help="A name of `stillpath machines`, or a JSON file's path."),
]
DialectOption = Annotated[
    str | None,
    typer.Option(
        "--dialect",
        metavar="NAME",
        help="How the file is read: klipper, marlin, prusa, bambu or reprapfirmware. [default: "
        "as the machine's firmware reads it]",
    ),
]
ReportOption = Annotated[
    Path | None,
    typer.Option(
        "--report", metavar="DIR", help="Folder for report.html and .json, layers.json and .bin."
    ),
]
MethodOption = Annotated[str, typer.Option("--method", help=METHODS)]
RobustOption = Annotated[
    str,
    typer.Option(
        "--robust",
        help="What fbf is designed for: auto (all plants that explain the measurement, as far as "
        "they allow), off (the nominal plant), ensemble or minimax (the set).",
    ),
]
BasisOption = Annotated[
    str,
    typer.Option(
        "--basis", help="Basis of fbf: ce-opt, robust (chosen for the whole set), bspline or dct."
    ),
]
BudgetOption = Annotated[
    float | None,
    typer.Option(
        "--budget-um",
        help="Contour error that every feature may have (rms, worst plant of the set): print as "
        "fast as that allows. [default: keep all speeds]",
    ),
]
ServerOption = Annotated[
    str | None,
    typer.Option(
        "--server",
        metavar="URL",
        envvar="STILLPATH_SERVER",
        help="Send the work to a service, for instance http://127.0.0.1:8000.",
    ),
]
KeyOption = Annotated[
    str | None,
    typer.Option(
        "--key",
        metavar="KEY",
        envvar="STILLPATH_KEY",
        show_envvar=False,
        help="Key of the service; better set STILLPATH_KEY, which other users cannot see.",
    ),
]


@dataclass(frozen=True, slots=True)
class CompensationOptions:
    """How files are compensated: the options of `compensate`, `batch` and `watch`."""

    method: MethodOption = DEFAULT_METHOD
    basis: BasisOption = DEFAULT_BASIS
    robust: RobustOption = "auto"
    along: Annotated[
        float | None,
        typer.Option(
            help="Weight of errors along the path against those across it, .01 to 1. Less than 1 "
            "takes longer. [default: 1]"
        ),
    ] = None
    tolerance_um: Annotated[
        float | None,
        typer.Option(
            help="How far the written path may be from the computed one; less where the "
            "machine is known well. [default: 2]"
        ),
    ] = None
    where: Annotated[
        str,
        typer.Option(
            help="What is compensated: all, visible (outer walls, top and bottom surfaces) or "
            "walls (outer ones). The rest stays as sliced, and the file is smaller."
        ),
    ] = "all"
    max_mb: Annotated[
        float | None,
        typer.Option(
            metavar="MB",
            help="The most that the written G-code may have: compensate what is visible, then less "
            "exactly (tolerances of 8, 12 and 16), then walls alone, until it fits.",
        ),
    ] = None
    budget_um: BudgetOption = None
    dialect: DialectOption = None
    compare_live: Annotated[
        bool,
        typer.Option(
            "--compare-live",
            help="Report also what the compensation inside Klipper would make of the sliced file.",
        ),
    ] = False
    keep_times: Annotated[
        bool,
        typer.Option("--keep-times", help="Leave the slicer's times in the file as they are."),
    ] = False

    def chosen(self, plate: int | None = None) -> Options:
        """Return the options of a job, checked."""
        given = asdict(self)
        times = "kept" if given.pop("keep_times") else None
        return chosen_options(**given, times=times, plate=plate)


class CommandRefused(Exception):
    """The command cannot be carried out as given."""


def check_input(source: Path) -> None:
    """Refuse anything but a regular file: the pipeline reads it twice."""
    if source.is_dir():
        raise CommandRefused(f"{source} is a folder, not a G-code file")
    if not source.exists():
        raise CommandRefused(f"{source} does not exist")
    if not source.is_file():
        # The pipeline reads a file twice, and opening a pipe waits for somebody to write.
        raise CommandRefused(f"{source} is a pipe or a device; save it as a file first")


def check_output(target: Path, *inputs: Path | str | None) -> Path:
    """Refuse a place that cannot be written, before anything is computed; return it resolved.

    Parameters
    ----------
    inputs : Path or str or None
        What the command reads, as it was named; no file of these is replaced.
    """
    if str(target) == "-":
        raise CommandRefused("nothing is written to the standard output; name a file instead of -")
    if target.is_dir():
        raise CommandRefused(f"{target} is a folder; name the file to write")
    if target.exists() and not target.is_file():
        raise CommandRefused(f"{target} is a pipe or a device; name a file to write")
    # A link is followed, so that what it points to is replaced and not the link.
    target = target.resolve()
    if not target.parent.is_dir():
        raise CommandRefused(f"the folder {target.parent} does not exist; make it first")
    for each in inputs:
        if each and target.exists() and Path(each).exists() and target.samefile(each):
            raise CommandRefused(
                f"{target} is an input of this command; name another file to write"
            )
    return target


def check_folder(folder: Path | None, option: str = "--report") -> None:
    """Refuse a folder to write into that is a file."""
    if folder is not None and folder.exists() and not folder.is_dir():
        raise CommandRefused(f"{option} {folder} is a file; name a folder")


def chosen_options(**given: Any) -> Options:
    """Return the options of a job; those given as None have their defaults."""
    from pydantic import ValidationError

    from stillpath.cli.wrong_options import wrong_option
    from stillpath.pipeline.options import Options

    try:
        return Options(**{name: value for name, value in given.items() if value is not None})
    except ValidationError as error:
        raise CommandRefused(wrong_option(error)) from None
