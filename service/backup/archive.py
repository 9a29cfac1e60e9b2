"""Back up database, results and machines to one tar file while the service is running.

The database comes first, by SQLite's own online backup; then the files that its rows name, which
never change once a row names them; then everything else. A job that was deleted meanwhile is
removed from the copy, so that no row is without its files. The manifest comes last: a truncated
archive has none.
"""

from __future__ import annotations

import contextlib
import errno
import gzip
import hashlib
import io
import os
import shutil
import sqlite3
import tarfile
import tempfile
import zlib
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import IO

from pydantic import ValidationError

from stillpath.models.document import Document
from stillpath.pipeline.files import replacing, sync
from stillpath.service.instance_lock import RESTORING, exclusive, is_half_restored
from stillpath.service.permissions import private_folder
from stillpath.service.storage.leftovers import delete_leftovers
from stillpath.version import __version__

__all__ = ["BackupError", "Manifest", "back_up", "restore"]

DATABASE = "stillpath.sqlite3"
_MANIFEST = "backup.json"
_LOCK = "service.lock"
_BACKUPS = "backups"
"""Folder in the data directory for backups on the same disk, from where they are fetched."""
_PASSING = frozenset(
    {"incoming", "scratch", "cache", "jobs", "first-key", "disk-reserve", _BACKUPS, _LOCK}
)
"""What is no data at the top of the directory, a secret, or led to by the database (jobs)."""
_STAYING = frozenset({_LOCK, RESTORING, _BACKUPS})
"""What may be at the top of a directory that is restored into, and stays."""
_DAMAGES = (
    *(tarfile.TarError, gzip.BadGzipFile, zlib.error),
    *(EOFError, ValidationError, UnicodeError),
)
"""What reading a damaged archive raises."""
_WORK = ".stillpath-backup-"
"""Beginning of the name of a folder beside the archive, for a copy of the database."""
_CHUNK_BYTES = 1 << 20


class BackupError(Exception):
    """It cannot be backed up or restored; the message says what to do."""


class Manifest(Document):
    """What an archive holds: SHA-256 and size in bytes of every file."""

    version: str
    jobs: int
    files: dict[str, tuple[str, int]]

    @property
    def size_bytes(self) -> int:
        """Bytes of all files."""
        return sum(size for _, size in self.files.values())


def back_up(data_dir: Path, target: Path) -> Manifest:
    """Write an archive of a data directory, whether or not a service works there.

    Parameters
    ----------
    target : Path
        A new file that only its owner may read; compressed if its name ends with ``gz``. In the
        data directory only below ``backups``, which is made if need be.

    Raises
    ------
    BackupError, OSError
    """
    if not data_dir.is_dir():
        raise BackupError(f"there is no data directory {data_dir}; name it with --data-dir")
    if target.exists():
        raise BackupError(f"{target} already exists; name a new file")
    if _is_in_backups(target, data_dir):
        private_folder(target.parent)
    if is_half_restored(data_dir):
        raise BackupError(f"{data_dir}: a restore was broken off there; finish it first")
    database = data_dir / DATABASE
    if not database.exists() and _below(data_dir / "jobs"):
        raise BackupError(
            f"the database {database} is missing, and without it the files of jobs are not backed "
            "up; put it back, or restore an earlier backup"
        )
    delete_leftovers(target.parent, f"{_WORK}*")
    with (
        replacing(target, mode=0o600) as temporary,
        tempfile.TemporaryDirectory(dir=target.parent, prefix=_WORK) as work,
        tarfile.open(
            temporary, "w:gz" if target.name.endswith("gz") else "w", format=tarfile.PAX_FORMAT
        ) as tar,
    ):
        archive = _Archive(tar)
        jobs = 0
        if database.exists():
            try:
                jobs = _add_jobs(archive, data_dir, Path(work) / DATABASE)
            except sqlite3.Error as error:
                raise BackupError(
                    f"the database {database} cannot be copied: {error}; if it is empty or "
                    "damaged, restore an earlier backup"
                ) from None
        _add_rest(archive, data_dir)
        manifest = Manifest(version=__version__, jobs=jobs, files=archive.files)
        archive.add_text(_MANIFEST, manifest.model_dump_json(indent=1))
    return manifest


