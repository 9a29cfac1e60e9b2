"""What holds for every stream of moves, and plain twins of the kernels."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from stillpath.gcode.firmware.encoding import as_moves
from stillpath.gcode.firmware.marlin._block_kernels import (
    Q_ACCEL,
    Q_FLOOR2,
    Q_JUNCTION2,
    Q_PATH,
    Q_REACH2,
    Q_SIZE,
    Q_STEPS,
)
from stillpath.gcode.firmware.marlin._planner_kernels import _step_time, settle
from stillpath.gcode.firmware.marlin.limits import initial_limits
from stillpath.gcode.firmware.marlin.planner import Planner, planner_facts
from stillpath.gcode.firmware.planning import join_phases
from stillpath.gcode.types import Moves, Phases, rows_of
from stillpath.models.firmware import Marlin
from stillpath.models.firmware.marlin import PerAxis
from tests.gcode.marlin_interrupts import Ramps, waits_s

SCALE = (80.0, 80.0, 400.0, 100.0)
MACHINES = st.builds(
    Marlin,
    variant=st.sampled_from(["2.0", "2.1", "bugfix", "prusa", "bambu"]),
    junction=st.sampled_from(["deviation", "classic_jerk"]),
    s_curve=st.booleans(),
    slowdown=st.booleans(),
    min_steps_per_segment=st.sampled_from([1, 6]),
    block_buffer_size=st.sampled_from([4, 16]),
    linear_advance=st.booleans(),
    linear_advance_k_s=st.just(0.05),
    steps_per_mm=st.just(PerAxis(x=80.0, y=80.0, z=400.0, e=100.0)),
)


@st.composite
def streams(draw: st.DrawFn) -> Moves:
    n = draw(st.integers(1, 60))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    step = rng.normal(size=(n, 4)) * draw(st.sampled_from([0.02, 0.3, 20.0]))
    step *= [1.0, 1.0, 0.05, 0.05]
    step[rng.random((n, 4)) < draw(st.sampled_from([0.0, 0.3, 0.7]))] = 0.0
    points = np.vstack((np.zeros(4), np.cumsum(step, axis=0)))
    speed = rng.uniform(1.0, 300.0, n)
    return as_moves(points[:-1], points[1:], speed, np.zeros(n, np.int32))


def plan(firmware: Marlin, parts: list[Moves], *, corexy: bool = False) -> Phases:
    planner, table = Planner(firmware, corexy=corexy), [initial_limits(firmware)]
    return join_phases([*(planner.push_moves(part, table) for part in parts), planner.flush()])


@given(MACHINES, streams(), st.booleans())
@settings(max_examples=60)
def test_what_every_plan_keeps(firmware: Marlin, moves: Moves, corexy: bool) -> None:
    phases = plan(firmware, [moves], corexy=corexy)
    assert phases.move_index.tolist() == list(range(len(moves)))
    for name in ("accel_s", "cruise_s", "decel_s"):
        assert np.all(getattr(phases, name) >= -1e-12)
    # Time goes on without gaps.
    assert phases.t_s[1:] == pytest.approx(phases.t_s[:-1] + phases.lasts_s[:-1], abs=1e-9)
    # Each row ends where the next begins, and that is within a short move of where it should be.
    up, down = phases.accel_s, phases.decel_s
    path = 0.5 * (phases.start_mm_s + phases.cruise_mm_s) * up
    path += phases.cruise_mm_s * phases.cruise_s
    path += (phases.cruise_mm_s - 0.5 * phases.accel_mm_s2 * down) * down
    end = phases.start_mm + phases.direction * path[:, None]
    assert end[:-1] == pytest.approx(phases.start_mm[1:], abs=1e-6)
    short = (firmware.min_steps_per_segment + 0.5) / np.array(SCALE)
    assert np.all(np.abs(end - moves.end_mm) <= short + 1e-6)
    # Caps of speed, but for a step per second and a tick.
    limit = firmware.planner.max_feedrate_mm_s
    executed = phases.lasts_s > 0.0
    least = 130.0 / 80.0
    for axis, cap in ((2, limit.z), (3, limit.e)):
        v = np.abs(phases.direction[executed, axis]) * phases.cruise_mm_s[executed]
        assert np.all(v <= 1.05 * cap + least)


@given(MACHINES, streams(), st.lists(st.integers(0, 60), max_size=5))
@settings(max_examples=80)
def test_cutting_the_stream_changes_nothing(firmware: Marlin, moves: Moves, cuts: Any) -> None:
    bounds = sorted({0, len(moves), *(min(c, len(moves)) for c in cuts)})
    parts = [rows_of(moves, slice(a, b)) for a, b in pairwise(bounds)]
    whole, cut = plan(firmware, [moves]), plan(firmware, parts)
    for name in Phases.__dataclass_fields__:
        assert getattr(cut, name) == pytest.approx(getattr(whole, name), rel=1e-9, abs=1e-12)


@given(streams())
@settings(max_examples=60)
def test_ideal_trapezoids_join_without_steps_of_speed(moves: Moves) -> None:
    firmware = Marlin(variant="prusa", min_steps_per_segment=1)
    phases = plan(firmware, [moves])
    moving = phases.lasts_s > 0.0
    start, end = phases.start_mm_s[moving], phases.end_mm_s[moving]
    assert end[:-1] == pytest.approx(start[1:], rel=1e-6, abs=1e-6)


@given(streams())
@settings(max_examples=60)
def test_higher_limits_are_not_slower(moves: Moves) -> None:
    firmware = Marlin(variant="prusa", slowdown=False)
    own = initial_limits(firmware)
    raised = replace(own, print_accel_mm_s2=2000.0, travel_accel_mm_s2=2000.0)
    raised = replace(raised, accel_x_mm_s2=2000.0, accel_y_mm_s2=2000.0, accel_z_mm_s2=2000.0)
    times = []
    for limits in (own, raised):
        planner = Planner(firmware)
        planner.push_moves(moves, [limits])
        planner.flush()
        times.append(planner.time_s)
    assert times[1] <= times[0] * (1.0 + 1e-9)


# Twins


def ring_of_blocks(
    path: NDArray[np.float64],
    accel: NDArray[np.float64],
    junction2: NDArray[np.float64],
    size: int,
    floor2: float,
) -> list[float]:
    """Entry speeds squared as a ring of `size` - 1 blocks settles them, block by block."""
    n = len(path)
    entry2 = [floor2]
    for busy in range(n - 1):
        # Block `busy` starts: those up to busy + size - 3 are in the queue.
        last = min(busy + size - 3, n - 1)
        reach2 = floor2
        for k in range(last, busy, -1):
            reach2 = min(junction2[k], reach2 + 2.0 * accel[k] * path[k])
        entry2.append(min(reach2, entry2[busy] + 2.0 * accel[busy] * path[busy]))
    return entry2


@given(st.integers(1, 60), st.integers(0, 2**32 - 1), st.sampled_from([4, 8, 16]))
@settings(max_examples=60)
def test_the_queue_settles_like_a_ring_of_blocks(n: int, seed: int, size: int) -> None:
    rng = np.random.default_rng(seed)
    queue = np.zeros((n, Q_SIZE))
    queue[:, Q_PATH] = rng.uniform(0.05, 3.0, n)
    queue[:, Q_ACCEL] = rng.choice([100.0, 500.0, 3000.0], n)
    queue[:, Q_JUNCTION2] = rng.uniform(0.1, 60.0, n) ** 2
    queue[:, Q_FLOOR2] = 0.05**2
    queue[:, Q_STEPS] = 1.0
    facts = planner_facts(Marlin(block_buffer_size=size), corexy=False)
    assert settle(queue, n, facts, True) == n
    entry2 = [0.05**2]
    for k in range(n - 1):
        gain2 = 2.0 * queue[k, Q_ACCEL] * queue[k, Q_PATH]
        entry2.append(min(queue[k + 1, Q_REACH2], entry2[k] + gain2))
    expected = ring_of_blocks(
        queue[:, Q_PATH], queue[:, Q_ACCEL], queue[:, Q_JUNCTION2], size, 0.05**2
    )
    assert entry2 == pytest.approx(expected, rel=1e-9)


@given(
    st.integers(1, 2500),
    st.floats(3.5, 8.0),
    st.floats(130.0, 20_000.0),
    st.floats(0.0, 1.0),
    st.floats(0.0, 1.0),
    st.booleans(),
    st.booleans(),
    st.sampled_from([0.0, 30_000.0]),
)
@settings(max_examples=60)
def test_step_times_are_those_of_the_interrupts(
    steps: int,
    decades: float,
    nominal: float,
    low: float,
    high: float,
    bugfix: bool,
    counts_first: bool,
    smoothing_hz: float,
) -> None:
    accel = 10.0**decades
    first, final = (120.0 + share * (nominal - 120.0) for share in (low, high))
    up = 0.5 * (nominal**2 - first**2) / accel
    down = 0.5 * (nominal**2 - final**2) / accel
    rising, falling = math.ceil(up), math.ceil(down) if bugfix else math.floor(down)
    if rising + falling > steps:
        half = 0.5 * (steps + up - down)
        whole = math.floor(half + 0.5) if bugfix else math.ceil(half)
        rising = min(max(whole, 0), steps)
        falling = steps - rising
    fine = 1
    while nominal * fine * 2 < smoothing_hz:
        fine *= 2
    falls_from = steps - falling
    ramps = Ramps(steps, first, nominal, final, accel, rising, falls_from, fine)
    expected = sum(waits_s(ramps, bugfix=bugfix, counts_first=counts_first))
    found = _step_time(
        float(steps),
        first,
        nominal,
        final,
        accel,
        float(rising),
        float(falls_from),
        bugfix,
        counts_first,
        2e6,
        smoothing_hz,
    )
    # Ramps are summed in closed form; what that misses is some steps at their slow end.
    assert found == pytest.approx(expected, rel=2e-3, abs=2.5 / min(first, final))
