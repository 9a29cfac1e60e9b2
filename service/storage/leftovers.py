"""Remove what a killed process left in a folder of unfinished files."""

from __future__ import annotations

import contextlib
import shutil
import time
from pathlib import Path

__all__ = ["delete_leftovers"]

_OLD_S = 86400.0
"""Files in use are never older than this."""


def delete_leftovers(folder: Path, pattern: str) -> None:
    """Delete the files and folders that fit `pattern` and were not touched for a day."""
    before = time.time() - _OLD_S
    for path in folder.glob(pattern):
        with contextlib.suppress(OSError):  # another process may be deleting it too
            if path.stat().st_mtime < before:
                if path.is_dir():
                    shutil.rmtree(path)
                else:
                    path.unlink()
