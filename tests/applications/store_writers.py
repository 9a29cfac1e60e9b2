"""Processes that write to one store at a time: they import little, so that they begin at once."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Literal

from stillpath.applications.machines.revision import Conflict, UnknownMachine
from stillpath.applications.machines.store import MachineStore
from tests.service.machines import make_confirmation, make_machine, with_accel

__all__ = ["confirm_many", "delete_and_restore", "write_many"]


def write_many(root: Path, writer: int, count: int) -> None:
    store = MachineStore(root)
    for k in range(count):
        machine = with_accel(make_machine(), 1000.0 + 1000.0 * writer + k)
        store.add_revision("mine", machine, author=f"writer-{writer}")


def confirm_many(root: Path, axis: Literal["x", "y"], count: int) -> None:
    store = MachineStore(root)
    for k in range(count):
        store.confirm("mine", {axis: make_confirmation(1.0 + k)}, author=axis)


def delete_and_restore(root: Path, count: int) -> None:
    store = MachineStore(root)
    for k in range(count):
        with contextlib.suppress(UnknownMachine, Conflict):
            store.delete("mine")
            if k % 2:
                store.restore("mine")
