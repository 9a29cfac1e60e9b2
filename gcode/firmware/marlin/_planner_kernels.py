"""Kernels of Marlin's planner: look-ahead of a finite queue, trapezoids, and their step timing.

When a block starts, the firmware knows the `C_AHEAD` blocks after it that its full queue
holds; the last of them is planned to end at the lowest speed. With prefix sums of 2 a d that is the
same as one backward pass over everything and a cap for each block.

A block is executed step by step: the time to the next step is computed from the speed at the step
before (releases) or half a step later (bugfix), in whole ticks of the step timer. So a block that
starts slower than it cruises loses up to one step's time, and `_step_time` counts it.

Rules: Marlin/src/module/planner.cpp (`reverse_pass`, `forward_pass`, `recalculate_trapezoids`,
`calculate_trapezoid_for_block`) and stepper.cpp (`block_phase_isr`), releases 2.0.8 and 2.1.2.5,
bugfix-2.1.x as of 2025-09.
"""

from __future__ import annotations

from math import ceil, floor, log, sqrt
from typing import Any

import numpy as np

from stillpath.gcode.firmware.marlin._block_kernels import (
    BUGFIX,
    C_AHEAD,
    C_FAMILY,
    C_FIRST_STEPS,
    C_MIN_RATE,
    C_S_CURVE,
    C_SMOOTHING_HZ,
    C_TIMER_HZ,
    PRUSA,
    Q_ACCEL,
    Q_ACCEL_STEPS,
    Q_DIRECTION,
    Q_FLOOR2,
    Q_INDEX,
    Q_JUNCTION2,
    Q_PATH,
    Q_RATE,
    Q_REACH2,
    Q_SPEED,
    Q_START,
    Q_STEPS,
    Q_STEPS_PER_MM,
    S_ENTRY2,
)
from stillpath.models.jit import kernel

__all__ = ["emit", "parts_of_a_step", "settle"]

_FEW = 12  # steps that are always counted one by one
_SMALL = 0.01  # relative change of the rate in a step, below which a ramp is summed in closed form
_TINY_S = 1e-12


@kernel
def settle(queue: Any, count: int, facts: Any, final: bool) -> int:
    """Cap the entry speeds of the queue's blocks; return how many rows are settled.

    The first row's entry speed was settled with the rows before it.
    """
    blocks = np.empty(count, np.int64)
    n = 0
    for m in range(count):
        if queue[m, Q_STEPS] > 0.0:
            blocks[n] = m
            n += 1
    ahead = int(facts[C_AHEAD])
    settled = count
    if not final:
        if n <= ahead:
            return 0
        settled = blocks[n - ahead]
    # Backward: what the next block's entry allows, over all that is known.
    reach2 = queue[blocks[n - 1], Q_FLOOR2] if n else 0.0
    for i in range(n - 1, -1, -1):
        row = queue[blocks[i]]
        reach2 = min(row[Q_JUNCTION2], reach2 + 2.0 * row[Q_ACCEL] * row[Q_PATH])
        row[Q_REACH2] = reach2
    # The queue's end, seen from each block.
    gain2 = 0.0
    for i in range(n - 1, -1, -1):
        row = queue[blocks[i]]
        gain2 += 2.0 * row[Q_ACCEL] * row[Q_PATH]
        last = i + ahead - 1
        if last < n - 1:
            far, end2 = queue[blocks[last + 1]], queue[blocks[last], Q_FLOOR2]
            gain2 -= 2.0 * far[Q_ACCEL] * far[Q_PATH]
            row[Q_REACH2] = min(row[Q_REACH2], end2 + gain2)
            if far[Q_REACH2] < end2:  # the firmware has not read the queue's end yet
                for j in range(last, i - 1, -1):
                    one = queue[blocks[j]]
                    end2 = min(one[Q_JUNCTION2], end2 + 2.0 * one[Q_ACCEL] * one[Q_PATH])
                row[Q_REACH2] = end2
    return settled


