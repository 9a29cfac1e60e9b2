"""Atomic writing of files, and the cache that is kept between jobs."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import secrets
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

__all__ = [
    "Discarding",
    "check_unchanged",
    "default_cache_dir",
    "kept",
    "replacing",
    "result_name",
    "sync",
]

T = TypeVar("T")

_NAME_PART = 40
"""Characters of the target's name in that of its temporary file (names: 255 bytes at most)."""
_WAITS_S = (0.1, 0.2, 0.5, 1.0, 2.0) if os.name == "nt" else ()
"""Windows lets nobody rename a file that a virus scanner reads, which lasts for moments."""


class Discarding:
    """A file that discards what is written to it."""

    def write(self, data: bytes) -> int:
        """Discard bytes; return how many."""
        return len(data)


@contextlib.contextmanager
def replacing(target: Path, mode: int | None = None) -> Iterator[Path]:
    """Yield a temporary file beside `target` that takes its place when the block ends well.

    On Linux the file has no name until it is complete (the path goes through ``/proc``), so that a
    killed process leaves nothing behind. Elsewhere a hidden ``.part`` file may remain.

    Parameters
    ----------
    mode : int, optional
        Permissions of the file; otherwise those of the replaced or of any new file.

    Raises
    ------
    OSError
        The folder or disk refuses it, or `target` is a device or a pipe, which must not be
        replaced by a file.
    """
    if target.exists() and not target.is_file():
        raise OSError(errno.EINVAL, "is not a regular file; name one to write", str(target))
    if mode is None and target.exists():
        mode = target.stat().st_mode
    # Of a new file the system takes off what the umask says: to ask for it would change it for all
    # threads.
    first_mode = 0o666 if mode is None else 0o600
    handle = _open_unnamed(target.parent, first_mode)
    temporary = _named(target, first_mode) if handle is None else _path_of(handle)
    try:
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        if mode is not None:
            with contextlib.suppress(OSError):  # file systems of memory cards have no modes
                temporary.chmod(mode & 0o7777)
        if handle is not None:
            temporary = _link(handle, target)
        _put(temporary, target)
    except BaseException as error:
        with contextlib.suppress(OSError):  # an unnamed file cannot and need not be removed
            temporary.unlink(missing_ok=True)
        if isinstance(error, OSError) and (error.filename is None or error.filename2 is not None):
            # Of a full disk no name, of copying and renaming that of the temporary file or source.
            error.filename = str(target)
        raise
    finally:
        if handle is not None:
            os.close(handle)


def _put(temporary: Path, target: Path) -> None:
    for wait_s in _WAITS_S:
        with contextlib.suppress(PermissionError):
            temporary.replace(target)
            return
        time.sleep(wait_s)
    temporary.replace(target)


def check_unchanged(source: Path, began: os.stat_result) -> None:
    """Refuse to mix what was read with what is there now, or to replace what nobody read.

    Raises
    ------
    OSError
        EBUSY if the file is not as it was when its state `began` was taken.
    """
    now = source.stat()
    if (now.st_size, now.st_mtime_ns) != (began.st_size, began.st_mtime_ns):
        raise OSError(
            errno.EBUSY,
            "another program changed the file while it was processed, so nothing was written; "
            "run it again",
            str(source),
        )


def sync(path: Path) -> None:
    """Wait until a file or the names in a folder, where it can be done, are on the disk."""
    if os.name == "nt" and path.is_dir():
        return  # Windows opens no folders
    # Windows syncs only what may be written to.
    handle = os.open(path, os.O_RDWR if os.name == "nt" else os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as error:
        # Of a folder, file systems that know no sync of one: VirtualBox's shared folders, say.
        if error.errno != errno.EINVAL or not path.is_dir():
            raise
    finally:
        os.close(handle)


def result_name(name: str) -> str:
    """Return what the result of a file is called: ``part.stillpath.gcode``.

    Printers tell a sliced package by both of its suffixes.
    """
    suffix = ".gcode.3mf" if name.lower().endswith(".gcode.3mf") else Path(name).suffix
    return f"{name[: len(name) - len(suffix)]}.stillpath{suffix or '.gcode'}"


def _part(target: Path) -> Path:
    return target.with_name(f".{target.name[:_NAME_PART]}.{secrets.token_hex(4)}.part")


def _named(target: Path, mode: int) -> Path:
    name = _part(target)
    try:
        os.close(os.open(name, os.O_CREAT | os.O_EXCL | os.O_RDWR, mode))
    except OSError as error:
        error.filename = str(target.parent)  # nobody knows the temporary file
        raise
    return name


def _open_unnamed(folder: Path, mode: int) -> int | None:
    """Open a file without a name; None where that is not supported."""
    if sys.platform != "linux":
        return None
    try:
        handle = os.open(folder, os.O_TMPFILE | os.O_RDWR | os.O_CLOEXEC, mode)
    except OSError:
        return None
    if _path_of(handle).exists():
        return handle
    os.close(handle)  # no /proc
    return None


def _path_of(handle: int) -> Path:
    return Path(f"/proc/{os.getpid()}/fd/{handle}")


def _link(handle: int, target: Path) -> Path:
    """Link an unnamed file beside `target`, as a link cannot replace an existing file."""
    name = _part(target)
    # Python follows links only if given a directory handle, which absolute paths ignore.
    os.link(_path_of(handle), name, src_dir_fd=handle, follow_symlinks=True)
    return name


def kept(path: Path, read: Callable[[Any], T], make: Callable[[], T]) -> T:
    """Return the content of a JSON file; one that is missing or unreadable is made anew.

    Parameters
    ----------
    path : Path
        Written whole or, where the folder or disk refuses it, not at all.
    read : callable
        Turns the JSON document into the value; raises ValueError, TypeError or KeyError if it
        cannot.
    make : callable
        Makes the value, a dataclass of numbers, strings and arrays.
    """
    with contextlib.suppress(OSError, ValueError, TypeError, KeyError, AttributeError):
        return read(json.loads(path.read_text(encoding="utf-8")))
    made = make()
    text = json.dumps(asdict(made), default=lambda array: array.tolist())  # type: ignore[call-overload]
    with contextlib.suppress(OSError):  # no room, no right: it is made again next time
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as temporary:
            temporary.write_text(text, encoding="utf-8")
    return made


def default_cache_dir() -> Path:
    """Return the user's folder for results that are kept between jobs."""
    base = os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA")
    return (Path(base) if base else Path.home() / ".cache") / "stillpath"
