"""The sub-commands of `stillpath machines`. Heavy imports wait until a command needs them."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from stillpath.cli.motors import motors
from stillpath.cli.own_machines import By, Message, Name, open_machines, print_revision, who
from stillpath.cli.printer_settings import from_config, from_m503, refused, set_firmware
from stillpath.models.errors import ModelError

if TYPE_CHECKING:
    from stillpath.applications.machines.revision import Revision

__all__ = ["app"]


class _Group(TyperGroup):
    """`machines NAME` without a command shows that machine."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """See `typer.core.TyperGroup`."""
        alone = len(args) == 1 or args[1].startswith("-")
        if alone and args[0] not in self.commands and not args[0].startswith("-"):
            args = ["show", *args]
        return super().resolve_command(ctx, args)


app = typer.Typer(
    cls=_Group,
    help="Machines, built in and your own. Each change of your own is a revision.",
    rich_markup_mode=None,
)

Number = Annotated[
    int | None, typer.Option("--revision", min=1, help="A revision. [default: the newest]")
]


@app.callback(invoke_without_command=True)
def machines(context: typer.Context) -> None:
    """List the machines: the built-in library and your own."""
    if context.invoked_subcommand is not None:
        return
    from stillpath.models.store import builtin_machines, load_machine

    store = open_machines().store
    table = _table("name", "machine", "kinematics", "content", "revision", "approved")
    library = [name for name in builtin_machines() if name not in store]
    for machine in map(load_machine, library):
        table.add_row(machine.name, machine.title, machine.kinematics, machine.revision, "built in")
    for name in store.names():
        try:
            current, approved = store.current(name), store.approvals(name)
        except ModelError as error:
            table.add_row(name, str(error))
            continue
        machine = current.machine
        table.add_row(
            name,
            machine.title,
            machine.kinematics,
            machine.revision,
            str(current.number),
            str(max(approved)) if approved else "none",
        )
    _print(table)


@app.command()
def show(name: Name, revision: Number = None) -> None:
    """Print a machine as a JSON document, to start from."""
    resolver = open_machines()
    if revision is None:
        machine = resolver.to_look_at(name, files=True).machine
    else:
        machine = resolver.store.revision(name, revision).machine
    typer.echo(machine.model_dump_json(indent=1))


@app.command()
def history(
    name: Name,
    since: Annotated[
        str | None,
        typer.Option(metavar="DATE", help="Look for drift from this day on (after a rebuild)."),
    ] = None,
) -> None:
    """List the revisions of a machine, and say if its resonances have moved."""
    from stillpath.applications.machines.drift import drift

    store = open_machines().store
    revisions, approved = store.history(name), store.approvals(name)
    day = None if since is None else _day(since)
    table = _table("revision", "when", "who", "X, Hz", "Y, Hz", "approved by", "why")
    for revision in revisions:
        approval = approved.get(revision.number)
        table.add_row(
            str(revision.number),
            f"{revision.when:%Y-%m-%d %H:%M}",
            revision.author,
            *(_leading(revision, axis) for axis in ("x", "y")),
            approval.author if approval else "",
            revision.message,
        )
    _print(table)
    for entry in drift(revisions, since=day):
        typer.echo(entry.text)


@app.command()
def diff(
    name: Name,
    a: Annotated[int, typer.Argument(min=1, metavar="A", help="A revision.")],
    b: Annotated[int, typer.Argument(min=1, metavar="B", help="Another one.")],
) -> None:
    """Tell what revision B changed against A."""
    from stillpath.applications.machines.diff import diff as compare

    store = open_machines().store
    changes = compare(store.revision(name, a).machine, store.revision(name, b).machine)
    for change in changes:
        typer.echo(change.text)
    if not changes:
        typer.echo("no difference")


@app.command()
def approve(name: Name, revision: Number = None, by: By = None, message: Message = "") -> None:
    """Say that a revision may be used for jobs."""
    store = open_machines().store
    number = revision or store.current(name).number
    approval = store.approve(name, number, author=who(by), message=message)
    typer.echo(f"{name} revision {number}: approved by {approval.author}")


@app.command()
def rollback(
    name: Name,
    to: Annotated[int, typer.Argument(min=1, metavar="REVISION", help="Goes back to it.")],
    by: By = None,
    message: Message = "",
) -> None:
    """Bring an earlier revision back, as a new one."""
    store = open_machines().store
    print_revision(store.roll_back(name, to, author=who(by), message=message))


@app.command()
def export(
    name: Name,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE")],
    revision: Number = None,
    with_history: Annotated[
        bool, typer.Option("--history", help="All revisions, with who, when and why.")
    ] = False,
) -> None:
    """Write a machine to a JSON file: the document, or its history."""
    from stillpath.applications.machines.revision import document_text
    from stillpath.applications.machines.transfer import export_history
    from stillpath.pipeline.files import replacing

    if with_history and revision is not None:
        raise ModelError("give either --history or --revision")
    resolver = open_machines()
    if with_history:
        text = export_history(resolver.store, name)
    elif revision is not None:
        text = document_text(resolver.store.revision(name, revision).machine)
    else:
        text = document_text(resolver.to_look_at(name).machine)
    with replacing(output.resolve()) as temporary:
        temporary.write_text(text, encoding="utf-8")


@app.command("import")
def import_(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A machine, or a history.")],
    name: Annotated[str | None, typer.Option("--as", metavar="NAME", help="Another name.")] = None,
    by: By = None,
    message: Message = "",
) -> None:
    """Add a machine from a JSON file, under a name that is free."""
    from stillpath.applications.machines.transfer import import_file

    store = open_machines().store
    print_revision(import_file(store, file, author=who(by), message=message, name=name))


@app.command()
def put(
    file: Annotated[Path, typer.Argument(metavar="FILE")], by: By = None, message: Message = ""
) -> None:
    """Make the machine document in a file the new revision of its machine."""
    from stillpath.applications.machines.diff import replaced_plants
    from stillpath.applications.machines.revision import source_file
    from stillpath.models.store import load_machine

    machine = load_machine(file)
    store = open_machines().store
    made = store.add_revision(
        machine.name,
        machine,
        author=who(by),
        message=message or f"from {file.name}",
        sources=[source_file(file.name, file.read_bytes())],
    )
    print_revision(made)
    for line in replaced_plants(store.history(machine.name)[: made.number]):
        typer.echo(line)


app.command("set-firmware")(set_firmware)
app.command("from-config")(from_config)
app.command("from-m503")(from_m503)
app.command()(motors)


@app.command()
def delete(name: Name) -> None:
    """Move a machine with its history to the trash."""
    open_machines().store.delete(name)
    typer.echo(f"{name}: deleted; `stillpath machines restore {name}` brings it back")


@app.command()
def restore(
    name: Name,
    number: Annotated[
        int | None,
        typer.Option(
            "--number",
            min=1,
            help="Which one, if several were deleted: 1 is the first. [default: the last]",
        ),
    ] = None,
) -> None:
    """Bring back a machine that was deleted under a name."""
    store = open_machines().store
    print_revision(store.restore(name, number))
    for other, when in enumerate(store.trash(name), 1):
        typer.echo(f"also in the trash: number {other}, deleted {when}")


@app.command()
def check(
    name: Name,
    printer_cfg: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Klipper's configuration as it is now.")
    ] = None,
) -> None:
    """Look whether a machine can still be relied on. Exit code 0 fine, 2 not."""
    from stillpath.applications.machines.checks import check_before_job, differences
    from stillpath.applications.machines.envelope import envelope_warnings
    from stillpath.applications.machines.klipper_config import read_printer_config
    from stillpath.applications.machines.klipper_settings import (
        not_followed,
        not_planned,
        read_as_older,
    )

    resolver = open_machines()
    config = None if printer_cfg is None else read_printer_config(printer_cfg)
    machine = resolver.to_look_at(name, files=True).machine
    found = check_before_job(
        machine,
        datetime.now(UTC),
        max_age_days=resolver.max_age_days,
        config=config,
    )
    found += refused(machine)
    notes = envelope_warnings(machine)
    if config is not None:
        notes += not_followed(config) + not_planned(config)
    if config is not None and any("minimum_cruise_ratio" in line for line in found):
        notes += read_as_older(config)
    for line in [*found, *(f"note: {line}" for line in notes)]:
        typer.echo(line)
    if config is not None and differences(machine, config):
        typer.echo(f"all of printer.cfg: stillpath machines set-firmware {name} {printer_cfg}")
    if found:
        raise typer.Exit(2)
    typer.echo(f"{name}: no problems found")


def _day(text: str) -> Any:
    from datetime import date

    try:
        return date.fromisoformat(text)
    except ValueError:
        raise ModelError(f"--since {text!r}: give a day like 2026-03-02") from None


def _leading(revision: Revision, axis: Any) -> str:
    from stillpath.applications.machines.resonances import leading

    mode = leading(revision.machine.axes[axis].nominal)
    return "" if mode is None else f"{mode[0]:.1f}"


def _table(*columns: str) -> Any:
    from rich.table import Column, Table

    return Table(Column(columns[0], no_wrap=True), *columns[1:], box=None, pad_edge=False)


def _print(table: Any) -> None:
    from rich.console import Console

    Console(highlight=False, markup=False).print(table)