@kernel
def emit(
    queue: Any,
    settled: int,
    count: int,
    facts: Any,
    state: Any,
    t_s: float,
    times: Any,
    starts: Any,
    directions: Any,
    speeds: Any,
    index: Any,
) -> float:
    """Write the settled rows as phases; return the time at their end.

    Parameters
    ----------
    times : ndarray, shape (4, n)
        t, acceleration, cruise, deceleration.
    starts, directions : ndarray, shape (n, 4)
    speeds : ndarray, shape (4, n)
        Start, cruise, end speed and acceleration.
    """
    family = facts[C_FAMILY]
    shape = np.empty(7)
    entry2 = state[S_ENTRY2]
    for m in range(settled):
        row = queue[m]
        times[0, m] = t_s
        for k in range(4):
            starts[m, k] = row[Q_START + k]
            directions[m, k] = row[Q_DIRECTION + k]
        index[m] = int(row[Q_INDEX])
        if row[Q_STEPS] == 0.0:
            times[1, m] = times[2, m] = times[3, m] = 0.0
            speeds[0, m] = speeds[1, m] = speeds[2, m] = sqrt(max(entry2, 0.0))
            speeds[3, m] = 1.0
            continue
        if entry2 < 0.0:
            entry2 = row[Q_FLOOR2]
        nxt = m + 1
        while nxt < count and queue[nxt, Q_STEPS] == 0.0:
            nxt += 1
        exit2 = row[Q_FLOOR2]
        if nxt < count:
            exit2 = min(queue[nxt, Q_REACH2], entry2 + 2.0 * row[Q_ACCEL] * row[Q_PATH])
            if family == BUGFIX:
                exit2 = max(exit2, queue[nxt, Q_FLOOR2])
        if family == PRUSA:
            _trapezoid(row, sqrt(entry2), sqrt(exit2), shape)
        else:
            _steps(row, sqrt(entry2), sqrt(exit2), facts, shape)
        for k in range(4):
            speeds[k, m] = shape[k]
        times[1, m] = shape[4]
        times[2, m] = shape[5]
        times[3, m] = shape[6]
        t_s += shape[4] + shape[5] + shape[6]
        entry2 = exit2
    state[S_ENTRY2] = entry2
    return t_s


@kernel
def _trapezoid(row: Any, entry: float, leave: float, shape: Any) -> None:
    """Start, cruise, end speed, acceleration and three durations of an ideal trapezoid."""
    path, accel, cruise = row[Q_PATH], row[Q_ACCEL], row[Q_SPEED]
    entry, leave = min(entry, cruise), min(leave, cruise)
    up = 0.5 * (cruise * cruise - entry * entry) / accel
    down = 0.5 * (cruise * cruise - leave * leave) / accel
    level = path - up - down
    if level < 0.0:
        up = min(max(0.5 * (path + up - down), 0.0), path)
        down = path - up
        level = 0.0
        cruise = sqrt(entry * entry + 2.0 * accel * up)
        leave = min(leave, cruise)
    shape[0], shape[1], shape[2], shape[3] = entry, cruise, leave, accel
    shape[4] = 2.0 * up / (entry + cruise)
    shape[5] = level / cruise
    shape[6] = 2.0 * down / (cruise + leave)


@kernel
def _steps(row: Any, entry: float, leave: float, facts: Any, shape: Any) -> None:
    """Find the same for a block in whole steps, as the step interrupt executes it."""
    bugfix = facts[C_FAMILY] == BUGFIX
    steps, per_mm = row[Q_STEPS], row[Q_STEPS_PER_MM]
    least = facts[C_MIN_RATE]
    nominal, accel = max(row[Q_RATE], least), row[Q_ACCEL_STEPS]
    if bugfix:
        first = max(floor(entry * per_mm + 0.5), least)
        final = max(floor(leave * per_mm + 0.5), least)
    else:
        first = max(ceil(nominal * (entry / row[Q_SPEED]) - 1e-6), least)
        final = max(ceil(nominal * (leave / row[Q_SPEED]) - 1e-6), least)
    up = 0.5 * (nominal * nominal - first * first) / accel
    down = 0.5 * (nominal * nominal - final * final) / accel
    rising = max(ceil(up), 0.0)
    falling = max(ceil(down) if bugfix else floor(down), 0.0)
    peak = nominal
    if rising + falling > steps:
        half = 0.5 * (steps + up - down)
        rising = min(max(floor(half + 0.5) if bugfix else ceil(half), 0.0), steps)
        falling = steps - rising
        peak = min(sqrt(first * first + 2.0 * accel * rising), nominal)
    if facts[C_S_CURVE] != 0.0 and not bugfix:
        duration = _curved_time(
            steps,
            first,
            peak,
            nominal,
            final,
            accel,
            rising,
            steps - falling,
            facts[C_FIRST_STEPS] == 1.0,
            facts[C_TIMER_HZ],
            facts[C_SMOOTHING_HZ],
        )
        flat = falling <= 1.0
    elif facts[C_S_CURVE] != 0.0:
        # bugfix: along the Bezier curve as along the line, the same time and the same way.
        level = max(steps - rising - falling, 0.0)
        first, final = min(first, peak), min(final, peak)
        duration = max((2.0 * peak - first - final) / accel + level / peak, steps / peak)
        flat = False
    else:
        duration = _step_time(
            steps,
            first,
            nominal,
            final,
            accel,
            rising,
            steps - falling,
            bugfix,
            facts[C_FIRST_STEPS] == 1.0,
            facts[C_TIMER_HZ],
            facts[C_SMOOTHING_HZ],
        )
        # Without a step on the ramp the speed jumps to that of the next block.
        flat = falling <= (0.0 if bugfix else 1.0)
    fine = parts_of_a_step(nominal, facts[C_SMOOTHING_HZ])
    cruise = 1.0 / (fine * _interval(nominal, fine, facts[C_TIMER_HZ]))
    _fit(steps, min(first, cruise), cruise, cruise if flat else min(final, cruise), duration, shape)
    for k in range(4):
        shape[k] /= per_mm


