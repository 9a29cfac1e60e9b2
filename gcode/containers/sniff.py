"""Detects the kind of a file from its first bytes; its name does not count.

Slicers hand post-processing scripts files without an extension or with one of their own.
"""

from __future__ import annotations

import re
from enum import Enum
from pathlib import Path

__all__ = ["Kind", "foreign", "kind_named", "kind_of", "sniff"]


class Kind(Enum):
    """The containers of G-code, each with its media type."""

    TEXT = "text/x.gcode"
    BGCODE = "application/gcode+binary"
    THREEMF = "model/3mf"


_MAGICS = {
    b"GCDE": Kind.BGCODE,
    b"PK\x03\x04": Kind.THREEMF,
    b"PK\x05\x06": Kind.THREEMF,
}
_FOREIGN = {
    b"\x89PNG": "a PNG picture",
    b"\xff\xd8\xff": "a JPEG picture",
    b"%PDF": "a PDF document",
    b"solid": "an STL model, not sliced yet",
    b"<?xml": "an XML file",
    b"\x1f\x8b\x08": "compressed by gzip",
    b"7z\xbc\xaf": "a 7z archive",
    b"Rar!": "a RAR archive",
    b"\x7fELF": "a program",
    b"xgcode ": "FlashForge's .gx (G-code behind a binary header)",
}
_SLICER_WROTE = "give the file that the slicer wrote"
_REMEDIES = {b"xgcode ": "let the slicer save plain G-code (.gcode)"}
_JSON = re.compile(rb'(\xef\xbb\xbf)?\s*(\{\s*"|\[\s*["\d\[{-])')
_STL_HEAD_BYTES = 84
"""Header of a binary STL model: 80 arbitrary bytes and the number of facets in four."""
_STL_FACET_BYTES = 50
_SUFFIXES = {
    ".gcode": Kind.TEXT,
    ".gco": Kind.TEXT,
    ".g": Kind.TEXT,
    ".nc": Kind.TEXT,
    ".bgcode": Kind.BGCODE,
    ".bgc": Kind.BGCODE,
    ".3mf": Kind.THREEMF,
}


def sniff(path: Path) -> Kind:
    """Return the kind of a file by its magic number; text if it has none."""
    with path.open("rb") as file:
        return kind_of(file.read(4))


def kind_of(head: bytes) -> Kind:
    """Return the kind of a file by its first four bytes; text if they are no magic number."""
    return _MAGICS.get(head[:4], Kind.TEXT)


def foreign(path: Path) -> tuple[str, str] | None:
    """Return what a file is that is certainly no print file, and the remedy; None: it may be."""
    with path.open("rb") as file:
        head = file.read(_STL_HEAD_BYTES)
    size = path.stat().st_size
    if size == 0:
        return "empty", _SLICER_WROTE
    if size == _STL_HEAD_BYTES + _STL_FACET_BYTES * int.from_bytes(head[-4:], "little"):
        return _FOREIGN[b"solid"], _SLICER_WROTE
    if _JSON.match(head):
        return "JSON, such as a machine or a report", _SLICER_WROTE
    magic = next((magic for magic in _FOREIGN if head.startswith(magic)), None)
    return None if magic is None else (_FOREIGN[magic], _REMEDIES.get(magic, _SLICER_WROTE))


def kind_named(path: Path) -> Kind | None:
    """Return the kind of an output file by its name; None if the name does not show it."""
    return _SUFFIXES.get(path.suffix.lower())
