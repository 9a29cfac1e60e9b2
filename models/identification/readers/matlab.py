"""Variables of MATLAB files, versions 5 to 7, from bytes that nobody vouches for."""

from __future__ import annotations

import io
import struct
import warnings
import zlib
from typing import Any, cast

import numpy as np
from scipy.io import loadmat

from models.errors import ModelError

__all__ = ["is_matlab", "matlab_variables"]

_HDF5 = b"\x89HDF\r\n\x1a\n"
_HEADER_BYTES = 128
_COMPRESSED = 15
_LARGEST_BYTES = 4_000_000
_LARGEST_UNPACKED = 32_000_000
_DEEPEST = 4


def is_matlab(content: bytes) -> bool:
    """Whether the bytes begin like a MATLAB file of version 5 or later."""
    return content.startswith((b"MATLAB 5.0 MAT-file", b"MATLAB 7.3 MAT-file", _HDF5))


def matlab_variables(content: bytes, source: str) -> dict[str, Any]:
    """Return the variables: arrays, texts, and structs as dictionaries.

    Raises
    ------
    ModelError
        For version 7.3, damaged files, and files that unpack to more than a model can be.
    """
    if not content.startswith(b"MATLAB 5.0"):
        raise ModelError(
            f"{source}: MATLAB 7.3 files (HDF5) are not read; in MATLAB: "
            "save('model.mat', 'num', 'den', 'Ts', '-v7')"
        )
    if len(content) > _LARGEST_BYTES:
        raise ModelError(
            f"{source}: {len(content)} bytes, more than {_LARGEST_BYTES}: save the model's "
            "variables alone"
        )
    _check_unpacked(content, source)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            loaded = loadmat(cast(Any, io.BytesIO(content)), squeeze_me=True, struct_as_record=True)
    except Exception as error:  # scipy's parser raises whatever the damage leads it to
        raise ModelError(
            f"{source}: damaged MATLAB file ({type(error).__name__}: {error!s:.100}); "
            "save it again with -v7"
        ) from None
    return {name: _plain(value, source, 0) for name, value in loaded.items() if name[:2] != "__"}


def _check_unpacked(content: bytes, source: str) -> None:
    """Unpack every compressed element up to the limit, before a parser believes its sizes."""
    order = ">" if content[126:128] == b"MI" else "<"
    at, left = _HEADER_BYTES, _LARGEST_UNPACKED
    while at + 8 <= len(content):
        kind, size = struct.unpack_from(order + "II", content, at)
        if kind == _COMPRESSED:
            try:
                left -= len(
                    zlib.decompressobj().decompress(content[at + 8 : at + 8 + size], left + 1)
                )
            except zlib.error:
                raise ModelError(
                    f"{source}: damaged MATLAB file (compressed data at byte {at}); save it again"
                ) from None
        if left < 0:
            raise ModelError(
                f"{source}: unpacks to more than {_LARGEST_UNPACKED} bytes: save the model's "
                "variables alone"
            )
        at += 8 + size


def _plain(value: Any, source: str, depth: int) -> Any:
    """Turn structs into dictionaries and one-element cells into their element."""
    if depth > _DEEPEST:
        raise ModelError(f"{source}: structs are nested deeper than {_DEEPEST}")
    if isinstance(value, np.ndarray) and value.dtype == object and value.size == 1:
        return _plain(value.reshape(-1)[0], source, depth + 1)
    if isinstance(value, (np.void, np.ndarray)) and value.dtype.names:
        if value.size != 1:
            return None
        record = value.reshape(-1)[0] if isinstance(value, np.ndarray) else value
        return {name: _plain(record[name], source, depth + 1) for name in value.dtype.names}
    return value
