"""Machines by name: the built-in library and JSON files of the user."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from functools import cache
from pathlib import Path

from pydantic import ValidationError

from stillpath.models.complaints import explain
from stillpath.models.errors import ModelError
from stillpath.models.machine import Machine
from stillpath.models.user_files import as_json, names_a_file

__all__ = ["builtin_machines", "load_machine", "no_such_machine", "read_machine"]

_LIBRARY = Path(__file__).parent / "library"
_LARGEST_BYTES = 4_000_000


def builtin_machines() -> list[str]:
    """Return the names of the built-in machines, sorted."""
    return list(_builtin_names())


def load_machine(name_or_path: str | Path) -> Machine:
    """Load a built-in machine by name, or a machine from a JSON file.

    Whatever ends in `.json` or holds a slash is a path, all else a name.

    Raises
    ------
    ModelError
        If there is no such machine or file, or the document is not a valid machine.
    """
    text = str(name_or_path)
    if isinstance(name_or_path, Path) or names_a_file(text):
        return _from_file(Path(name_or_path))
    if text not in _builtin_names():
        raise no_such_machine(text)
    return _builtin(text)


def no_such_machine(name: str, own: Sequence[str] = (), *, files: bool = True) -> ModelError:
    """Return the error for a name that neither the library nor the user's store (`own`) knows.

    With `files` it says that a path would do as well.
    """
    names = builtin_machines()
    wanted = name.lower().replace("_", "-")
    near = difflib.get_close_matches(wanted, [*own, *names], n=3, cutoff=0.5)
    hint = f"did you mean {', '.join(near)}? " if near else ""
    yours = f"your own are {', '.join(own)}; " if own else ""
    path = "; a file of your own is given by its path, ending in .json" if files else ""
    return ModelError(
        f"no machine is called {name!r:.80}; {hint}{yours}built in are {', '.join(names)}{path}"
    )


def read_machine(document: str | bytes, source: str = "machine") -> Machine:
    """Read a machine from its JSON text; `source` names it in messages.

    Raises
    ------
    ModelError
        Naming the first field that is wrong, its value and what it must be.
    """
    parsed = as_json(document.encode() if isinstance(document, str) else document, source)
    try:
        return Machine.model_validate(parsed)
    except ValidationError as error:
        raise ModelError(f"{source}: {explain(error)}") from None


# What comes with the program does not change while it runs, and every upload asks for it.
@cache
def _builtin_names() -> tuple[str, ...]:
    return tuple(sorted(path.stem for path in _LIBRARY.glob("*.json")))


@cache
def _builtin(name: str) -> Machine:
    return _from_file(_LIBRARY / f"{name}.json")


def _from_file(path: Path) -> Machine:
    try:
        if path.stat().st_size > _LARGEST_BYTES:
            raise ModelError(f"{path}: over {_LARGEST_BYTES} bytes, not a machine")
        document = path.read_bytes()
    except OSError as error:
        raise ModelError(
            f"cannot read the machine file {path}: {error.strerror}; built in are "
            f"{', '.join(builtin_machines())}"
        ) from None
    return read_machine(document, str(path))
