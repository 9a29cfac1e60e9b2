"""Ripple undone: exact where it enters, within limits, standing still in rests."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stillpath.compensation.base import DesignError
from stillpath.compensation.registry import compensator
from stillpath.compensation.ripple import PassThrough, RippleCompensator, input_command, wave_shares
from stillpath.models.identification.ripple import PassLog, WaveBasis, learn_ripple, update_ripple
from stillpath.models.machine import AxisTravel, CommandLimits, Machine
from stillpath.models.plants import Mode, ModesSpec, PlantSetSpec, continuous
from stillpath.models.ripple import (
    AxisRipple,
    RippleSide,
    RippleTable,
)
from stillpath.models.store import load_machine
from stillpath.simulation.response import response
from tests.models.test_ripple import drive as along_x
from tests.models.test_ripple import ripple as axis_ripple

DT = 1e-3
FINER = 8
NO_RESTS = np.zeros((0, 2), np.int64)


def printer(f_hz: float = 45.0, accel: float = 80_000.0, name: str = "ender3") -> Machine:
    plants = PlantSetSpec(nominal=ModesSpec(modes=(Mode(f_hz=f_hz, zeta=0.05),)))
    limits = CommandLimits(accel_mm_s2=accel)
    update = {"axes": {"x": plants, "y": plants}, "command": limits}
    return load_machine(name).model_copy(update=update)


def rippled(machine: Machine, **ripple: AxisRipple) -> Machine:
    document = machine.model_dump(mode="json")
    return Machine.model_validate(
        document | {"ripple": {axis: r.model_dump(mode="json") for axis, r in ripple.items()}}
    )


def drive(kind: str, seconds: float = 6.0, speed: float = 80.0) -> np.ndarray:
    """X goes, Y stands; at rest at both ends."""
    x = along_x(kind, seconds, speed)
    return np.stack([x, np.zeros_like(x)])


def moved(
    u: np.ndarray, table: RippleTable, side: RippleSide, path: np.ndarray, f_hz: float = 45.0
):
    """Where the axis is at the samples, of a command that is linear between them."""
    n = len(u)
    fine = np.interp(np.arange((n - 1) * FINER + 1) / FINER, np.arange(n), u)
    entering = fine + table.deviation_mm(fine) if side == "input" else fine
    plant = continuous(ModesSpec(modes=(Mode(f_hz=f_hz, zeta=0.05),))).discretise(DT / FINER)
    y = response([plant], entering[None])[0][::FINER]
    return y if side == "input" else y + table.deviation_mm(path)


def cut(u: np.ndarray, path: np.ndarray, side: RippleSide = "input", f_hz: float = 45.0) -> float:
    """Share of the ripple (rms at the tool) that is gone, starts and stops left out."""
    table = axis_ripple(side).table(side)
    nothing = RippleTable(np.zeros(0), np.zeros(0, complex))
    clean = moved(path, nothing, side, path, f_hz)
    inner = slice(500, -500)
    before = moved(path, table, side, path, f_hz)[inner] - clean[inner]
    after = moved(u, table, side, path, f_hz)[inner] - clean[inner]
    return float(1 - np.sqrt(np.mean(after**2) / np.mean(before**2)))


def undo(path: np.ndarray, ripple: AxisRipple, machine: Machine | None = None) -> np.ndarray:
    made = RippleCompensator(PassThrough(), rippled(machine or printer(), x=ripple), DT)
    return made.compensate(path, np.ones(path.shape[1], bool), NO_RESTS)


@settings(max_examples=50)
@given(st.lists(st.floats(-300, 300), min_size=1, max_size=60))
def test_table_cancels_exactly_on_the_input_side(points: list[float]) -> None:
    wanted = np.array(points)
    table = axis_ripple().table("input")
    u = input_command(wanted, table)
    assert u + table.deviation_mm(u) == pytest.approx(wanted, abs=1e-11)


def test_a_ripple_steeper_than_the_axis_is_refused() -> None:
    steep = RippleTable(np.array([100.0]), np.array([0.02 + 0j]))
    with pytest.raises(DesignError, match="turn back"):
        input_command(np.zeros(3), steep)


class TestCut:
    @pytest.mark.parametrize("kind", ["constant", "ramp", "stop and go"])
    def test_input_side_at_any_speed(self, kind: str) -> None:
        path = drive(kind)
        assert cut(undo(path, axis_ripple())[0], path[0]) > 0.99

    @pytest.mark.parametrize("speed", [10.0, 180.0])
    def test_input_side_at_constant_speeds(self, speed: float) -> None:
        path = drive("constant", speed=speed)
        assert cut(undo(path, axis_ripple())[0], path[0]) > 0.99

    @pytest.mark.parametrize("kind", ["constant", "ramp", "stop and go"])
    def test_output_side_at_varying_speed(self, kind: str) -> None:
        path = drive(kind)
        u = undo(path, axis_ripple("output"))
        assert cut(u[0], path[0], "output") > 0.97

    @pytest.mark.parametrize("kind", ["constant", "stop and go"])
    @pytest.mark.parametrize("error", [0.95, 1.05])
    def test_learnt_over_passes_with_a_wrong_model(self, kind: str, error: float) -> None:
        """5 % of frequency and 10 um of noise: the map is the input's, so it comes out right."""
        path, rng = drive(kind), np.random.default_rng(4)
        plant = continuous(ModesSpec(modes=(Mode(f_hz=45.0, zeta=0.05),))).discretise(DT)
        true, known, u = axis_ripple().table("input"), None, path
        for _ in range(9):
            y = moved(u[0], true, "input", path[0], 45.0 * error)
            noise = rng.normal(scale=0.01, size=len(y))
            log = PassLog(path[0], DT * np.arange(len(y)), y + noise, homed=True)
            learnt = learn_ripple([log], (WaveBasis("belt", 2.0),), plant).ripple
            if known is not None:
                learnt = update_ripple(known, learnt, gain=0.8, remaining=True)
            known = learnt
            u = undo(path, known)
        assert cut(u[0], path[0], f_hz=45.0 * error) > 0.95


