"""Valid keys of the storage."""

from __future__ import annotations

__all__ = ["check_key", "check_prefix"]

_LONGEST = 900
"""Of a key, in bytes; S3 takes 1024."""


def check_key(key: str) -> None:
    """Refuse an invalid key, which might be a path to elsewhere.

    Raises
    ------
    ValueError
    """
    parts = key.split("/")
    bad = any(part in ("", ".", "..") for part in parts) or any(c in key for c in "\\:\0\n\r")
    if bad or len(key.encode()) > _LONGEST:
        raise ValueError(
            f"{key!r} is not a key of the storage: names joined by '/', at most {_LONGEST} bytes"
        )


def check_prefix(prefix: str) -> None:
    """Refuse an invalid prefix: it must be a key and ``/``.

    Raises
    ------
    ValueError
    """
    if not prefix.endswith("/"):
        raise ValueError(f"{prefix!r} is not a prefix of keys: it must end with '/'")
    check_key(prefix[:-1])
