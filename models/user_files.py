"""Read files named by a user, with a limit on their size."""

from __future__ import annotations

import json
from codecs import BOM_UTF8, BOM_UTF16_BE, BOM_UTF16_LE
from pathlib import Path
from typing import Any

from pydantic_core import from_json

from stillpath.models.errors import ModelError

__all__ = ["as_json", "as_utf8", "names_a_file", "read_bytes"]


def names_a_file(text: str) -> bool:
    """Return whether `text` is the path of a file rather than a name of ours."""
    return text.lower().endswith(".json") or "/" in text or "\\" in text


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


def as_utf8(content: bytes) -> bytes:
    """Return text as UTF-8 without a byte order mark.

    Editors of Windows write that mark, its PowerShell (``>``) and spreadsheets UTF-16 with one.
    """
    if content[:2] in (BOM_UTF16_LE, BOM_UTF16_BE):
        return content.decode("utf-16", errors="replace").encode()
    return content.removeprefix(BOM_UTF8)


def as_json(content: bytes, source: str) -> Any:
    """Return a JSON document that somebody may have edited by hand; `source` names it in messages.

    Raises
    ------
    ModelError
        It is not JSON, or has two values of a name: readers would pass over one in silence.
    """
    text = as_utf8(content)
    try:
        document = from_json(text)
    except ValueError as error:
        raise ModelError(f"{source}: not JSON ({error})") from None

    def once(pairs: list[tuple[str, Any]]) -> None:
        seen = set()
        for name, _ in pairs:
            if name in seen:
                raise ModelError(f"{source}: {name!r:.80} is there twice; keep one of them")
            seen.add(name)

    json.loads(text, object_pairs_hook=once)
    return document
