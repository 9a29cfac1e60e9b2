"""Vertices for a firmware that swallows short moves: far enough apart, near the command."""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from gcode.firmware.marlin._encoder_kernels import thin
from gcode.firmware.marlin._vertex_kernels import choose_vertices
from gcode.interpreter import Interpreter
from gcode.types import ProgramBlock
from models.firmware import Marlin
from models.firmware.marlin import MarlinPlanner, PerAxis
from models.machine import Machine
from models.store import load_machine
from service.pipeline.options import Options
from service.pipeline.road import compensate_file
from tests.gcode.cutting import HEAD
from tests.gcode.prints import polygon

DT_S = 1e-3


def choose(
    fit: NDArray[np.float64],
    at_s: NDArray[np.float64],
    least: int = 6,
    *,
    fed: NDArray[np.float64] | None = None,
    **options: Any,
) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Which vertices of a fit, X Y in steps with its start, are kept, and where they go."""
    place = np.zeros((len(fit), 3), np.int64)
    place[:, :2] = np.round(fit)
    keep = np.ones(len(fit), np.bool_)
    given = {"y_weight": 1.0, "step_hz": np.full(2, np.inf), "corexy": False, **options}
    fed = np.zeros(len(fit)) if fed is None else fed
    command = sampled(np.column_stack([fit, fed]), at_s)
    assert choose_vertices(place, fed, at_s, command, DT_S, least, *given.values(), keep)
    return keep, place


def sampled(points: NDArray[Any], at_s: NDArray[np.float64]) -> NDArray[np.float64]:
    t_s = DT_S * np.arange(int(at_s[-1] / DT_S + 1e-9) + 1)
    return np.column_stack(
        [np.interp(t_s, at_s, points[:, axis]) for axis in range(points.shape[1])]
    )


def hops(place: NDArray[np.int64], *, corexy: bool) -> NDArray[np.int64]:
    """Steps of the motor that makes the most, move by move."""
    way = np.abs(np.diff(place[:, :2], axis=0))
    return np.asarray(way.sum(axis=1) if corexy else way.max(axis=1))


def squares(fit: NDArray[Any], own: NDArray[Any], at_s: NDArray[np.float64], keep: Any) -> float:
    gap = sampled(own[keep][:, :2], at_s[keep]) - sampled(fit, at_s)
    return float(np.sum(gap**2))


@st.composite
def motions(draw: st.DrawFn) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A fit that hurries, creeps and turns back: start and vertices in steps, and their times."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    n = draw(st.integers(2, 40))
    speed = rng.normal(size=(n, 2)).cumsum(axis=0) * draw(st.sampled_from([0.3, 1.0, 4.0]))
    at_s = DT_S * np.append(0, np.cumsum(rng.integers(1, 5, n)))
    return np.vstack([np.zeros(2), speed.cumsum(axis=0)]), at_s


@given(motions(), st.sampled_from([2, 6, 12]), st.booleans())
@settings(max_examples=40, deadline=None)
def test_no_move_is_short_and_none_turns_straight_back(
    motion: tuple[NDArray[np.float64], NDArray[np.float64]], least: int, corexy: bool
) -> None:
    fit, at_s = motion
    keep, place = choose(fit, at_s, least, corexy=corexy)
    assert keep[[0, -1]].all()
    assert np.array_equal(place[[0, -1], :2], np.round(fit[[0, -1]]))
    if keep.sum() > 2:
        assert np.all(hops(place[keep], corexy=corexy) >= least)
    # A vertex moves by two steps at most, or two parts of a sixth of the least.
    moved = np.abs(place[:, :2] - np.round(fit))[keep]
    assert np.max(moved) <= 2 * max(1, (least + 3) // 6)


@given(motions())
@settings(max_examples=40, deadline=None)
def test_it_is_better_than_leaving_out_what_comes_too_soon(
    motion: tuple[NDArray[np.float64], NDArray[np.float64]],
) -> None:
    fit, at_s = motion
    place, group = np.round(np.column_stack([fit, 0 * at_s])).astype(np.int64), np.zeros(len(fit))
    greedy = np.ones(len(fit), np.bool_)
    begin, start_s = place[:1], np.zeros(1)
    rest, kept = group[1:].astype(np.int64), greedy[1:]
    thin(place[1:], begin, at_s[1:], start_s, rest, 6, 1e9, 8.0, False, kept)
    back = np.diff(place[greedy][:, :2], axis=0)
    turns = np.sum(back[1:] * back[:-1], axis=1) < 0
    keep, own = choose(fit, at_s)
    # A turn straight back is the one thing that the greedy choice may have and this one not.
    if not turns.any() and np.max(np.diff(at_s[greedy])) <= 0.025:
        assert squares(fit, own, at_s, keep) <= squares(fit, place, at_s, greedy) + 1e-9


@pytest.mark.parametrize("seed", range(4))
def test_nothing_is_nearer_among_all_choices(seed: int) -> None:
    """Every set of vertices at every place, tried one by one."""
    rng = np.random.default_rng(seed)
    fit = np.vstack([np.zeros(2), np.cumsum(rng.uniform((4, -2), (7, 2), (3, 2)), axis=0)])
    at_s = DT_S * np.array([0, 2, 5, 7])
    keep, own = choose(fit, at_s)
    beside = [None, *product(range(-2, 3), repeat=2)]
    best = np.inf
    for choice in product(beside, repeat=2):
        trial = np.round(fit).astype(np.int64)
        kept = np.array([True, *(c is not None for c in choice), True])
        for k, c in enumerate(choice, 1):
            trial[k] += c or (0, 0)
        if np.all(hops(trial[kept], corexy=False) >= 6):
            best = min(best, squares(fit, trial, at_s, kept))
    assert squares(fit, own, at_s, keep) == pytest.approx(best)


def test_a_turn_below_the_least_is_kept_in_place() -> None:
    # 40 mm/s out and back at 80 steps/mm and 20 m/s2; greedily, the turn comes late or not at all.
    at_s = DT_S * np.arange(21)
    x = 40.0 - 0.8 * (np.arange(21) - 10.0) ** 2 / 2.0
    keep, own = choose(np.column_stack([x - x[0], 0.0 * x]), at_s)
    gap = np.abs(sampled(own[keep], at_s[keep])[:, 0] - (x - x[0]))
    assert gap.max() < 3.0


def test_where_the_filament_begins_stays_a_vertex() -> None:
    # Straight on and then slowly: for X and Y alone, one of the last three is enough.
    x, at_s = np.array([0.0, 100.0, 200.0, 203.0, 206.0]), DT_S * np.array([0, 10, 20, 23, 26])
    fit = np.column_stack([x, 0.0 * x])
    keep, _ = choose(fit, at_s, fed=np.array([0.0, 0.0, 30.0, 31.0, 32.0]))
    assert keep[1]


def test_steps_of_speed_stay_small_where_they_can() -> None:
    rng = np.random.default_rng(3)
    at_s = DT_S * np.arange(200)
    fit = np.column_stack([30 * np.sin(at_s / 0.004), 9 * np.cos(at_s / 0.007)])
    fit = fit - fit[0] + rng.normal(size=fit.shape) * 0.3
    fit[0] = 0.0

    def largest(most_hz: float) -> float:
        keep, own = choose(fit, at_s, step_hz=np.full(2, most_hz))
        rate = np.diff(own[keep][:, :2], axis=0) / np.diff(at_s[keep])[:, None]
        slack = 1.0 / np.diff(at_s[keep])
        return float(np.max(np.abs(np.diff(rate, axis=0)).max(axis=1) - slack[1:] - slack[:-1]))

    assert largest(4000.0) < min(4100.0, largest(np.inf) - 1000.0)


# The road


@pytest.mark.slow
def test_a_stock_printer_executes_every_move_of_a_stream(tmp_path: Path) -> None:
    firmware = Marlin(
        steps_per_mm=PerAxis(x=80.0, y=80.0, z=400.0, e=93.0),
        planner=MarlinPlanner(
            max_accel_mm_s2=PerAxis(x=3000.0, y=3000.0, z=200.0, e=5000.0),
            max_feedrate_mm_s=PerAxis(x=500.0, y=500.0, z=20.0, e=100.0),
            accel_mm_s2=2000.0,
            travel_accel_mm_s2=2000.0,
            junction_deviation_mm=0.02,
        ),
        home_mm=(0.0, 0.0, 0.0),
    )
    machine = load_machine("ender3").model_copy(update={"firmware": firmware})
    source, target = tmp_path / "in.gcode", tmp_path / "out.gcode"
    print_ = "\n".join([*polygon(6, 15), *polygon(4, 2, (113.0, 100.0), feed=1800)])
    source.write_text(HEAD + "G1 X115 Y100 F6000\n" + print_ + "\nG1 E-1 F2100\nG28 X\n")
    result = compensate_file(source, target, machine, Options(), cache_dir=tmp_path / "cache")
    assert result.put_back == []
    assert result.emission_max_um < 60.0
    text = target.read_bytes()
    assert b"swallows moves below 6 steps (75 um)" in text
    assert shortest_hop(machine, text) >= 6


def shortest_hop(machine: Machine, text: bytes) -> int:
    """Fewest steps of X and Y that a move of a file makes that moves them at all."""
    reader = Interpreter(machine)
    blocks: list[ProgramBlock] = [*reader.push(text), *reader.flush()]
    ends = np.concatenate([b.moves.end_mm[:, :2] for b in blocks if len(b.moves)])
    steps = np.abs(np.diff(np.round(80.0 * ends), axis=0)).max(axis=1)
    return int(np.min(steps[steps > 0]))
