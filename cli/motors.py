"""`stillpath machines motors`: what a search for lost steps says of a machine's motors."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from stillpath.cli.own_machines import By, Message, Name, open_machines, print_revision, who
from stillpath.models.errors import ModelError
from stillpath.models.user_files import as_utf8

__all__ = ["motors"]


def motors(
    name: Name,
    written: Annotated[
        Path, typer.Argument(metavar="TEST", exists=True, help="What `motor-test` wrote.")
    ],
    console: Annotated[
        Path, typer.Argument(metavar="CONSOLE", exists=True, help="Its console, or klippy.log.")
    ],
    margin: Annotated[
        float, typer.Option(min=0.1, max=1.0, help="Fraction of the measured limit to store.")
    ] = 0.75,
    full_step: Annotated[
        int, typer.Option(min=1, max=256, help="Microsteps of a full step, of X and Y.")
    ] = 16,
    by: By = None,
    message: Message = "",
) -> None:
    """Store the limits that a search for lost steps measured, with a margin (`command`)."""
    from stillpath.applications.proof.motor_test import borne, envelope, levels_of

    levels = levels_of(written.read_text(encoding="utf-8", errors="replace"))
    said = as_utf8(console.read_bytes()).decode(errors="replace")
    count = borne(levels, said, full_step)
    if not count:
        raise ModelError(
            "steps were lost at the printer's own limits already (or the endstops do not repeat "
            "within a full step): lower max_accel, raise the motors' current, or try again"
        )
    best, resolver = levels[count - 1], open_machines()
    found = resolver.to_look_at(name)
    command = envelope(found.machine, best, margin)
    end = "no step was lost" if count == len(levels) else f"level {count + 1} lost steps"
    revision = resolver.store.add_revision(
        name,
        found.machine.model_copy(update={"command": command}),
        author=who(by),
        message=message or f"motors tried up to {best.accel_mm_s2:.0f} mm/s2",
        expected=found.number,
    )
    typer.echo(
        f"borne: {best.accel_mm_s2:.0f} mm/s2, steps of {best.speed_step_mm_s:.0f} mm/s ({end}); "
        f"stored, times {margin:g}: {command.accel_mm_s2:.0f} and {command.speed_step_mm_s:.0f}"
    )
    print_revision(revision)
