"""Unpacks measurement files that are stored with gzip or Zstandard."""

from __future__ import annotations

import io
import zlib
from gzip import BadGzipFile, GzipFile

from zstandard import ZstdDecompressor, ZstdError

from stillpath.models.errors import ModelError

__all__ = ["unpacked"]

_GZIP, _ZSTD = b"\x1f\x8b", b"\x28\xb5\x2f\xfd"
_ARCHIVES = {
    b"PK\x03\x04": "zip archive, or a spreadsheet",
    b"7z\xbc\xaf": "7-Zip archive",
    b"Rar!": "RAR archive",
    b"BZh": "file compressed with bzip2",
    b"\xfd7zXZ": "file compressed with xz",
}
_TAR, _TAR_AT = b"ustar", 257
_STEP = 4096


def unpacked(content: bytes, name: str, most_bytes: int) -> bytes:
    """Return a file's content as it was before compression; other content as it is.

    Raises
    ------
    ModelError
        If the file is damaged or cut off, unpacks to more than `most_bytes`, or is an archive of
        files.
    """
    found = content
    try:
        if content.startswith(_GZIP):
            found = GzipFile(fileobj=io.BytesIO(content)).read(most_bytes + 1)
        elif content.startswith(_ZSTD):
            found = _from_zstd(content, most_bytes)
    except (BadGzipFile, EOFError, ZstdError, zlib.error) as error:
        raise ModelError(
            f"{name}: the compressed file is damaged or cut off ({error}); copy it again"
        ) from None
    if found is not content and len(found) > most_bytes:
        raise ModelError(f"{name}: unpacks to more than {most_bytes} bytes, which are not read")
    _check_no_archive(found, name)
    return found


def _check_no_archive(content: bytes, name: str) -> None:
    kind = next((kind for mark, kind in _ARCHIVES.items() if content.startswith(mark)), None)
    if content[_TAR_AT:].startswith(_TAR):
        kind = "tar archive"
    if kind is not None:
        raise ModelError(
            f"{name}: a {kind}, which is not read: unpack it and give the files in it (a "
            "spreadsheet: saved as CSV, with decimal points)"
        )


def _from_zstd(content: bytes, most_bytes: int) -> bytes:
    """Return the content of the frames, or its beginning if that is more than `most_bytes`."""
    found = bytearray()
    at = 0
    while at < len(content) and len(found) <= most_bytes:
        frame = ZstdDecompressor().decompressobj()
        while not frame.eof and len(found) <= most_bytes:
            if at >= len(content):
                raise EOFError("the last frame has no end")
            # A little at a time: a byte may stand for twenty thousand.
            found += frame.decompress(content[at : at + _STEP])
            at += _STEP
        at = min(at, len(content)) - len(frame.unused_data)
    return bytes(found)
