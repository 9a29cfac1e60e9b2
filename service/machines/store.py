"""The store of the user's machines: one folder per machine, one file per revision.

::

    machines/NAME/000001.json            a revision; its number is taken by whoever writes it first
    machines/NAME/000001.approved.json   that it may be used
    machines/.trash/NAME/TIME/           a machine that was deleted

Every file is written once (`service.machines.publish`), so nothing points anywhere: the newest
revision is the current one, and a process that is killed leaves the state before or after.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal, TypeVar

from pydantic import BaseModel, ValidationError
from pydantic_core import from_json

from models.errors import ModelError
from models.machine import Machine
from models.plants import PlantSetSpec
from models.provenance import SourceFile
from models.store import builtin_machines, explain
from service.machines.publish import publish, sync_folder
from service.machines.revision import (
    Approval,
    Conflict,
    NotApproved,
    Revision,
    UnknownMachine,
    document_text,
)

__all__ = ["MachineStore"]

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
    root : Path
        Made when the first machine is added.

    Notes
    -----
    Methods that read or change a machine raise `UnknownMachine` if there is none of that name,
    and `ModelError`, naming the file, if a file of it is damaged.
    """

    def __init__(self, root: Path) -> None:
        self._root = root

    # Reading

    def names(self) -> list[str]:
        """Return the names of all machines, sorted."""
        if not self._root.is_dir():
            return []
        folders = [p for p in self._root.iterdir() if _NAME.fullmatch(p.name) and p.is_dir()]
        return sorted(folder.name for folder in folders if _numbers(folder, _REVISION))

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
        folder = self._root / name
        return {
            number: _read(_approval_file(folder, number), Approval)
            for number in _numbers(folder, _APPROVAL)
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
            raise ModelError(
                f"{_revision_file(self._root / name, found.number)}: not the machine that was "
                "approved; restore the file from a backup, or add the machine again and approve it"
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
        author, message : str
            Who and why.
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

    def update_axis(
        self,
        name: str,
        axes: Mapping[Literal["x", "y"], PlantSetSpec],
        *,
        author: str,
        message: str = "",
        sources: Sequence[SourceFile] = (),
        when: datetime | None = None,
    ) -> Revision:
        """Give axes new plants and leave everything else of the machine as it is.

        Also if somebody else changes the machine meanwhile: the plants go on top of that change.
        """
        self._existing(name)
        fields = {"author": author, "message": message, "sources": tuple(sources)}

        def changed(current: Revision | None) -> tuple[Machine, dict[str, Any]]:
            if current is None:
                raise _no_machine(name)
            document = current.machine.model_dump()
            document["axes"] |= {axis: plants.model_dump() for axis, plants in axes.items()}
            return Machine.model_validate(document), fields

        return self._add(name, changed, when=when)

    def roll_back(
        self,
        name: str,
        number: int,
        *,
        author: str,
        message: str = "",
        when: datetime | None = None,
        expected: int | None = None,
    ) -> Revision:
        """Bring an earlier state back, as a new revision; history stays as it is."""
        earlier = self.revision(name, number)
        message = message or f"back to revision {number}"
        fields = {"author": author, "message": message, "restored": number}
        return self._add(name, lambda _: (earlier.machine, fields), when=when, expected=expected)

    def approve(
        self,
        name: str,
        number: int,
        *,
        author: str,
        message: str = "",
        when: datetime | None = None,
    ) -> Approval:
        """Say that a revision may be used; an approval that stands already is returned."""
        revision = self.revision(name, number)
        approval = Approval.of(
            revision, when=when or datetime.now(UTC), author=author, message=message
        )
        file = _approval_file(self._root / name, number)
        try:
            publish(file, document_text(approval))
        except FileExistsError:
            return _read(file, Approval)
        return approval

    def add_history(self, name: str, revisions: Sequence[Revision]) -> None:
        """Add a new machine with all its revisions, or nothing of it.

        Raises
        ------
        Conflict
            If there is a machine of that name, or the revisions are not those of one machine.
        """
        _check_name(name)
        if [r.number for r in revisions] != [*range(1, len(revisions) + 1)] or not revisions:
            raise Conflict("the revisions of a history must count from 1 without gaps")
        for revision in revisions:
            _check_own_name(name, revision.machine)
        self._root.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=self._root, prefix=".incoming-") as folder:
            made = Path(folder) / name
            made.mkdir()
            for revision in revisions:
                publish(_revision_file(made, revision.number), document_text(revision))
            self._move_in(made, name)

    def delete(self, name: str, *, when: datetime | None = None) -> None:
        """Move a machine with its history to the trash; `restore` brings it back."""
        self._existing(name)
        trash = self._root / _TRASH / name
        trash.mkdir(parents=True, exist_ok=True)
        stamp = (when or datetime.now(UTC)).strftime("%Y%m%dT%H%M%S.%fZ")
        try:
            (self._root / name).rename(trash / stamp)
        except FileNotFoundError:
            raise _no_machine(name) from None
        sync_folder(self._root)

    def restore(self, name: str) -> Revision:
        """Bring the machine that was deleted last under this name back.

        Raises
        ------
        Conflict
            If there is a machine of that name again.
        """
        _check_name(name)
        trash = self._root / _TRASH / name
        found = sorted(trash.iterdir()) if trash.is_dir() else []
        if not found:
            raise UnknownMachine(f"no machine {name!r} is in the trash {self._root / _TRASH}")
        self._move_in(found[-1], name)
        return self.current(name)

    # Private

    def _add(
        self,
        name: str,
        change: Callable[[Revision | None], tuple[Machine, dict[str, Any]]],
        *,
        when: datetime | None,
        expected: int | None = None,
    ) -> Revision:
        """Write the revision that `change` makes of the current one, once more if it is late."""
        _check_name(name)
        folder = self._root / name
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
            folder.mkdir(parents=True, exist_ok=True)
            file = _revision_file(folder, revision.number)
            try:
                publish(file, document_text(revision))
            except (FileExistsError, FileNotFoundError):
                continue  # somebody else was faster, or deleted the machine meanwhile
            if last and not _revision_file(folder, last).exists():
                # Deleted and made anew meanwhile: this is no revision of that one.
                file.unlink(missing_ok=True)
                continue
            sync_folder(self._root)
            return revision
        raise Conflict(f"machine {name!r} is being changed by others all the time; try again")

    def _move_in(self, folder: Path, name: str) -> None:
        """Make a folder of revisions the machine `name`, which must be new."""
        try:
            # Fails on a folder that holds a revision already, whoever put it there.
            folder.rename(self._root / name)
        except OSError:
            if name not in self:
                raise
            raise _exists(name) from None
        sync_folder(self._root)

    def _existing(self, name: str) -> list[int]:
        numbers = self._revision_numbers(name)
        if not numbers:
            raise _no_machine(name)
        return numbers

    def _revision_numbers(self, name: str) -> list[int]:
        # A name only: a path must not reach the file system from outside.
        return _numbers(self._root / name, _REVISION) if _NAME.fullmatch(name) else []

    def _listed(self, name: str, number: int) -> Revision:
        """Read a revision that must be there: numbers have no gaps."""
        try:
            return self._read_revision(name, number)
        except _Gone:
            if name not in self:
                raise
            raise _damaged(_revision_file(self._root / name, number), "it is missing") from None

    def _read_revision(self, name: str, number: int) -> Revision:
        file = _revision_file(self._root / name, number)
        revision = _read(file, Revision)
        if (revision.machine.name, revision.number) != (name, number):
            raise _damaged(
                file, f"it holds revision {revision.number} of {revision.machine.name!r}"
            )
        return revision


class _Gone(UnknownMachine):
    """Deleted while it was read."""


def _numbers(folder: Path, pattern: re.Pattern[str]) -> list[int]:
    try:
        found = [pattern.fullmatch(path.name) for path in folder.iterdir()]
    except (FileNotFoundError, NotADirectoryError):
        return []
    return sorted(int(match[1]) for match in found if match)


def _revision_file(folder: Path, number: int) -> Path:
    return folder / f"{number:06d}.json"


def _approval_file(folder: Path, number: int) -> Path:
    return folder / f"{number:06d}.approved.json"


def _read(file: Path, kind: type[_Kind]) -> _Kind:
    try:
        return kind.model_validate(from_json(file.read_bytes()))
    except FileNotFoundError:
        raise _Gone(f"{file} is gone: the machine was deleted meanwhile") from None
    except ValidationError as error:
        raise _damaged(file, explain(error)) from None
    except ValueError as error:
        raise _damaged(file, f"not JSON ({error})") from None


def _damaged(file: Path, why: str) -> ModelError:
    return ModelError(
        f"{file}: damaged: {why}; put the file back from a backup, or, if it is the newest one, "
        "move it away with its .approved.json, to go on from the revision before"
    )


def _check_name(name: str) -> None:
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


def _exists(name: str) -> Conflict:
    return Conflict(
        f"there is a machine {name!r} already; take another name (--as), or delete that one "
        f"first (`stillpath machines delete {name}`, which can be undone)"
    )


def _changed(name: str, expected: int, last: int) -> Conflict:
    if expected == 0:
        return _exists(name)
    return Conflict(
        f"machine {name!r} is at revision {last}, not {expected} any more; look at the change "
        f"(`stillpath machines diff {name} {expected} {last}`) and try again"
    )
