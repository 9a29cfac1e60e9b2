"""RepRapFirmware's planner, worked by hand from its source: DDA.cpp, 3.6.0-beta.2."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from stillpath.gcode.errors import GcodeError
from stillpath.gcode.firmware.encoding import as_moves
from stillpath.gcode.firmware.planning import join_phases
from stillpath.gcode.firmware.reprapfirmware.limits import RepRapLimits
from stillpath.gcode.firmware.reprapfirmware.planner import RepRapPlanner
from stillpath.gcode.types import Moves, Phases, rows_of
from stillpath.models.firmware import RepRapFirmware
from stillpath.models.firmware.reprapfirmware import Drive, RepRapExtruder

FIRMWARE = RepRapFirmware(
    x=Drive(max_speed_mm_s=300.0),
    y=Drive(max_speed_mm_s=300.0),
    extruder=RepRapExtruder(max_accel_mm_s2=10_000.0, max_speed_mm_s=300.0),
)
"""Accelerations 1000 1000 200 10000, jerks 15 15 10 5, 80 80 800 steps/mm, ring of 40."""
LIMITS = RepRapLimits.of(FIRMWARE, 0.0)
CLOCK_S = 1.0 / 750_000.0


def path(points: list[tuple[float, ...]], speed: float | list[float]) -> Moves:
    """Moves through points x y [z [e]] from the first one on."""
    place = np.array([[*point, *[0.0] * (4 - len(point))] for point in points])
    n = len(place) - 1
    speeds = np.broadcast_to(np.asarray(speed, float), (n,)).copy()
    return as_moves(place[:-1].copy(), place[1:].copy(), speeds, np.zeros(n, np.int32))


def plan(
    moves: Moves,
    limits: RepRapLimits = LIMITS,
    firmware: RepRapFirmware = FIRMWARE,
    *,
    kinematics: str = "cartesian",
    cuts: tuple[int, ...] = (),
) -> Phases:
    planner = RepRapPlanner(firmware, kinematics)
    edges = [0, *sorted(cuts), len(moves)]
    parts = [planner.push_moves(rows_of(moves, slice(a, b)), [limits]) for a, b in pairwise(edges)]
    return join_phases([*parts, planner.flush()])


def test_a_move_from_rest_to_rest() -> None:
    # 60 mm/s at 1000 mm/s2: 60 ms over 1.8 mm at each end; 10 - 3.6 = 6.4 mm at 60 mm/s.
    phases = plan(path([(0, 0), (10, 0)], 60.0))
    assert phases.accel_s[0] == pytest.approx(0.06, abs=CLOCK_S)
    assert phases.cruise_s[0] == pytest.approx(6.4 / 60.0, abs=CLOCK_S)
    assert phases.decel_s[0] == pytest.approx(0.06, abs=CLOCK_S)
    assert phases.cruise_mm_s[0] == pytest.approx(60.0, abs=1e-3)


@pytest.mark.parametrize(
    ("turn", "speed"),
    [
        # Every axis may step by its jerk of 15 mm/s; the path's speed is the same on both sides.
        ((0.0, 1.0), 15.0),  # x steps by v
        ((-1.0, 0.0), 7.5),  # x steps by 2 v
        ((math.sqrt(0.5), math.sqrt(0.5)), 15.0 / math.sqrt(0.5)),  # y steps by .707 v
        ((0.8, 0.6), 25.0),  # y steps by .6 v, x only by .2 v
        ((1.0, 0.0), 60.0),
    ],
)
def test_corners_are_passed_at_the_speed_that_jerk_allows(
    turn: tuple[float, float], speed: float
) -> None:
    phases = plan(path([(0, 0), (10, 0), (10 + 10 * turn[0], 10 * turn[1])], 60.0))
    assert phases.end_mm_s[0] == pytest.approx(speed, abs=2e-3)
    assert phases.start_mm_s[1] == pytest.approx(speed, abs=2e-3)


def test_corexy_motors_limit_diagonals() -> None:
    # Along the diagonal one motor runs sqrt(2) times as fast as the path, the other one stands.
    moves = path([(0, 0), (100, 100)], 400.0)
    phases = plan(moves, kinematics="corexy")
    assert phases.cruise_mm_s[0] == pytest.approx(300.0 / math.sqrt(2.0), rel=1e-5)
    assert phases.accel_mm_s2[0] == pytest.approx(1000.0 / math.sqrt(2.0))
    assert plan(moves).accel_mm_s2[0] == pytest.approx(1000.0 * math.sqrt(2.0))


@pytest.mark.parametrize(
    ("speeds", "executed"),
    [
        # 10 clocks are 13.3 us; at 1e5 mm/s2 that is 1.33 mm/s: lower peaks are cut off.
        ([100.0, 101.0, 90.0], 100.0),
        ([90.0, 101.0, 100.0], 100.0),
        ([100.0, 102.0, 90.0], 102.0),
        ([100.0, 101.0, 200.0], 101.0),
    ],
)
def test_low_peaks_of_speed_are_cut_off(speeds: list[float], executed: float) -> None:
    limits = replace(LIMITS, accel_x_mm_s2=1e5, travel_accel_mm_s2=1e5, print_accel_mm_s2=1e5)
    phases = plan(path([(0, 0), (5, 0), (10, 0), (15, 0)], speeds), limits)
    assert phases.cruise_mm_s[1] == pytest.approx(executed, abs=0.05)


def test_the_ring_limits_the_speed_of_short_moves() -> None:
    # At most half the ring of 40 is frozen. When the next move is frozen, 19 frozen ones are not
    # over, so the ring holds 40 - 19 - 1 = 20 moves after it, and must be able to stop within
    # their 2 mm: v = sqrt(2 1000 2) = 63.2 mm/s, far below the 200 mm/s that are asked for.
    phases = plan(path([(0.1 * k, 0) for k in range(400)], 200.0))
    middle = phases.end_mm_s[150:200]
    assert middle == pytest.approx(math.sqrt(2.0 * 1000.0 * 2.0), rel=0.02)
    longer = FIRMWARE.model_copy(update={"ring_length": 200})
    phases = plan(path([(0.1 * k, 0) for k in range(400)], 200.0), firmware=longer)
    assert phases.end_mm_s[100:150].max() > 1.9 * middle.max()


def test_a_long_move_soon_after_a_standstill_ends_at_rest() -> None:
    """As the firmware's own code did on a PC (3.6-dev, 2024-10), to the clock.

    The ring takes no third move because the second one lasts more than 2 s, and when it starts, it
    freezes both: the first lasts less than 50 ms, and the wait before it does not count.
    """
    places = [(0, 0), (0.6, 0), (60, 0), (60.8, 0.6), (90, 0.6)]
    phases = plan(path(places, 26.0))
    assert phases.lasts_s / CLOCK_S == pytest.approx([27_058, 1_723_212, 36_658, 852_072], abs=0.1)
    assert phases.end_mm_s == pytest.approx([26.0, 0.0, 25.0, 0.0], abs=1e-3)
    # Where the first lasts longer, the second is frozen later, when the ring holds the third.
    phases = plan(path([(-2.0, 0), *places[1:]], 26.0))
    assert phases.end_mm_s == pytest.approx([26.0, 25.0, 25.0, 0.0], abs=1e-3)


def test_moves_that_come_too_fast_make_the_motion_stutter() -> None:
    # .5 ms each: when half the ring is frozen, the next one is frozen 9.5 ms before its time and
    # is put off until 25 ms after that.
    limits = replace(LIMITS, accel_x_mm_s2=1e6, travel_accel_mm_s2=1e6)
    phases = plan(path([(0.05 * k, 0) for k in range(400)], 100.0), limits)
    pauses = np.diff(phases.t_s) - phases.lasts_s[:-1]
    assert pauses.max() == pytest.approx(0.025 - 0.0095, abs=1e-3)
    # The firmware's own code on a PC paused for .305 s, before 3.6.0-beta.2 not at all.
    assert pauses.sum() == pytest.approx(0.305, rel=0.05)
    older = FIRMWARE.model_copy(update={"prepare_least_s": 0.0})
    phases = plan(path([(0.05 * k, 0) for k in range(400)], 100.0), limits, older)
    assert phases.t_s[-1] + phases.lasts_s[-1] == pytest.approx(0.1996013, abs=CLOCK_S)
    # 2 ms each: half a ring lasts 38 ms.
    calm = plan(path([(0.2 * k, 0) for k in range(200)], 100.0), limits)
    assert np.max(np.diff(calm.t_s) - calm.lasts_s[:-1]) < 1e-9


@pytest.mark.parametrize("speed", [1e-3, 1e-13])
def test_moves_of_a_million_years_are_planned(speed: float) -> None:
    """The clock of the plan goes on where its numbers are too large for a nanosecond."""
    limits = replace(LIMITS, speed_x_mm_s=speed, min_speed_mm_s=0.0)
    phases = plan(path([(7.3 * (k % 5), 0.1 * k) for k in range(90)], 60.0), limits)
    lasts_s = phases.lasts_s
    assert lasts_s.sum() == pytest.approx(phases.cruise_s.sum(), rel=1e-2)
    assert lasts_s.max() > 29.0 / speed


def test_a_speed_that_no_clock_can_count_is_refused() -> None:
    limits = replace(LIMITS, speed_x_mm_s=1e-300, min_speed_mm_s=0.0)
    with pytest.raises(GcodeError, match=r"line 1: .*must be above 0"):
        plan(path([(0.0, 0.0), (10.0, 0.0)], 60.0), limits)


def test_places_are_whole_steps_and_filament_is_not() -> None:
    # 80 steps/mm: .004 mm is .32 steps, rounded to 0; .02 mm is 1.6 steps, rounded to 2.
    phases = plan(path([(0.004, 0, 0, 0), (0.02, 0, 0, 0.001), (1, 0, 0, 0.05)], 10.0))
    assert phases.start_mm[:, 0].tolist() == [0.0, 0.025]
    assert phases.start_mm[1, 3] == 0.001
    # The time is that of the .016 mm that were asked for, the way is .025 mm.
    travel = phases.direction[0, 0] * 0.016
    assert travel == pytest.approx(0.025)


def test_corexy_rounds_the_places_of_the_motors() -> None:
    # x + y = .020 mm is 1.6 steps of 1/80 mm, x - y = .016 mm is 1.28: 2 and 1 steps.
    phases = plan(path([(0.018, 0.002), (5, 0)], 10.0), kinematics="corexy")
    assert phases.start_mm[0, :2] == pytest.approx([1.5 / 80.0, 0.5 / 80.0])


def test_a_move_of_no_length_has_a_row_and_takes_no_time() -> None:
    phases = plan(path([(0, 0), (0, 0), (5, 0), (5, 0), (10, 0), (10, 0)], 50.0))
    assert phases.move_index.tolist() == [0, 1, 2, 3, 4]
    assert phases.lasts_s[[0, 2, 4]].tolist() == [0.0, 0.0, 0.0]
    assert np.all(np.diff(phases.t_s) >= 0.0)
    assert phases.end_mm_s[1] == pytest.approx(50.0, rel=1e-4)


def test_a_stop_costs_the_time_in_which_the_ring_fills_again() -> None:
    planner = RepRapPlanner(FIRMWARE, "cartesian")
    first = [planner.push_moves(path([(0, 0), (5, 0)], 50.0), [LIMITS]), planner.stop(2.0)]
    second = [planner.push_moves(path([(5, 0), (9, 0)], 50.0), [LIMITS]), planner.flush()]
    phases = join_phases([*first, *second])
    # 10 ms of waiting for more moves, 50 ms between freezing and start.
    assert phases.t_s[1] - phases.lasts_s[0] == pytest.approx(2.06, abs=1e-9)


def test_limits_of_the_document_are_those_of_the_first_line() -> None:
    limits = RepRapLimits.of(RepRapFirmware(jerk_policy=1), 0.05)
    assert limits.as_row() == (
        *(1000.0, 1000.0, 200.0, 500.0),
        *(100.0, 100.0, 20.0, 100.0),
        *(0.5, 50_000.0, 50_000.0),
        *(15.0, 15.0, 10.0, 5.0),
        *(15.0, 15.0, 10.0, 5.0),
        *(1.0, 0.05),
    )


# --- the same rules once more, as plain objects with a recursive look-ahead ---


@dataclass
class Move:
    direction: np.ndarray
    length: float
    accel: float
    speed: float
    kind: tuple[bool, bool, bool]
    enter: float = 0.0
    leave: float = 0.0
    wish: float = 0.0

    def shape(self) -> tuple[float, float, float]:
        """Top speed, ways of acceleration and deceleration."""
        up = (self.speed**2 - self.enter**2) / (2 * self.accel)
        down = (self.speed**2 - self.leave**2) / (2 * self.accel)
        if up + down < self.length:
            edge = max(self.enter, self.leave)
            if edge + self.accel * 10 * CLOCK_S > self.speed and edge >= 0.9 * self.speed:
                return (edge, 0.0, down) if self.enter >= self.leave else (edge, up, 0.0)
            return self.speed, up, down
        peak2 = self.accel * self.length + (self.enter**2 + self.leave**2) / 2
        if peak2 > max(self.enter, self.leave) ** 2:
            return (
                math.sqrt(peak2),
                (peak2 - self.enter**2) / (2 * self.accel),
                (peak2 - self.leave**2) / (2 * self.accel),
            )
        if self.enter < self.leave:
            return self.leave, self.length, 0.0
        return self.enter, 0.0, self.length

    @property
    def seconds(self) -> float:
        top, up, down = self.shape()
        level = max(self.length - up - down, 0.0) / top
        if up == self.length or down == self.length:
            return 2 * self.length / (self.enter + self.leave)
        return (2 * top - self.enter - self.leave) / self.accel + level


def jerk_speed(move: Move, after: Move, limits: RepRapLimits) -> float:
    step = np.abs(move.direction - after.direction)
    jerk = np.array(limits.as_row()[11:15])
    return float(np.min(jerk[step > 0] / step[step > 0], initial=np.inf))


def raise_end(open_moves: list[Move], k: int, limits: RepRapLimits) -> None:
    """Let move k end as near to its wish as it can; moves before it may have to give way."""
    move = open_moves[k]
    move.wish = min(move.wish, move.speed)
    top, _, down = move.shape()
    reach = math.sqrt(move.enter**2 + 2 * move.accel * move.length)
    if top < move.speed:
        before = open_moves[k - 1] if k > 0 else None
        brakes = down > 0.98 * move.length
        if brakes and before is not None and before.shape()[2] > 0:
            same = before.kind[1] == move.kind[1] and (
                before.kind[0] == move.kind[0] or (before.kind[0] and before.speed == move.speed)
            )
            if limits.jerk_policy != 0 or same:
                move.wish = min(move.wish, jerk_speed(move, open_moves[k + 1], limits))
                could = math.sqrt(move.wish**2 + 2 * move.accel * move.length)
                before.wish = min(could, move.speed)
                raise_end(open_moves, k - 1, limits)
                move.enter = before.leave
                reach = math.sqrt(move.enter**2 + 2 * move.accel * move.length)
                move.leave = max(move.leave, min(move.wish, reach))
                return
        move.wish = min(move.wish, reach)
    move.leave = max(move.leave, min(move.wish, jerk_speed(move, open_moves[k + 1], limits)))


def plan_plainly(moves: Moves, limits: RepRapLimits, firmware: RepRapFirmware) -> np.ndarray:
    """Start time of every move and the end of the last one (cartesian)."""
    waiting = []
    row = limits.as_row()
    for start, end, speed in zip(moves.start_mm, moves.end_mm, moves.speed_mm_s, strict=True):
        way = end - start
        length = float(np.linalg.norm(way[:3])) or abs(float(way[3]))
        xy, prints = bool(way[:2].any()), bool(way[:2].any() and way[3] > 0)
        share = np.abs(way) / length
        accels = np.array(row[0:4])
        if prints and limits.pressure_advance_s > 0:
            accels[3] = min(accels[3], limits.max_jerk_e_mm_s / limits.pressure_advance_s)
        used = share > 0
        accel = float(np.min(accels[used] / share[used]))
        if xy:
            own = limits.print_accel_mm_s2 if prints else limits.travel_accel_mm_s2
            accel = min(accel, own)
        cap = float(np.min(np.array(row[4:8])[used] / share[used]))
        cruise = min(max(float(speed), limits.min_speed_mm_s), cap)
        kind = (prints, xy, bool(way[3] != 0 and not prints))
        waiting.append(Move(way / length, length, accel, cruise, kind))
    ring = firmware.ring_length
    frozen: list[tuple[float, float]] = []
    open_moves: list[Move] = []
    starts: list[float] = []
    now, end = -firmware.prepare_ahead_s, 0.0
    while waiting or open_moves:
        frozen = [span for span in frozen if span[1] > now + 1e-12]
        while waiting:
            used = len(frozen) + len(open_moves)
            spans = [move.seconds for move in open_moves]
            if used >= ring or (used == ring - 1 and not frozen):
                break
            if spans and sum(spans) >= 2.0 and sum(spans[1:]) >= 0.5:
                break
            new = waiting.pop(0)
            open_moves.append(new)
            if len(open_moves) > 1:
                last = open_moves[-2]
                if limits.jerk_policy != 0 or last.kind == new.kind:
                    last.wish = min(math.sqrt(2 * new.accel * new.length), new.speed)
                    raise_end(open_moves, len(open_moves) - 2, limits)
                    new.enter = last.leave
        while open_moves and 2 * len(frozen) < ring:
            lead = end - now
            left = sum(until - max(since, now) for since, until in frozen)
            # On the edge of being late the kernels' whole clocks may decide otherwise.
            assume(abs(lead - firmware.prepare_least_s) > 1e-5)
            if not frozen:
                start = now + firmware.prepare_ahead_s
            elif left > firmware.prepare_ahead_s + 1e-9:
                break
            elif lead >= firmware.prepare_least_s:
                start = end
            else:
                late = firmware.prepare_least_s
                start = now + (firmware.prepare_ahead_s if open_moves[0].enter == 0 else late)
            end = start + open_moves.pop(0).seconds
            frozen.append((start, end))
            starts.append(start)
        upcoming = [frozen[0][1]]
        if open_moves and 2 * len(frozen) < ring:
            left = firmware.prepare_ahead_s
            for since, until in reversed(frozen):
                if until - since >= left:
                    upcoming.append(until - left)
                    break
                left -= until - since
        now = max(now, min(upcoming))
    return np.array([*starts, end])


def steps_strategy() -> st.SearchStrategy[list[tuple[float, float, float, float, float]]]:
    way = st.one_of(st.just(0.0), *2 * [st.floats(-3.0, 3.0).map(lambda x: round(x, 2))])
    feed = st.sampled_from([0.0, 0.0, 0.02, 0.1, -0.5])
    climb = st.sampled_from([0.0, 0.0, 0.0, 0.2])
    speed = st.sampled_from([0.1, 5.0, 40.0, 120.0, 250.0])
    return st.lists(st.tuples(way, way, climb, feed, speed), min_size=1, max_size=90)


def moves_of(steps: list[tuple[float, float, float, float, float]]) -> Moves:
    table = np.array(steps)
    places = np.vstack([np.zeros(4), np.cumsum(table[:, :4], axis=0)])
    return path([tuple(place) for place in places], table[:, 4].tolist())


POLICIES = st.sampled_from([0.0, 1.0])
FIRMWARES = st.sampled_from(
    [FIRMWARE.model_copy(update={"ring_length": ring}) for ring in (6, 40, 200)]
)


LIMIT_SETS = st.sampled_from(
    [
        LIMITS,
        replace(LIMITS, print_accel_mm_s2=400.0, travel_accel_mm_s2=800.0),
        replace(
            LIMITS, accel_y_mm_s2=600.0, speed_y_mm_s=90.0, accel_e_mm_s2=50.0, speed_e_mm_s=2.0
        ),
    ]
)


@given(steps_strategy(), LIMIT_SETS, POLICIES, FIRMWARES, st.sampled_from([0.0, 0.05]))
@settings(max_examples=60)
def test_kernels_agree_with_plain_python(
    steps: list[tuple[float, float, float, float, float]],
    own: RepRapLimits,
    policy: float,
    firmware: RepRapFirmware,
    advance: float,
) -> None:
    moves = moves_of([step for step in steps if any(step[:4])] or [(1.0, 0.0, 0.0, 0.0, 5.0)])
    limits = replace(own, jerk_policy=policy, pressure_advance_s=advance)
    expected = plan_plainly(moves, limits, firmware)
    phases = plan(moves, limits, firmware)
    found = np.append(phases.t_s, phases.t_s[-1] + phases.lasts_s[-1])
    # Three roundings to whole clocks a move.
    allowed = 2.0 * CLOCK_S * (1 + np.arange(len(found)))
    assert np.all(np.abs(found - expected) <= allowed)


@given(steps_strategy(), POLICIES, FIRMWARES, st.sampled_from(["cartesian", "corexy"]))
@settings(max_examples=80)
def test_properties(
    steps: list[tuple[float, float, float, float, float]],
    policy: float,
    firmware: RepRapFirmware,
    kinematics: str,
) -> None:
    moves = moves_of(steps)
    limits = replace(LIMITS, jerk_policy=policy)
    phases = plan(moves, limits, firmware, kinematics=kinematics)
    # One row per move, time runs on.
    assert phases.move_index.tolist() == list(range(len(moves)))
    assert np.all(np.diff(phases.t_s) - phases.lasts_s[:-1] > -1e-9)
    # The way is whole, and ends where the next one begins.
    way = (
        0.5 * (phases.start_mm_s + phases.cruise_mm_s) * phases.accel_s
        + phases.cruise_mm_s * phases.cruise_s
        + 0.5 * (phases.cruise_mm_s + phases.end_mm_s) * phases.decel_s
    )
    end = phases.start_mm + phases.direction * way[:, None]
    moved = phases.lasts_s > 0.0
    assert np.allclose(end[:-1][moved[:-1]], phases.start_mm[1:][moved[:-1]], atol=1e-9)
    assert np.max(np.abs(phases.start_mm[:, :3] - moves.start_mm[:, :3])) <= 1.0 / 80.0
    # Limits are kept, but for the rounding to clocks.
    long = phases.lasts_s > 2e-3
    velocity = np.abs(phases.direction[long]) * phases.cruise_mm_s[long, None]
    path_mm = np.abs(moves.end_mm - moves.start_mm)[long]
    rounding = 1.0 + 2.0 / (80.0 * np.maximum(path_mm, 1e-9))
    caps = np.array([300.0, 300.0, 20.0, 300.0])
    assert np.all((velocity <= 1.01 * caps * rounding) | (path_mm == 0.0))
    # No jerk beyond the limits where two long moves meet.
    both = long_pairs(phases)
    commanded = (moves.end_mm - moves.start_mm) / np.maximum(lengths(moves), 1e-12)[:, None]
    jump = np.abs(
        commanded[1:] * phases.start_mm_s[1:, None] - commanded[:-1] * phases.end_mm_s[:-1, None]
    )
    assert np.all(jump[both] <= np.array([15.0, 15.0, 10.0, 5.0]) * 1.01 + 0.3)


def lengths(moves: Moves) -> np.ndarray:
    way = moves.end_mm - moves.start_mm
    xyz = np.linalg.norm(way[:, :3], axis=1)
    return np.where(xyz > 0.0, xyz, np.abs(way[:, 3]))


def long_pairs(phases: Phases) -> np.ndarray:
    """Pairs of neighbours that last so long that the rounding to clocks does not matter."""
    long = phases.lasts_s > 2e-3
    return long[1:] & long[:-1]


@given(steps_strategy(), FIRMWARES, st.sets(st.integers(0, 90), max_size=5))
@settings(max_examples=40)
def test_cutting_the_stream_changes_nothing(
    steps: list[tuple[float, float, float, float, float]],
    firmware: RepRapFirmware,
    cuts: set[int],
) -> None:
    moves = moves_of(steps)
    whole = plan(moves, firmware=firmware)
    cut = plan(moves, firmware=firmware, cuts=tuple(c for c in cuts if c <= len(moves)))
    for name in Phases.__dataclass_fields__:
        assert np.array_equal(getattr(whole, name), getattr(cut, name)), name


def test_a_move_without_a_step_is_still_a_move_of_its_axes() -> None:
    # .002 mm is .16 steps: the motors stand, the time passes, and the direction tells X from rest.
    phases = plan(path([(0, 0), (0.002, 0), (10, 0)], 10.0))
    assert phases.direction[0, 0] > 0.0
    assert phases.start_mm[1, 0] == 0.0
    assert phases.direction[0, 0] * 0.002 < 1e-9
    assert phases.lasts_s[0] > 0.0
