"""Loops of the Klipper encoder: speeds that land on time, and the text of G1 lines."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from models.jit import kernel

__all__ = ["assign_speeds", "format_moves", "merge_still"]


RUSH = 0.5
"""No segment is hurried to less than this part of its planned time."""


@kernel
def merge_still(
    position: NDArray[np.int64],
    end_s: NDArray[np.float64],
    group: NDArray[np.int64],
    begin: NDArray[np.int64],
    keep: NDArray[np.bool_],
) -> None:
    """Drop segments that round to no motion; their time and filament go to a neighbour.

    `position` (n, 4) in nanometres-like integers (1e-6 mm) is edited in place; `begin` (groups, 4)
    holds where each group starts.
    """
    count = len(end_s)
    last_kept = -1
    previous = begin[0].copy()
    for i in range(count):
        if i == 0 or group[i] != group[i - 1]:
            previous[:] = begin[group[i]]
            last_kept = -1
        still = (
            position[i, 0] == previous[0]
            and position[i, 1] == previous[1]
            and position[i, 2] == previous[2]
        )
        final = i + 1 == count or group[i + 1] != group[i]
        if still and not final:
            keep[i] = False
        elif still and last_kept >= 0:
            # Nothing follows in this stretch: the segment before takes filament and time.
            keep[i] = False
            position[last_kept, 3] = position[i, 3]
            end_s[last_kept] = end_s[i]
        elif still and position[i, 3] == previous[3]:
            keep[i] = False
        else:
            keep[i] = True
            last_kept = i
            previous[:] = position[i]


@kernel
def assign_speeds(
    ours: NDArray[np.bool_],
    stops: NDArray[np.bool_],
    length_mm: NDArray[np.float64],
    end_s: NDArray[np.float64],
    planned_s: NDArray[np.float64],
    speed_mm_s: NDArray[np.float64],
    accel_mm_s2: NDArray[np.float64],
    junction_mm_s: NDArray[np.float64],
    correction_s: NDArray[np.float64],
    start_s: float,
    feedrate: NDArray[np.float64],
    predicted_s: NDArray[np.float64],
) -> None:
    """Feedrates (mm/min, as they will be printed) that reach every end at its time.

    Moves with `ours` false have their own speed, moves with `stops` true (extruder alone) start
    and end at rest. `speed_mm_s` is the speed of a foreign move and the highest one of ours;
    `junction_mm_s[i]` limits the speed between i - 1 and i.

    The time still to spend is the target minus the time predicted so far. Klipper loses
    (v1 - v2)^2 / (2 a v) at a step between speeds v1 and v2; that loss is taken off first. A
    stretch starts when the rest before it is over: its times move with that.
    """
    now = start_s
    before = 0.0
    before_accel = 1.0
    pending = -1
    pending_entry = 0.0
    late = 0.0
    count = len(length_mm)
    for i in range(count):
        if not ours[i]:
            entry = 0.0
            if not stops[i] and i > 0 and not stops[i - 1]:
                entry = min(before, junction_mm_s[i], speed_mm_s[i])
            if i > 0 and ours[i - 1]:
                loss = (before - entry) ** 2 / (2.0 * before_accel * before)
                predicted_s[i - 1] += loss
                now += loss
            if not stops[i] and i + 1 < count and ours[i + 1]:
                pending = i
                pending_entry = entry
                continue
            leave = 0.0
            if not stops[i] and i + 1 < count and not stops[i + 1]:
                leave = min(junction_mm_s[i + 1], speed_mm_s[i], speed_mm_s[i + 1])
            predicted_s[i] = correction_s[i] + _trapezoid_s(
                length_mm[i], entry, leave, speed_mm_s[i], accel_mm_s2[i]
            )
            now += predicted_s[i]
            before = leave
            before_accel = accel_mm_s2[i]
            continue

        if pending >= 0:
            nominal = min(length_mm[i] / planned_s[i], speed_mm_s[i])
            leave = min(nominal, junction_mm_s[i], speed_mm_s[pending])
            predicted_s[pending] = correction_s[pending] + _trapezoid_s(
                length_mm[pending],
                pending_entry,
                leave,
                speed_mm_s[pending],
                accel_mm_s2[pending],
            )
            now += predicted_s[pending]
            before = leave
            before_accel = accel_mm_s2[pending]
            pending = -1
        if i > 0 and not ours[i - 1]:
            # The stretch starts when its rest is over, whenever that is.
            late = now + planned_s[i] - end_s[i]
        available = end_s[i] + late - now - correction_s[i]
        least = max(length_mm[i] / speed_mm_s[i], RUSH * planned_s[i])
        if available < least:
            late += least - available
            available = least
        v = length_mm[i] / available
        loss = 0.0
        for _ in range(3):
            corner = min(v, before, junction_mm_s[i])
            loss = (v - corner) ** 2 / (2.0 * accel_mm_s2[i] * v)
            if before > corner:
                loss += (before - corner) ** 2 / (2.0 * before_accel * before)
            loss = min(loss, 0.8 * available)
            v = min(length_mm[i] / (available - loss), speed_mm_s[i])
        feedrate[i] = _printed(60.0 * v)
        v = feedrate[i] / 60.0
        predicted_s[i] = length_mm[i] / v + loss + correction_s[i]
        now += predicted_s[i]
        before = v
        before_accel = accel_mm_s2[i]


@kernel
def _trapezoid_s(length: float, entry: float, leave: float, cruise: float, accel: float) -> float:
    """Time of a move that enters, cruises and leaves at the given speeds where it has room."""
    peak2 = 0.5 * (2.0 * accel * length + entry * entry + leave * leave)
    if peak2 <= cruise * cruise:
        return (2.0 * float(np.sqrt(peak2)) - entry - leave) / accel
    ramps = ((cruise - entry) ** 2 + (cruise - leave) ** 2) / (2.0 * accel * cruise)
    return length / cruise + ramps


@kernel(inline=True)
def _printed(f: float) -> float:
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
