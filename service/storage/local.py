"""Files of jobs in a folder of this computer."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path

from stillpath.pipeline.files import sync
from stillpath.service.storage.base import Room, Stat, StorageError
from stillpath.service.storage.disk import takes
from stillpath.service.storage.keys import check_key, check_prefix
from stillpath.service.storage.leftovers import delete_leftovers

__all__ = ["LocalStorage"]

_CHUNK_BYTES = 1 << 20
_FRESH = ".fresh"
"""Folder of files that are being copied here; no key begins with it."""
_ATTEMPTS = 5
_PROBE = b"stillpath" * 512


class LocalStorage:
    """A `service.storage.base.Storage` in a folder: a key is a path below it.

    Parameters
    ----------
    root : Path
        With the folder `.fresh` in it. A disk that is away leaves an empty folder without it: then
        every method raises `StorageError`, and nothing is written to another disk.
    make : bool
        Make both if they do not exist.
    """

    def __init__(self, root: Path, *, make: bool = True) -> None:
        self._root = root
        with _explained():
            for folder in _make_folder(root / _FRESH) if make else ():
                sync(folder)
            delete_leftovers(root / _FRESH, "*")

    def put(self, key: str, file: Path) -> None:
        """Move a local file to `key`; see `Storage.put`."""
        self.put_all({key: file})

    def put_all(self, files: Mapping[str, Path]) -> None:
        """Move local files to their keys; see `Storage.put_all`.

        First the contents reach the disk, then the names; all names together, because a file system
        with a journal writes it once for whatever changed before.
        """
        targets = {self._path(key): file for key, file in files.items()}
        changed: set[Path] = set()
        with self._there():
            for file in targets.values():
                sync(file)
            for target, file in targets.items():
                try:
                    changed |= self._publish(file, target)
                except OSError as error:
                    if error.errno != errno.EXDEV:
                        raise
                    changed |= self._copy(file, target)  # from another disk
            for folder in changed:
                with contextlib.suppress(FileNotFoundError):  # deleted meanwhile
                    sync(folder)

    @contextlib.contextmanager
    def local(self, key: str) -> Iterator[Path]:
        """Give the file of `key` itself; see `Storage.local`."""
        with self._there():
            file = self._file(key)
        yield file

    def stat(self, key: str) -> Stat:
        """Return what is known of a file; see `Storage.stat`."""
        with self._there():
            status = self._file(key).stat()
        return Stat(key, status.st_size, status.st_mtime)

    def read(self, key: str, start: int, stop: int) -> Iterator[bytes]:
        """Yield the bytes from `start` up to `stop`; see `Storage.read`."""
        with self._there(), self._file(key).open("rb") as file:
            file.seek(start)
            while start < stop and (chunk := file.read(min(_CHUNK_BYTES, stop - start))):
                start += len(chunk)
                yield chunk

    def list(self, prefix: str) -> Iterator[Stat]:
        """Yield the files below `prefix`; see `Storage.list`."""
        check_prefix(prefix)
        with self._there():
            pass
        for folder, _, names in os.walk(self._root / prefix):
            for name in names:
                path = Path(folder, name)
                with contextlib.suppress(FileNotFoundError):  # deleted meanwhile
                    status = path.stat()
                    key = path.relative_to(self._root).as_posix()
                    yield Stat(key, status.st_size, status.st_mtime)

    def delete(self, prefix: str) -> None:
        """Delete the files below `prefix`; see `Storage.delete`."""
        check_prefix(prefix)
        with self._there(), contextlib.suppress(FileNotFoundError, NotADirectoryError):
            shutil.rmtree(self._root / prefix)

    def room(self) -> Room:
        """Return how much room the folder's disk has; see `Storage.room`."""
        with self._there():
            usage = shutil.disk_usage(self._root)
        return Room(usage.free, usage.total)

    def takes(self, more_bytes: int) -> bool:
        """Return whether the folder has room for so much; see `Storage.takes`."""
        with self._there():
            return takes(self._root / _FRESH, more_bytes)

    def check(self) -> None:
        """Write a file of some kB and delete it; see `Storage.check`."""
        with self._there(), tempfile.TemporaryFile(dir=self._root / _FRESH) as file:
            file.write(_PROBE)
            file.flush()
            os.fsync(file.fileno())

    @contextlib.contextmanager
    def _there(self) -> Iterator[None]:
        """Refuse if the root is not there, and explain disk errors."""
        if not (self._root / _FRESH).is_dir():
            why = f"the storage is not there (no folder {_FRESH}); is its disk mounted?"
            raise StorageError(errno.EIO, why, str(self._root))
        with _explained():
            yield

    def _path(self, key: str) -> Path:
        check_key(key)
        if key.split("/", 1)[0] == _FRESH:
            raise ValueError(f"{key!r}: no key begins with {_FRESH}")
        return self._root / key

    def _file(self, key: str) -> Path:
        path = self._path(key)
        if not path.is_file():
            raise FileNotFoundError(errno.ENOENT, "there is no such file in the storage", key)
        return path

    def _publish(self, file: Path, target: Path) -> set[Path]:
        """Rename a file to its target; return the folders to be synced."""
        changed = {target.parent}
        for attempt in range(_ATTEMPTS):
            changed |= _make_folder(target.parent)
            try:
                file.replace(target)
            except FileNotFoundError:
                # The folder was deleted by a concurrent `delete` of its prefix.
                if attempt == _ATTEMPTS - 1 or not file.exists():
                    raise
            else:
                break
        return changed

    def _copy(self, file: Path, target: Path) -> set[Path]:
        handle, name = tempfile.mkstemp(dir=self._root / _FRESH)
        os.close(handle)
        fresh = Path(name)
        try:
            shutil.copyfile(file, fresh)
            sync(fresh)
            changed = self._publish(fresh, target)
        except BaseException:
            fresh.unlink(missing_ok=True)
            raise
        file.unlink()
        return changed


def _make_folder(folder: Path) -> set[Path]:
    """Make a folder and those above it; return those with new names."""
    if folder.is_dir():
        return set()
    changed = {folder.parent}
    if folder.parent != folder:
        changed |= _make_folder(folder.parent)
    folder.mkdir(exist_ok=True)
    return changed


@contextlib.contextmanager
def _explained() -> Iterator[None]:
    """Turn disk errors into `StorageError`, except for missing files."""
    try:
        yield
    except (FileNotFoundError, StorageError):
        raise
    except OSError as error:
        raise StorageError(error.errno, error.strerror, error.filename) from error
