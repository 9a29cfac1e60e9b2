"""Slow motion is not moved: no design leads or delays what a machine follows by itself."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stillpath.compensation.registry import compensator
from stillpath.models.machine import Machine
from stillpath.models.plants import (
    PlantSetSpec,
    RelativeMode,
    RelativeModesSpec,
    WeightedMember,
    frequency_response,
)
from stillpath.models.store import load_machine

DT_S = 1e-3
NO_RESTS = np.zeros((0, 2), np.int64)
MODES = ["off", "ensemble"]


def ramp(speed_mm_s: float, angle: float, accel_mm_s2: float = 3000.0) -> np.ndarray:
    """Two seconds of constant speed between a start and a stop."""
    t = np.arange(0.0, 2.0 + 2 * speed_mm_s / accel_mm_s2, DT_S)
    ends = [0.0, speed_mm_s / accel_mm_s2, t[-1] - speed_mm_s / accel_mm_s2, t[-1]]
    speed = np.interp(t, ends, [0.0, speed_mm_s, speed_mm_s, 0.0])
    way = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * DT_S)])
    return np.array([[np.cos(angle)], [np.sin(angle)]]) * way


def command(machine: Machine, path: np.ndarray, robust: str) -> np.ndarray:
    made = compensator("fbf", machine, DT_S, robust=robust)
    made.reset(path[:, 0])
    return made.compensate(path, np.ones(path.shape[1], bool), NO_RESTS)


def delayed(machine: Machine, grounded: float) -> Machine:
    """The machine with members whose guides delay slow motion."""
    axes = {}
    for axis, plants in machine.axes.items():
        members = []
        for member in plants.weighted_members():
            assert isinstance(member.plant, RelativeModesSpec)
            modes = [m.model_copy(update={"grounded": grounded}) for m in member.plant.modes]
            plant = RelativeModesSpec(modes=tuple(modes))
            members.append(WeightedMember(plant=plant, weight=member.weight))
        axes[axis] = plants.model_copy(update={"members": tuple(members)})
    return machine.model_copy(update={"axes": axes})


@pytest.mark.parametrize("robust", MODES)
@pytest.mark.parametrize("speed_mm_s", [20.0, 300.0])
@pytest.mark.parametrize("name", ["ender3", "voron-v0", "annex-k3"])
def test_uniform_motion_stays_where_it_is(name: str, speed_mm_s: float, robust: str) -> None:
    path = ramp(speed_mm_s, 0.6)
    made = command(load_machine(name), path, robust)
    middle = slice(path.shape[1] // 3, 2 * path.shape[1] // 3)
    assert np.abs(made - path)[:, middle].max() < 1e-4


def test_delays_of_members_lead_nothing() -> None:
    """What guides delay, nobody measured: the same command, whatever members say of it."""
    machine, path = load_machine("ender3"), ramp(100.0, 0.6)
    plain, led = (command(delayed(machine, share), path, "ensemble") for share in (0.0, 0.5))
    np.testing.assert_array_equal(plain, led)


@pytest.mark.parametrize("speed_mm_s", [20.0, 300.0])
def test_arcs_shift_no_axis_against_the_other(speed_mm_s: float) -> None:
    """Over a turn the command neither leads nor lags, but for what the plant does itself."""
    radius, turns = 30.0, 6
    rate = speed_mm_s / radius
    samples = round(2 * np.pi * turns / rate / DT_S)
    speed = np.minimum(np.arange(samples) * DT_S / 0.5, 1.0) * rate
    angle = np.cumsum(speed) * DT_S
    path = radius * np.stack([np.cos(angle), np.sin(angle)])
    made = command(load_machine("ender3"), path, "ensemble")
    last_turn = slice(
        samples - 2 * round(2 * np.pi / rate / DT_S), samples - round(2 * np.pi / rate / DT_S)
    )
    along = np.stack([-np.sin(angle), np.cos(angle)])
    lead = np.sum((made - path) * along, axis=0)[last_turn]
    machine, own = load_machine("ender3"), []
    for plants in machine.axes.values():
        assert isinstance(plants.nominal, RelativeModesSpec)
        modes = plants.nominal.modes
        # Of third order in the rate of turning, as a share of the radius.
        own.append(sum(m.share * 2 * m.zeta * (rate / (2 * np.pi * m.f_hz)) ** 3 for m in modes))
    assert abs(lead.mean()) < 1e-4 + radius * max(own)


@settings(max_examples=25)
@given(
    modes=st.lists(
        st.tuples(
            st.floats(10.0, 200.0), st.floats(0.01, 0.6), st.floats(-2.0, 2.0), st.floats(0.0, 1.0)
        ),
        min_size=1,
        max_size=4,
    )
)
def test_relative_modes_have_the_delay_they_say(
    modes: list[tuple[float, float, float, float]],
) -> None:
    """Phase slope at zero frequency: none without guides, and then the stated one."""
    last = 1.0 - sum(share for _, _, share, _ in modes[:-1])
    shares = [*(share for _, _, share, _ in modes[:-1]), last]
    plant = RelativeModesSpec(
        modes=tuple(
            RelativeMode(f_hz=f, zeta=z, share=r, grounded=g)
            for (f, z, _, g), r in zip(modes, shares, strict=True)
        )
    )
    f_hz = 0.01
    prompt, late = (
        -np.angle(frequency_response(p, f_hz)[0]) / (2 * np.pi * f_hz)
        for p in (plant.without_delay(), plant)
    )
    assert abs(prompt) < 1e-7
    assert late == pytest.approx(plant.delay_s, abs=1e-6)
    assert plant.without_delay().delay_s == 0.0


def test_a_set_without_delay_keeps_its_other_plants() -> None:
    plants = load_machine("taz6-x").axes["x"]
    assert plants.without_delay().nominal == plants.nominal
    assert isinstance(plants.without_delay(), PlantSetSpec)
