"""The compressions of binary G-code: none, deflate and heatshrink with two windows.

Source: libbgcode, doc/specifications.md (26beabf), *Block header*. Deflate data is in the zlib
format (RFC 1950). Heatshrink is that of the library of the same name (window 2^11 or 2^12 bytes,
lookahead 2^4), here through heatshrink2.
"""

from __future__ import annotations

import zlib
from enum import IntEnum

import heatshrink2

__all__ = ["Compression", "compress", "decompress"]

_LOOKAHEAD_BITS = 4


class Compression(IntEnum):
    """Numbers of the format."""

    NONE = 0
    DEFLATE = 1
    HEATSHRINK_11 = 2
    HEATSHRINK_12 = 3


_WINDOW_BITS = {Compression.HEATSHRINK_11: 11, Compression.HEATSHRINK_12: 12}


def compress(data: bytes, how: Compression) -> bytes:
    """Return compressed data."""
    if how is Compression.NONE:
        return data
    if how is Compression.DEFLATE:
        return zlib.compress(data)
    return bytes(
        heatshrink2.compress(data, window_sz2=_WINDOW_BITS[how], lookahead_sz2=_LOOKAHEAD_BITS)
    )


def decompress(data: bytes, how: Compression, size: int) -> bytes:
    """Return decompressed data, `size` bytes of them.

    Raises
    ------
    ValueError
        The data is damaged, or makes another number of bytes. No more than `size` bytes (deflate)
        or eight times the data (heatshrink cannot do better) are ever unpacked.
    """
    if how is Compression.NONE:
        made = data
    elif how is Compression.DEFLATE:
        made = _inflated(data, size)
    else:
        window = _WINDOW_BITS[how]
        made = bytes(heatshrink2.decompress(data, window_sz2=window, lookahead_sz2=_LOOKAHEAD_BITS))
    if len(made) != size:
        raise ValueError(f"unpacks to {len(made)} bytes instead of {size}")
    return made


def _inflated(data: bytes, size: int) -> bytes:
    stream = zlib.decompressobj()
    try:
        made = stream.decompress(data, size + 1)
    except zlib.error as error:
        raise ValueError(f"cannot be unpacked ({error})") from None
    if not stream.eof and len(made) <= size:
        raise ValueError("ends before its deflate stream does")
    return made
