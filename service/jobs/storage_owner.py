"""Whose storage it is: of two services in one, each would take the other's files for orphans."""

from __future__ import annotations

import tempfile
from pathlib import Path

import structlog

from stillpath.service.jobs.store import JobStore
from stillpath.service.storage import Storage

__all__ = ["StorageOwner"]

_OWNERS = "databases/"


class StorageOwner:
    """Notes in a storage to which database its jobs belong.

    Parameters
    ----------
    folder : Path
        For a file on its way there.
    """

    def __init__(self, store: JobStore, storage: Storage, folder: Path) -> None:
        self._store, self._storage, self._folder = store, storage, folder
        self._was_told = False

    def is_alone(self) -> bool:
        """Return whether no other database's jobs are in the storage.

        Raises
        ------
        DatabaseAway, StorageError
        """
        mine = f"{_OWNERS}{self._store.identity()}"
        found = {stat.key for stat in self._storage.list(_OWNERS)}
        if mine not in found:
            with tempfile.TemporaryDirectory(dir=self._folder) as folder:
                file = Path(folder) / "owner"
                file.write_text("Stillpath keeps the files of its jobs here.\n", "utf-8")
                self._storage.put(mine, file)
        others = sorted(found - {mine})
        if others and not self._was_told:
            structlog.get_logger("sweep").warning(
                "files without a job are not deleted: another service uses the same storage; give "
                "each a folder or prefix of its own (STILLPATH_STORAGE_URL), or, if the other one "
                "is gone, delete its mark",
                marks=others,
            )
        self._was_told = bool(others)
        return not others
