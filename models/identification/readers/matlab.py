"""Variables of MATLAB files, versions 5 to 7, from untrusted bytes.

Source: MathWorks, "MAT-File Format" (R2019b), level 5. scipy.io.loadmat reads the same files,
but believes their sizes: damaged bytes can end the whole process there (scipy 1.17).
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillpath.models.errors import ModelError

__all__ = ["is_matlab", "matlab_variables"]

_HDF5 = b"\x89HDF\r\n\x1a\n"
_HEADER_BYTES = 128
_LARGEST_BYTES = 4_000_000
_LARGEST_UNPACKED = 32_000_000
_DEEPEST = 6
_MOST_FIELDS = 200
_MATRIX, _COMPRESSED = 14, 15
_CELL, _STRUCT = 1, 2
_NUMERIC = range(6, 16)
"""Classes of real arrays: double, single, and the integers."""
_DTYPES = {
    1: "i1",
    2: "u1",
    3: "i2",
    4: "u2",
    5: "i4",
    6: "u4",
    7: "f4",
    9: "f8",
    12: "i8",
    13: "u8",
}
_COMPLEX_FLAG = 0x08


def is_matlab(content: bytes) -> bool:
    """Whether the bytes begin like a MATLAB file of version 5 or later."""
    return content.startswith((b"MATLAB 5.0 MAT-file", b"MATLAB 7.3 MAT-file", _HDF5))


def matlab_variables(content: bytes, source: str) -> dict[str, Any]:
    """Return the variables: numeric arrays, and structs of one element as dictionaries.

    A cell of one element counts as that element; all else (texts, objects, sparse matrices)
    is None.

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
    order = ">" if content[126:128] == b"MI" else "<"
    variables: dict[str, Any] = {}
    left = _LARGEST_UNPACKED
    try:
        for kind, data in _elements(content[_HEADER_BYTES:], order):
            if kind == _COMPRESSED:
                data = zlib.decompressobj().decompress(data, left + 1)
                left -= len(data)
                if left < 0:
                    raise ModelError(
                        f"{source}: unpacks to more than {_LARGEST_UNPACKED} bytes: save the "
                        "model's variables alone"
                    )
                kind, data = next(_elements(data, order), (0, b""))
            if kind == _MATRIX:
                array = _array(data, order, 0)
                variables[array.name] = array.value
    except (_Damaged, zlib.error) as error:
        raise ModelError(f"{source}: damaged MATLAB file ({error}); save it again") from None
    return variables


class _Damaged(Exception):
    """Sizes or kinds that cannot be."""


class _Named(NamedTuple):
    name: str
    value: Any


def _elements(data: bytes, order: str) -> Iterator[tuple[int, bytes]]:
    """Yield kind and bytes of the elements; small ones hold their bytes in their tag."""
    at = 0
    while at + 8 <= len(data):
        kind, size = struct.unpack_from(order + "II", data, at)
        if kind >> 16:
            kind, size = kind & 0xFFFF, kind >> 16
            if size > 4:
                raise _Damaged(f"small element of {size} bytes")
            yield kind, data[at + 4 : at + 4 + size]
            at += 8
            continue
        start = at + 8
        if start + size > len(data):
            raise _Damaged(f"{size} bytes announced, {len(data) - start} there")
        yield kind, data[start : start + size]
        at = start + size + (0 if kind == _COMPRESSED else -size % 8)


def _array(data: bytes, order: str, depth: int) -> _Named:
    """Read one array: flags, dimensions, name, then what its class asks for."""
    if depth > _DEEPEST:
        raise _Damaged(f"arrays nested deeper than {_DEEPEST}")
    parts = _elements(data, order)
    flags = _numbers(parts, order)
    if len(flags) == 0:
        return _Named("", np.zeros(0))
    kind, is_complex = int(flags[0]) & 0xFF, bool(int(flags[0]) >> 8 & _COMPLEX_FLAG)
    shape = tuple(int(size) for size in _numbers(parts, order))
    name = _bytes(parts).decode("latin-1")
    if not shape or min(shape) < 0:
        raise _Damaged(f"dimensions {shape}")
    if kind in _NUMERIC:
        return _Named(name, _numeric(parts, order, shape, is_complex))
    single = math.prod(shape) == 1
    if kind == _STRUCT and single:
        return _Named(name, _fields(parts, order, depth))
    if kind == _CELL and single:
        return _Named(name, _inner(parts, order, depth))
    return _Named(name, None)


def _numeric(
    parts: Iterator[tuple[int, bytes]], order: str, shape: tuple[int, ...], is_complex: bool
) -> NDArray[Any]:
    values: NDArray[Any] = _numbers(parts, order)
    if is_complex:
        imaginary = _numbers(parts, order)
        if len(imaginary) != len(values):
            raise _Damaged("imaginary parts are missing")
        # Not by a sum: an infinite part would make the other one NaN.
        values = np.column_stack([values, imaginary]).view(np.complex128)[:, 0]
    if len(values) != math.prod(shape):
        raise _Damaged(f"{len(values)} numbers for an array of {shape}")
    return np.squeeze(values.reshape(shape, order="F"))


def _fields(parts: Iterator[tuple[int, bytes]], order: str, depth: int) -> dict[str, Any]:
    length = _numbers(parts, order)
    packed = _bytes(parts)
    width = int(length[0]) if len(length) else 0
    if width <= 0 or len(packed) > width * _MOST_FIELDS:
        raise _Damaged("names of fields")
    names = [packed[i : i + width] for i in range(0, len(packed), width)]
    return {name.split(b"\0")[0].decode("latin-1"): _inner(parts, order, depth) for name in names}


def _inner(parts: Iterator[tuple[int, bytes]], order: str, depth: int) -> Any:
    kind, data = next(parts, (0, b""))
    if kind != _MATRIX:
        raise _Damaged(f"kind {kind} where an array is due")
    return _array(data, order, depth + 1).value


def _bytes(parts: Iterator[tuple[int, bytes]]) -> bytes:
    return next(parts, (0, b""))[1]


def _numbers(parts: Iterator[tuple[int, bytes]], order: str) -> NDArray[np.float64]:
    kind, data = next(parts, (1, b""))
    if kind not in _DTYPES:
        raise _Damaged(f"kind {kind} where numbers are due")
    dtype = np.dtype(order + _DTYPES[kind])
    if len(data) % dtype.itemsize:
        raise _Damaged(f"{len(data)} bytes of {dtype.itemsize}-byte numbers")
    values: NDArray[np.float64] = np.frombuffer(data, dtype).astype(np.float64)
    return values
