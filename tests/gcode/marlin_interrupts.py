"""Marlin's steps one by one, as its step interrupt makes them; the planner's kernels add them up.

stepper.cpp, `block_phase_isr`, and planner.cpp, `calculate_trapezoid_for_block`: releases 2.0.8
(2021-05) and 2.1.2.5 (2024-11), bugfix-2.1.x as of 2025-09. Without S-curves.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import zip_longest

import numpy as np
from numpy.typing import NDArray

from stillpath.gcode.firmware.marlin import _block_kernels as blocks
from stillpath.gcode.firmware.marlin._planner_kernels import parts_of_a_step, settle
from stillpath.gcode.firmware.marlin.planner import planner_facts
from stillpath.gcode.types import Limits, Moves
from stillpath.models.firmware import Marlin


@dataclass(frozen=True)
class Ramps:
    """A block in steps and steps per second; `fine`: timed parts of a step."""

    steps: int
    first: float
    nominal: float
    final: float
    accel: float
    rising: int
    falls_from: int
    fine: int = 1


def waits_s(
    ramps: Ramps, *, bugfix: bool, counts_first: bool, timer_hz: float = 2e6
) -> list[float]:
    """Time before each (part of a) step, interrupt by interrupt."""
    fine = ramps.fine

    def ticks(rate: float) -> float:
        return max(math.floor(timer_hz / (rate * fine)), 1) / timer_hz

    steps, rising, falls_from = (fine * n for n in (ramps.steps, ramps.rising, ramps.falls_from))
    wait = ticks(ramps.first)
    waits, accelerated, cruised = [wait], ramps.first, False
    t_up = 0.5 * wait if bugfix else wait * counts_first
    t_down = 0.5 * wait if bugfix else 0.0
    for done in range(1, steps):
        if done < rising if bugfix else done <= rising:
            accelerated = min(ramps.first + ramps.accel * t_up, ramps.nominal)
            wait = ticks(accelerated)
            t_up += wait
            t_down = 0.0
        elif done >= falls_from if bugfix else done > falls_from:
            wait = ticks(max(accelerated - ramps.accel * t_down, ramps.final))
            t_down += wait
        else:
            wait = ticks(ramps.nominal)
            if bugfix and not cruised:
                t_down, accelerated, cruised = 0.5 * wait, ramps.nominal, True
        waits.append(wait)
    return waits


def _ramps(
    row: NDArray[np.float64], entry: float, leave: float, facts: NDArray[np.float64]
) -> Ramps:
    """Trapezoid of a block from its speeds at either end, mm/s."""
    bugfix = facts[blocks.C_FAMILY] == blocks.BUGFIX
    least, per_mm = facts[blocks.C_MIN_RATE], row[blocks.Q_STEPS_PER_MM]
    nominal, accel = max(row[blocks.Q_RATE], least), row[blocks.Q_ACCEL_STEPS]
    steps = int(row[blocks.Q_STEPS])
    if bugfix:
        first, final = (max(math.floor(v * per_mm + 0.5), least) for v in (entry, leave))
    else:
        scale = nominal / row[blocks.Q_SPEED]
        first, final = (max(math.ceil(v * scale - 1e-6), least) for v in (entry, leave))
    up, down = (0.5 * (nominal**2 - v**2) / accel for v in (first, final))
    rising = max(math.ceil(up), 0)
    falling = max(math.ceil(down) if bugfix else math.floor(down), 0)
    if rising + falling > steps:
        half = 0.5 * (steps + up - down)
        rising = min(max(math.floor(half + 0.5) if bugfix else math.ceil(half), 0), steps)
        falling = steps - rising
    fine = int(parts_of_a_step(nominal, facts[blocks.C_SMOOTHING_HZ]))
    return Ramps(steps, first, nominal, final, accel, rising, steps - falling, fine)


def stepped(
    moves: Moves, limits: list[Limits], firmware: Marlin, *, corexy: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Execute moves from rest to rest, step by step.

    Returns
    -------
    t_s : ndarray, shape (n,)
        Of every step of the leading motor (or its parts), from 0 at the start.
    place_mm : ndarray, shape (2, n)
        X and Y as if the other motors moved along with every such step.
    """
    facts = planner_facts(firmware, corexy=corexy)
    queue, state = np.zeros((len(moves), blocks.Q_SIZE)), np.zeros(blocks.S_SIZE)
    table = np.array([one.as_row() for one in limits])
    count, problem, bad = blocks.append(
        moves.start_mm, moves.end_mm, moves.speed_mm_s, moves.limits_id, table, facts, 0, state,
        queue, 0,
    )  # fmt: skip
    assert not problem or problem == blocks.OK, f"move {bad}: {problem}"
    settle(queue, count, facts, True)
    rows = [row for row in queue[:count] if row[blocks.Q_STEPS] > 0.0]
    bugfix = facts[blocks.C_FAMILY] == blocks.BUGFIX
    counts_first = facts[blocks.C_FIRST_STEPS] == 1.0
    entry2 = rows[0][blocks.Q_FLOOR2] if rows else 0.0
    times, places = [np.zeros(1)], [moves.start_mm[:1, :2]]
    for row, nxt in zip_longest(rows, rows[1:]):
        exit2 = row[blocks.Q_FLOOR2]
        if nxt is not None:
            gain2 = 2.0 * row[blocks.Q_ACCEL] * row[blocks.Q_PATH]
            exit2 = min(nxt[blocks.Q_REACH2], entry2 + gain2)
            if bugfix:
                exit2 = max(exit2, nxt[blocks.Q_FLOOR2])
        ramps = _ramps(row, math.sqrt(entry2), math.sqrt(exit2), facts)
        waits = waits_s(
            ramps, bugfix=bugfix, counts_first=counts_first, timer_hz=facts[blocks.C_TIMER_HZ]
        )
        times.append(times[-1][-1] + np.cumsum(waits))
        way = np.arange(1, len(waits) + 1)[:, None] / len(waits) * row[blocks.Q_PATH]
        begin = row[blocks.Q_START : blocks.Q_START + 2]
        places.append(begin + way * row[blocks.Q_DIRECTION : blocks.Q_DIRECTION + 2])
        entry2 = exit2
    return np.concatenate(times), np.concatenate(places).T
