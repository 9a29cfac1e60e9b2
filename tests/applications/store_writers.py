"""Processes that write to one store at a time: they import little, so that they begin at once."""

from __future__ import annotations

from pathlib import Path

from stillpath.applications.machines.store import MachineStore
from tests.service.machines import make_machine, with_accel

__all__ = ["write_many"]


def write_many(root: Path, writer: int, count: int) -> None:
    store = MachineStore(root)
    for k in range(count):
        machine = with_accel(make_machine(), 1000.0 + 1000.0 * writer + k)
        store.add_revision("mine", machine, author=f"writer-{writer}")
