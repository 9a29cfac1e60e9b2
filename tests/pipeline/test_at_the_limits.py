"""Prints that go right to the limits of the machine are compensated, not reverted."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stillpath.gcode.firmware.registry import adapter
from stillpath.models.firmware import RepRapFirmware
from stillpath.models.firmware.reprapfirmware import Drive
from stillpath.models.machine import AxisTravel, CommandLimits, Machine
from stillpath.models.store import load_machine
from stillpath.pipeline.compensated_piece import deviation
from stillpath.pipeline.following import strayed
from stillpath.pipeline.options import Options
from stillpath.pipeline.piece_compensator import PieceCompensator
from tests.compensating import compensated
from tests.gcode.cutting import HEAD, pieces_of


@pytest.mark.parametrize(
    ("method", "edge_mm"), [("fbf", 100.0), ("fbf", 100.0006), ("shaper:mzv", 77.7)]
)
def test_a_wall_on_the_edge_of_the_bed(method: str, edge_mm: float) -> None:
    """The path and its command lie on the edge; neither tolerance nor rounding may leave it."""
    machine = load_machine("ender3")
    edges = AxisTravel(min_mm=0.0, max_mm=edge_mm)
    machine = machine.model_copy(update={"travel": machine.travel | {"x": edges}})
    wall = f"G1 X{edge_mm} Y60 E2 F6000\nG1 Y90 E2\nG1 X60 E2\n"
    piece = pieces_of(HEAD + wall, machine)[-1]
    made = PieceCompensator(machine, Options(method=method)).compensate(piece)
    assert edge_mm - 1e-3 < made.encoded.position[:, 0].max() / 1e6 <= edge_mm


def test_a_diagonal_near_the_command_s_speed() -> None:
    """X and Y each keep the command's limit; the firmware may not limit the way they make."""
    machine = fast(load_machine("voron-v0"), 150.0)
    moves = "G1 X100 Y90 F8400\nG1 X60 Y50\nG1 X105 Y95 E1 F8400\nG1 X60 Y50 E1\n"
    piece = pieces_of(HEAD + moves, machine)[-1]
    made = PieceCompensator(machine, Options()).compensate(piece)
    speed = made.encoded.phases.cruise_mm_s
    assert speed.max() > 150.0
    assert (
        speed.max() < adapter(machine).stream_limits(adapter(machine).initial_limits()).as_row()[0]
    )
    end_s = made.segments.end_s[-1]
    assert made.encoded.phases.duration_s == pytest.approx(end_s, abs=2e-3)


def test_a_vase_on_a_machine_with_a_slow_z() -> None:
    """Z's acceleration holds for X and Y as well where they climb: evenly, no vertex is late."""
    machine = load_machine("voron-v0")
    planner = machine.firmware.planner.model_copy(update={"max_z_accel_mm_s2": 100.0})
    firmware = machine.firmware.model_copy(update={"planner": planner})
    machine = machine.model_copy(update={"firmware": firmware})
    angle = 2 * np.pi * np.arange(49) / 12
    places = zip(
        60 + 20 * np.cos(angle), 50 + 20 * np.sin(angle), 5 + 0.016 * np.arange(49), strict=True
    )
    wall = [f"G1 X{x:.3f} Y{y:.3f} Z{z:.4f} E0.3 F4800" for x, y, z in places]
    piece = pieces_of(HEAD + "G1 X80\n" + "\n".join(wall) + "\n", machine)[-1]
    made = PieceCompensator(machine, Options()).compensate(piece)
    assert deviation(made, made.encoded.phases)[made.extruding].max() < 15e-3


@pytest.mark.parametrize(("accel_mm_s2", "sliced_mm_s2"), [(20_000.0, 12_000), (60_000.0, 20_000)])
def test_the_acceleration_of_a_fast_corexy_is_no_step_of_speed(
    accel_mm_s2: float, sliced_mm_s2: int
) -> None:
    """As on printers with 20 to 40 m/s2, whose corners are slow: most of a print was put back."""
    ring = "G1 X60 Y84.6 E1.1\nG1 X35.4 Y60 E1.1\nG1 X60 Y35.4 E1.1\nG1 X84.6 Y60 E1.1\n"
    text = f"{HEAD}SET_VELOCITY_LIMIT ACCEL={sliced_mm_s2}\nG1 X84.6 F24000\n{ring}"
    for step_mm_s in (100.0, 30.0):
        command = CommandLimits(accel_mm_s2=accel_mm_s2, speed_step_mm_s=step_mm_s)
        changes = {"kinematics": "corexy", "command": command}
        machine = load_machine("ender3").model_copy(update=changes)
        piece = pieces_of(text, machine)[-1]
        work = PieceCompensator(machine, Options())
        work.compensator.reset(piece.phases.start_mm[0, :2])
        made = work.compensate(piece)
        phases = made.encoded.phases
        motors = phases.direction[:, :2] @ np.array([[1.0, 1.0], [1.0, -1.0]])
        half = 0.5e-3 * phases.accel_mm_s2
        ends = [phases.start_mm_s, phases.end_mm_s]
        near = [np.minimum(speed + half, phases.cruise_mm_s) for speed in ends]
        begin, end, after, before = (motors * speed[:, None] for speed in (*ends, *near))
        assert np.max(np.abs(begin[1:] - end[:-1])) <= step_mm_s
        # 60 m/s2 along the path are 85 mm/s in a millisecond for a motor of a CoreXY.
        own_mm_s = np.sqrt(2.0) * 1e-3 * accel_mm_s2
        assert np.max(np.abs(after[1:] - before[:-1])) <= max(step_mm_s, own_mm_s)
        assert deviation(made, phases)[made.extruding].max() < 22e-3


