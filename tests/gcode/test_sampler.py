from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from math import comb

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stillpath.gcode.firmware.klipper.planner import Planner
from stillpath.gcode.firmware.planning import join_phases
from stillpath.gcode.sampler import Sampler, Samples, distances, sample_phases, sample_until
from stillpath.gcode.types import Phases, rows_of
from stillpath.models.machine import Machine
from tests.gcode.cutting import blocks_of


def plan_of(text: str, machine: Machine) -> Phases:
    planner = Planner(machine.firmware)
    parts = [planner.push(block) for block in blocks_of(text.encode(), machine)]
    return join_phases([*parts, planner.flush()])


def position_at(plan: Phases, t: float) -> np.ndarray:
    """The plain meaning of the columns."""
    m = max(int(np.searchsorted(plan.t_s, t, side="right")) - 1, 0)
    left = max(t - plan.t_s[m], 0.0)
    t1 = min(left, plan.accel_s[m])
    t2 = min(left - t1, plan.cruise_s[m])
    t3 = min(left - t1 - t2, plan.decel_s[m])
    path = plan.start_mm_s[m] * t1 + 0.5 * plan.accel_mm_s2[m] * t1 * t1
    path += plan.cruise_mm_s[m] * (t2 + t3) - 0.5 * plan.accel_mm_s2[m] * t3 * t3
    return plan.start_mm[m] + plan.direction[m] * path


@pytest.fixture(scope="module")
def plan(golden_machine: Machine) -> Phases:
    text = "G28\nM83\nG1 X30 F6000\nG1 Y20 E1\nG4 P35\nG1 E-1\nG1 X0 Y0 Z1\nG3 X0 Y10 J5 E1\n"
    return plan_of(text, golden_machine)


@settings(max_examples=50)
@given(st.lists(st.floats(-1, 6), max_size=40).map(sorted))
def test_the_sampler_agrees_with_plain_python(plan: Phases, times: list[float]) -> None:
    position, row = sample_phases(plan, np.array(times))
    expected = np.array([position_at(plan, t) for t in times]).reshape(-1, 4).T
    np.testing.assert_allclose(position, expected, rtol=0, atol=1e-9)
    assert np.all(np.diff(row) >= 0)
    flat, same = sample_phases(plan, np.array(times), flat=True)
    np.testing.assert_array_equal(flat, position[:2])
    np.testing.assert_array_equal(same, row)


@pytest.mark.parametrize("axes", [2, 3, 4])
def test_grid_as_times(plan: Phases, axes: int) -> None:
    until_s = plan.t_s + 0.7 * plan.accel_s
    position, row, inside = sample_until(plan, (-0.1, 3e-3, 2000), until_s, axes=axes)
    times = -0.1 + np.arange(2000) * 3e-3
    expected, same = sample_phases(plan, times)
    np.testing.assert_array_equal(position, expected[:axes])
    np.testing.assert_array_equal(row, same)
    np.testing.assert_array_equal(inside, times <= until_s[row])


@settings(max_examples=50)
@given(
    st.lists(st.tuples(st.integers(0, 400), st.floats(-1, 6), st.floats(0, 6)), max_size=6),
    st.integers(0, 1000),
)
def test_distances_agree_with_plain_numpy(
    plan: Phases, stretches: list[tuple[int, float, float]], seed: int
) -> None:
    count, dt_s = 400, 4e-3
    points = np.random.default_rng(seed).normal(scale=20.0, size=(2, count))
    first = np.array([0, *sorted(at for at, _, _ in stretches)])
    late = np.array([0.0, *(late for _, late, _ in stretches)])
    until = np.array([np.inf, *(until for _, _, until in stretches)])
    found = distances(plan, points, dt_s, first, late, until)
    stretch = np.searchsorted(first, np.arange(count), side="right") - 1
    times = np.minimum(np.arange(count) * dt_s + late[stretch], until[stretch])
    position, _ = sample_phases(plan, np.maximum.accumulate(times))
    np.testing.assert_allclose(found, np.hypot(*(position[:2] - points)), rtol=0, atol=1e-9)


