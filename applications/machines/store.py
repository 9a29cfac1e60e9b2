"""The store of the user's machines: one folder per machine, one document per revision.

::

    machines/NAME/000001.json            a revision; its number is taken by whoever writes it first
    machines/NAME/000001.approved.json   that it may be used
    machines/.trash/NAME/TIME/           a machine that was deleted

Every document is written once (`applications.machines.documents`: files, or rows of a database).
There are no pointers: the newest revision is the current one, and a killed process leaves either
the old or the new state.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal, TypeVar

from pydantic import BaseModel, ValidationError
from pydantic_core import from_json

from stillpath.applications.machines.documents import DocumentFolder, Documents
from stillpath.applications.machines.revision import (
    Approval,
    Conflict,
    NotApproved,
    Revision,
    UnknownMachine,
    document_text,
)
from stillpath.models.complaints import explain
from stillpath.models.confirmation import Confirmation
from stillpath.models.errors import ModelError
from stillpath.models.machine import Machine
from stillpath.models.provenance import SourceFile
from stillpath.models.store import builtin_machines

__all__ = ["MachineStore", "check_name"]

_NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,63}")
_REVISION = re.compile(r"(\d{6})\.json")
_APPROVAL = re.compile(r"(\d{6})\.approved\.json")
_TRASH = ".trash"
_ATTEMPTS = 100
_Kind = TypeVar("_Kind", bound=BaseModel)


class MachineStore:
    """Machines by name, every change a revision. Safe for several processes at once.

    Parameters
    ----------
    place : Path or Documents
        Storage of the machines; a folder is made for the first machine.

    Notes
    -----
    Methods that read or change a machine raise `UnknownMachine` if there is none of that name,
    and `ModelError`, naming the file, if a file of it is damaged.
    """

    def __init__(self, place: Path | Documents) -> None:
        self._documents = DocumentFolder(place) if isinstance(place, Path) else place

    # Reading

    def names(self) -> list[str]:
        """Return the names of all machines, sorted."""
        return [name for name in self._documents.folders() if self._revision_numbers(name)]

    def __contains__(self, name: object) -> bool:
        return isinstance(name, str) and bool(self._revision_numbers(name))

    def current(self, name: str) -> Revision:
        """Return the newest revision."""
        return self._read_revision(name, self._existing(name)[-1])

    def revision(self, name: str, number: int) -> Revision:
        """Return one revision."""
        last = self._existing(name)[-1]
        if not 1 <= number <= last:
            raise UnknownMachine(f"machine {name!r} has no revision {number}; it has 1 to {last}")
        return self._listed(name, number)

    def history(self, name: str) -> list[Revision]:
        """Return all revisions, oldest first."""
        last = self._existing(name)[-1]
        return [self._listed(name, number) for number in range(1, last + 1)]

    def approvals(self, name: str) -> dict[int, Approval]:
        """Return the approvals by the number of their revision."""
        self._existing(name)
        return {
            number: self._read(_approval_file(name, number), Approval)
            for number in _numbers(self._documents.names(name), _APPROVAL)
        }

    def usable(self, name: str, *, require_approval: bool) -> Revision:
        """Return the revision that jobs use: the newest, or the newest approved one.

        Raises
        ------
        NotApproved
            If only approved ones may be used and there is none.
        """
        newest = self.current(name)
        if not require_approval:
            return newest
        approved = self.approvals(name)
        if not approved:
            raise NotApproved(
                f"no revision of machine {name!r} is approved, and only approved ones may be used "
                f"(STILLPATH_REQUIRE_APPROVAL); the newest is {newest.number}, by {newest.author}: "
                f"look at it and approve it (`stillpath machines approve {name} "
                f"--revision {newest.number}`)"
            )
        found = self.revision(name, max(approved))
        if approved[found.number].content_sha256 != found.content_sha256:
            place = self._documents.place(_revision_file(name, found.number))
            raise ModelError(
                f"{place}: not the machine that was approved; restore the file from a backup, or "
                "add the machine again and approve it"
            )
        return found

    # Changing

    def add_revision(
        self,
        name: str,
        machine: Machine,
        *,
        author: str,
        message: str = "",
        sources: Sequence[SourceFile] = (),
        when: datetime | None = None,
        expected: int | None = None,
    ) -> Revision:
        """Make `machine` the current state of the machine `name`, which may be new.

        Parameters
        ----------
        name : str
            Also the document's own name; not a built-in machine's.
        sources : sequence of SourceFile
            Files the change was made from.
        when : datetime, optional
            With its time zone; now by default.
        expected : int, optional
            Number of the revision that the change was made on, 0 for a new machine. By default
            the change goes on top of whatever there is.

        Returns
        -------
        Revision
            The current one, without a change, if it holds the very same machine.

        Raises
        ------
        Conflict
            If the name is a built-in machine's, or another revision than `expected` is current.
        """
        fields = {"author": author, "message": message, "sources": tuple(sources)}
        return self._add(name, lambda _: (machine, fields), when=when, expected=expected)

    def confirm(
        self,
        name: str,
        confirmations: Mapping[Literal["x", "y"], Confirmation],
        *,
        author: str,
        message: str = "",
        sources: Sequence[SourceFile] = (),
    ) -> Revision:
        """Store a ring test's verdict on axes, on top of whatever else has changed.

        If the plants changed meanwhile, the confirmation refers to the old ones and is stale.
        """
        self._existing(name)
        fields = {"author": author, "message": message, "sources": tuple(sources)}

        def confirmed(current: Revision | None) -> tuple[Machine, dict[str, Any]]:
            if current is None:
                raise _no_machine(name)
            document = current.machine.model_dump()
            entries = {axis: entry.model_dump() for axis, entry in confirmations.items()}
            document["confirmations"] |= entries
            return Machine.model_validate(document), fields

        return self._add(name, confirmed)

    def roll_back(
        self,
        name: str,
        number: int,
        *,
        author: str,
        message: str = "",
        expected: int | None = None,
    ) -> Revision:
        """Bring an earlier state back, as a new revision; history stays as it is."""
        earlier = self.revision(name, number)
        message = message or f"back to revision {number}"
        fields = {"author": author, "message": message, "restored": number}
        return self._add(name, lambda _: (earlier.machine, fields), expected=expected)

    def approve(
        self,
        name: str,
        number: int,
        *,
        author: str,
        message: str = "",
        when: datetime | None = None,
    ) -> Approval:
        """Approve a revision for use; an existing approval is returned."""
        revision = self.revision(name, number)
        approval = Approval.of(
            revision, when=when or datetime.now(UTC), author=author, message=message
        )
        file = _approval_file(name, number)
        try:
            self._documents.create(
                file, document_text(approval), beside=_revision_file(name, number)
            )
        except FileExistsError:
            return self._read(file, Approval)
        except FileNotFoundError:
            raise _no_machine(name) from None
        return approval

    def add_history(self, name: str, revisions: Sequence[Revision]) -> None:
        """Add a new machine with all its revisions, or nothing of it.

        Raises
        ------
        Conflict
            If there is a machine of that name, or the revisions are not those of one machine.
        """
        check_name(name)
        if [r.number for r in revisions] != [*range(1, len(revisions) + 1)] or not revisions:
            raise Conflict("the revisions of a history must count from 1 without gaps")
        for revision in revisions:
            _check_own_name(name, revision.machine)
        contents = {_file_name(r.number): document_text(r) for r in revisions}
        try:
            self._documents.create_folder(name, contents)
        except FileExistsError:
            raise _exists(name, "take another name (--as)") from None

    def delete(self, name: str) -> None:
        """Move a machine with its history to the trash; `restore` brings it back."""
        self._existing(name)
        stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%S.%fZ")
        try:
            self._documents.move(name, f"{_TRASH}/{name}/{stamp}")
        except FileNotFoundError:
            raise _no_machine(name) from None

    def trash(self, name: str) -> list[str]:
        """Return when machines of this name in the trash were deleted (UTC), oldest first."""
        check_name(name)
        return self._documents.folders(f"{_TRASH}/{name}")

    def restore(self, name: str, number: int | None = None) -> Revision:
        """Bring a machine that was deleted under this name back.

        Parameters
        ----------
        number : int, optional
            Which one of `trash`, from 1; the last by default.

        Raises
        ------
        Conflict
            If there is a machine of that name again.
        """
        found = self.trash(name)
        if not found:
            raise UnknownMachine(
                f"no machine {name!r} is in the trash {self._documents.place(_TRASH)}"
            )
        number = len(found) if number is None else number
        if not 1 <= number <= len(found):
            times = ", ".join(f"{n} (deleted {when})" for n, when in enumerate(found, 1))
            raise UnknownMachine(f"no machine {name!r} number {number} is in the trash: {times}")
        try:
            self._documents.move(f"{_TRASH}/{name}/{found[number - 1]}", name)
        except FileExistsError:
            # Deleted, it becomes the last one: the numbers of the others stay.
            raise Conflict(
                f"there is a machine {name!r} already; delete that one "
                f"(`stillpath machines delete {name}`, which can be undone), then bring this one "
                f"back: `stillpath machines restore {name} --number {number}`"
            ) from None
        return self.current(name)

    # Private

    def _add(
        self,
        name: str,
        change: Callable[[Revision | None], tuple[Machine, dict[str, Any]]],
        *,
        when: datetime | None = None,
        expected: int | None = None,
    ) -> Revision:
        """Write the revision that `change` makes of the current one; retry after a conflict."""
        check_name(name)
        for _ in range(_ATTEMPTS):
            numbers = self._revision_numbers(name)
            last = numbers[-1] if numbers else 0
            if expected is not None and expected != last:
                raise _changed(name, expected, last)
            try:
                current = self._read_revision(name, last) if last else None
            except _Gone:
                continue
            machine, fields = change(current)
            _check_own_name(name, machine)
            if current is not None and current.machine.revision == machine.revision:
                return current
            revision = Revision.of(
                machine,
                number=last + 1,
                parent=last or None,
                when=when or datetime.now(UTC),
                **fields,
            )
            try:
                self._documents.create(
                    _revision_file(name, revision.number),
                    document_text(revision),
                    beside=_revision_file(name, last) if last else None,
                )
            except (FileExistsError, FileNotFoundError):
                continue  # somebody else was faster, or deleted the machine meanwhile
            return revision
        raise Conflict(f"machine {name!r} is being changed by others all the time; try again")

    def _existing(self, name: str) -> list[int]:
        numbers = self._revision_numbers(name)
        if not numbers:
            raise _no_machine(name)
        return numbers

    def _revision_numbers(self, name: str) -> list[int]:
        # Accept names only: paths from outside must not reach the file system.
        if not _NAME.fullmatch(name):
            return []
        return _numbers(self._documents.names(name), _REVISION)

    def _listed(self, name: str, number: int) -> Revision:
        """Read a revision that must exist, as numbers have no gaps."""
        try:
            return self._read_revision(name, number)
        except _Gone:
            if name not in self:
                raise
            raise self._damaged(_revision_file(name, number), "it is missing") from None

    def _read_revision(self, name: str, number: int) -> Revision:
        file = _revision_file(name, number)
        revision = self._read(file, Revision)
        if (revision.machine.name, revision.number) != (name, number):
            raise self._damaged(
                file, f"it holds revision {revision.number} of {revision.machine.name!r}"
            )
        return revision

    def _read(self, path: str, kind: type[_Kind]) -> _Kind:
        try:
            return kind.model_validate(from_json(self._documents.read(path)))
        except FileNotFoundError:
            place = self._documents.place(path)
            raise _Gone(f"{place} is gone: the machine was deleted meanwhile") from None
        except ValidationError as error:
            raise self._damaged(path, explain(error)) from None
        except ValueError as error:
            raise self._damaged(path, f"not JSON ({error})") from None

    def _damaged(self, path: str, why: str) -> ModelError:
        return ModelError(
            f"{self._documents.place(path)}: damaged: {why}; put the file back from a backup, or, "
            "if it is the newest one, move it away with its .approved.json, to go on from the "
            "revision before"
        )


class _Gone(UnknownMachine):
    """Deleted while it was read."""


def _numbers(names: Sequence[str], pattern: re.Pattern[str]) -> list[int]:
    found = [pattern.fullmatch(name) for name in names]
    return sorted(int(match[1]) for match in found if match)


def _file_name(number: int) -> str:
    return f"{number:06d}.json"


def _revision_file(name: str, number: int) -> str:
    return f"{name}/{_file_name(number)}"


def _approval_file(name: str, number: int) -> str:
    return f"{name}/{number:06d}.approved.json"


def check_name(name: str) -> None:
    """Refuse what cannot be the name of a user's machine.

    Raises
    ------
    Conflict
        If it is the name of a built-in machine.
    ModelError
        If it is not a valid name.
    """
    if not _NAME.fullmatch(name):
        raise ModelError(
            f"{name!r:.80} cannot be a machine's name: up to 64 of a-z 0-9 _ -, the first a letter "
            "or digit"
        )
    if name in builtin_machines():
        raise Conflict(
            f"{name!r} is the name of a built-in machine, which cannot be changed; take another "
            f"name (`stillpath machines import FILE --as my-{name}`)"
        )


def _check_own_name(name: str, machine: Machine) -> None:
    if machine.name != name:
        raise ModelError(
            f"name: the document is of machine {machine.name!r}, not {name!r}; make both the same"
        )


def _no_machine(name: str) -> UnknownMachine:
    return UnknownMachine(
        f"there is no machine {name!r:.80} of your own; `stillpath machines` lists them"
    )


def _exists(name: str, remedy: str = "take another name") -> Conflict:
    return Conflict(
        f"there is a machine {name!r} already; {remedy}, or delete that one first "
        f"(`stillpath machines delete {name}`, which can be undone)"
    )


def _changed(name: str, expected: int, last: int) -> Conflict:
    if expected == 0:
        return _exists(name)
    return Conflict(
        f"machine {name!r} is at revision {last}, not {expected} any more; look at the change "
        f"(`stillpath machines diff {name} {expected} {last}`) and try again"
    )
