"""A stream that breaks off at any line: the firmware brakes, stands, and goes on after it."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from stillpath.gcode.firmware.encoding import as_moves, limits_in_force
from stillpath.gcode.firmware.registry import adapter
from stillpath.gcode.pieces import Piece
from stillpath.gcode.plan import plan_moves
from stillpath.gcode.sampler import sample_phases
from stillpath.gcode.types import Limits, Moves, rows_of
from stillpath.models.machine import Machine
from stillpath.pipeline.compensated_piece import CompensatedPiece
from tests.gcode.cutting import HEAD, compensated, ender3_with

BODY = (
    "G1 X90 Y60 E1 F9000\nG1 X20 Y20 E2\nG1 X21 Y60 E1\nG1 X90 Y21 E2\nG1 E-.8 F2100\n"
    "G1 X20 Y90 F12000\nG1 E.8 F2100\nG1 X90 Y20 E3 F6000\nG1 X20 Y20 E1\n"
)
_SAMPLE_S = 5e-5
_AROUND = 60
"""Moves that are looked at before and after a break."""


def written(piece: Piece, made: CompensatedPiece, factor: float) -> tuple[Moves, list[Limits]]:
    """The moves as written, at a speed factor (M220), and their limits."""
    encoded = made.encoded
    places = np.vstack([encoded.begin, encoded.position]) * 1e-6
    ours = encoded.row < 0
    own = np.where(ours, 1.0, piece.moves.speed_mm_s[encoded.row])
    speed = factor * np.where(ours, encoded.feedrate_mm_min / 60.0, own)
    limits_id, limits = limits_in_force(piece, encoded.row, encoded.limits, encoded.level)
    return as_moves(places[:-1], places[1:], speed, limits_id), limits


def velocity_step(moves: Moves, limits: list[Limits], machine: Machine) -> float:
    """Largest change of velocity of X and Y within a ms when moves go from rest to rest, mm/s."""
    phases = plan_moves(moves, limits, machine)
    # RepRapFirmware holds moves back by some hundredths of a ms where they come too fast: late
    # steps, which this does not count.
    lasts_s = phases.lasts_s
    ends_s = phases.t_s[0] + np.cumsum(lasts_s)
    phases = replace(phases, t_s=ends_s - lasts_s)
    count = int((ends_s[-1] - ends_s[0] + lasts_s[0]) / _SAMPLE_S) + 41
    place, _ = sample_phases(phases, (float(phases.t_s[0]) - 20 * _SAMPLE_S, _SAMPLE_S, count))
    velocity = np.diff(place[:2], axis=1) / _SAMPLE_S
    reach = round(1e-3 / _SAMPLE_S)
    x, y = velocity[:, reach:] - velocity[:, :-reach]
    change = np.abs(x) + np.abs(y) if machine.kinematics == "corexy" else np.hypot(x, y)
    return float(np.max(change, initial=0.0))


@pytest.mark.parametrize(
    ("kind", "kinematics", "factor", "times"),
    [
        *product(("klipper", "reprapfirmware"), ("cartesian",), (0.5, 1.0, 2.0), (1.0,)),
        *product(("klipper", "reprapfirmware"), ("corexy",), (1.0, 2.0), (1.0,)),
        ("marlin", "cartesian", 0.5, 1.1),
        ("marlin", "cartesian", 1.0, 1.5),
        ("marlin", "cartesian", 2.0, 2.1),
    ],
)
def test_no_break_asks_for_more_than_the_motors_bear(
    kind: str, kinematics: str, factor: float, times: float
) -> None:
    """By each firmware's own rules; Marlin may start harder (docs/safety.md)."""
    machine = ender3_with(kind).model_copy(update={"kinematics": kinematics})
    piece, made = compensated(HEAD + BODY, machine)
    moves, limits = written(piece, made, factor)
    worst = 0.0
    for k in np.flatnonzero(made.encoded.row < 0)[5::7]:
        for rows in (slice(max(k - _AROUND, 0), k), slice(k, k + _AROUND)):
            worst = max(worst, velocity_step(rows_of(moves, rows), limits, machine))
    assert worst <= times * machine.command.speed_step_mm_s, worst


@pytest.mark.parametrize("kinematics", ["cartesian", "corexy"])
def test_marlin_starts_hard_at_few_lines_only(kinematics: str) -> None:
    """Those that are fast and change their speed; under one limit for all it would be most."""
    machine = ender3_with("marlin").model_copy(update={"kinematics": kinematics})
    piece, made = compensated(HEAD + BODY, machine)
    moves, limits = written(piece, made, 1.0)
    stream = made.encoded.row < 0
    shares = []
    for found in (
        moves,
        replace(moves, limits_id=np.where(stream, len(made.encoded.limits) - 1, moves.limits_id)),
    ):
        steps = np.array(
            [
                velocity_step(rows_of(found, slice(k, k + _AROUND)), limits, machine)
                for k in np.flatnonzero(stream)[5::7]
            ]
        )
        shares.append(np.mean(steps > 1.1 * machine.command.speed_step_mm_s))
    assert shares[0] < 0.1
    assert shares[1] > 0.4


@pytest.mark.parametrize("factor", [0.5, 1.0, 2.0])
def test_waits_of_a_queue_leave_no_motor_behind(factor: float) -> None:
    """RepRapFirmware holds moves back where they come faster than it prepares them: late steps."""
    machine = ender3_with("reprapfirmware")
    phases = plan_moves(*written(*compensated(HEAD + BODY, machine), factor), machine)
    ends_s = phases.end_s
    waits_s = np.maximum(phases.t_s[1:] - ends_s[:-1], 0.0)
    late_mm = waits_s * np.minimum(phases.end_mm_s[:-1], phases.start_mm_s[1:])
    # A quarter of a full step (.2 mm), where the motor still has most of its torque.
    assert late_mm.max() <= 0.05


@pytest.mark.parametrize(
    ("kind", "most"),
    [
        # Around small angles velocity steps by 1.82 times the speed through a square corner.
        ("klipper", 1.83 * 5.0 + 1e-3 * 5000.0),
        # sqrt(8 a J)
        ("marlin", 31.0 + 1e-3 * 2000.0),
        # M566 of both axes, and a little of another corner within the millisecond
        ("reprapfirmware", 1.5 * 10.0 + 1e-3 * 6000.0),
    ],
)
def test_a_stream_that_is_begun_at_a_layers_line(kind: str, most: float) -> None:
    """What an emergency resume does: no "stream on" was read, the printer's own limits hold."""
    machine = ender3_with(kind)
    moves, _ = written(*compensated(HEAD + BODY, machine), 1.0)
    own = replace(moves, limits_id=np.zeros_like(moves.limits_id))
    limits = [adapter(machine).initial_limits()]
    parts = (slice(k, k + _AROUND) for k in range(5, len(own), 7))
    worst = max(velocity_step(rows_of(own, part), limits, machine) for part in parts)
    assert worst <= most < machine.command.speed_step_mm_s
