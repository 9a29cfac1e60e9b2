"""Grids of operating points: how near they lie, and the weights between them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stillpath.models.machine import Machine
from stillpath.models.operating import OperatingGrid, machine_at
from stillpath.models.plants import Mode, ModesSpec
from stillpath.models.schedule import (
    AxisSchedule,
    GridNode,
    GridSchedule,
    MassSchedule,
    OperatingPoint,
    resonances_hz,
)
from stillpath.models.store import load_machine


def mode(f_hz: float) -> ModesSpec:
    return ModesSpec(modes=(Mode(f_hz=f_hz, zeta=0.06),))


@pytest.fixture(scope="module")
def machine() -> Machine:
    corners = [(x, z) for x in (20.0, 120.0, 200.0) for z in (0.0, 150.0)]
    across = GridSchedule(
        nodes=tuple(
            GridNode(x_mm=x, z_mm=z, plant=mode(45.0 - 0.03 * x - 0.04 * z)) for x, z in corners
        )
    )
    mass = MassSchedule(moving_mass_kg=0.8)
    schedules = {"x": AxisSchedule(grid=across), "y": AxisSchedule(mass=mass)}
    return load_machine("generic-bedslinger").model_copy(update={"schedules": schedules})


def lowest_hz(machine: Machine, point: OperatingPoint) -> dict[str, float]:
    axes = machine_at(machine, point).axes
    return {name: float(resonances_hz(axis.nominal)[0]) for name, axis in axes.items()}


@settings(max_examples=60)
@given(
    mass_kg=st.floats(0.0, 4.0),
    x_mm=st.floats(0.0, 220.0),
    z_mm=st.floats(0.0, 200.0),
    step=st.sampled_from([0.002, 0.01, 0.02]),
)
def test_levels_are_near(
    machine: Machine, mass_kg: float, x_mm: float, z_mm: float, step: float
) -> None:
    grid = OperatingGrid(machine, step=step, blend_step=0.02)
    point = OperatingPoint(mass_kg, x_mm, 0.0, z_mm)
    level = grid.level(point)
    exact = lowest_hz(machine, point)
    rounded = lowest_hz(machine, OperatingPoint(level.mass_kg, x_mm, 0.0, level.z_mm))
    for name, f_hz in exact.items():
        assert abs(np.log(rounded[name] / f_hz)) <= 0.5 * step + 1e-9
    assert grid.level(level) == level


def test_nothing_on_the_bed_is_the_document(machine: Machine) -> None:
    grid = OperatingGrid(machine, step=0.01, blend_step=0.02)
    level = grid.level(OperatingPoint(mass_kg=1e-4))
    assert level.mass_kg == 0.0
    assert machine_at(machine, level).axes["y"] == machine.axes["y"]
    assert machine_at(machine, level).schedules == {}


def test_neighbours_are_near(machine: Machine) -> None:
    grid = OperatingGrid(machine, step=0.01, blend_step=0.02)
    nodes = grid.at_level(OperatingPoint(z_mm=150.0))
    assert len(nodes) == grid.nodes
    f_hz = np.array([lowest_hz(machine, node)["x"] for node in nodes])
    assert np.max(np.abs(np.diff(np.log(f_hz)))) <= np.log(1.02) + 1e-9
    assert {20.0, 120.0, 200.0} <= {node.x_mm for node in nodes}


def test_weights_are_a_smooth_partition(machine: Machine) -> None:
    grid = OperatingGrid(machine, step=0.01, blend_step=0.02)
    x_mm = np.linspace(0.0, 220.0, 20_001)
    weights = grid.weights(np.stack([x_mm, np.zeros_like(x_mm)]))
    np.testing.assert_allclose(weights.sum(axis=0), 1.0, atol=1e-12)
    assert weights.min() >= 0.0
    # Twice differentiable: the second difference does not jump between samples.
    bend = np.diff(weights, 2, axis=1)
    assert np.max(np.abs(np.diff(bend, axis=1))) < 0.05 * np.max(np.abs(bend))
    nodes = np.array([node.x_mm for node in grid.at_level(grid.level(OperatingPoint()))])
    at_nodes = grid.weights(np.stack([nodes, np.zeros_like(nodes)]))
    np.testing.assert_allclose(at_nodes, np.eye(len(nodes)), atol=1e-12)


def test_without_schedules_one_point() -> None:
    grid = OperatingGrid(load_machine("ender3"), step=0.01, blend_step=0.02)
    point = OperatingPoint(1.0, 10.0, 20.0, 30.0)
    assert grid.nodes == 1
    assert grid.level(point) == OperatingPoint()
    np.testing.assert_array_equal(grid.weights(np.zeros((2, 5))), np.ones((1, 5)))
