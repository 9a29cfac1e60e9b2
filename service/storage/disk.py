"""Free space of a disk: a reserve is kept so that accepted jobs can be finished and deleted."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import stat
import tempfile
from pathlib import Path

import structlog

from stillpath.service.permissions import private_folder

__all__ = [
    "DISK_FULL",
    "Disk",
    "NoRoom",
    "PeakDiskUse",
    "refuses_more",
    "room_again_bytes",
    "takes",
    "written_bytes",
]

DISK_FULL = (errno.ENOSPC, errno.EDQUOT)
"""Error numbers of a full disk."""

_MIB = 1 << 20
_MOST_UNSEEN_BYTES = 256 * _MIB
"""What a job may write between two looks at it."""
_BALLAST = "disk-reserve"
_BALLAST_BYTES = 8 * _MIB


class NoRoom(OSError):
    """The disk has too little room left; the message says how much, and what to do."""

    def __init__(self, message: str) -> None:
        super().__init__(errno.ENOSPC, message)
        self.message = message


class Disk:
    """The disk of the data directory.

    Uploads may not use the reserve; jobs start while half of it is free, and go back to the queue
    when a quarter is left. A placeholder file holds the space that the database needs for deleting,
    and is removed when the disk is full.

    Parameters
    ----------
    folder : Path
        Anywhere on the disk; made if need be.
    reserve_bytes : int
        0: the disk is not looked at.
    """

    def __init__(self, folder: Path, reserve_bytes: int) -> None:
        self._folder = folder
        self._reserve_bytes = reserve_bytes

    def free_bytes(self) -> int:
        """Return the free space in bytes."""
        try:
            return shutil.disk_usage(self._folder).free
        except FileNotFoundError:
            private_folder(self._folder)
            return shutil.disk_usage(self._folder).free

    def total_bytes(self) -> int:
        """Return how large the disk is."""
        self.free_bytes()  # makes the folder
        return shutil.disk_usage(self._folder).total

    def fits_ever(self, more_bytes: int) -> bool:
        """Return whether a disk with nothing else on it would have room for a job's files.

        A reserve that is larger than the disk is no job's fault.
        """
        most = self.total_bytes() - self._reserve_bytes
        return not self._reserve_bytes or most <= 0 or more_bytes <= most

    def has_room_for(self, more_bytes: int) -> bool:
        """Return whether a job may begin that needs so much."""
        reserve_bytes = self._reserve_bytes
        if reserve_bytes and self.free_bytes() - more_bytes < reserve_bytes // 4:
            return False
        return self.lets_jobs_begin and takes(self._folder, more_bytes)

    def check_ever(self, job_bytes: int) -> None:
        """Raise `NoRoom` if the files of a job are larger than the disk."""
        if not self.fits_ever(job_bytes):
            raise NoRoom(
                f"the job needs {job_bytes // _MIB} MiB for the upload and its result, more than "
                f"the disk of the service can ever have: {self.total_bytes() // _MIB} MiB in all, "
                f"of which {self._reserve_bytes // _MIB} MiB stay free "
                "(STILLPATH_DISK_RESERVE_BYTES). Cut the print into several files"
            )

    def refusal(self, more_bytes: int = 0) -> str | None:
        """Return why the service takes no upload of so many bytes, or None."""
        if not self._reserve_bytes:
            return None
        left = self.free_bytes() - more_bytes
        if left >= self._reserve_bytes:
            return None
        size = f" after {more_bytes // _MIB} MiB more" if more_bytes else ""
        return (
            f"the disk of the service has {max(left, 0) // _MIB} MiB left{size}; "
            f"{self._reserve_bytes // _MIB} MiB stay free for the jobs that were accepted "
            "(STILLPATH_DISK_RESERVE_BYTES). Delete finished jobs, or make room on it"
        )

    def check(self, more_bytes: int = 0) -> None:
        """Raise `NoRoom` if an upload of so many bytes is too much."""
        why = self.refusal(more_bytes)
        if why is not None:
            raise NoRoom(why)

    @property
    def lets_jobs_begin(self) -> bool:
        """Whether there is room for a job's files."""
        return not self._reserve_bytes or self.free_bytes() >= self._reserve_bytes // 2

    @property
    def lets_jobs_go_on(self) -> bool:
        """Whether a running job may write more."""
        return not self._reserve_bytes or self.free_bytes() >= self._reserve_bytes // 4

    @property
    def is_full(self) -> bool:
        """Whether there is hardly space left for the database; a quota does not show here."""
        return bool(self._reserve_bytes) and self.free_bytes() < _BALLAST_BYTES

    def hold(self) -> None:
        """Reserve space for `give_up`, if the disk has plenty."""
        if not self._reserve_bytes or self.free_bytes() < self._reserve_bytes // 2:
            return
        size = min(_BALLAST_BYTES, self._reserve_bytes // 4)
        path = self._folder / _BALLAST
        with contextlib.suppress(OSError):
            if path.exists() and path.stat().st_size == size and _takes_space(path):
                return
            try:
                # Actually written: some file systems overcommit, and some compress.
                with path.open("wb") as file:
                    file.write(os.urandom(size))
                    file.flush()
                    os.fsync(file.fileno())
            except OSError:  # a quota has no room for it: half of it would only take what is left
                path.unlink()

    def give_up(self) -> None:
        """Release the space reserved by `hold`, for necessary writes on a full disk."""
        with contextlib.suppress(OSError):
            (self._folder / _BALLAST).unlink()
            structlog.get_logger("disk").warning("the disk is full; the reserve was given up")


class PeakDiskUse:
    """The most that the work in a folder has taken on the disk.

    A file that is not complete has no name on Linux (`pipeline.files.replacing`), and is gone once
    the work fails: so the folder is looked at from time to time.

    Parameters
    ----------
    folder : Path
        See `written_bytes`.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._most_bytes = 0

    def look(self) -> int:
        """Return the most bytes that were seen until now."""
        self._most_bytes = max(self._most_bytes, written_bytes(self._folder))
        return self._most_bytes


def refuses_more(folder: Path) -> bool:
    """Return whether a folder has no room for 1 MiB more: of a quota nothing else tells."""
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            # Not synced: Btrfs would not give the space back for half a minute.
            file.write(os.urandom(_MIB))
            file.flush()
    except OSError as error:
        return error.errno in DISK_FULL
    return False


def takes(folder: Path, more_bytes: int) -> bool:
    """Return whether a folder has room for so much now, also of a quota: nothing else tells.

    The space is asked for and given back; nothing is written where the file system knows how.
    """
    if not hasattr(os, "posix_fallocate"):  # macOS, Windows
        return True
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            os.posix_fallocate(file.fileno(), 0, max(more_bytes, 1))
    except OSError as error:
        return error.errno not in DISK_FULL
    return True


def room_again_bytes(room_bytes: int) -> int:
    """Return how much room a job is to find that had written `room_bytes` when there was no more.

    It needs more than that, and what it wrote last was not seen: with no more than that it would
    begin and end without room for ever.
    """
    return room_bytes + min(room_bytes // 8, _MOST_UNSEEN_BYTES) + _MIB


def written_bytes(folder: Path) -> int:
    """Return the size of the files in a folder, and of those without a name on its disk.

    Parameters
    ----------
    folder : Path
        Where this process writes, and no other.
    """
    size_bytes = 0
    with contextlib.suppress(OSError):  # files may disappear meanwhile
        size_bytes = _unnamed_bytes(folder.stat().st_dev)
        for path in folder.rglob("*"):
            size_bytes += path.stat().st_size
    return size_bytes


def _takes_space(file: Path) -> bool:
    """Return whether a file is not all zeros, as earlier versions wrote it, which compress."""
    with file.open("rb") as opened:
        return any(opened.read(64))


def _unnamed_bytes(device: int) -> int:
    """Return the size of the files without a name that this process has open on a disk."""
    sizes: dict[int, int] = {}  # a file may be open several times
    with contextlib.suppress(FileNotFoundError):  # no Linux
        for handle in Path("/proc/self/fd").iterdir():
            with contextlib.suppress(OSError):  # closed meanwhile
                status = handle.stat()
                if stat.S_ISREG(status.st_mode) and not status.st_nlink and status.st_dev == device:
                    sizes[status.st_ino] = status.st_size
    return sum(sizes.values())