@kernel(inline=True)
def _interval(rate: float, fine: float, timer_hz: float) -> float:
    """Time between (parts of) steps: whole ticks of the timer, at least one."""
    return max(floor(timer_hz / (rate * fine)), 1.0) / timer_hz


@kernel
def _step_time(
    steps: float,
    first: float,
    nominal: float,
    final: float,
    accel: float,
    rising: float,
    falls_from: float,
    bugfix: bool,
    counts_first: bool,
    timer_hz: float,
    smoothing_hz: float,
) -> float:
    """Time from the start of a block to its last step.

    `counts_first`: the first step's time counts as time on the ramp (2.1); in 2.0 it does not, so
    that the second step takes as long.
    """
    fine = parts_of_a_step(nominal, smoothing_hz)
    steps *= fine
    rising *= fine
    falls_from *= fine
    before = _interval(first, fine, timer_hz)
    total = before
    t_up = 0.5 * before if bugfix else before if counts_first else 0.0
    t_down = 0.5 * before if bugfix else 0.0
    rate = first
    # The releases look at the step just done, bugfix at the one to come.
    accelerated = min(rising, steps - 1.0)
    if bugfix:
        accelerated = max(min(rising, steps) - 1.0, 0.0)
    if accelerated > 0.0:
        spent, rate = _ramp(first, accel, t_up, accelerated, nominal, fine, timer_hz, not bugfix)
        total += spent
        t_down = 0.0
    done = 1.0 + accelerated
    cruised = max(min(falls_from + (0.0 if bugfix else 1.0), steps) - done, 0.0)
    if cruised > 0.0:
        before = _interval(nominal, fine, timer_hz)
        total += cruised * before
        if bugfix:
            t_down = 0.5 * before
            rate = nominal
    left = steps - done - cruised
    if left > 0.0:
        spent, rate = _ramp(rate, -accel, t_down, left, final, fine, timer_hz, not bugfix)
        total += spent
    return total


@kernel
def _curved_time(
    steps: float,
    first: float,
    peak: float,
    nominal: float,
    final: float,
    accel: float,
    rising: float,
    falls_from: float,
    counts_first: bool,
    timer_hz: float,
    smoothing_hz: float,
) -> float:
    """Time of a block of the releases with ramps along Bezier curves, step by step.

    The curve is entered where the first step, at the entry's speed, has come to: a ramp that is
    shorter than that is not seen, as without S-curve. `counts_first` as for `_step_time`.
    """
    fine = parts_of_a_step(nominal, smoothing_hz)
    steps, rising, falls_from = fine * steps, fine * rising, fine * falls_from
    total = _interval(first, fine, timer_hz)
    up_s, down_s = (peak - first) / accel, (peak - final) / accel
    t = total if counts_first else 0.0
    accelerated = max(min(rising, steps - 1.0), 0.0)
    for _ in range(int(accelerated)):
        wait = _interval(_on_curve(first, peak, t, up_s), fine, timer_hz)
        t += wait
        total += wait
    done = 1.0 + accelerated
    cruised = max(min(falls_from + 1.0, steps) - done, 0.0)
    total += cruised * _interval(nominal, fine, timer_hz)
    t = 0.0
    for _ in range(int(steps - done - cruised)):
        wait = _interval(_on_curve(peak, final, t, down_s), fine, timer_hz)
        t += wait
        total += wait
    return total


