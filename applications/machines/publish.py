"""Write files atomically and exactly once, never replacing another."""

from __future__ import annotations

import contextlib
import errno
import os
import tempfile
import time
from pathlib import Path

from stillpath.pipeline.files import sync

__all__ = ["publish", "sync_folder"]

_ABANDONED_S = 3600.0
_NO_LINKS = {errno.EPERM, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP}
"""What FAT, SMB and Android answer to a link."""


def publish(target: Path, text: str) -> None:
    """Write `target`, synced to disk, unless it exists.

    The text is written to a temporary file, which is then linked to its name: that fails if another
    process was faster. A killed process leaves at most a `.part` file, which a later call deletes.

    Raises
    ------
    FileExistsError
        If `target` exists; it is left as it is.
    OSError
        If the folder is gone or cannot be written.
    """
    _sweep(target.parent)
    handle, name = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name}.", suffix=".part")
    temporary = Path(name)
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        _take_name(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)
    sync_folder(target.parent)


def sync_folder(folder: Path) -> None:
    """Bring the names in a folder to disk, where the system can."""
    with contextlib.suppress(OSError):
        sync(folder)


def _take_name(temporary: Path, target: Path) -> None:
    if os.name == "nt":
        temporary.rename(target)  # refuses to replace, unlike elsewhere
        return
    try:
        target.hardlink_to(temporary)
    except OSError as error:
        if error.errno not in _NO_LINKS:
            raise
        raise OSError(
            error.errno,
            "this file system has no hard links: put STILLPATH_DATA_DIR on a local disk",
            str(target),
        ) from None


def _sweep(folder: Path) -> None:
    """Delete old files of killed writers; those of active writers are much younger."""
    oldest = time.time() - _ABANDONED_S
    for part in folder.glob(".*.part"):
        with contextlib.suppress(FileNotFoundError):
            if part.stat().st_mtime < oldest:
                part.unlink()
