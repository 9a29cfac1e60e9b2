"""`stillpath printers ...`: compares printers that receive results with their machine documents."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stillpath.cli.arguments import CommandRefused, KeyOption, ServerOption
from stillpath.models.errors import ModelError

if TYPE_CHECKING:
    from stillpath.service.deliveries.checking import PrinterCheck

__all__ = ["app"]

Name = Annotated[str, typer.Argument(metavar="NAME", help="A section [printer.NAME] of the file.")]
FileOption = Annotated[
    Path | None,
    typer.Option(
        "--printers",
        metavar="FILE",
        envvar="STILLPATH_PRINTERS",
        help="The file of printers, docs/running.md.",
    ),
]

app = typer.Typer(
    help="Printers that results are sent to.", rich_markup_mode=None, no_args_is_help=True
)


@app.command()
def check(
    context: typer.Context,
    name: Name,
    printers: FileOption = None,
    server: ServerOption = None,
    key: KeyOption = None,
) -> None:
    """Compare a printer's configuration with its machine. Exit code 0: all well, 2: not."""
    found = _found(name, printers, _server(context, server), key, accept=False)
    for finding in found.findings:
        typer.echo(f"{'unsafe: ' if finding.unsafe else ''}{finding.text}")
    if found.findings:
        raise typer.Exit(2)
    typer.echo(f"{name}: as the machine {found.machine} says ({found.software})")


@app.command()
def accept(
    context: typer.Context,
    name: Name,
    printers: FileOption = None,
    server: ServerOption = None,
    key: KeyOption = None,
) -> None:
    """Take a printer's configuration as it is now: later changes count from here."""
    found = _found(name, printers, _server(context, server), key, accept=True)
    typer.echo(f"{name}: configuration remembered, for {found.machine} {found.machine_revision}")


def _server(context: typer.Context, server: str | None) -> str | None:
    """Return the service to ask; None where the command line names a file of printers instead.

    Raises
    ------
    CommandRefused
        The command line names both.
    """
    said = [
        name
        for name in ("printers", "server")
        if (source := context.get_parameter_source(name)) and source.name == "COMMANDLINE"
    ]
    if len(said) > 1:
        raise CommandRefused(
            "give either --printers FILE or --server URL: a service has its own file of printers"
        )
    return None if "printers" in said else server


def _found(
    name: str, file: Path | None, server: str | None, key: str | None, *, accept: bool
) -> PrinterCheck:
    if server:
        return _asked(name, server, key, accept=accept)
    from stillpath.cli.own_machines import open_documents, open_machines
    from stillpath.service.deliveries.checking import Checker, PrinterUnknown
    from stillpath.service.deliveries.printers import PrinterFileError, load_printers, printer_for
    from stillpath.service.deliveries.targets import TargetRefused

    if file is None:
        raise ModelError("which printers? Name their file: --printers FILE, or STILLPATH_PRINTERS")
    try:
        printer = printer_for(load_printers(file), name)
        machine = open_machines().for_job(printer.machine).machine
        return Checker(open_documents("printers")).check(printer, machine, accept=accept)
    except (PrinterFileError, TargetRefused, PrinterUnknown) as error:
        raise ModelError(str(error)) from None


def _asked(name: str, server: str, key: str | None, *, accept: bool) -> PrinterCheck:
    from stillpath.service.client import Client
    from stillpath.service.deliveries.checking import PrinterCheck

    with Client(server, key or None) as client:
        return PrinterCheck.model_validate(client.check_printer(name, accept=accept))
