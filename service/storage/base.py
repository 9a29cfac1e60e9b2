"""Interface of a storage of files."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

__all__ = ["Room", "Stat", "Storage", "StorageError", "sha256_of"]


class StorageError(OSError):
    """The storage does not respond, or refuses; a retry may help."""


@dataclass(frozen=True, slots=True)
class Stat:
    """What is known of a file.

    Attributes
    ----------
    modified_at : float
        Seconds since the epoch.
    """

    key: str
    size_bytes: int
    modified_at: float


@dataclass(frozen=True, slots=True)
class Room:
    """Free and total space of a storage's disk."""

    free_bytes: int
    total_bytes: int


def sha256_of(file: Path) -> str:
    """Return the SHA-256 of a file, as the rows of jobs hold it."""
    with file.open("rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()


class Storage(Protocol):
    """Files by key, for instance ``jobs/ID/source/part.gcode``; a file is whole or not there.

    Keys are made by the service, never by a caller: parts of letters, digits and what
    `service.api.uploads.safe_name` lets through, joined by ``/``. Methods block; they are safe to
    call from several threads. All raise `StorageError` where the storage does not answer.
    """

    def put(self, key: str, file: Path) -> None:
        """Move a local file to `key`; it is durable when this returns.

        `file` is gone afterwards. What lay at `key` is replaced at once.
        """

    def put_all(self, files: Mapping[str, Path]) -> None:
        """Move local files to their keys, as `put` does; quicker than one after the other.

        If an error is raised, some may be there.
        """

    def local(self, key: str) -> AbstractContextManager[Path]:
        """Yield a read-only local file with the content of `key`, for a `with` block.

        Raises
        ------
        FileNotFoundError
        """

    def stat(self, key: str) -> Stat:
        """Return what is known of a file.

        Raises
        ------
        FileNotFoundError
        """

    def read(self, key: str, start: int, stop: int) -> Iterator[bytes]:
        """Yield the bytes from `start` up to `stop` in chunks of at most 1 MiB.

        Raises
        ------
        FileNotFoundError
            At the first chunk.
        """

    def list(self, prefix: str) -> Iterator[Stat]:
        """Yield the files whose key begins with `prefix`, which ends with ``/``."""

    def delete(self, prefix: str) -> None:
        """Delete the files, if any, whose key begins with `prefix`, which ends with ``/``."""

    def room(self) -> Room | None:
        """Return the space of its disk; None if unknown."""

    def takes(self, more_bytes: int) -> bool:
        """Return whether there is room for so much now, as far as that can be known."""

    def check(self) -> None:
        """Raise `StorageError` unless a file could be written now."""
