"""Vertices for a firmware that swallows short moves: far enough apart, near the command."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from stillpath.gcode.firmware import _vertex_kernels as kernels
from stillpath.gcode.firmware.vertices import Lattice, _response_of, vertices_on_steps
from stillpath.gcode.interpreter import Interpreter
from stillpath.gcode.segments import ErrorFilter, Segments
from stillpath.gcode.timeline import Timeline
from stillpath.gcode.types import ProgramBlock
from stillpath.models.firmware import Marlin
from stillpath.models.firmware.marlin import PerAxis
from stillpath.models.machine import Machine
from stillpath.models.plants import plant_set
from stillpath.models.store import load_machine
from stillpath.simulation.response import response
from tests.compensating import compensated
from tests.gcode.cutting import HEAD, MARLIN_PLANNER
from tests.gcode.prints import polygon

DT_S = 1e-3
RIGID = None
PLANTS = [plant_set(load_machine("ender3").axes[axis], DT_S).nominal for axis in ("x", "y")]
SOFT = ErrorFilter(PLANTS)


def lattice(least: int, *, corexy: bool = False, speed_step: float = np.inf) -> Lattice:
    """One step a mm in X and Y: what is said in mm is in steps."""
    return Lattice(
        per_mm=np.array([1.0, 1.0, 400.0, 1.0]),
        low=np.full(2, -(10**6)),
        high=np.full(2, 10**6),
        least=least,
        corexy=corexy,
        speed_step_mm_s=speed_step,
        spare_steps=1.0,
        accel_mm_s2=np.inf,
        moves_per_s=1000.0,
    )


def choose(
    fit: NDArray[Any],
    at_s: NDArray[Any],
    least: int = 6,
    answer: ErrorFilter | None = RIGID,
    tolerance_mm: float = 0.0,
    **options: Any,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Times and places in steps, X Y, for a fit with its start; it may have a column of E."""
    mm = np.zeros((len(fit), 4))
    mm[:, :2] = fit[:, :2]
    mm[:, 3] = fit[:, 2] if fit.shape[1] > 2 else 0.0
    group = np.zeros(len(fit) - 1, np.int64)
    segments = Segments(at_s[1:] + 0.25, mm[1:].T.copy(), group, answer, tolerance_mm)
    own = vertices_on_steps(lattice(least, **options), timeline_of(mm, at_s + 0.25), segments)
    return np.append(0.0, own.end_s - 0.25), np.vstack([mm[0, :2], own.end_mm[:2].T])


def timeline_of(mm: NDArray[Any], at_s: NDArray[np.float64]) -> Timeline:
    """One whose path is the command, beginning after another stretch."""
    t_s = DT_S * np.arange(round(at_s[-1] / DT_S) + 2)
    path = np.stack([np.interp(t_s, at_s, row) for row in mm.T])
    return cast(
        Timeline,
        SimpleNamespace(dt_s=DT_S, start_s=at_s[:1], group_start_mm=mm[:1], position_mm=path),
    )


def sampled(points: NDArray[Any], at_s: NDArray[np.float64]) -> NDArray[np.float64]:
    t_s = DT_S * np.arange(int(at_s[-1] / DT_S + 1e-9) + 1)
    return np.column_stack([np.interp(t_s, at_s, row) for row in points.T])


def hops(place: NDArray[Any], *, corexy: bool) -> NDArray[Any]:
    """Steps of the motor that makes the most, move by move."""
    way = np.abs(np.diff(place, axis=0))
    return np.asarray(way.sum(axis=1) if corexy else way.max(axis=1))


def answered(error: NDArray[Any]) -> float:
    """Root mean square of what the printer makes of an error (n, 2)."""
    return float(np.sqrt(np.mean(np.sum(response(PLANTS, error.T.copy()) ** 2, axis=0))))


@st.composite
def motions(draw: st.DrawFn) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A fit that hurries, creeps and turns back: start and vertices in steps, and their times."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    n = draw(st.integers(2, 40))
    speed = rng.normal(size=(n, 2)).cumsum(axis=0) * draw(st.sampled_from([0.3, 1.0, 4.0]))
    at_s = DT_S * np.append(0, np.cumsum(rng.integers(1, 5, n)))
    fit = np.vstack([np.zeros(2), speed.cumsum(axis=0)])
    fit[-1] = np.round(fit[-1])
    return fit, at_s


@given(motions(), st.sampled_from([1, 2, 6, 12]), st.booleans())
@settings(max_examples=40)
def test_vertices_are_whole_steps_far_enough_apart_in_time(
    motion: tuple[NDArray[np.float64], NDArray[np.float64]], least: int, corexy: bool
) -> None:
    fit, at_s = motion
    own_s, own = choose(fit, at_s, least, SOFT, corexy=corexy)
    assert np.array_equal(own, np.round(own))
    assert np.array_equal(own[[0, -1]], fit[[0, -1]])
    assert np.allclose(own_s[[0, -1]], at_s[[0, -1]])
    assert np.all(np.diff(own_s) >= 0.5 * DT_S - 1e-12)
    if len(own) > 2:
        assert np.all(hops(own, corexy=corexy) >= least)


