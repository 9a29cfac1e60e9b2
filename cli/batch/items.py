"""Items of a batch: a file, its machines, and the name of the result."""

from __future__ import annotations

import fnmatch
import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from stillpath.cli.arguments import check_input
from stillpath.models.errors import ModelError
from stillpath.pipeline.files import result_name

if TYPE_CHECKING:
    from stillpath.applications.machines.resolve import Resolver

__all__ = [
    "Group",
    "Item",
    "check_apart",
    "check_names",
    "is_stamped",
    "is_unfinished",
    "items_of",
    "parse_map",
    "print_files",
]

_SUFFIXES = (".gcode", ".gco", ".g", ".nc", ".bgcode", ".bgc", ".3mf")
_STAMP = b"; Processed by stillpath "
_SEARCHED_BYTES = 1 << 16


@dataclass(frozen=True, slots=True)
class Item:
    """One file for one machine.

    Attributes
    ----------
    place : str
        The file's name, below the folder that was named if one was: ``plates/part.gcode``.
    machine : str
        A name, or the path of a JSON file; empty if no machine was chosen for this file.
    """

    source: Path
    place: str
    machine: str

    def output(self, machine: str) -> str:
        """Return where the result lies below the output folder, by the machine's own name."""
        return f"{machine}/{result_name(self.place)}"

    def report(self, machine: str) -> str:
        """Return the folder of the report below the output folder."""
        return f"reports/{machine}/{self.place}"


@dataclass(frozen=True, slots=True)
class Group:
    """Which machines a file is for.

    Attributes
    ----------
    machines : tuple of str
        For every file that no pattern fits.
    map : tuple of (pattern, machines)
        The first pattern (as in a shell) that fits the file's place or name goes before.
    """

    machines: tuple[str, ...] = ()
    map: tuple[tuple[str, tuple[str, ...]], ...] = ()

    def of(self, place: str) -> tuple[str, ...]:
        """Return the machines for a file; one empty name if there are none."""
        name = place.rpartition("/")[2]
        for pattern, machines in self.map:
            if fnmatch.fnmatch(place, pattern) or fnmatch.fnmatch(name, pattern):
                return machines
        return self.machines or ("",)


def parse_map(machine: str | None, entries: Sequence[str]) -> Group:
    """Read ``--machine`` and ``--machine-map``; names are separated by commas.

    Raises
    ------
    ModelError
    """
    found = []
    for entry in entries:
        pattern, equals, names = entry.rpartition("=")
        if not equals or not pattern or not _names(names):
            raise ModelError(f"--machine-map {entry!r}: write PATTERN=MACHINE, say 'pla_*=ender3'")
        found.append((pattern, _names(names)))
    if machine is None and not found:
        raise ModelError("name a machine with --machine, or several by --machine-map PATTERN=NAME")
    return Group(_names(machine or ""), tuple(found))


def items_of(sources: Sequence[Path], group: Group, *, output: Path) -> list[Item]:
    """Return what files and folders stand for, each file once and for each of its machines.

    Folders are searched through. What lies in the output folder, is hidden, is no print file by
    its name, or was written by us, is passed over there; a file that was named is always tried.

    Raises
    ------
    Refused
        A source does not exist, or is a pipe or a device.
    ModelError
        Two files would have the same result, or a folder lies in the output folder.
    """
    items: list[Item] = []
    places: dict[str, Path] = {}
    seen: set[Path] = set()
    for source in sources:
        found: Iterable[tuple[Path, str]] = [(source, source.name)]
        if source.is_dir():
            check_apart(source, output)
            found = _below(source, output)
        else:
            check_input(source)
        for path, place in found:
            if path.resolve() in seen:
                continue
            seen.add(path.resolve())
            other = places.setdefault(result_name(place).casefold(), path)
            if other is not path:
                raise ModelError(
                    f"{other} and {path} would both become {result_name(place)}; name the folder "
                    "above them instead, or rename one"
                )
            items += [Item(path, place, machine) for machine in group.of(place)]
    return items


def check_apart(folder: Path, output: Path) -> None:
    """Refuse a folder that is the output folder or lies in it: nothing there is ever compensated.

    Raises
    ------
    ModelError
    """
    if folder.resolve().is_relative_to(output.resolve()):
        raise ModelError(
            f"--output {output} is or holds the folder {folder}, and what lies in the output "
            "folder is passed over; name an output folder in it or elsewhere"
        )


def check_names(group: Group, machines: Resolver) -> None:
    """Refuse two machines of one name for a file: their results would lie in one place.

    A machine that cannot be used is passed over; each of its files says why.

    Raises
    ------
    ModelError
    """
    for chosen in (group.machines, *(machines for _, machines in group.map)):
        called: dict[str, str] = {}
        for given in chosen:
            with suppress(ModelError):
                called[given] = machines.for_job(given, files=True).machine.name
        for given, name in called.items():
            other = next(first for first in called if called[first] == name)
            if other != given:
                raise ModelError(
                    f"{other} and {given} are both called {name!r}, and results lie in folders "
                    'of that name: give one of the documents another "name"'
                )


def _is_print_file(path: Path) -> bool:
    """Return whether a file in a folder is to be done, by its name."""
    name = path.name.lower()
    return (
        name.endswith(_SUFFIXES)
        and not name.startswith(".")
        and ".stillpath." not in name
        and os.path.isfile(path)  # noqa: PTH113 - raises nothing in folders that may not be entered
    )


def is_stamped(path: Path) -> bool:
    """Return whether we wrote a file; False for what cannot be read."""
    from stillpath.gcode.containers.opening import open_text
    from stillpath.gcode.errors import GcodeError

    try:
        with open_text(path) as container:
            size = container.text.seek(0, 2)
            for start in (0, max(size - _SEARCHED_BYTES, 0)):
                container.text.seek(start)
                if _STAMP in container.text.read(_SEARCHED_BYTES):
                    return True
    except (GcodeError, OSError):
        return False
    return False


def is_unfinished(path: Path) -> bool:
    """Return whether a file lacks its slicer's end; False for what cannot be read."""
    from stillpath.gcode.containers.opening import open_text
    from stillpath.gcode.errors import GcodeError

    try:
        with open_text(path) as container:
            return container.facts().missing_end != ""
    except (GcodeError, OSError):
        return False


def _names(text: str) -> tuple[str, ...]:
    return tuple(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))


def print_files(folder: Path, output: Path) -> Iterator[Path]:
    """Yield print files below a folder in order, without hidden ones and those in `output`.

    Folders may disappear meanwhile, such as those of a run that writes into `output`.
    """
    kept_out = output.resolve()
    for parent, folders, names in os.walk(folder):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        for name in sorted(names):
            path = Path(parent, name)
            if _is_print_file(path) and not path.resolve().is_relative_to(kept_out):
                yield path


def _below(folder: Path, output: Path) -> Iterator[tuple[Path, str]]:
    for path in sorted(print_files(folder, output)):
        if not is_stamped(path):
            yield path, path.relative_to(folder).as_posix()