class TestRests:
    def test_command_stands_on_the_plan(self) -> None:
        path = np.hstack([drive("constant", 2.0), drive("constant", 2.0)])
        path[0, 2000:] += path[0, 1999]
        hold = np.repeat(path[:, 1999:2000], 300, axis=1)
        path = np.hstack([path[:, :2000], hold, path[:, 2000:]])
        rests = np.array([[2000, 2300]])
        made = RippleCompensator(PassThrough(), rippled(printer(), x=axis_ripple()), DT)
        u = made.compensate(path, np.ones(path.shape[1], bool), rests)
        assert np.all(u[:, 1999:2300] == path[:, 1999:2000])
        assert np.all(u[:, [0, -1]] == path[:, [0, -1]])

    def test_around_fbf(self) -> None:
        path = drive("constant", 2.0)
        machine = printer(accel=20_000.0)
        inner = compensator("fbf", machine, DT)
        made = compensator("fbf+ripple", rippled(machine, x=axis_ripple()), DT)
        assert made.name == "fbf+ripple"
        made.reset(path[:, 0])
        u = made.compensate(path, np.ones(path.shape[1], bool), NO_RESTS)
        table = axis_ripple().table("input")
        nothing = RippleTable(np.zeros(0), np.zeros(0, complex))
        inner_only = inner.compensate(path, np.ones(path.shape[1], bool), NO_RESTS)
        middle = slice(300, -300)
        straight = moved(inner_only[0], nothing, "input", path[0])[middle]
        shaken = moved(inner_only[0], table, "input", path[0])[middle]
        undone = moved(u[0], table, "input", path[0])[middle]
        assert np.std(undone - straight) < 0.01 * np.std(shaken - straight)