@pytest.mark.parametrize("least", [1, 6])
def test_straight_lines_are_followed_far_closer_than_by_rounding(least: int) -> None:
    """60 mm/s at 80 steps/mm, anywhere between the steps, some nearly along an axis."""
    rng = np.random.default_rng(7)
    at_s = DT_S * np.arange(0.0, 200.0, 3.0)
    way = 4800.0 * at_s
    ours, rounded = np.zeros(40), np.zeros(40)
    for k in range(len(ours)):
        turn = rng.uniform(0.0, 6.28) if k % 4 else 0.5 * np.pi * (k // 4) + rng.normal() * 0.01
        fit = np.column_stack([np.cos(turn) * way, np.sin(turn) * way])
        fit[1:-1] += rng.uniform() * np.array([-np.sin(turn), np.cos(turn)])
        fit[-1] = np.round(fit[-1])
        own_s, own = choose(fit, at_s, least, SOFT)
        wanted = sampled(fit, at_s)
        ours[k] = answered(sampled(own, own_s) - wanted)
        rounded[k] = answered(sampled(np.round(fit), at_s) - wanted)
    assert ours.mean() < 0.15 * rounded.mean()
    assert np.all(ours < np.maximum(0.75 * rounded, 0.15))


def test_a_coarse_fit_has_fewer_vertices_on_straight_lines() -> None:
    fit, at_s = np.array([[0.0, 0.0], [2400.0, 700.0]]), np.array([0.0, 0.4])
    fine, coarse = (
        len(choose(fit, at_s, 1, SOFT, tolerance_mm=tolerance_mm)[0])
        for tolerance_mm in (2e-3, 1e-2)
    )
    assert fine == pytest.approx(100, rel=0.1)
    assert coarse == pytest.approx(25, rel=0.2)


def test_a_turn_below_the_least_is_kept_in_place() -> None:
    # 40 mm/s out and back at 80 steps/mm and 20 m/s2; greedily, the turn comes late or not at all.
    at_s = DT_S * np.arange(21)
    x = 40.0 - 0.8 * (np.arange(21) - 10.0) ** 2 / 2.0
    own_s, own = choose(np.column_stack([x - x[0], 0.0 * x]), at_s)
    gap = np.abs(sampled(own, own_s)[:, 0] - (x - x[0]))
    assert gap.max() < 3.0


def test_where_the_filament_begins_stays_a_vertex() -> None:
    # Straight on and then slowly: for X and Y alone, one of the last three is enough.
    x, at_s = np.array([0.0, 100.0, 200.0, 203.0, 206.0]), DT_S * np.array([0, 10, 20, 23, 26])
    fed_mm = 0.01 * np.array([0.0, 0.0, 30.0, 31.0, 32.0])
    own_s, _ = choose(np.column_stack([x, 0.0 * x, fed_mm]), at_s)
    assert np.min(np.abs(own_s - 0.01)) <= 2 * DT_S


def test_steps_of_speed_stay_small_where_they_can() -> None:
    rng = np.random.default_rng(3)
    at_s = DT_S * np.arange(200)
    fit = np.column_stack([30 * np.sin(at_s / 0.004), 9 * np.cos(at_s / 0.007)])
    fit = fit - fit[0] + rng.normal(size=fit.shape) * 0.3
    fit[0] = 0.0

    def largest(most: float) -> float:
        own_s, own = choose(fit, at_s, speed_step=most)
        rate = np.diff(own, axis=0) / np.diff(own_s)[:, None]
        slack = 1.0 / np.diff(own_s)
        return float(np.max(np.abs(np.diff(rate, axis=0)).max(axis=1) - slack[1:] - slack[:-1]))

    assert largest(3600.0) < 0.9 * largest(np.inf)


def test_no_vertex_leaves_the_travel() -> None:
    at_s = DT_S * np.arange(0.0, 100.0, 2.0)
    fit = np.column_stack([5000.0 * at_s, np.full(len(at_s), 3.0)])
    within = replace(lattice(1), high=np.array([10**6, 3]))
    fit[0] = 0.0
    mm = np.zeros((len(fit), 4))
    mm[:, :2] = fit
    segments = Segments(at_s[1:], mm[1:].T.copy(), np.zeros(len(fit) - 1, np.int64), SOFT)
    own = vertices_on_steps(within, timeline_of(mm, at_s), segments)
    assert np.max(own.end_mm[1]) == 3.0


def cost_of_all(
    times: NDArray[np.float64],
    places: NDArray[Any],
    command: NDArray[np.float64],
    heading: NDArray[np.float64],
) -> float:
    """What `_vertex_kernels` says that it makes small, by plain sums: a way through vertices."""
    samples = np.arange(1, len(command))
    error = np.column_stack([np.interp(samples, times, places[:, a]) for a in (0, 1)])
    error -= command[1:]
    # The answer rings on after the end.
    silence = np.zeros((1000, 2))
    lag = np.arange(len(error) + len(silence))
    answer = np.empty((len(lag), 2))
    for a in (0, 1):
        ringing = (SOFT.pole[a] ** lag[:, None] @ SOFT.weight[a]).real
        impulse = np.append(SOFT.direct[a], ringing[:-1])
        answer[:, a] = np.convolve(np.concatenate([error, silence])[:, a], impulse)[: len(lag)]

    def counted(value: NDArray[np.float64]) -> float:
        along = np.sum(value * heading[1:], axis=1)
        return float(np.sum(value**2) - (1.0 - kernels._ALONG) * np.sum(along**2))

    square = np.sum(error**2, axis=1)
    far = np.sum(np.maximum(square - kernels._FAR, 0.0))
    ringing_on = np.sum(answer[len(error) :] ** 2, axis=0)
    later = np.sum(ringing_on * (1.0 - (1.0 - kernels._ALONG) * heading[-1] ** 2))
    return counted(answer[: len(error)]) + kernels._SEEN * counted(error) + float(far + later)


def test_the_choice_is_nearly_the_best_of_all() -> None:
    """A bend at 38 mm/s (80 steps/mm) with four vertices to place or leave out: all 1 296 ways."""
    rng = np.random.default_rng(5)
    excess = np.zeros(3)
    for case in range(len(excess)):
        n, at = 6, np.arange(0.0, 11.0, 2.0)
        turn = np.cumsum(rng.normal(rng.uniform(-0.2, 0.2), 0.05, 11)) + rng.uniform(0.0, 6.28)
        heading = np.column_stack([np.cos(turn), np.sin(turn)])
        command = np.zeros((11, 3))
        command[1:, :2] = np.cumsum(3.0 * heading[1:], axis=0)
        command[-1] = np.round(command[-1])
        place, place_at = (
            np.zeros((n, kernels.MOST_PLACES, 2), np.int64),
            np.zeros((n, kernels.MOST_PLACES)),
        )
        count = np.array([1, 5, 5, 5, 5, 1])
        for k in range(n):
            nearest = np.round(command[2 * k, :2])
            beside = [(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)]
            place[k, : count[k]] = nearest + np.array(beside[: count[k]])
            place_at[k, : count[k]] = at[k] + rng.uniform(-0.5, 0.5, count[k]) * (0 < k < n - 1)
        chosen, z = np.zeros(n, np.int64), np.zeros(n, np.int64)
        places = kernels.Places(place, place_at, count, np.ones(n, np.bool_))
        bend = np.array([1e9, 1e9, np.inf])
        rules = kernels.Rules(6, np.ones(2), np.full(2, np.inf), 1.0, bend, False)
        assert kernels.choose_vertices(
            places, z, command, heading, rules, _response_of(SOFT), chosen
        )

        def cost(
            which: tuple[int, ...],
            place: NDArray[Any] = place,
            place_at: NDArray[Any] = place_at,
            command: NDArray[Any] = command,
            heading: NDArray[Any] = heading,
        ) -> float:
            taken = np.flatnonzero(np.array(which) >= 0)
            where = place[taken, np.array(which)[taken]]
            if np.min(hops(where, corexy=False)) < 6:
                return np.inf
            when = place_at[taken, np.array(which)[taken]]
            return cost_of_all(when, where, command[:, :2], heading)

        best = min(cost((0, *x, 0)) for x in itertools.product(range(-1, 5), repeat=4))
        excess[case] = cost(tuple(chosen.tolist())) / best - 1.0
    assert np.all(excess > -1e-9)
    assert np.mean(excess) < 0.1
    assert np.max(excess) < 0.3


# The pipeline


@pytest.mark.slow
def test_a_stock_printer_executes_every_move_of_a_stream(tmp_path: Path, cache: Path) -> None:
    firmware = Marlin(
        steps_per_mm=PerAxis(x=80.0, y=80.0, z=400.0, e=93.0),
        planner=MARLIN_PLANNER,
        home_mm=(0.0, 0.0, 0.0),
    )
    machine = load_machine("ender3").model_copy(update={"firmware": firmware})
    print_ = "\n".join([*polygon(6, 15), *polygon(4, 2, (113.0, 100.0), feed=1800)])
    print_ = HEAD + "G1 X115 Y100 F6000\n" + print_ + "\nG1 E-1 F2100\nG28 X\n"
    result, text = compensated(print_, tmp_path, cache, machine)
    assert result.put_back == []
    assert result.emission_max_um < 60.0
    assert b"swallows moves below 6 steps (75 um)" in text
    assert shortest_hop(machine, text) >= 6


def shortest_hop(machine: Machine, text: bytes) -> int:
    """Fewest steps of X and Y that a move of a file makes that moves them at all."""
    reader = Interpreter(machine)
    blocks: list[ProgramBlock] = [*reader.push(text), *reader.flush()]
    ends = np.concatenate([b.moves.end_mm[:, :2] for b in blocks if len(b.moves)])
    steps = np.abs(np.diff(np.round(80.0 * ends), axis=0)).max(axis=1)
    return int(np.min(steps[steps > 0]))
