"""Compensate a text as the pipeline does a file."""

from __future__ import annotations

from pathlib import Path

from stillpath.models.machine import Machine
from stillpath.models.store import load_machine
from stillpath.pipeline.compensate import compensate_file
from stillpath.pipeline.options import Options
from stillpath.pipeline.result import Result

__all__ = ["compensated"]


def compensated(
    text: bytes | str,
    folder: Path,
    cache: Path,
    machine: Machine | str = "ender3",
    **options: object,
) -> tuple[Result, bytes]:
    """Return result and written text; the folder holds in.gcode as it was and out.gcode then."""
    source, target = folder / "in.gcode", folder / "out.gcode"
    data = text.encode() if isinstance(text, str) else text
    source.write_bytes(data)
    there = set(folder.iterdir())
    if isinstance(machine, str):
        machine = load_machine(machine)
    chosen = Options.model_validate(options)
    result = compensate_file(source, target, machine, chosen, cache_dir=cache)
    assert source.read_bytes() == data
    assert set(folder.iterdir()) == there | {target}
    return result, target.read_bytes()
