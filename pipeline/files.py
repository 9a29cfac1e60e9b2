"""Files that are written whole or not at all, and where kept things lie."""

from __future__ import annotations

import contextlib
import errno
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

__all__ = ["Discarding", "default_cache_dir", "replacing"]

_NAME_PART = 40
"""Characters of a name that its temporary file carries on; names have at most 255 bytes."""


class Discarding:
    """A file to write to that keeps nothing."""

    def write(self, data: bytes) -> int:
        """Take bytes; return how many."""
        return len(data)


@contextlib.contextmanager
def replacing(target: Path) -> Iterator[Path]:
    """Yield a temporary file beside `target` that takes its place when the block ends well.

    Raises
    ------
    OSError
        The folder or the disk does not take it; or `target` is a device or a pipe, which must not
        be replaced by a file.
    """
    if target.exists() and not target.is_file():
        raise OSError(errno.EINVAL, "is no regular file; name one to write", str(target))
    prefix = f".{target.name[:_NAME_PART]}."
    handle, name = tempfile.mkstemp(dir=target.parent, prefix=prefix, suffix=".part")
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        mode = target.stat().st_mode if target.exists() else 0o666 & ~_umask()
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        with contextlib.suppress(OSError):  # file systems of memory cards know no modes
            temporary.chmod(mode & 0o7777)
        temporary.replace(target)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.filename is None:
            error.filename = str(target)  # a full disk does not say which
        raise


def default_cache_dir() -> Path:
    """Return the user's folder for what is worth keeping between jobs."""
    base = os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA")
    return (Path(base) if base else Path.home() / ".cache") / "stillpath"


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
