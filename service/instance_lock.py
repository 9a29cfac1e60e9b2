"""Ensure that only one service uses a data directory.

At its start a service deletes broken uploads and requeues running jobs; with another service on the
same directory, these would be the other one's.
"""

from __future__ import annotations

import contextlib
import errno
import os
import sys
from collections.abc import Iterator
from pathlib import Path

from stillpath.service.permissions import private_folder

__all__ = ["RESTORING", "exclusive", "is_half_restored"]

RESTORING = ".restoring"
"""Folder in the data directory from which a restore moves everything in, the database last."""
_TAKEN = (errno.EAGAIN, errno.EACCES, errno.EDEADLK)


@contextlib.contextmanager
def exclusive(folder: Path) -> Iterator[None]:
    """Lock a folder, made if necessary, for the `with` block; a killed process loses the lock.

    Raises
    ------
    OSError
        EBUSY if another process holds it. File systems without locks do not protect.
    """
    private_folder(folder)
    handle = os.open(folder / "service.lock", os.O_RDWR | os.O_CREAT, 0o666)
    try:
        try:
            _lock(handle)
        except OSError as error:
            if error.errno in _TAKEN:
                raise OSError(
                    errno.EBUSY,
                    "another service works with this data directory; stop it, or choose another "
                    "one (--data-dir, STILLPATH_DATA_DIR)",
                    str(folder),
                ) from None
        yield
    finally:
        os.close(handle)


def is_half_restored(folder: Path) -> bool:
    """Return whether a restore into a data directory was broken off."""
    fresh = folder / RESTORING
    return fresh.is_dir() and any(fresh.iterdir())


def _lock(handle: int) -> None:
    if sys.platform == "win32":
        import msvcrt

        msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
    else:
        import fcntl

        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
