"""Bytes of a text as kernels see them: single ones, and eight at a time.

These functions are for use inside kernels only. They do not check the array's length; the caller
must ensure that the bytes exist.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.extending import intrinsic

__all__ = ["byte_at", "trailing_zeros", "word_at"]


@intrinsic
def _byte_at(_typing: Any, text: Any, offset: Any) -> Any:
    """Return the byte at an offset, as int64."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        pointer = _pointer(context, builder, signature, args)
        return builder.zext(builder.load(pointer), ir.IntType(64))

    return types.int64(text, offset), generate


@intrinsic
def _word_at(_typing: Any, text: Any, offset: Any) -> Any:
    """Return eight bytes from an offset on as uint64, the first of them lowest."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        pointer = _pointer(context, builder, signature, args)
        word = builder.load(builder.bitcast(pointer, ir.IntType(64).as_pointer()))
        word.align = 1
        return word

    return types.uint64(text, offset), generate


@intrinsic
def _trailing_zeros(_typing: Any, _value: Any) -> Any:
    """Return the number of trailing zero bits of a uint64; 64 for 0."""

    def generate(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 0))

    return types.uint64(types.uint64), generate


def _pointer(context: Any, builder: Any, signature: Any, args: Any) -> Any:
    array = context.make_array(signature.args[0])(context, builder, args[0])
    data = builder.bitcast(array.data, ir.IntType(8).as_pointer())
    return builder.gep(data, [args[1]])


byte_at = cast("Callable[[Any, int], int]", _byte_at)
word_at = cast("Callable[[Any, int], Any]", _word_at)
trailing_zeros = cast("Callable[[Any], Any]", _trailing_zeros)