def test_what_climbs_too_fast_is_told(tmp_path: Path, cache: Path) -> None:
    """Moves that keep their own lines because Z could not follow are no secret."""
    wall = "".join(f"G1 X{60 + 20 * (i % 2)} Z{6 + i} E1 F1200\n" for i in range(20))
    result, _ = compensated(HEAD + wall, tmp_path, cache, "voron-v0")
    assert result.put_back == []
    assert any("climb faster than Z can follow" in warning for warning in result.warnings)


RINGS = "G1 F6000\n" + 4 * "G1 X84 Y77 E1\nG1 X59 Y84 E1\nG1 X37 Y61 E1\nG1 X60 Y50 E1\n"


def with_steps(steps_per_mm: float) -> Machine:
    """A RepRapFirmware printer that moves in so many steps."""
    drive = Drive(steps_per_mm=steps_per_mm, max_speed_mm_s=300.0, max_accel_mm_s2=3000.0)
    own = RepRapFirmware(x=drive, y=drive, home_mm=(0.0, 0.0, 0.0))
    return load_machine("annex-k3").model_copy(update={"firmware": own})


def test_what_is_left_alone_begins_where_it_was_switched_off(tmp_path: Path, cache: Path) -> None:
    """Not at a piece that was reverted before, for a reason of its own."""
    text = HEAD + RINGS + "; STILLPATH_OFF\n" + 6 * RINGS + "; STILLPATH_ON\n"
    result, _ = compensated(text, tmp_path, cache, with_steps(32.0))
    assert result.put_back
    (told,) = [one for one in result.warnings if "keep their own lines" in one]
    first = text[: text.index("; STILLPATH_OFF")].count("\n") + 3
    assert f"from line {first} on" in told


@pytest.mark.parametrize(
    ("plants_of", "steps_per_mm", "reverted", "told"),
    [
        ("annex-k3", 32.0, True, True),
        ("annex-k3", 400.0, False, False),
        ("generic-bedslinger", 32.0, False, True),
        ("generic-bedslinger", 400.0, False, False),
    ],
)
def test_where_the_shaper_would_serve_better_it_is_said(
    plants_of: str, steps_per_mm: float, reverted: bool, told: bool, tmp_path: Path, cache: Path
) -> None:
    """Vertices on steps of .03 mm shake the printer more than the sliced file: that stays.

    A resonance that was typed in says what the command is, not that it reached the file.
    """
    axes = load_machine(plants_of).axes
    machine = with_steps(steps_per_mm).model_copy(update={"axes": axes})
    result, _ = compensated(HEAD + RINGS, tmp_path, cache, machine)
    assert ["as sliced" in one.reason for one in result.put_back] == [True] * reverted
    assert any("shaper would serve this file better" in w for w in result.warnings) is told


@pytest.mark.parametrize("name", ["ender3", "generic-bedslinger"])
def test_what_is_not_compensated_has_the_range_of_the_sliced_file(
    name: str, tmp_path: Path, cache: Path
) -> None:
    """It had the wide range of the command that was not written, and was called a shaper's."""
    result, _ = compensated(HEAD + "; STILLPATH_OFF\n" + RINGS, tmp_path, cache, name)
    before, after = (c for c in result.channels if c.name in ("before", "after"))
    assert after.judged_rms_um == pytest.approx(before.judged_rms_um, rel=0.01)
    assert after.contour_range_um == pytest.approx(before.contour_range_um, rel=0.01)
    assert not any("typed in" in warning for warning in result.warnings)


def fast(machine: Machine, speed_mm_s: float) -> Machine:
    """The machine with another highest speed of the command."""
    return machine.model_copy(update={"command": CommandLimits(velocity_mm_s=speed_mm_s)})


@pytest.mark.parametrize(
    ("apart_um", "lasts", "allowed"),
    [(21.0, 2000, True), (35.0, 20, True), (35.0, 200, False), (50.0, 20, False)],
)
def test_motion_may_leave_its_command_only_briefly(
    apart_um: float, lasts: int, allowed: bool
) -> None:
    gap_mm = np.zeros(5000)
    gap_mm[:lasts] = 1e-3 * apart_um
    extruding = np.ones(5000, np.bool_)
    assert (strayed(gap_mm, extruding, 2e-3, briefly=True) is None) is allowed
    assert (strayed(gap_mm, extruding, 2e-3) is None) is (apart_um <= 22.0)


def test_motion_that_is_early_or_late_by_less_than_a_moment_is_not_read_as_off_its_path() -> None:
    """A minute at 350 mm/s was 0.1 ms late, 30 um along the path, and was put back for it."""
    gap_mm, speed_mm_s = np.full(5000, 30e-3), np.full(5000, 350.0)
    extruding = np.ones(5000, np.bool_)
    assert strayed(gap_mm, extruding, 2e-3, briefly=True) is not None
    assert strayed(gap_mm, extruding, 2e-3, briefly=True, drift_mm=1e-4 * speed_mm_s) is None
