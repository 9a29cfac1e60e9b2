"""The sampled path of a piece: groups, rests on the grid, and the original motion between."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stillpath.gcode.pieces import Piece
from stillpath.gcode.sampler import sample_phases
from stillpath.gcode.timeline import Timeline, build_timeline, group_rows
from stillpath.gcode.types import Phases
from stillpath.models.machine import Machine
from stillpath.models.store import load_machine
from tests.gcode.cutting import HEAD, pieces_of

DT_S = 1e-3
BODY = (
    "G1 X80 Y60 E1\nG1 E-0.8 F2100\nG1 Z5.4 F600\nG1 X20 Y20 F9000\nG1 Z5 F600\nG1 E0.8 F2100\n"
    "G1 X30 Y20 E.5 F1800\nG1 X30 Y30 E.5\n"
)


@pytest.fixture(scope="module")
def machine() -> Machine:
    return load_machine("ender3")


@pytest.fixture(scope="module")
def piece(machine: Machine) -> Piece:
    pieces = pieces_of(HEAD + BODY, machine)
    assert len(pieces) == 2
    return pieces[1]


def timeline(piece: Piece, rest_s: float = 0.0123, **extra: float) -> Timeline:
    groups = group_rows(piece.phases)
    durations = np.full(len(groups), rest_s)
    return build_timeline(piece.phases, groups, durations, DT_S, **extra)


def test_rows_are_grouped_into_stretches_and_rests(piece: Piece) -> None:
    found = [(g.first, g.last, g.rest, g.before_z) for g in group_rows(piece.phases)]
    assert found == [
        (0, 1, False, False),
        (1, 3, True, False),
        (3, 4, False, True),
        (4, 6, True, False),
        (6, 8, False, False),
    ]


@settings(max_examples=40)
@given(rest_s=st.floats(1e-4, 0.3), lead=st.sampled_from([0.0, 0.02]), tail=st.floats(0, 0.05))
def test_rests_start_on_the_grid_and_last_as_told(
    piece: Piece, rest_s: float, lead: float, tail: float
) -> None:
    line = timeline(piece, rest_s, lead_s=lead, tail_s=tail)
    p = piece.phases
    duration = p.accel_s + p.cruise_s + p.decel_s
    for i, group in enumerate(line.groups):
        if group.rest:
            # A rest starts on the grid, where the stretch before it ends, and lasts as told.
            assert line.start_s[i] / DT_S == pytest.approx(round(line.start_s[i] / DT_S), abs=1e-6)
            assert line.start_s[i] == line.end_s[i - 1]
            assert line.end_s[i] - line.start_s[i] == pytest.approx(rest_s, abs=1e-12)
        else:
            begin = line.end_s[i - 1] if i else 0.0
            assert line.start_s[i] == begin
            assert line.row_start_s[group.first] == pytest.approx(begin + lead, abs=1e-12)
            moving = duration[group.first : group.last].sum()
            spare = line.end_s[i] - line.row_start_s[group.first] - moving
            assert tail - 1e-8 <= spare <= tail + DT_S
    np.testing.assert_allclose(line.group_start_mm, p.start_mm[[g.first for g in line.groups]])
    assert line.position_mm.shape[1] == round(line.end_s[-1] / DT_S) + 1


@settings(max_examples=40)
@given(rest_s=st.floats(1e-4, 0.3))
def test_x_and_y_stand_in_rests(piece: Piece, rest_s: float) -> None:
    line = timeline(piece, rest_s)
    assert np.all(line.rests[:, 0] < line.rests[:, 1])
    assert np.all(line.rests[1:, 0] >= line.rests[:-1, 1])
    for a, b in line.rests:
        before = line.position_mm[:2, a - 1]
        # The sample just after a rest's end may be half a sample under way.
        assert np.max(np.abs(line.position_mm[:2, a : b - 1].T - before), initial=0.0) == 0.0
        assert np.max(np.abs(line.position_mm[:2, b - 1] - before)) < 1e-2


def test_stretches_are_the_original_motion(piece: Piece) -> None:
    line, p = timeline(piece), piece.phases
    for i, group in enumerate(line.groups):
        if group.rest:
            continue
        t = DT_S * np.arange(np.ceil(line.start_s[i] / DT_S), np.floor(line.end_s[i] / DT_S))
        original, _ = sample_phases(p, t - line.start_s[i] + p.t_s[group.first])
        k = np.round(t / DT_S).astype(int)
        end = p.start_mm[group.last] if group.last < len(p) else piece.moves.end_mm[-1]
        moving = t - line.start_s[i] < (p.accel_s + p.cruise_s + p.decel_s)[
            group.first : group.last
        ].sum()  # fmt: skip
        np.testing.assert_allclose(line.position_mm[:, k[moving]], original[:, moving], atol=1e-9)
        np.testing.assert_allclose(line.position_mm[:2, k[~moving]].T - end[:2], 0, atol=1e-9)


def test_moving_and_rows(piece: Piece) -> None:
    line = timeline(piece)
    assert np.all(np.diff(line.row) >= 0)
    xy = np.any(piece.phases.direction[:, :2] != 0, axis=1)
    assert not np.any(line.moving & ~xy[line.row])
    still = np.append(np.all(np.diff(line.position_mm[:2]) == 0, axis=0), True)
    assert np.mean(line.moving & still) < 0.02


def test_a_stretch_of_no_time_has_a_sample(piece: Piece) -> None:
    """Marlin swallows a move of less than a step; a segment must be able to end after it."""
    rows = Phases(**{f.name: getattr(piece.phases, f.name)[:1] for f in fields(Phases)})
    none = np.zeros(1)
    phases = replace(rows, accel_s=none, cruise_s=none, decel_s=none)
    line = build_timeline(phases, group_rows(phases), none, DT_S)
    assert line.end_s.tolist() == [DT_S]
    assert line.position_mm.shape[1] == 2
