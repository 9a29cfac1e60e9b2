"""Read files named by a user, with a limit on their size."""

from __future__ import annotations

from pathlib import Path

from stillpath.models.errors import ModelError

__all__ = ["read_bytes"]


def read_bytes(path: Path, largest: int, otherwise: str) -> bytes:
    """Read a file.

    Parameters
    ----------
    largest : int
        Most bytes that are read.
    otherwise : str
        Message for a larger file, such as "not a machine".

    Raises
    ------
    ModelError
        The file is larger, or cannot be read.
    """
    try:
        if path.stat().st_size > largest:
            raise ModelError(f"{path}: over {largest} bytes, {otherwise}")
        return path.read_bytes()
    except OSError as error:
        raise ModelError(f"cannot read {path}: {error.strerror}") from None
