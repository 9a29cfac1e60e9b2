"""A stream on a crooked bed: the firmware adds Z to every move, and Z's limits cap it."""

from __future__ import annotations

import numpy as np
import pytest

from stillpath.gcode.firmware.encoding import UNITS_PER_MM, as_moves, limits_in_force
from stillpath.gcode.firmware.registry import adapter
from stillpath.gcode.pieces import Piece
from stillpath.gcode.plan import plan_moves
from stillpath.gcode.types import Phases
from stillpath.models.errors import ModelError
from stillpath.models.machine import Machine
from stillpath.pipeline.compensate import compensate_file
from stillpath.pipeline.compensated_piece import CompensatedPiece, deviation
from stillpath.pipeline.options import Options
from tests.gcode.cutting import HEAD, compensated, ender3_with

SLOPE = 0.005
BODY = (
    "G1 X90 Y60 E1 F9000\nG1 X20 Y20 E2\nG1 X21 Y60 E1\nG1 X90 Y21 E2\nG1 E-.8 F2100\n"
    "G1 Z5.4 F600\nG1 X20 Y90 F12000\nG1 Z5 F600\nG1 E.8 F2100\nG1 X90 Y20 E3 F6000\n"
    "G1 X20 Y20 E1\nG1 X20 Y90 E1\n"
)


def crooked(slope: float, kind: str = "klipper") -> Machine:
    return ender3_with(kind, slope)


def on_a_plane(machine: Machine, piece: Piece, made: CompensatedPiece, slope: float) -> Phases:
    """Plan the written moves with Z = slope x added, as firmwares do after the G-code."""
    encoded = made.encoded
    position = encoded.position / UNITS_PER_MM
    points = np.vstack([encoded.begin / UNITS_PER_MM, position])
    points[:, 2] += slope * points[:, 0]
    ours = encoded.row < 0
    own = np.where(ours, 1.0, piece.moves.speed_mm_s[encoded.row])
    speed = np.where(ours, encoded.feedrate_mm_min / 60.0, own)
    limits_id, limits = limits_in_force(piece, encoded.row, encoded.limits, encoded.level)
    return plan_moves(as_moves(points[:-1], points[1:], speed, limits_id), limits, machine)


def made_on(machine: Machine) -> tuple[Piece, CompensatedPiece]:
    return compensated(HEAD + BODY, machine)


def seconds(phases: Phases) -> float:
    return float(np.sum(phases.lasts_s))


@pytest.mark.parametrize("kind", ["klipper", "marlin", "reprapfirmware"])
@pytest.mark.parametrize("slope", [SLOPE, -SLOPE, 0.4 * SLOPE])
def test_a_tilted_plane_keeps_the_times(slope: float, kind: str) -> None:
    machine = crooked(SLOPE, kind)
    piece, made = made_on(machine)
    level = made.encoded.phases
    tilted = on_a_plane(machine, piece, made, slope)
    # The way is longer by the square root of 1 + slope^2 where it climbs; no limit of Z binds.
    longer = seconds(tilted) - seconds(level)
    bound = 0.5 * slope**2 * seconds(level)
    # Marlin's whole steps fall differently.
    steps_s = 1e-4 if kind == "marlin" else 1e-5
    assert -steps_s <= longer <= bound + steps_s
    late_mm = bound * float(np.max(level.cruise_mm_s))
    late_mm += 5e-3 if kind == "marlin" else 1e-3
    assert deviation(made, tilted).max() <= deviation(made, level).max() + late_mm
    np.testing.assert_allclose(tilted.direction[-1, :2], level.direction[-1, :2], atol=1e-4)


def test_stream_limits_are_what_z_leaves() -> None:
    machine = crooked(SLOPE)
    planner = machine.firmware.planner
    own = adapter(machine).initial_limits()
    stream = adapter(machine).stream_limits(own)
    assert planner.max_z_accel_mm_s2 / SLOPE > machine.command.accel_mm_s2
    assert stream.accel_mm_s2 == machine.command.accel_mm_s2
    assert stream.velocity_mm_s == pytest.approx(
        min(2**0.5 * machine.command.velocity_mm_s, planner.max_z_velocity_mm_s / SLOPE)
    )


def test_a_bed_too_crooked_for_z_is_refused(tmp_path, cache) -> None:
    machine = crooked(0.02)
    source, target = tmp_path / "in.gcode", tmp_path / "out.gcode"
    source.write_text(HEAD + BODY)
    with pytest.raises(ModelError, match=r"mesh_slope.*max_z_accel.*level the bed"):
        compensate_file(source, target, machine, Options(), cache_dir=cache)
    assert not target.exists()
    assert list(tmp_path.iterdir()) == [source]


def test_climbing_along_the_mesh_counts_as_climbing() -> None:
    machine = crooked(SLOPE)
    least = machine.firmware.planner.max_z_accel_mm_s2 / machine.command.accel_mm_s2
    travel = np.array([[10.0, 0.0, 9.9 * (least - SLOPE), 0.0], [10.0, 0.0, 9.9 * least, 0.0]])
    assert adapter(machine).too_steep(travel).tolist() == [False, True]
    level = adapter(machine.model_copy(update={"mesh_slope": 0.0}))
    assert level.too_steep(travel).tolist() == [False, False]
