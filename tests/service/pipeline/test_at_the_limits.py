"""Prints that go right to the limits of the machine are compensated, not put back."""

from __future__ import annotations

import pytest

from gcode.firmware.registry import kit
from models.machine import AxisTravel, CommandLimits, Machine
from models.store import load_machine
from service.pipeline.compensating import PieceCompensator
from service.pipeline.options import Options
from tests.gcode.cutting import HEAD, pieces_of


@pytest.mark.parametrize("edge_mm", [100.0, 100.0006])
def test_a_wall_on_the_edge_of_the_bed(edge_mm: float) -> None:
    """The path and its command lie on the edge; neither tolerance nor rounding may leave it."""
    machine = load_machine("ender3")
    edges = AxisTravel(min_mm=0.0, max_mm=edge_mm)
    machine = machine.model_copy(update={"travel": machine.travel | {"x": edges}})
    wall = f"G1 X{edge_mm} Y60 E2 F6000\nG1 Y90 E2\nG1 X60 E2\n"
    piece = pieces_of(HEAD + wall, machine)[-1]
    made = PieceCompensator(machine, Options()).compensate(piece)
    assert edge_mm - 1e-3 < made.encoded.position[:, 0].max() / 1e6 <= edge_mm


def test_a_diagonal_near_the_command_s_speed() -> None:
    """X and Y each keep the command's limit; the firmware may not limit the way they make."""
    machine = fast(load_machine("voron-v0"), 150.0)
    moves = "G1 X100 Y90 F8400\nG1 X60 Y50\nG1 X105 Y95 E1 F8400\nG1 X60 Y50 E1\n"
    piece = pieces_of(HEAD + moves, machine)[-1]
    made = PieceCompensator(machine, Options()).compensate(piece)
    speed = made.encoded.phases.cruise_mm_s
    assert speed.max() > 150.0
    assert speed.max() < kit(machine).stream_limits(kit(machine).initial_limits()).as_row()[0]
    end_s = made.segments.end_s[-1]
    assert made.encoded.phases.duration_s == pytest.approx(end_s, abs=2e-3)


def fast(machine: Machine, speed_mm_s: float) -> Machine:
    """The machine with another highest speed of the command."""
    return machine.model_copy(update={"command": CommandLimits(velocity_mm_s=speed_mm_s)})