@kernel(inline=True)
def parts_of_a_step(nominal: float, smoothing_hz: float) -> float:
    """Find how many parts of a step ADAPTIVE_STEP_SMOOTHING times for each step."""
    fine = 1.0
    rate = nominal
    while rate < smoothing_hz:
        rate *= 2.0
        if rate < smoothing_hz:
            fine *= 2.0
    return fine


@kernel(inline=True)
def _on_curve(begin: float, end: float, t: float, over: float) -> float:
    """Rate on the quintic Bezier curve of three equal points at either end."""
    x = t / over if t < over else 1.0
    return begin + (end - begin) * x * x * x * (10.0 - x * (15.0 - 6.0 * x))


@kernel
def _ramp(
    start: float,
    accel: float,
    t: float,
    steps: float,
    end: float,
    fine: float,
    timer_hz: float,
    euler: bool,
) -> tuple[float, float]:
    """Time of `steps` intervals on a ramp from `start` that is held at `end`; and the last rate.

    The rate of an interval is that of the time `t` at its begin; a ramp whose rate changes little
    from step to step is summed in closed form.
    """
    total = 0.0
    rate = start
    rises = accel > 0.0
    done = 0.0
    while done < steps:
        rate = start + accel * t
        if (rises and rate >= end) or (not rises and rate <= end):
            rate = end
            total += (steps - done) * _interval(end, fine, timer_hz)
            break
        left = steps - done
        size = abs(accel)
        if left > _FEW and size < _SMALL * rate * rate * fine:
            limit = end
            if not rises:
                limit = max(end, sqrt(size / (_SMALL * fine)))
            leap = min(abs(limit * limit - rate * rate) / (2.0 * size) * fine - 1.0, left)
            if leap > _FEW:
                leap = floor(leap)
                # d(rate^2) per step is 2 a; less what the ticks cut off, half of one on average;
                # and a^2/rate^2 more where the rate lags by a step.
                gain2 = 2.0 * accel * leap / fine
                mean = 0.5 * (rate + sqrt(rate * rate + gain2))
                gain2 -= accel * leap * mean / timer_hz
                if euler:
                    gain2 += size / fine * abs(log(1.0 + gain2 / (rate * rate))) * 0.5
                reached = sqrt(rate * rate + gain2)
                total += (reached - rate) / accel
                t = (reached - start) / accel
                rate = reached - accel / (reached * fine)
                done += leap
                continue
        wait = _interval(rate, fine, timer_hz)
        total += wait
        t += wait
        done += 1.0
    return total, rate


@kernel
def _fit(
    steps: float, first: float, cruise: float, final: float, duration: float, shape: Any
) -> None:
    """Constant accelerations that cover the steps in just the time that they take."""
    spare = duration - steps / cruise
    lift, fall = cruise - first, cruise - final
    if spare > _TINY_S and lift + fall > 0.0:
        accel = (lift * lift + fall * fall) / (2.0 * cruise * spare)
        if lift + fall <= accel * duration:
            shape[0], shape[1], shape[2], shape[3] = first, cruise, final, accel
            shape[4] = lift / accel
            shape[6] = fall / accel
            shape[5] = duration - shape[4] - shape[6]
            return
        # Never at cruise: up to a peak and down again.
        ends = first + final
        squares = first * first + final * final
        inside = 16.0 * steps * steps + 8.0 * duration * (duration * squares - 2.0 * steps * ends)
        if inside > 0.0:
            peak = (4.0 * steps + sqrt(inside)) / (4.0 * duration)
            accel = (2.0 * peak - ends) / duration
            if peak >= first and peak >= final and 2.0 * peak - ends > 1e-9 * peak:
                shape[0], shape[1], shape[2], shape[3] = first, peak, final, accel
                shape[4] = (peak - first) / accel
                shape[6] = duration - shape[4]
                shape[5] = 0.0
                return
    # Up or down all the way, from the first rate to whatever makes the way come out.
    mean = steps / duration
    final = max(2.0 * mean - first, 0.01 * mean)
    first = 2.0 * mean - final
    if spare <= _TINY_S or lift + fall == 0.0 or abs(final - first) < 1e-9 * mean:
        shape[0], shape[1], shape[2], shape[3] = mean, mean, mean, 1.0
        shape[4], shape[5], shape[6] = 0.0, duration, 0.0
        return
    shape[0], shape[1], shape[2] = first, max(first, final), final
    shape[3] = abs(final - first) / duration
    shape[4] = duration if final > first else 0.0
    shape[5] = 0.0
    shape[6] = 0.0 if final > first else duration
