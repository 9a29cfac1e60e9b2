"""Limits of commands, and gentler commands around places beyond them."""

from __future__ import annotations

from functools import partial

import numpy as np

from stillpath.compensation.limits import CommandBounds, eased
from stillpath.models.machine import CommandLimits, Machine, MotorLimits
from stillpath.models.store import load_machine

DT_S = 1e-3
STILL = np.zeros((2, 1000))


def machine(motors: MotorLimits | None = None) -> Machine:
    limits = CommandLimits(velocity_mm_s=100.0, accel_mm_s2=1000.0, motors=motors)
    return load_machine("generic-corexy").model_copy(update={"command": limits})


def accelerating(at: int, x_mm_s2: float, y_mm_s2: float) -> np.ndarray:
    """Ten samples of acceleration, then as many of braking."""
    accel = np.zeros((2, 1000))
    accel[:, at : at + 10] = np.array([[x_mm_s2], [y_mm_s2]])
    accel[:, at + 10 : at + 20] = -accel[:, at : at + 10]
    return np.cumsum(np.cumsum(accel, axis=1), axis=1) * DT_S**2


def test_only_the_axis_and_the_place_are_marked() -> None:
    u = accelerating(500, 999.0, 1001.0)
    beyond = CommandBounds(machine(), DT_S).beyond(u, STILL)
    assert not beyond[0].any()
    assert beyond[1].sum() == 20
    assert set(np.flatnonzero(beyond[1])) <= set(range(495, 525))


def test_speed_counts_too() -> None:
    u = np.stack([np.arange(1000) * 0.1001, np.zeros(1000)])
    assert CommandBounds(machine(), DT_S).beyond(u, STILL)[0, 1:].all()


def test_both_axes_together_may_ask_too_much_of_a_motor() -> None:
    u = accelerating(500, 800.0, 800.0)
    assert not CommandBounds(machine(), DT_S).beyond(u, STILL).any()
    motors = MotorLimits(accel_mm_s2=1500.0)
    beyond = CommandBounds(machine(motors), DT_S).beyond(u, STILL)
    assert beyond[0].sum() == beyond[1].sum() == 20


def test_what_is_needed_anyway_is_allowed() -> None:
    u = accelerating(500, 1500.0, 0.0)
    assert not CommandBounds(machine(), DT_S).beyond(u, accelerating(100, 1500.0, 0.0)).any()


def test_the_way_over_to_a_gentler_command_is_gentle() -> None:
    sharp = accelerating(500, 1100.0, 0.0)
    gentle = accelerating(500, 900.0, 0.0)
    beyond = partial(CommandBounds(machine(), DT_S).beyond, wanted_mm=STILL)
    u = eased(sharp, gentle, beyond, DT_S, 4)
    assert not beyond(u).any()
    np.testing.assert_allclose(u[:, 500:520], gentle[:, 500:520], atol=1e-12)
    np.testing.assert_array_equal(u[:, [0, -1]], sharp[:, [0, -1]])
