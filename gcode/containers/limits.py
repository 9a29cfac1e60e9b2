"""Limits of the size to which a container may unpack, so that a small file cannot fill the disk."""

from __future__ import annotations

from pathlib import Path

from stillpath.gcode.errors import GcodeError

__all__ = ["BLOCK_BYTES", "check_unpacked", "largest_unpacked"]

BLOCK_BYTES = 1 << 24
"""Largest block that is taken into memory as a whole; slicers write blocks of 64 KiB."""

_RATIO = 100
_ALWAYS_ALLOWED = 1 << 26
_NEVER_MORE = 1 << 32


def largest_unpacked(container: Path) -> int:
    """Return the bytes that a container may unpack to.

    G-code is 3 to 15 times its packed size; 100 times, and at least 64 MiB, leaves room, and no
    print needs more than 4 GiB.
    """
    return min(max(_RATIO * container.stat().st_size, _ALWAYS_ALLOWED), _NEVER_MORE)


def check_unpacked(size: int, largest: int) -> None:
    """Raise `GcodeError` when a container unpacks to more than it may."""
    if size > largest:
        raise GcodeError(
            f"the file unpacks to more than {largest >> 20} MiB, more than any print needs: it is "
            "damaged or made to fill the disk; export plain G-code if the file is genuine"
        )
