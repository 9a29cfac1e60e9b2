"""Notes on what was read or assumed, and those among them that are warnings."""

from __future__ import annotations

from collections.abc import Iterable

__all__ = ["WarningNote", "by_file", "parted"]


class WarningNote(str):
    """A note that the user should look at.

    It travels among plain notes, from the reader that sees something odd to the page that shows
    warnings apart. Text that is made of it is a plain note again: `by_file` keeps what it is.
    """

    __slots__ = ()


def by_file(told: Iterable[tuple[str, str]]) -> list[str]:
    """Group notes by their text, with the names of all files in front of it.

    Parameters
    ----------
    told : iterable of (str, str)
        Name of a file, and a note on it.
    """
    sources: dict[str, list[str]] = {}
    for source, note in dict.fromkeys(told):
        sources.setdefault(note, []).append(source)
    return [type(note)(f"{', '.join(names)}: {note}") for note, names in sources.items()]


def parted(told: Iterable[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the plain notes, and the warnings among them, each in the order they were told."""
    told = tuple(told)
    notes = tuple(note for note in told if not isinstance(note, WarningNote))
    return notes, tuple(str(note) for note in told if isinstance(note, WarningNote))
