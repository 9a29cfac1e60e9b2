"""`stillpath machines`: what printers say of themselves, as new machines or new settings."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stillpath.cli.option_groups import grouped
from stillpath.cli.own_machines import By, Message, Name, open_machines, print_revision, who

if TYPE_CHECKING:
    from stillpath.applications.machines.stated import StatedMachine
    from stillpath.models.machine import Machine

__all__ = ["NewMachine", "from_config", "from_m503", "refused", "set_firmware"]

_LARGEST_LOG_BYTES = 10_000_000


@dataclass(frozen=True, slots=True, kw_only=True)
class NewMachine:
    """What a machine is called, and its resonances until they are measured."""

    name: Annotated[str, typer.Option("--name", help="The machine's name.")]
    title: Annotated[str, typer.Option(help="What people call it.")] = ""
    fx: Annotated[float | None, typer.Option(min=1.0, max=500.0, help="Resonance of X, Hz.")] = None
    fy: Annotated[float | None, typer.Option(min=1.0, max=500.0, help="Resonance of Y, Hz.")] = None
    zeta: Annotated[float, typer.Option(min=0.001, max=1.0, help="Damping ratio.")] = 0.07


def set_firmware(
    name: Name,
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            help="Klipper's printer.cfg, RepRapFirmware's config.g, Marlin's answer to M503, "
            "or the firmware section as JSON.",
        ),
    ],
    as_name: Annotated[
        str | None, typer.Option("--as", metavar="NAME", help="A copy under a free name.")
    ] = None,
    by: By = None,
    message: Message = "",
) -> None:
    """Give a machine another firmware: its next revision, or with --as a copy.

    What a printer.cfg, a config.g or an answer to M503 does not say stays as the machine has it,
    and so does what was measured.
    """
    from stillpath.applications.machines.settings_file import with_firmware_file

    resolver = open_machines()
    found = resolver.to_look_at(name)
    machine, sources, notes = with_firmware_file(found.machine, file)
    if as_name is not None:
        machine = machine.model_copy(update={"name": as_name})
    revision = resolver.store.add_revision(
        machine.name,
        machine,
        author=who(by),
        message=message or f"firmware from {file.name}",
        sources=sources,
        expected=found.number if as_name is None else 0,
    )
    print_revision(revision)
    for line in [*notes, *refused(machine)]:
        typer.echo(line)


@grouped
def from_config(
    file: Annotated[
        Path,
        typer.Argument(metavar="FILE", help="Klipper's printer.cfg, or RepRapFirmware's config.g."),
    ],
    made: NewMachine,
    fields: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="FIELD=VALUE",
            help="What a config.g does not say: ring_length=60, step_clock_hz=937500, "
            "prepare_least_s=0, extruder.nozzle_diameter_mm=0.6, ... (docs/machines.md).",
        ),
    ] = None,
    by: By = None,
) -> None:
    """Make a machine from a configuration: limits, travel, and plants still to be measured."""
    from stillpath.applications.machines.settings_file import machine_from_file

    machine, sources, notes = machine_from_file(file, _stated(made), fields or ())
    revision = open_machines().store.add_revision(
        made.name,
        machine,
        author=who(by),
        message=f"from {file.name}; plants typed in",
        sources=sources,
        expected=0,
    )
    print_revision(revision)
    for line in [*notes, *refused(machine)]:
        typer.echo(line)


@grouped
def from_m503(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="What Marlin answers to M503.")],
    made: NewMachine,
    travel: Annotated[
        str,
        typer.Option(
            metavar="XxYxZ",
            help="How far the axes reach, mm: 235x235x250, or --travel=-4:220x-17:227x250 "
            "(X_MIN_POS and X_MAX_POS of Configuration.h).",
        ),
    ],
    kinematics: Annotated[str, typer.Option(help="cartesian or corexy.")] = "cartesian",
    fields: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="FIELD=VALUE",
            help="What M503 does not say, from Configuration.h and _adv.h: "
            "min_steps_per_segment=1, variant=2.0, s_curve=true, ... (docs/machines.md).",
        ),
    ] = None,
    by: By = None,
) -> None:
    """Make a machine from Marlin's M503: limits and steps, with plants still to be measured."""
    from stillpath.applications.machines import marlin_settings
    from stillpath.applications.machines.revision import source_file
    from stillpath.models.user_files import as_utf8, read_bytes

    content = read_bytes(file, _LARGEST_LOG_BYTES, "keep M503's answer only")
    text = as_utf8(content).decode(errors="replace")
    machine = marlin_settings.machine_from_m503(
        text,
        file.name,
        _stated(made),
        travel_mm=marlin_settings.read_travel(travel),
        kinematics=kinematics,
        fields=fields or (),
    )
    revision = open_machines().store.add_revision(
        made.name,
        machine,
        author=who(by),
        message=f"M503 in {file.name}; plants typed in",
        sources=[source_file(file.name, content)],
        expected=0,
    )
    print_revision(revision)
    for line in [*_what_m503_leaves(machine, text, fields or ()), *refused(machine)]:
        typer.echo(line)


def refused(machine: Machine) -> list[str]:
    """Return a line that says why the machine's firmware cannot execute a compensated file."""
    from stillpath.gcode.firmware.registry import adapter

    reason = adapter(machine).refusal
    return [] if reason is None else [f"{machine.name} can be simulated, not compensated: {reason}"]


def _stated(made: NewMachine) -> StatedMachine:
    from stillpath.applications.machines.stated import StatedMachine
    from stillpath.applications.machines.store import check_name

    check_name(made.name)
    return StatedMachine(made.name, made.title, (made.fx, made.fy), made.zeta)


def _what_m503_leaves(machine: Machine, text: str, fields: Sequence[str]) -> Iterator[str]:
    """Yield what an answer to M503 does not say, or says of other tools."""
    from stillpath.applications.machines import marlin_settings

    said = {field.partition("=")[0].strip() for field in fields}
    assumed = [
        f"{field}={str(value).lower()}"
        for field, value in marlin_settings.ASSUMED.items()
        if field not in said and getattr(machine.firmware, field) == value
    ]
    if assumed:
        yield f"assumed, for M503 does not say it: {', '.join(assumed)}; --set says otherwise"
    section = machine.firmware.model_dump(mode="json", exclude_unset=True)
    short = [
        f"{place}={value:g}"
        for place, value in marlin_settings.rounded(section).items()
        if place not in said
    ]
    if short:
        yield f"rounded by M503: {', '.join(short)}; give the exact values with --set"
    if differing := marlin_settings.of_other_tools(text):
        yield (
            f"other tools differ: {', '.join(differing)}; the machine has the first tool's, which "
            "files set behind every stretch: put M900 K behind each T, state the lower limits"
        )
