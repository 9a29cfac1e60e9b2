"""Making up for dry friction."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from stillpath.compensation.friction import FrictionCompensator, against_friction
from stillpath.compensation.registry import compensator
from stillpath.models.friction import DryFriction
from stillpath.models.machine import CommandLimits, Machine
from stillpath.models.reference_motion import reference_motion
from stillpath.models.store import load_machine
from stillpath.simulation.machine_response import MachineStream
from stillpath.simulation.measures import contour_error

DT_S = 1e-3
RESTS = np.array([[900, 1000], [2400, 2450]], np.int64)


def rubbing(x_mm: float, y_mm: float) -> Machine:
    plain = load_machine("generic-corexy")
    held = {"x": x_mm, "y": y_mm}
    axes = {k: v.model_copy(update={"friction_mm": held[k]}) for k, v in plain.axes.items()}
    return plain.model_copy(update={"axes": axes})


MACHINE = rubbing(0.003, 0.006)


def motion() -> tuple[np.ndarray, np.ndarray]:
    path, extruding = reference_motion(DT_S)
    return path[:, :8000] + 60.0, extruding[:8000]


def test_machines_without_friction_are_compensated_as_before() -> None:
    assert not isinstance(compensator("fbf", rubbing(0.0, 0.0), DT_S), FrictionCompensator)
    assert isinstance(compensator("fbf", MACHINE, DT_S), FrictionCompensator)


def test_the_print_is_better_for_it() -> None:
    path, extruding = motion()
    rms = {}
    for name, one in (
        ("with", compensator("fbf", MACHINE, DT_S)),
        ("without", compensator("fbf", MACHINE.without_friction(), DT_S)),
    ):
        one.reset(path[:, 0])
        command = one.compensate(path, extruding, np.zeros((0, 2), np.int64))
        answer = MachineStream(MACHINE, DT_S).push(command, path)
        rms[name] = float(np.sqrt(np.mean(contour_error(path, answer)[extruding] ** 2)))
    assert rms["with"] < 0.35 * rms["without"]


def test_nothing_is_added_in_rests_and_at_the_ends() -> None:
    path, _ = motion()
    for a, b in RESTS:
        path[:, a - 1 : b] = path[:, a - 1, None]
    added = against_friction(path, MACHINE.friction_mm, RESTS, DT_S) - path
    for a, b in RESTS:
        np.testing.assert_array_equal(added[:, a:b], 0.0)
    np.testing.assert_array_equal(added[:, [0, -1]], 0.0)
    assert np.abs(added).max(axis=1) == pytest.approx(MACHINE.friction_mm, rel=1e-3)


def test_an_axis_that_stops_stays_where_it_stopped() -> None:
    """The other axis moves on. The guide is another one: it rubs as much as it slips fast."""
    t_s = np.arange(1500) * DT_S
    path = np.stack([np.minimum(30.0 * t_s, 15.0), np.maximum(30.0 * t_s - 15.0, 0.0)])
    command = against_friction(path, (0.008, 0.0), np.zeros((0, 2), np.int64), DT_S)[0]
    w, held_mm, creep_mm_s = 2.0 * np.pi * 45.0, 0.008, 0.5

    def motion(t: float, state: np.ndarray) -> list[float]:
        place, speed = state
        springs = np.interp(t, t_s, command) - place
        return [speed, w**2 * (springs - held_mm * np.tanh(speed / creep_mm_s)) - 0.2 * w * speed]

    times = t_s[600:1400]
    found = solve_ivp(motion, (0.0, times[-1]), [0.0, 0.0], "LSODA", times, max_step=1e-3)
    error = found.y[0] - path[0, 600:1400]
    assert np.sqrt(np.mean(error**2)) < 0.15 * held_mm


def test_what_is_added_is_smooth_and_arrives() -> None:
    path, _ = motion()
    none = np.zeros((0, 2), np.int64)
    command = against_friction(path, MACHINE.friction_mm, none, DT_S)
    bends = np.abs(np.diff(command - path, 2)).max() / DT_S**2
    assert bends < 5000.0
    received = DryFriction(MACHINE.friction_mm, DT_S).received_mm(command)
    assert np.sqrt(np.mean((received - path)[:, 50:-50] ** 2)) < 0.1 * max(MACHINE.friction_mm)


def test_it_stays_on_the_bed() -> None:
    path, extruding = motion()
    edge = path - path.min(axis=1, keepdims=True)
    edge += np.array([[MACHINE.travel["x"].min_mm], [MACHINE.travel["y"].min_mm]])
    one = compensator("fbf", MACHINE, DT_S)
    one.reset(edge[:, 0])
    command = one.compensate(edge, extruding, np.zeros((0, 2), np.int64))
    assert command[0].min() >= MACHINE.travel["x"].min_mm
    assert command[1].min() >= MACHINE.travel["y"].min_mm


def test_one_place_at_the_limit_costs_no_more_than_this_place() -> None:
    """Motors that are at their limit in one corner compensate friction everywhere else."""
    path, extruding = motion()
    none = np.zeros((0, 2), np.int64)
    inner = compensator("fbf", MACHINE.without_friction(), DT_S)
    inner.reset(path[:, 0])
    wanted = inner.compensate(path, extruding, none)
    accel = np.abs(np.diff(wanted, 2, axis=1)) / DT_S**2
    limits = MACHINE.command.model_copy(update={"accel_mm_s2": float(accel.max())})
    one = compensator("fbf", MACHINE.model_copy(update={"command": limits}), DT_S)
    one.reset(path[:, 0])
    command = one.compensate(path, extruding, none)
    assert np.abs(np.diff(command, 2, axis=1)).max() / DT_S**2 <= accel.max() * (1 + 1e-9)
    free = against_friction(wanted, MACHINE.friction_mm, none, DT_S)
    same = np.all(np.abs(command - free) < 1e-9, axis=0)
    assert 0.8 < np.mean(same) < 1.0


def test_x_and_y_together_ask_no_more_of_a_motor_than_it_bears() -> None:
    """Both motors of a CoreXY move either axis: what each axis bears may be too much for them."""
    t = np.arange(2000) * DT_S
    path = 60.0 + 10.0 * np.stack([np.sin(6 * np.pi * t), np.sin(6 * np.pi * t)])
    inner = SimpleNamespace(name="as planned", lead_s=0.0, tail_s=0.0, compensate=lambda y, *_: y)

    def asked_mm_s2(command: np.ndarray) -> float:
        motors = np.array([[1.0, 1.0], [1.0, -1.0]]) @ command
        return float(np.abs(np.diff(motors, 2, axis=1)).max()) / DT_S**2

    def made(**limits: object) -> np.ndarray:
        command = CommandLimits.model_validate({"accel_mm_s2": 4500.0, **limits})
        machine = rubbing(0.015, 0.015).model_copy(update={"command": command})
        one = FrictionCompensator(inner, machine, DT_S)  # type: ignore[arg-type]
        return one.compensate(path, np.ones(len(t), np.bool_), np.zeros((0, 2), np.int64))

    limit = 1.02 * asked_mm_s2(path)
    assert asked_mm_s2(made()) > 1.05 * limit
    held = made(motors={"accel_mm_s2": limit})
    assert asked_mm_s2(held) <= limit
    assert np.abs(held - path).max() == pytest.approx(0.015, rel=0.05)
