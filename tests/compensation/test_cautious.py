"""Mixtures of filtered basis functions and a shaper."""

from __future__ import annotations

import numpy as np
import pytest

from stillpath.compensation.base import DesignError
from stillpath.compensation.cautious import Caution
from stillpath.compensation.registry import compensator
from stillpath.compensation.shapers import ShaperCompensator
from stillpath.models.machine import AxisLimits, Machine
from stillpath.models.plants import plant_set
from stillpath.models.reference_motion import reference_motion
from stillpath.models.store import load_machine
from stillpath.simulation.measures import contour_error
from stillpath.simulation.response import response

DT_S = 1e-3
NO_RESTS = np.zeros((0, 2), np.int64)
MACHINE = load_machine("ender3")


def caution(x: float, y: float) -> Caution:
    return Caution((x, y), "mzv", 45.0, 33.0)


def short() -> tuple[np.ndarray, np.ndarray]:
    path, extruding = reference_motion(DT_S)
    return path[:, :4000], extruding[:4000]


def made(shares: Caution | None, path: np.ndarray, extruding: np.ndarray) -> np.ndarray:
    one = compensator("fbf", MACHINE, DT_S, robust="ensemble", caution=shares)
    one.reset(path[:, 0])
    return one.compensate(path, extruding, NO_RESTS)


def test_the_ends_are_those_of_the_two() -> None:
    path, extruding = short()
    shaper = ShaperCompensator(MACHINE, DT_S, shaper="mzv", fx_hz=45.0, fy_hz=33.0)
    smooth = shaper.compensate(path, extruding, NO_RESTS)
    exact = made(None, path, extruding)
    np.testing.assert_allclose(made(caution(1.0, 1.0), path, extruding), exact, atol=1e-12)
    np.testing.assert_allclose(made(caution(0.0, 0.0), path, extruding), smooth, atol=1e-12)
    half = made(caution(0.5, 1.0), path, extruding)
    np.testing.assert_allclose(half[0], 0.5 * (exact[0] + smooth[0]), atol=1e-12)
    np.testing.assert_allclose(half[1], exact[1], atol=1e-12)


def test_the_machine_follows_the_mixture() -> None:
    """What comes after a piece is that of a machine which saw the mixture, not its parts.

    The last sample of a piece is the first one of what follows.
    """
    path, extruding = short()
    first, second = path[:, :1500], path[:, 1500:3000]
    committed = compensator("fbf", MACHINE, DT_S, robust="ensemble", caution=caution(0.6, 0.6))
    observed = compensator("fbf", MACHINE, DT_S, robust="ensemble", caution=caution(0.6, 0.6))
    for one in (committed, observed):
        one.reset(first[:, 0])
    command = committed.compensate(first, extruding[:1500], NO_RESTS)
    committed.commit()
    # The same step of the ladder, but the machine is told what it followed.
    observed.compensate(first, extruding[:1500], NO_RESTS)
    observed.commit()
    observed.reset(first[:, 0])
    observed.observe(command[:, :-1])
    rest = [one.compensate(second, extruding[1500:3000], NO_RESTS) for one in (committed, observed)]
    np.testing.assert_allclose(rest[0], rest[1], atol=1e-9)


def test_a_whole_share_leaves_the_machine_as_its_own_design_does() -> None:
    """A piece begins with the last sample of the one before, whoever made that command."""
    ease = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, 400))
    there = np.outer([20.0, 8.0], ease)
    pieces = [there, there[:, ::-1]]
    mixed = compensator("fbf", MACHINE, DT_S, robust="ensemble", caution=caution(1.0, 1.0))
    alone = compensator("fbf", MACHINE, DT_S, robust="ensemble")
    made = []
    for one in (mixed, alone):
        one.reset(there[:, 0])
        for piece in pieces:
            last = one.compensate(piece, np.ones(400, bool), NO_RESTS)
            one.commit()
        made.append(last)
    np.testing.assert_allclose(*made, atol=1e-6)


def test_an_axis_of_the_shaper_alone_refuses_nothing() -> None:
    """Y was typed in and bears little; X keeps its compensation."""
    path, extruding = short()
    axes = {"y": AxisLimits(accel_mm_s2=50.0)}
    slow = MACHINE.model_copy(update={"command": MACHINE.command.model_copy(update={"axes": axes})})
    commands = []
    for machine in (MACHINE, slow):
        one = compensator("fbf", machine, DT_S, robust="ensemble", caution=caution(0.85, 0.0))
        one.reset(path[:, 0])
        commands.append(one.compensate(path, extruding, NO_RESTS))
    np.testing.assert_array_equal(*commands)


def test_shares_are_shares() -> None:
    with pytest.raises(DesignError, match=r"\(1.2, 0.0\): 0 to 1"):
        compensator("fbf", MACHINE, DT_S, caution=caution(1.2, 0.0))


def limited(accel_mm_s2: float) -> Machine:
    command = MACHINE.command.model_copy(update={"accel_mm_s2": accel_mm_s2})
    return MACHINE.model_copy(update={"command": command})


def test_where_the_motors_allow_no_better_the_shaper_s_command_is_taken() -> None:
    """With as much acceleration as the path itself, what is left of the compensation is bent."""
    path, extruding = reference_motion(DT_S, 250.0, 3000.0)
    plants = [plant_set(MACHINE.axes[axis].without_delay(), DT_S).nominal for axis in ("x", "y")]
    shaped = ShaperCompensator(MACHINE, DT_S, shaper="zv", fx_hz=46.0, fy_hz=33.0)
    smooth = shaped.compensate(path, extruding, NO_RESTS)
    shares = Caution((1.0, 1.0), "zv", 46.0, 33.0)
    errors = []
    for accel in (20_000.0, 3300.0):
        one = compensator("fbf", limited(accel), DT_S, robust="off", caution=shares)
        one.reset(path[:, 0])
        try:
            command = one.compensate(path, extruding, NO_RESTS)
        except DesignError:
            assert accel < 4000.0
            assert one.ease(0.0)
            command = one.compensate(path, extruding, NO_RESTS)
        assert np.abs(np.diff(command, 2)).max() / DT_S**2 <= accel * (1 + 1e-6)
        errors.append(contour_error(path, response(plants, command), DT_S)[extruding])
    free, bent = (float(np.sqrt(np.mean(e**2))) for e in errors)
    of_shaper = contour_error(path, response(plants, smooth), DT_S)[extruding]
    assert free < 0.5 * bent
    assert bent <= float(np.sqrt(np.mean(of_shaper**2))) * (1 + 1e-9)


def test_only_a_shaper_can_ask_for_no_more_than_the_path() -> None:
    assert compensator("fbf", MACHINE, DT_S, caution=caution(0.5, 0.5)).ease(0.0)
    assert not compensator("fbf", MACHINE, DT_S).ease(0.0)
