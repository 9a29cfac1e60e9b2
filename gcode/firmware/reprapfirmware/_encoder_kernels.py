"""Kernels of the RepRapFirmware encoder: speeds that end on time, segments within the queue.

Rules of the times: src/Movement/DDA.cpp RecalculateMove, 3.6.0-beta.2, 2024-11.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stillpath.gcode.firmware._encoding_kernels import MoveLimits
from stillpath.gcode.firmware._writing_kernels import printed_feedrate
from stillpath.gcode.firmware.reprapfirmware._planner_kernels import SHORT_CLOCKS
from stillpath.models.jit import kernel

__all__ = ["assign_speeds", "keep_apart"]

RUSH = 0.5
"""Shortest time of a segment relative to its planned one."""
_ROUNDS = 4
_OVER, _UNDER = 1.05, 1.5
"""Shares of the band in which a peak is cut off."""


@kernel
def assign_speeds(
    ours: NDArray[np.bool_],
    allowed: MoveLimits,
    end_s: NDArray[np.float64],
    planned_s: NDArray[np.float64],
    missed_s: NDArray[np.float64],
    start_s: float,
    clock_hz: float,
    feedrate: NDArray[np.float64],
    predicted_s: NDArray[np.float64],
) -> None:
    """Compute feedrates (mm/min, as printed) that reach every end on time.

    Moves with `ours` false have their own speed: `allowed.speed_mm_s` is that, and the highest
    speed of ours. The duration of a move depends on the speed of the next one, so both are chosen
    together. A stretch starts when the rest before it is over, and its times shift accordingly.

    The firmware cuts off low peaks of speed. If that would cost more distance than giving a move
    the speed of a neighbour, it gets that.

    Parameters
    ----------
    missed_s : ndarray
        Extra time of each move over the prediction in the previous pass.
    clock_hz : float
        Of the motors' steps. Phases last whole clocks; rounded by themselves, those of a long
        stretch would add up to some tenths of a ms.
    """
    length_mm, accel_mm_s2, speed_mm_s, junction_mm_s = allowed
    short_s = SHORT_CLOCKS / clock_hz
    count = len(length_mm)
    begin = start_s  # of the move before
    enter_before = 0.0
    before = 0.0  # its speed
    late = 0.0
    for i in range(count):
        v = min(speed_mm_s[i], length_mm[i] / planned_s[i]) if ours[i] else speed_mm_s[i]
        fastest = 0.0  # at which the move can begin
        if i > 0:
            reach2 = enter_before * enter_before + 2.0 * accel_mm_s2[i - 1] * length_mm[i - 1]
            fastest = min(before, junction_mm_s[i], float(np.sqrt(reach2)))
        # By how much a peak of speed must stand out.
        band = accel_mm_s2[i] * short_s
        band_before = accel_mm_s2[i - 1] * short_s if i > 0 else 0.0
        # As the newest of the ring a move begins so that it can brake to rest within its length. If
        # that cuts off the peak of the move before, the look-ahead does not raise it later.
        brakes = float(np.sqrt(2.0 * accel_mm_s2[i] * length_mm[i]))
        if enter_before < brakes < fastest and before < brakes + band_before:
            fastest = brakes
        band_next = 0.0
        following = 0.0  # what the next move will ask for
        if i + 1 < count and ours[i + 1]:
            following = length_mm[i + 1] / planned_s[i + 1]
            band_next = accel_mm_s2[i + 1] * short_s
        enter = 0.0
        lasts = 0.0
        for k in range(_ROUNDS + 1):
            enter = min(v, fastest)
            lasts = 0.0
            if i > 0:
                lasts = missed_s[i - 1] + _lasts_s(
                    length_mm[i - 1], enter_before, enter, before, accel_mm_s2[i - 1], clock_hz
                )
            if not ours[i] or k == _ROUNDS:
                break
            now = begin + lasts
            if i > 0 and not ours[i - 1]:
                # The stretch starts when its rest is over, whenever that is.
                late = now + planned_s[i] - end_s[i]
            available = end_s[i] + late - now - missed_s[i]
            least = max(length_mm[i] / speed_mm_s[i], RUSH * planned_s[i])
            wanted = _speed(length_mm[i], max(available, least), fastest, accel_mm_s2[i])
            wanted = min(wanted, speed_mm_s[i])
            v = wanted
            least_cost = np.inf
            # Just high enough not to be cut off, and room under the next move's peak.
            high = fastest + _OVER * band
            low = max(following - _UNDER * band_next, 0.5 * wanted)
            for choice in (wanted, before, following, high, low):
                # As it will be printed: a digit decides whether a peak is cut off.
                choice = printed_feedrate(60.0 * min(choice, speed_mm_s[i])) / 60.0
                cost = planned_s[i] * abs(choice - wanted)
                if i > 0 and ours[i - 1]:
                    side = max(enter_before, min(choice, fastest))
                    cost += planned_s[i - 1] * _lost(before, side, band_before)
                if following > 0.0:
                    cut = planned_s[i] * _lost(choice, max(min(choice, fastest), following), band)
                    # The next move may carry this one's speed on, and so may this one the next's.
                    cost += min(cut, planned_s[i + 1] * max(choice - following, 0.0))
                    # What the next move will ask for is not known exactly.
                    cost += planned_s[i + 1] * _lost(following, choice, _OVER * band_next)
                if cost < least_cost:
                    v, least_cost = choice, cost
        if i > 0:
            predicted_s[i - 1] = lasts
            begin += lasts
        if ours[i]:
            feedrate[i] = printed_feedrate(60.0 * v)
            # Time that could not be caught up is written off.
            late = max(late, begin + RUSH * planned_s[i] - end_s[i])
        before, enter_before = v, enter
    if count:
        predicted_s[count - 1] = missed_s[count - 1] + _lasts_s(
            length_mm[count - 1], enter_before, 0.0, before, accel_mm_s2[count - 1], clock_hz
        )


@kernel(inline=True)
def _lost(speed: float, side: float, band: float) -> float:
    """Return the speed lost by a peak that exceeds its higher neighbour by too little."""
    return speed - side if side < speed < side + band and side >= 0.9 * speed else 0.0


@kernel
def _speed(length: float, lasts_s: float, enter: float, accel: float) -> float:
    """Return the speed of a move of given duration that begins with at most `enter`."""
    even = length / lasts_s
    if even <= enter:
        return even
    # The ramp (v - enter)^2 / 2a and the cruise after it make up the way in the time.
    half = enter + accel * lasts_s
    return half - float(np.sqrt(max(half * half - enter * enter - 2.0 * accel * length, 0.0)))


@kernel
def _lasts_s(
    length: float, enter: float, leave: float, speed: float, accel: float, clock_hz: float
) -> float:
    """Return the duration of a move between given end speeds, in whole clocks per phase."""
    up = (speed * speed - enter * enter) / (2.0 * accel)
    down = (speed * speed - leave * leave) / (2.0 * accel)
    top = speed
    if up + down < length:
        higher = max(enter, leave)
        if higher + accel * SHORT_CLOCKS / clock_hz > speed and higher >= 0.9 * speed:
            top = higher
            if enter >= leave:
                up = 0.0
            else:
                down = 0.0
    else:
        top = float(np.sqrt(max(accel * length + 0.5 * (enter * enter + leave * leave), 0.0)))
        top = max(top, enter, leave)
        up, down = length, 0.0
    ramps = np.rint((top - enter) / accel * clock_hz) + np.rint((top - leave) / accel * clock_hz)
    return float(ramps + np.rint((length - up - down) / top * clock_hz)) / clock_hz


@kernel
def keep_apart(
    end_s: NDArray[np.float64],
    crowded: NDArray[np.bool_],
    final: NDArray[np.bool_],
    begin_s: NDArray[np.float64],
    least_s: NDArray[np.float64],
    keep: NDArray[np.bool_],
) -> None:
    """Drop crowded ends that come sooner than `least_s[i]` after the one before.

    `begin_s[i]` is when the stretch of segment i begins; ends with `final` set stay.
    """
    last = 0.0
    for i in range(len(end_s)):
        if i == 0 or final[i - 1]:
            last = begin_s[i]
        keep[i] = final[i] or not crowded[i] or end_s[i] - last >= least_s[i] - 1e-9
        if keep[i]:
            last = end_s[i]
