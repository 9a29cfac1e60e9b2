"""Unpacks measurement files that are stored with gzip or Zstandard."""

from __future__ import annotations

import io
import zlib
from gzip import BadGzipFile, GzipFile

from zstandard import ZstdDecompressor, ZstdError

from stillpath.models.errors import ModelError

__all__ = ["unpacked"]

_GZIP, _ZSTD = b"\x1f\x8b", b"\x28\xb5\x2f\xfd"
_STEP = 4096


def unpacked(content: bytes, name: str, most_bytes: int) -> bytes:
    """Return a file's content as it was before compression; other content as it is.

    Raises
    ------
    ModelError
        If the file is damaged or cut off, or unpacks to more than `most_bytes`.
    """
    try:
        if content.startswith(_GZIP):
            found = GzipFile(fileobj=io.BytesIO(content)).read(most_bytes + 1)
        elif content.startswith(_ZSTD):
            found = _from_zstd(content, most_bytes)
        else:
            return content
    except (BadGzipFile, EOFError, ZstdError, zlib.error) as error:
        raise ModelError(
            f"{name}: the compressed file is damaged or cut off ({error}); copy it again"
        ) from None
    if len(found) > most_bytes:
        raise ModelError(f"{name}: unpacks to more than {most_bytes} bytes, which are not read")
    return found


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
