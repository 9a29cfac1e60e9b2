"""Write files atomically and exactly once, never replacing another."""

from __future__ import annotations

import contextlib
import os
import tempfile
import time
from pathlib import Path

from stillpath.pipeline.files import sync

__all__ = ["publish", "sync_folder"]

_ABANDONED_S = 3600.0


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
    else:
        target.hardlink_to(temporary)


def _sweep(folder: Path) -> None:
    """Delete old files of killed writers; those of active writers are much younger."""
    oldest = time.time() - _ABANDONED_S
    for part in folder.glob(".*.part"):
        with contextlib.suppress(FileNotFoundError):
            if part.stat().st_mtime < oldest:
                part.unlink()
