"""Kernel of the Klipper encoder: choose feedrates that end segments on time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stillpath.gcode.firmware._encoding_kernels import MoveLimits
from stillpath.gcode.firmware._writing_kernels import printed_feedrate
from stillpath.models.jit import kernel

__all__ = ["assign_speeds", "expected_braking"]

RUSH = 0.5
"""Shortest time of a segment relative to its planned one."""
MOST_LOST = 0.8
"""Largest loss assumed, relative to a segment's time: the formula is valid only if the ramp fits
into the segment."""
CATCH_UP = 0.1
"""Share of every segment's planned time by which a late stretch catches up."""
_ROUNDS = 3
_SETTLED_MM_S = 1e-4
"""Convergence limit of speeds: F has larger steps."""
_WHOLE_F = 300.0
"""F from which no decimals are written: the next segment makes up for a duration 0.2 % off."""


@kernel(allocates=False)
def expected_braking(
    ours: NDArray[np.bool_],
    stops: NDArray[np.bool_],
    allowed: MoveLimits,
    planned_s: NDArray[np.float64],
    braking_s: NDArray[np.float64],
) -> None:
    """Compute the time lost by braking at the end of each segment of ours if all are on time.

    See `assign_speeds`; `braking_s` is what it starts from.
    """
    length_mm, accel_mm_s2, speed_mm_s = allowed.length_mm, allowed.accel_mm_s2, allowed.speed_mm_s
    for i in range(len(length_mm)):
        braking_s[i] = 0.0
        if not ours[i]:
            continue
        v = min(length_mm[i] / planned_s[i], speed_mm_s[i])
        leave = min(v, _leaving_mm_s(i, ours, stops, allowed, planned_s))
        lost = (v - leave) ** 2 / (2.0 * accel_mm_s2[i] * v)
        braking_s[i] = min(lost, MOST_LOST * planned_s[i])


@kernel(allocates=False)
def assign_speeds(
    ours: NDArray[np.bool_],
    stops: NDArray[np.bool_],
    allowed: MoveLimits,
    end_s: NDArray[np.float64],
    planned_s: NDArray[np.float64],
    correction_s: NDArray[np.float64],
    start_s: float,
    braking_s: NDArray[np.float64],
    feedrate: NDArray[np.float64],
    predicted_s: NDArray[np.float64],
) -> None:
    """Compute feedrates (mm/min, as printed) that reach every end on time.

    Moves with `ours` false have their own speed, moves with `stops` true (extruder alone) start
    and end at rest. `allowed.speed_mm_s` is the speed of a foreign move and the highest one of
    ours.

    The time of a segment is its target end minus the time predicted so far. Klipper loses
    (v1 - v2)^2 / (2 a v) at a step between speeds v1 and v2; that loss is subtracted first. The
    loss by braking at the end of a segment depends on the next one: `braking_s` is the expected one
    or that of the previous pass, and is updated. A stretch starts when the rest before it is over,
    and its times shift accordingly. If a segment cannot be on time, the following ones gradually
    make up for it.
    """
    length_mm, accel_mm_s2, speed_mm_s, junction_mm_s = allowed
    now = start_s
    before = 0.0
    before_accel = 1.0
    pending = -1
    pending_entry = 0.0
    late = owed = 0.0
    count = len(length_mm)
    for i in range(count):
        if not ours[i]:
            entry = 0.0
            if not stops[i] and i > 0 and not stops[i - 1]:
                entry = min(before, junction_mm_s[i], speed_mm_s[i])
            if i > 0 and ours[i - 1]:
                braking = (before - entry) ** 2 / (2.0 * before_accel * before)
                predicted_s[i - 1] += braking - braking_s[i - 1]
                now += braking - braking_s[i - 1]
                braking_s[i - 1] = braking
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
            # The stretch starts when its rest is over.
            late = now + planned_s[i] - end_s[i]
            owed = 0.0
        made_up = min(owed, CATCH_UP * planned_s[i])
        owed -= made_up
        late -= made_up
        available = end_s[i] + late - now - correction_s[i]
        least = max(length_mm[i] / speed_mm_s[i], RUSH * planned_s[i])
        if available < least:
            owed += least - available
            late += least - available
            available = least
        chained = i > 0 and ours[i - 1]
        twice_accel = 2.0 * accel_mm_s2[i]
        # Exclude the braking time given to the segment before, and include this one's own.
        known = braking_s[i] - (braking_s[i - 1] if chained else 0.0)
        brakes = 1.0 / (2.0 * before_accel * before) if before > 0.0 else 0.0
        most_braking = MOST_LOST * planned_s[i - 1] if chained else np.inf
        leave = _leaving_mm_s(i, ours, stops, allowed, planned_s)
        brakable2 = leave * leave + twice_accel * length_mm[i]
        v = length_mm[i] / available
        for _ in range(_ROUNDS):
            corner = min(v, before, junction_mm_s[i])
            lost = known + min((before - corner) ** 2 * brakes, most_braking)
            if v > corner:
                lost += (v - corner) ** 2 / (twice_accel * v)
            last = v
            v = min(length_mm[i] / (available - min(lost, MOST_LOST * available)), speed_mm_s[i])
            # No faster than reached and left within its length, where the formula is still valid.
            fastest2 = min(corner * corner + twice_accel * length_mm[i], brakable2)
            if v * v > fastest2:
                v = np.sqrt(fastest2)
            if abs(v - last) < _SETTLED_MM_S:
                break
        feedrate[i] = printed_feedrate(60.0 * v, _WHOLE_F)
        v = feedrate[i] / 60.0
        corner = min(v, before, junction_mm_s[i])
        loss = min((v - corner) ** 2 / (twice_accel * v), MOST_LOST * available)
        braking = min((before - corner) ** 2 * brakes, most_braking)
        if chained:
            predicted_s[i - 1] += braking - braking_s[i - 1]
            now += braking - braking_s[i - 1]
            braking_s[i - 1] = braking
        else:
            loss += braking
        predicted_s[i] = length_mm[i] / v + loss + correction_s[i] + braking_s[i]
        now += predicted_s[i]
        before = v
        before_accel = accel_mm_s2[i]
    if count > 0 and ours[count - 1]:
        predicted_s[count - 1] += before / (2.0 * before_accel) - braking_s[count - 1]
        braking_s[count - 1] = before / (2.0 * before_accel)


@kernel(allocates=False)
def _leaving_mm_s(
    i: int,
    ours: NDArray[np.bool_],
    stops: NDArray[np.bool_],
    allowed: MoveLimits,
    planned_s: NDArray[np.float64],
) -> float:
    """Largest speed at the end of segment i if the next one is on time."""
    if i + 1 == len(ours) or stops[i + 1]:
        return 0.0
    leave = min(allowed.speed_mm_s[i + 1], allowed.junction_mm_s[i + 1])
    if ours[i + 1]:
        leave = min(leave, allowed.length_mm[i + 1] / planned_s[i + 1])
    return float(leave)


@kernel(allocates=False)
def _trapezoid_s(length: float, entry: float, leave: float, cruise: float, accel: float) -> float:
    """Time of a move that enters, cruises and leaves at the given speeds where it has room."""
    peak2 = 0.5 * (2.0 * accel * length + entry * entry + leave * leave)
    if peak2 <= cruise * cruise:
        return (2.0 * float(np.sqrt(peak2)) - entry - leave) / accel
    ramps = ((cruise - entry) ** 2 + (cruise - leave) ** 2) / (2.0 * accel * cruise)
    return length / cruise + ramps
