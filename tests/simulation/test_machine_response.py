"""Answers of a machine whose plants change: at rest with the mass, and over the position."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lsim

from stillpath.models.machine import Machine
from stillpath.models.operating import machine_at
from stillpath.models.plants import Mode, ModesSpec, discretise
from stillpath.models.schedule import (
    AxisSchedule,
    GridNode,
    GridSchedule,
    MassSchedule,
    OperatingPoint,
)
from stillpath.models.store import load_machine
from stillpath.simulation.machine_response import MachineStream
from stillpath.simulation.response import PlantStream

DT_S = 1e-3
M0 = 0.8


@pytest.fixture(scope="module")
def growing() -> Machine:
    schedule = AxisSchedule(mass=MassSchedule(moving_mass_kg=M0))
    return load_machine("generic-bedslinger").model_copy(update={"schedules": {"y": schedule}})


def stroke(samples: int = 150) -> np.ndarray:
    s = np.clip(np.arange(samples) / 80.0, 0.0, 1.0)
    return np.stack([10 * s, 20 * s * s * (3 - 2 * s)])


def test_without_schedules_it_is_the_plants(growing: Machine) -> None:
    machine = growing.model_copy(update={"schedules": {}})
    plants = [discretise(machine.axes[a].nominal, DT_S) for a in ("x", "y")]
    stream, plain = MachineStream(machine, DT_S), PlantStream(plants)
    stream.operate_at(OperatingPoint(mass_kg=2.0))
    for u in (stroke(), 7.0 - stroke()):
        np.testing.assert_array_equal(stream.push(u, u), plain.push(u))


def test_a_heavier_bed_answers_as_the_law_says(growing: Machine) -> None:
    stream = MachineStream(growing, DT_S, OperatingPoint(mass_kg=0.5))
    u = stroke(400)
    y = stream.push(u, u)[1]
    w, zeta = 2 * np.pi * 35.0, 0.08
    k, c = M0 * w**2, 2 * zeta * w * M0
    m = M0 + 0.5
    expected = lsim(([c, k], [m, c, k]), u[1], DT_S * np.arange(400))[1]
    # The mass is taken to .1 % of the frequency.
    assert np.max(np.abs(y - expected)) < 0.01 * np.max(np.abs(expected - u[1]))


def test_goes_on_where_it_was(growing: Machine) -> None:
    """A kilogram laid down at rest: no step, and the vibration goes on at the new frequency."""
    stream = MachineStream(growing, DT_S)
    u = stroke(150)
    before = stream.push(u, u)
    stream.operate_at(OperatingPoint(mass_kg=0.004))
    still = np.repeat(u[:, -1:], 400, axis=1)
    after = stream.push(still, still)
    ring = np.max(np.abs(before[1, -30:] - u[1, -1]))
    step = np.max(np.abs(np.diff(np.append(before[1, -30:], after[1, :30]))))
    assert abs(after[1, 0] - before[1, -1]) <= 1.2 * step
    assert 0.05 * ring < np.max(np.abs(after[1] - still[1])) < ring
    np.testing.assert_allclose(after[1, -1], u[1, -1], atol=1e-3 * ring)


def test_new_plants_after_rest_are_those_plants(growing: Machine) -> None:
    stream = MachineStream(growing, DT_S)
    u = stroke(150)
    still = np.repeat(u[:, -1:], 4500, axis=1)
    for part in (u, still):
        stream.push(part, part)
    point = OperatingPoint(mass_kg=0.5)
    stream.operate_at(point)
    back = u[:, ::-1].copy()
    axes = machine_at(growing, stream._grid.level(point)).axes
    fresh = PlantStream([discretise(axes["x"].nominal, DT_S), discretise(axes["y"].nominal, DT_S)])
    fresh.push(still[:, :1])
    np.testing.assert_allclose(stream.push(back, back), fresh.push(back), atol=1e-9)


def test_blends_over_the_position() -> None:
    def node(x_mm: float, f_hz: float) -> GridNode:
        return GridNode(x_mm=x_mm, plant=ModesSpec(modes=(Mode(f_hz=f_hz, zeta=0.06),)))

    grid = GridSchedule(nodes=(node(0.0, 40.0), node(100.0, 30.0)))
    machine = load_machine("generic-bedslinger").model_copy(
        update={"schedules": {"y": AxisSchedule(grid=grid)}}
    )
    s = np.arange(3000) * DT_S
    u = np.stack([np.zeros(3000), np.sin(2 * np.pi * 33.0 * s)])
    answers = {}
    for x_mm, f_hz in ((0.0, 40.0), (100.0, 30.0)):
        path = np.stack([np.full(3000, x_mm), np.zeros(3000)])
        there = PlantStream([discretise(node(x_mm, f_hz).plant, DT_S)])
        answers[x_mm] = there.push(u[1:])[0]
        y = MachineStream(machine, DT_S).push(u, path)
        np.testing.assert_allclose(y[1], answers[x_mm], atol=1e-10)
    # On its way from one end to the other the answer passes from one to the other.
    path = np.stack([np.clip((s - 1.0) * 100.0, 0.0, 100.0), np.zeros(3000)])
    y = MachineStream(machine, DT_S).push(u, path)[1]
    np.testing.assert_allclose(y[:1000], answers[0.0][:1000], atol=1e-10)
    np.testing.assert_allclose(y[2001:], answers[100.0][2001:], atol=1e-10)
    # Never faster than at resonance: no step where one plant gives way to the next.
    assert np.max(np.abs(np.diff(y))) < 1.05 * 2 * np.pi * 33.0 * DT_S / (2 * 0.06)


def test_stands_still_as_if_it_had_just_begun(growing: Machine) -> None:
    """What was before is forgotten, and not remembered for plants to come."""
    heavy, u = OperatingPoint(mass_kg=1.0), stroke()
    used, fresh = MachineStream(growing, DT_S), MachineStream(growing, DT_S, heavy)
    used.push(5.0 + u, u)
    used.operate_at(heavy)
    used.stand()
    np.testing.assert_array_equal(used.push(u, u), fresh.push(u, u))
    used.stand()
    used.operate_at(OperatingPoint())
    np.testing.assert_array_equal(used.push(u, u), MachineStream(growing, DT_S).push(u, u))