@settings(max_examples=50)
@given(st.lists(st.integers(0, 200), max_size=8), st.sampled_from([0.0005, 0.004, 0.3]))
def test_streaming_has_no_gap(plan: Phases, cuts: list[int], dt_s: float) -> None:
    sampler = Sampler(dt_s)
    bounds = [0, *sorted(min(cut, len(plan)) for cut in cuts), len(plan)]
    parts: list[Samples] = []
    for a, b in pairwise(bounds):
        part = rows_of(plan, slice(a, b))
        parts += sampler.push(part)
    parts += sampler.flush()
    t_s = np.concatenate([part.t_s for part in parts])
    np.testing.assert_array_equal(t_s, np.arange(len(t_s)) * dt_s)
    position, row = sample_phases(plan, t_s)
    np.testing.assert_array_equal(np.concatenate([p.xyz_mm for p in parts], axis=1), position[:3])
    np.testing.assert_array_equal(np.concatenate([p.e_mm for p in parts]), position[3])
    np.testing.assert_array_equal(
        np.concatenate([p.move_index for p in parts]), plan.move_index[row]
    )
    assert position[:, -1] == pytest.approx([0, 10, 1, 1], abs=1e-9)
    end_s = plan.t_s + plan.accel_s + plan.cruise_s + plan.decel_s
    np.testing.assert_array_equal(np.concatenate([p.moving for p in parts]), t_s <= end_s[row])


def test_grids_that_cannot_be_sampled_are_refused(plan: Phases) -> None:
    none = rows_of(plan, slice(0))
    with pytest.raises(ValueError, match="no phases"):
        sample_phases(none, (0.0, 1.0, 1))
    with pytest.raises(ValueError, match="no phases"):
        distances(none, np.zeros((2, 1)), 1.0, np.zeros(1, int), np.zeros(1), np.zeros(1))
    with pytest.raises(ValueError, match="ascending"):
        sample_phases(plan, np.array([1.0, 0.0]))
    with pytest.raises(ValueError, match="dt > 0"):
        sample_phases(plan, (0.0, 0.0, 1))
    with pytest.raises(ValueError, match="above 0"):
        Sampler(0.0)
    assert [*Sampler(1.0).push(none), *Sampler(1.0).flush()] == []


def test_hours_come_in_parts(plan: Phases) -> None:
    """A dwell of a day in front of the last move: as many samples, never all at once."""
    late = replace(plan, t_s=plan.t_s + np.where(np.arange(len(plan)) == len(plan) - 1, 86400, 0))
    sampler = Sampler(0.01)
    lengths = [len(part) for part in sampler.push(late)]
    assert max(lengths) <= 1 << 17
    assert sum(lengths) == pytest.approx(8.64e6, rel=1e-3)


def test_s_curves_are_marlins_bezier(plan: Phases) -> None:
    """Velocity by Bernstein's formula with three equal control points at either end, summed up."""
    curved = replace(plan, s_curve=np.ones(len(plan), dtype=bool))
    end = plan.t_s[-1] + plan.accel_s[-1] + plan.cruise_s[-1] + plan.decel_s[-1]
    dt = 1e-5
    t = np.arange(0.0, end, dt)
    position, row = sample_phases(curved, t)
    speed = np.zeros(len(t))
    slows = plan.t_s + plan.accel_s + plan.cruise_s
    for v0, v1, length, begin in (
        (plan.start_mm_s, plan.cruise_mm_s, plan.accel_s, plan.t_s),
        (plan.cruise_mm_s, plan.end_mm_s, plan.decel_s, slows),
    ):
        inside = (t >= begin[row]) & (t < begin[row] + length[row]) & (length[row] > 0.0)
        at = row[inside]
        u = (t[inside] - begin[at]) / length[at]
        high = sum(comb(5, i) * u**i * (1.0 - u) ** (5 - i) for i in (3, 4, 5))
        speed[inside] = v0[at] * (1.0 - high) + v1[at] * high
    cruise = (t >= (plan.t_s + plan.accel_s)[row]) & (t < slows[row])
    speed[cruise] = plan.cruise_mm_s[row[cruise]]
    velocity = plan.direction[row].T * speed
    summed = np.cumsum(velocity, axis=1) * dt
    np.testing.assert_allclose(position - position[:, :1], summed, atol=5e-3)
    # The same time and way as without the curve.
    straight, _ = sample_phases(plan, np.append(plan.t_s, end))
    bent, _ = sample_phases(curved, np.append(plan.t_s, end))
    np.testing.assert_allclose(bent, straight, atol=1e-9)