def restore(source: Path, data_dir: Path) -> Manifest:
    """Fill an empty data directory from an archive; every file is checked before any counts.

    Parameters
    ----------
    source : Path
        In the data directory only below ``backups``, which may be there and stays.

    Raises
    ------
    BackupError
        The archive is damaged or broken off, or there are data already; nothing has changed then.
    OSError
        EBUSY if a service works with the directory.
    """
    _is_in_backups(source, data_dir)
    with exclusive(data_dir):
        fresh = data_dir / RESTORING
        if fresh.exists():
            if (data_dir / DATABASE).exists():  # moved in last: the rest may be used since
                raise BackupError(
                    f"{data_dir} has a database beside a restore that was broken off there; move "
                    "it away, or name another folder with --data-dir"
                )
            _check_untouched(data_dir)
            _clear(data_dir)
        there = sorted(p.name for p in data_dir.iterdir() if p.name not in _STAYING)
        if there:
            raise BackupError(
                f"{data_dir} is not empty ({', '.join(there[:3])}); move it away, or name another "
                "folder with --data-dir"
            )
        fresh.mkdir()
        try:
            manifest = _unpack(source, fresh)
        except BaseException:
            shutil.rmtree(fresh)
            raise
        _hold_back(fresh / DATABASE)
        names = sorted(path.name for path in fresh.iterdir())
        for name in sorted(names, key=lambda name: name == DATABASE):
            (fresh / name).replace(data_dir / name)
        sync(data_dir)
        fresh.rmdir()
    return manifest


class _Archive:
    """A tar file with a manifest of its contents."""

    def __init__(self, tar: tarfile.TarFile) -> None:
        self._tar = tar
        self.files: dict[str, tuple[str, int]] = {}

    def add(self, name: str, path: Path) -> None:
        with path.open("rb") as file:
            entry = tarfile.TarInfo(name)
            state = os.fstat(file.fileno())
            entry.size, entry.mtime = state.st_size, int(state.st_mtime)
            hashing = _Hashing(file)
            self._tar.addfile(entry, hashing)
        self.files[name] = (hashing.digest.hexdigest(), entry.size)

    def add_text(self, name: str, text: str) -> None:
        data = text.encode()
        entry = tarfile.TarInfo(name)
        entry.size = len(data)
        self._tar.addfile(entry, io.BytesIO(data))

    def forget(self, names: list[str]) -> None:
        for name in names:
            del self.files[name]


