"""Find a machine by its name: built in, the user's own, or a file."""

from __future__ import annotations

import contextlib
import os
from datetime import UTC, datetime
from pathlib import Path

from pydantic import ValidationError

from stillpath.applications.machines.checks import age_warnings
from stillpath.applications.machines.revision import NotApproved, UnknownMachine, document_text
from stillpath.applications.machines.store import MachineStore
from stillpath.models.document import Document
from stillpath.models.errors import ModelError
from stillpath.models.machine import Machine
from stillpath.models.store import builtin_machines, load_machine, no_such_machine
from stillpath.models.user_files import names_a_file

__all__ = ["PinnedMachine", "Resolver"]


class PinnedMachine(Document):
    """A machine as it was found; a job keeps the one that it was accepted with.

    Attributes
    ----------
    number : int, optional
        Revision of the user's machine; None: built in.
    warnings : tuple of str
        What speaks against using it; goes into the report of the job.
    """

    machine: Machine
    number: int | None = None
    warnings: tuple[str, ...] = ()

    def write(self, file: Path) -> None:
        """Write it to a file of the caller's own, and wait for the disk."""
        with file.open("w", encoding="utf-8") as opened:
            opened.write(document_text(self))
            opened.flush()
            os.fsync(opened.fileno())

    @classmethod
    def read(cls, file: Path, name: str, revision: str) -> PinnedMachine:
        """Return the machine `name` that a job was submitted with, from a file of `write`.

        Raises
        ------
        ModelError
            If the file does not hold the machine of this `revision` (`Machine.revision`).
        """
        found = None
        with contextlib.suppress(FileNotFoundError, ValidationError):
            found = cls.model_validate_json(file.read_bytes())
        if found is None or found.machine.revision != revision:
            raise ModelError(
                f"the storage no longer has machine {name!r} as it was when the job was submitted "
                f"(revision {revision}): machine.json is gone, damaged or another one; check "
                "the storage's disk, delete the job, and submit it again"
            )
        return found


class Resolver:
    """Finds machines by name.

    Names of built-in machines are reserved. One that a later version has built in stays the user's.

    Parameters
    ----------
    require_approval : bool
        Jobs use approved revisions only. Built-in machines count as approved.
    max_age_days : float
        Largest age of a measurement.
    """

    def __init__(
        self, store: MachineStore, *, require_approval: bool = False, max_age_days: float = 180.0
    ) -> None:
        self.store = store
        self._require_approval = require_approval
        self.max_age_days = max_age_days

    def for_job(self, name: str, *, files: bool = False) -> PinnedMachine:
        """Return the machine that a job is done with, and warnings about it.

        Parameters
        ----------
        name : str
            With `files` also the path of a JSON file.

        Raises
        ------
        ModelError
            If there is none, its file is damaged, or it is not approved.
        """
        if files and names_a_file(name) and self._require_approval:
            raise NotApproved(
                f"{name}: only approved machines may be used (STILLPATH_REQUIRE_APPROVAL); put it "
                f"into the store (`stillpath machines import {name}`) and have it approved"
            )
        found = self._find(name, files=files, approved=self._require_approval)
        warnings = age_warnings(found.machine, datetime.now(UTC), self.max_age_days)
        return found.model_copy(update={"warnings": tuple(warnings)})

    def to_look_at(self, name: str, *, files: bool = False) -> PinnedMachine:
        """Return a machine as it stands, approved or not. See `for_job`."""
        return self._find(name, files=files, approved=False)

    def names(self) -> list[str]:
        """Return all names: built-in machines first, then the user's."""
        return list(dict.fromkeys([*builtin_machines(), *self.store.names()]))

    def _find(self, name: str, *, files: bool, approved: bool) -> PinnedMachine:
        if files and names_a_file(name):
            return PinnedMachine(machine=load_machine(name))
        if name not in self.store:
            if name in builtin_machines():
                return PinnedMachine(machine=load_machine(name))
            raise UnknownMachine(str(no_such_machine(name, self.store.names(), files=files)))
        revision = self.store.usable(name, require_approval=approved)
        return PinnedMachine(machine=revision.machine, number=revision.number)
