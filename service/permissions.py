"""Folders and files that only their owner reads: jobs, machines and digests of keys are in them."""

from __future__ import annotations

import contextlib
import errno
import os
from pathlib import Path

import structlog

__all__ = ["private_file", "private_folder"]

_OTHERS, _NOT_OWNERS = 0o007, 0o077


def private_folder(folder: Path) -> None:
    """Make a folder that only its owner enters.

    One that is there is closed to everybody else, unless somebody has opened it to a group only. On
    Windows folders of a user are his own anyway.
    """
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    _close(folder, 0o700, _OTHERS)


def private_file(path: Path) -> None:
    """Make an empty file that only its owner reads; close one that is there.

    Raises
    ------
    PermissionError
        If it is another user's: a service that was started by root once leaves such files.
    """
    with contextlib.suppress(FileExistsError):
        os.close(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600))
    _close(path, 0o600, _NOT_OWNERS)
    if not os.access(path, os.R_OK | os.W_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))


def _close(path: Path, mode: int, unwanted: int) -> None:
    if os.name != "posix":
        return
    status = path.stat()
    if status.st_mode & unwanted and status.st_uid == os.geteuid():
        # Of some file systems nobody can change that.
        with contextlib.suppress(OSError):
            path.chmod(mode)
            structlog.get_logger("serve").info("closed to others", path=str(path), mode=oct(mode))
