"""Storage of small documents by name: its interface, and a folder that implements it.

`service.database.documents` is another implementation, for several computers.
"""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

from stillpath.applications.machines.publish import publish, sync_folder
from stillpath.pipeline.files import replacing

__all__ = ["DocumentFolder", "Documents"]


class Documents(Protocol):
    """Texts by path (``folder/name``), written atomically, with concurrent writers.

    Paths are made by the program, never by a caller.
    """

    def folders(self, within: str = "") -> list[str]:
        """Return the names of the folders in a folder, sorted; at least of those not empty."""

    def names(self, folder: str) -> list[str]:
        """Return the names of the documents in a folder, which need not be there."""

    def read(self, path: str) -> bytes:
        """Return a document.

        Raises
        ------
        FileNotFoundError
        """

    def create(self, path: str, text: str, *, beside: str | None = None) -> None:
        """Write a new document; it is durable when this returns.

        Parameters
        ----------
        beside : str, optional
            Another document that must exist.

        Raises
        ------
        FileExistsError
            If `path` is taken; of several callers one succeeds.
        FileNotFoundError
            If `beside` does not exist.
        """

    def create_folder(self, folder: str, contents: Mapping[str, str]) -> None:
        """Write a new folder with all its documents, or nothing of it.

        Raises
        ------
        FileExistsError
            If there are documents in a folder of that name.
        """

    def move(self, folder: str, target: str) -> None:
        """Give a folder with everything in it another name.

        Raises
        ------
        FileNotFoundError
            If there is no such folder.
        FileExistsError
            If there are documents in `target`.
        """

    def replace(self, path: str, text: str) -> None:
        """Write a document, over an earlier one if there is one."""

    def place(self, path: str) -> str:
        """Return the name of a document or folder as shown to users."""


class DocumentFolder:
    """`Documents` as files in a folder.

    Parameters
    ----------
    root : Path
        Made with the first document.
    """

    def __init__(self, root: Path) -> None:
        self._root = root

    def folders(self, within: str = "") -> list[str]:
        """See `Documents`."""
        folder = self._root / within
        return sorted(p.name for p in folder.iterdir() if p.is_dir()) if folder.is_dir() else []

    def names(self, folder: str) -> list[str]:
        """See `Documents`."""
        try:
            return sorted(path.name for path in (self._root / folder).iterdir())
        except (FileNotFoundError, NotADirectoryError):
            return []

    def read(self, path: str) -> bytes:
        """See `Documents`."""
        return (self._root / path).read_bytes()

    def create(self, path: str, text: str, *, beside: str | None = None) -> None:
        """See `Documents`."""
        file = self._root / path
        if beside is None:
            file.parent.mkdir(parents=True, exist_ok=True)
        try:
            publish(file, text)
        except OSError:
            with contextlib.suppress(OSError):
                file.parent.rmdir()  # only if it is empty
            raise
        if beside is not None and not (self._root / beside).exists():
            # The folder was moved and recreated meanwhile, and this does not belong in the new one.
            file.unlink(missing_ok=True)
            raise FileNotFoundError(f"{self._root / beside} is gone")
        sync_folder(self._root)

    def create_folder(self, folder: str, contents: Mapping[str, str]) -> None:
        """See `Documents`."""
        self._root.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=self._root, prefix=".incoming-") as incoming:
            made = Path(incoming) / "made"
            made.mkdir()
            for name, text in contents.items():
                publish(made / name, text)
            self._move(made, folder)

    def move(self, folder: str, target: str) -> None:
        """See `Documents`."""
        (self._root / target).parent.mkdir(parents=True, exist_ok=True)
        self._move(self._root / folder, target)

    def replace(self, path: str, text: str) -> None:
        """See `Documents`."""
        file = self._root / path
        file.parent.mkdir(parents=True, exist_ok=True)
        with replacing(file) as temporary:
            temporary.write_text(text, encoding="utf-8")

    def place(self, path: str) -> str:
        """See `Documents`."""
        return str(self._root / path)

    def _move(self, folder: Path, target: str) -> None:
        try:
            # Fails if the target folder already contains a document.
            folder.rename(self._root / target)
        except FileNotFoundError:
            raise
        except OSError:
            if not self.names(target):
                raise
            raise FileExistsError(f"{self._root / target} already exists") from None
        sync_folder(self._root)
