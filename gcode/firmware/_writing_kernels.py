"""The text of G1 lines."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from models.jit import kernel

__all__ = ["format_moves", "printed_feedrate"]


@kernel(inline=True)
def printed_feedrate(f: float) -> float:
    """F rounded to the decimals that `format_moves` prints: about six significant digits."""
    digits = 10.0 if f >= 100.0 else 1000.0 if f >= 1.0 else 1e5
    return max(float(np.round(f * digits)), 1.0) / digits


@kernel
def _put_fixed(buffer: NDArray[np.uint8], at: int, value: int, decimals: int) -> int:
    """Write ``value / 10**decimals`` without trailing zeros; returns the next free byte."""
    if value < 0:
        buffer[at] = 45
        at += 1
        value = -value
    scale = 1
    for _ in range(decimals):
        scale *= 10
    whole = value // scale
    fraction = value - whole * scale
    digits = 1
    power = 10
    while whole >= power:
        digits += 1
        power *= 10
    for k in range(digits):
        buffer[at + digits - 1 - k] = 48 + whole % 10
        whole //= 10
    at += digits
    if fraction:
        buffer[at] = 46
        at += 1
        while fraction:
            scale //= 10
            digit = fraction // scale
            buffer[at] = 48 + digit
            at += 1
            fraction -= digit * scale
    return at


@kernel
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
    of move i ends, `extruded[i]` the extruder's position [mm] behind it as written.
    """
    at = 0
    previous = begin.copy()
    rounding = 0.0
    last_f = -1.0
    for i in range(len(position)):
        if fixed[i]:
            previous[:] = position[i]
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
                at = _put_fixed(buffer, at + 2, position[i, axis] - origin[i, axis], 6)
        wanted = (position[i, 3] - previous[3]) / (10.0 * extrude_factor[i]) + rounding
        written = np.int64(np.round(wanted))
        rounding = wanted - written
        if written != 0:
            buffer[at] = 32
            buffer[at + 1] = 69
            at = _put_fixed(buffer, at + 2, int(written), 5)
        f = feedrate[i] / speed_factor[i]
        if f != last_f:
            buffer[at] = 32
            buffer[at + 1] = 70
            at = _put_fixed(buffer, at + 2, int(np.round(f * 1e5)), 5)
            last_f = f
        buffer[at] = 10
        at += 1
        previous[:] = position[i]
        line_end[i] = at
        extruded[i] = 1e-6 * position[i, 3] - 1e-5 * rounding * extrude_factor[i]
    return at
