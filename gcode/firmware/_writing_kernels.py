"""Kernels that format G1 lines."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stillpath.models.jit import kernel

__all__ = ["format_moves", "printed_feedrate"]


_LEADING = np.array([[*f"{n:<3}".encode(), len(str(n))] for n in range(1000)], np.uint8)
"""Digits of 0 to 999 without leading zeros, and their count."""
_TRAILING = np.array(
    [[*b"%03d" % n, len((b"%03d" % n).rstrip(b"0"))] for n in range(1000)], np.uint8
)
"""The same with all three digits, and their count without trailing zeros."""


@kernel(inline=True)
def printed_feedrate(f: float, whole_from: float = np.inf) -> float:
    """F rounded to the decimals that `format_moves` prints: about six significant digits.

    No decimals from `whole_from` on: there the planner keeps time however F is rounded.
    """
    digits = 10.0 if f >= 100.0 else 1000.0 if f >= 1.0 else 1e5
    if f >= whole_from:
        digits = 1.0
    return max(float(np.round(f * digits)), 1.0) / digits


@kernel(force_inline=True, allocates=False)
def _put_number(buffer: NDArray[np.uint8], at: int, millionths: int) -> int:
    """Write ``millionths / 1e6`` without needless zeros (``.5``); returns the next free byte.

    Three digits at a time, with their count from the table, which avoids mispredicted branches. Up
    to two more bytes are overwritten.
    """
    if millionths < 0:
        buffer[at] = 45
        at += 1
        millionths = -millionths
    whole = millionths // 1_000_000
    fraction = millionths - 1_000_000 * whole
    if whole < 1000:
        if whole or not fraction:
            at = _put_three(buffer, at, _LEADING, whole)
    else:
        power = 1000
        while whole // power >= 1000:
            power *= 1000
        at = _put_three(buffer, at, _LEADING, whole // power)
        while power > 1:
            power //= 1000
            _put_three(buffer, at, _TRAILING, whole // power % 1000)
            at += 3
    if fraction:
        buffer[at] = 46
        thousandths = fraction // 1000
        fraction -= 1000 * thousandths
        shorter = _put_three(buffer, at + 1, _TRAILING, thousandths)
        at = _put_three(buffer, at + 4, _TRAILING, fraction) if fraction else shorter
    return at


@kernel(force_inline=True, allocates=False)
def _put_three(buffer: NDArray[np.uint8], at: int, table: NDArray[np.uint8], number: int) -> int:
    """Write the three bytes of a number below 1000; returns the byte after those that count."""
    for k in range(3):
        buffer[at + k] = table[number, k]
    return at + int(table[number, 3])


@kernel(allocates=False)
def format_moves(
    position: NDArray[np.int64],
    begin: NDArray[np.int64],
    fixed: NDArray[np.bool_],
    fresh: NDArray[np.bool_],
    feedrate: NDArray[np.float64],
    extrude_factor: NDArray[np.float64],
    speed_factor: NDArray[np.float64],
    origin: NDArray[np.int64],
    buffer: NDArray[np.uint8],
    line_end: NDArray[np.int64],
    extruded: NDArray[np.float64],
) -> int:
    """Write one G1 line per move of ours; moves with `fixed` set are left out.

    `position` (n, 4) and `begin` (4,) are in 1e-6 mm; `origin` (n, 3) is where the G-code's zero
    lies. `fresh[i]` says that the modal feedrate is not ours before move i. Extruder values are
    relative and rounded to 1e-5 mm so that the sum never drifts. `line_end[i]` is where the text
    of move i ends, `extruded[i]` the extruder's position [mm] after it as written.
    """
    at = 0
    previous = begin
    rounding = 0.0
    last_f = -1.0
    for i in range(len(position)):
        if fixed[i]:
            previous = position[i]
            last_f = -1.0
            line_end[i] = at
            extruded[i] = 1e-6 * position[i, 3] - 1e-5 * rounding * extrude_factor[i]
            continue
        if fresh[i]:
            last_f = -1.0
        buffer[at] = 71
        buffer[at + 1] = 49
        at += 2
        for axis in range(3):
            if position[i, axis] != previous[axis]:
                buffer[at] = 32
                buffer[at + 1] = 88 + axis
                at = _put_number(buffer, at + 2, position[i, axis] - origin[i, axis])
        wanted = (position[i, 3] - previous[3]) / (10.0 * extrude_factor[i]) + rounding
        written = np.int64(np.round(wanted))
        rounding = wanted - written
        if written != 0:
            buffer[at] = 32
            buffer[at + 1] = 69
            at = _put_number(buffer, at + 2, 10 * int(written))
        f = feedrate[i] / speed_factor[i]
        if f != last_f:
            buffer[at] = 32
            buffer[at + 1] = 70
            at = _put_number(buffer, at + 2, 10 * int(np.round(f * 1e5)))
            last_f = f
        buffer[at] = 10
        at += 1
        previous = position[i]
        line_end[i] = at
        extruded[i] = 1e-6 * position[i, 3] - 1e-5 * rounding * extrude_factor[i]
    return at
