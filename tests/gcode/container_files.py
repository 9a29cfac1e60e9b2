"""Containers made from the specifications, apart from the code under test."""

from __future__ import annotations

import hashlib
import io
import re
import struct
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path

import heatshrink2
import pytest

from stillpath.gcode.containers.meatpack import pack
from stillpath.gcode.containers.opening import open_text, rewriting
from stillpath.gcode.errors import GcodeError

__all__ = [
    "binary",
    "block",
    "blocks",
    "members",
    "normal",
    "package",
    "refused",
    "rewritten",
    "text_of",
]

_METADATA = (
    (0, 0, b"Producer=PrusaSlicer 2.9.4\nProduced on=2026-01-02 at 03:04:05 UTC\n"),
    (3, 0, b"printer_model=MK4\n"),
    (4, 1, b"estimated printing time (normal mode)=1m 8s\n"),
    (2, 1, b"layer_height=0.2\nstart_gcode=G28\\nG1 X1\n"),
)
_THUMBNAIL = bytes(range(256)) * 3
_BEFORE_WORD = re.compile(rb"(?<=[^ ])(?=[ACEFGHIJPRSWXYZ])")


def block(
    kind: int,
    data: bytes,
    *,
    compression: int = 0,
    parameters: bytes = b"\0\0",
    checked: bool = True,
    size: int | None = None,
) -> bytes:
    packed = _compressed(data, compression)
    header = struct.pack("<HHI", kind, compression, len(data) if size is None else size)
    if compression:
        header += struct.pack("<I", len(packed))
    whole = header + parameters + packed
    return whole + struct.pack("<I", zlib.crc32(whole)) if checked else whole


def binary(
    text: bytes | list[bytes],
    *,
    compression: int = 3,
    encoding: int = 2,
    checked: bool = True,
    version: int = 1,
    checksum: int | None = None,
) -> bytes:
    """A file with metadata, a thumbnail, and a block for each text."""
    parts = [struct.pack("<4sIH", b"GCDE", version, checked if checksum is None else checksum)]
    parts += [block(k, d, compression=c, checked=checked) for k, c, d in _METADATA[:2]]
    parts.append(block(5, _THUMBNAIL, parameters=struct.pack("<3H", 0, 16, 9), checked=checked))
    parts += [block(k, d, compression=c, checked=checked) for k, c, d in _METADATA[2:]]
    for piece in [text] if isinstance(text, bytes) else text:
        parts.append(
            block(
                1,
                pack(piece) if encoding else piece,
                compression=compression,
                parameters=struct.pack("<H", encoding),
                checked=checked,
            )
        )
    return b"".join(parts)


def blocks(file: bytes) -> Iterator[tuple[int, int, bytes, bytes]]:
    """Type, compression, parameters and all bytes of each block; checksums are asserted."""
    checked = struct.unpack_from("<H", file, 8)[0]
    at = 10
    while at < len(file):
        kind, compression, stored = struct.unpack_from("<HHI", file, at)
        body = at + 8
        if compression:
            (stored,) = struct.unpack_from("<I", file, body)
            body += 4
        data = body + (6 if kind == 5 else 2)
        end = data + stored
        if checked:
            assert struct.unpack_from("<I", file, end)[0] == zlib.crc32(file[at:end])
            end += 4
        yield kind, compression, file[body:data], file[at:end]
        at = end


def normal(text: bytes) -> bytes:
    """What MeatPack leaves of a text: no empty lines, a space before each word of a G line."""
    lines = [
        _BEFORE_WORD.sub(b" ", line) if line.startswith(b"G") else line
        for line in text.split(b"\n")
    ]
    ends = text.endswith(b"\n")
    return b"\n".join(line for line in lines if line) + (b"\n" if ends and any(lines) else b"")


def package(
    plates: dict[int, bytes], *, upper: bool = True, more: dict[str, bytes] | None = None
) -> bytes:
    """Bytes of a sliced package."""
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("[Content_Types].xml", b"<Types/>")
        archive.writestr("3D/3dmodel.model", b"<model/>" * 50)
        for number, text in plates.items():
            digest = hashlib.md5(text, usedforsecurity=False).hexdigest()
            archive.writestr(f"Metadata/plate_{number}.gcode", text)
            name = f"Metadata/plate_{number}.gcode.md5"
            archive.writestr(name, digest.upper() if upper else digest + "\n")
            archive.writestr(f"Metadata/plate_{number}.png", _THUMBNAIL)
        for name, data in (more or {}).items():
            archive.writestr(name, data)
        archive.comment = b"sliced"
    return made.getvalue()


def members(file: bytes) -> dict[str, bytes]:
    """Names and contents of a package."""
    with zipfile.ZipFile(io.BytesIO(file)) as archive:
        assert archive.testzip() is None
        return {info.filename: archive.read(info) for info in archive.infolist()}


def text_of(file: bytes, folder: Path, **plate: int) -> bytes:
    path = folder / "any.name"
    path.write_bytes(file)
    with open_text(path, **plate) as container:
        return container.text.read()


def rewritten(file: bytes, text: bytes, folder: Path, **plate: int) -> bytes:
    source, target = folder / "in", folder / "out"
    source.write_bytes(file)
    with (
        open_text(source, **plate) as container,
        rewriting(container, target, name=target) as made,
    ):
        made.write(text)
    return target.read_bytes()


def refused(file: bytes, folder: Path, words: str, **plate: int) -> None:
    with pytest.raises(GcodeError, match=words):
        text_of(file, folder, **plate)


def _compressed(data: bytes, how: int) -> bytes:
    if how in (2, 3):
        return bytes(heatshrink2.compress(data, window_sz2=9 + how, lookahead_sz2=4))
    return zlib.compress(data) if how == 1 else data