class TestLimits:
    def test_keeps_the_acceleration(self) -> None:
        path = drive("constant", 3.0, speed=250.0)
        machine = printer(accel=10_000.0)
        made = RippleCompensator(PassThrough(), rippled(machine, x=axis_ripple()), DT)
        u = made.compensate(path, np.ones(path.shape[1], bool), NO_RESTS)
        assert np.abs(np.diff(u, 2)).max() / DT**2 <= 10_000.0
        assert 0 < made.budget_mm_s2 < 10_000.0

    @pytest.mark.parametrize("side", [1.0, -1.0])
    def test_ends_with_the_travel(self, side: float) -> None:
        """X stands at an end of the travel for a while, where the table would have it beyond."""
        places = np.linspace(100.0, 102.0, 201)
        end_mm = places[np.argmin(side * axis_ripple().table("input").deviation_mm(places))]
        way = drive("constant", 3.0)[0]
        there = end_mm + side * (way - way[-1])
        x = np.concatenate([there, np.full(500, end_mm), there[::-1]])
        machine = printer()
        ends = AxisTravel(min_mm=float(x.min()), max_mm=float(x.max()))
        machine = machine.model_copy(update={"travel": {**machine.travel, "x": ends}})
        path = np.stack([x, np.full(len(x), 50.0)])
        u = undo(path, axis_ripple(), machine)[0]
        assert ends.min_mm <= u.min() < u.max() <= ends.max_mm
        assert np.ptp((u - x)[: len(way)]) > 0.03

    def test_slow_motion_has_all_of_every_wave(self) -> None:
        path = drive("constant", speed=20.0)[0]
        shares = wave_shares(path, axis_ripple().table("input"), DT, 20_000.0)
        assert np.all((shares >= 1.0) & (shares < 1.004))
        assert np.all(shares[:, [0, -1]] == pytest.approx(1.0, abs=1e-6))

    def test_fast_motion_fades(self) -> None:
        path = drive("constant", speed=320.0)[0]
        shares = wave_shares(path, axis_ripple().table("input"), DT)
        assert shares[0, 3000] == pytest.approx(1 / np.sinc(0.16) ** 2)
        assert shares[2, 3000] == pytest.approx(0.0, abs=1e-12)


class TestAxes:
    def test_motors_of_corexy(self) -> None:
        """Ripple of motor A shows in X and Y; with the table, A receives what it should."""
        machine = printer(name="generic-corexy")
        path = drive("constant", 3.0) + 30.0
        made = RippleCompensator(PassThrough(), rippled(machine, a=axis_ripple()), DT)
        u = made.compensate(path, np.ones(path.shape[1], bool), NO_RESTS)
        a, b = u[0] + u[1], u[0] - u[1]
        table = axis_ripple().table("input")
        inner = slice(500, -500)
        received = a + table.deviation_mm(a)
        untouched = (path[0] + path[1]) + table.deviation_mm(path[0] + path[1])
        assert np.std(untouched - path[0] - path[1]) > 10e-3
        assert received[inner] == pytest.approx((path[0] + path[1])[inner], abs=5e-4)
        assert b[inner] == pytest.approx((path[0] - path[1])[inner], abs=1e-12)

    def test_axes_that_are_not_the_machines(self) -> None:
        with pytest.raises(ValueError, match="belongs to"):
            rippled(printer(name="generic-corexy"), x=axis_ripple())

    def test_without_ripple(self) -> None:
        with pytest.raises(DesignError, match="no ripple"):
            compensator("none+ripple", printer(), DT)

    def test_homing_that_would_do_harm(self) -> None:
        loose = axis_ripple(homing_repeatability_mm=0.4)
        with pytest.raises(DesignError, match=r"homing repeats only within 0\.4 mm"):
            RippleCompensator(PassThrough(), rippled(printer(), x=loose), DT)
        close = axis_ripple(homing_repeatability_mm=0.03)
        RippleCompensator(PassThrough(), rippled(printer(), x=close), DT)