class _Hashing(io.RawIOBase):
    """A file that is hashed while it is read."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self.digest = hashlib.sha256()

    def readable(self) -> bool:
        return True

    def read(self, size: int = -1) -> bytes:
        data = self._file.read(size)
        self.digest.update(data)
        return data


def _add_jobs(archive: _Archive, data_dir: Path, copy: Path) -> int:
    """Add the database and the files that its jobs name; return how many jobs there are."""
    with (
        contextlib.closing(sqlite3.connect(data_dir / DATABASE, timeout=60.0)) as live,
        contextlib.closing(sqlite3.connect(copy)) as taken,
    ):
        live.backup(taken)
        taken.execute("PRAGMA journal_mode = DELETE").fetchone()
        taken.execute("PRAGMA foreign_keys = ON").close()
        rows = taken.execute("SELECT id, state, source_bytes, output FROM jobs").fetchall()
        gone = []
        for job_id, state, upload_bytes, output in rows:
            folder = data_dir / "jobs" / job_id
            needed = [folder / "source"] if upload_bytes else []
            needed += [data_dir / output] if output else []
            names = _add_job(archive, data_dir, folder, needed)
            # Rows are deleted before their files: what has a row still was whole.
            still = live.execute("SELECT 1 FROM jobs WHERE id = ?", (job_id,)).fetchone()
            if still is None or (names is None and state not in ("failed", "cancelled")):
                archive.forget(names or [])
                gone.append((job_id,))
        taken.executemany("DELETE FROM jobs WHERE id = ?", gone).close()
        taken.commit()
    archive.add(DATABASE, copy)
    return len(rows) - len(gone)


def _add_job(
    archive: _Archive, data_dir: Path, folder: Path, needed: list[Path]
) -> list[str] | None:
    """Add the files of a job and return their names; None, and nothing added, if some are gone."""
    added: list[str] = []
    try:
        paths = set()
        for part in needed:
            if not (found := _below(part)):
                raise FileNotFoundError(errno.ENOENT, "the files are gone", str(part))
            paths |= found
        if (folder / "machine.json").exists():  # not every kind of job has one
            paths.add(folder / "machine.json")
        for path in sorted(paths):
            name = path.relative_to(data_dir).as_posix()
            archive.add(name, path)
            added.append(name)
    except FileNotFoundError:
        archive.forget(added)
        return None
    return added


def _add_rest(archive: _Archive, data_dir: Path) -> None:
    """Add machines, identifications, and whatever else is kept: files that are never changed."""
    for top in sorted(data_dir.iterdir()):
        if top.name in _PASSING or top.name.startswith((".", DATABASE)):
            continue
        for path in sorted(_below(top) if top.is_dir() else {top}):
            if path.is_symlink() or path.name.endswith(".part"):
                continue
            with contextlib.suppress(FileNotFoundError):
                archive.add(path.relative_to(data_dir).as_posix(), path)


def _below(folder: Path) -> set[Path]:
    return {path for path in folder.rglob("*") if path.is_file()}


def _unpack(source: Path, folder: Path) -> Manifest:
    found: dict[str, tuple[str, int]] = {}
    manifest: Manifest | None = None
    try:
        with tarfile.open(source, "r:*") as tar:
            for entry in tar:
                content = tar.extractfile(entry) if entry.isfile() else None
                if content is None or not _is_inside(entry.name):
                    raise BackupError(f"{source}: {entry.name!r} does not belong into a backup")
                if entry.name == _MANIFEST:
                    manifest = Manifest.model_validate_json(content.read())
                else:
                    found[entry.name] = _write(folder / entry.name, content)
    except _DAMAGES as error:
        raise BackupError(f"{source} is damaged ({_first_line(error)}); take another") from None
    if manifest is None:
        raise BackupError(
            f"{source} has no end: it was broken off, or is not a backup; take another"
        )
    for name, known in manifest.files.items():
        if found.pop(name, None) != known:
            raise BackupError(f"{source}: {name} is damaged or missing; take another backup")
    for name in found:  # of jobs that were deleted while the backup was made
        path = folder / name
        path.unlink()
        while (path := path.parent) != folder and not any(path.iterdir()):
            path.rmdir()
    return manifest


def _hold_back(database: Path) -> None:
    """Prevent starts of printers and uploads to them, which may have happened already.

    A printer may have a later file of the name by now, of which the backup does not know.
    """
    if not database.exists():
        return
    why = (
        "held back: it was due when the backup was made that was restored since, and the printer "
        "may have a later file; download the result, or submit the file again"
    )
    with contextlib.closing(sqlite3.connect(database)) as connection:
        tables = {name for (name,) in connection.execute("SELECT name FROM sqlite_master")}
        if {"jobs", "deliveries"} <= tables:
            connection.execute(
                "UPDATE deliveries SET state = 'failed', error = ? "
                "WHERE state IN ('waiting', 'sending') AND kind = 'printer'",
                (why,),
            )
            # One that an earlier restore held back is there already.
            connection.execute(
                "INSERT OR IGNORE INTO deliveries "
                "(job_id, kind, target, state, attempts, next_at, error) "
                "SELECT id, 'printer', printer, 'failed', 0, 0, ? FROM jobs "
                "WHERE state IN ('queued', 'running') AND printer IS NOT NULL",
                (why,),
            )
            connection.execute(
                "UPDATE jobs SET print_after = 0 WHERE state IN ('queued', 'running')"
            )
        connection.commit()


def _write(path: Path, content: IO[bytes]) -> tuple[str, int]:
    path.parent.mkdir(parents=True, exist_ok=True)
    digest, size = hashlib.sha256(), 0
    with path.open("wb") as file:
        for chunk in _chunks(content):
            file.write(chunk)
            digest.update(chunk)
            size += len(chunk)
        file.flush()
        os.fsync(file.fileno())
    return digest.hexdigest(), size


def _chunks(content: IO[bytes]) -> Iterator[bytes]:
    while chunk := content.read(_CHUNK_BYTES):
        yield chunk


def _is_inside(name: str) -> bool:
    path = PurePosixPath(name)
    stays = bool(_STAYING & {*path.parts[:1]})
    return not (path.is_absolute() or ".." in path.parts or "\\" in name or stays)


def _is_in_backups(file: Path, data_dir: Path) -> bool:
    """Return whether an archive lies in the folder of backups; refuse the rest of the directory."""
    place, root = file.resolve(), data_dir.resolve()
    if not place.is_relative_to(root):
        return False
    if root / _BACKUPS not in place.parents:
        raise BackupError(
            f"{file} lies in the data directory; name a file elsewhere, or in {data_dir / _BACKUPS}"
        )
    return True


def _check_untouched(data_dir: Path) -> None:
    """Refuse files that were made since a restore was broken off, such as machines.

    Its own are older than its folder, which changed last when it moved something out.
    """
    broken_off_ns = (data_dir / RESTORING).stat().st_mtime_ns
    for path in sorted(_below(data_dir)):
        name = path.relative_to(data_dir)
        if name.parts[0] not in _STAYING and path.stat().st_mtime_ns > broken_off_ns:
            raise BackupError(
                f"{data_dir} has files that were made since a restore was broken off there "
                f"({name}); move them away, or name another folder with --data-dir"
            )


def _clear(data_dir: Path) -> None:
    for path in data_dir.iterdir():
        if path.name in _STAYING:
            continue
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()
    shutil.rmtree(data_dir / RESTORING)  # last: until then we may begin anew


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
