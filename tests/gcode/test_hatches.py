"""Hatch files: what is drawn, when, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stillpath.gcode.errors import GcodeError
from stillpath.gcode.hatches import Timing, read_hatches, sample_hatches

TWO = """
G21 G90
M5
F60000
G0 X0 Y0 ; to the first
M3 S500
G1 X10
M5
G0 X10 Y1
M3
G1 X0
"""


def test_beam_speed_and_lines() -> None:
    found = read_hatches(TWO)
    assert found.beam.tolist() == [False, True, False, True]
    assert found.line.tolist() == [5, 7, 9, 11]
    np.testing.assert_array_equal(found.start_mm[1:], found.end_mm[:-1])
    assert found.end_mm.tolist() == [[0, 0], [10, 0], [10, 1], [0, 1]]
    assert found.speed_mm_s.tolist() == [0, 1000, 0, 1000]
    assert found.tracks().tolist() == [-1, 0, -1, 1]


@pytest.mark.parametrize("odd", ["\u2028", "\x85", "\v", "\f"])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_lines_end_where_a_sender_ends_them(end: str, odd: str) -> None:
    text = TWO.replace("to the first", f"to{odd}G1 X90").replace("\n", end)
    found = read_hatches(text)
    assert found.line.tolist() == [5, 7, 9, 11]
    assert found.end_mm.tolist() == read_hatches(TWO).end_mm.tolist()


def test_motion_is_modal_and_power_switches() -> None:
    """As senders write for GRBL: one G1, then bare words; S0 is a jump."""
    found = read_hatches("M4 S0\nG0X0Y0\nG1F600X1S10\nX2\nX3S0\nX4S10 (mark)\nM5")
    assert found.beam.tolist() == [False, True, True, False, True]
    assert found.tracks().tolist() == [-1, 0, 0, -1, 1]
    assert found.end_mm[:, 0].tolist() == [0, 1, 2, 3, 4]


def test_extruder_is_the_beam_where_there_is_no_other() -> None:
    found = read_hatches("G1 F600 X1 E1\nG1 X2\nG1 X3 E1.5\nG92 E0\nG1 X4 E0.1\nG1 X5 E0.1")
    assert found.beam.tolist() == [True, False, True, True, False]
    relative = "G1 F600 X10 E.5\nG1 Y1 E.02\nG1 X0 E.5\nG1 X1 E-.5\n"
    assert read_hatches("M83\nG90\n" + relative).beam.tolist() == [True, True, True, False]
    assert read_hatches("G91\nM82\n" + relative).beam.tolist() == [True, False, True, False]


def test_relative_inches_and_shifted_origin() -> None:
    found = read_hatches("M3\nG20 G91\nG1 F60 X1 Y1\nX1\nG90 G21\nG92 X0 Y0\nX2.5")
    assert found.end_mm.tolist() == pytest.approx(
        np.array([[25.4, 25.4], [50.8, 25.4], [53.3, 25.4]])
    )
    assert found.speed_mm_s[0] == pytest.approx(25.4)


def test_tracks_end_at_sharp_turns_only() -> None:
    round_points = [(np.cos(a), np.sin(a)) for a in np.linspace(0, 2 * np.pi, 37)]
    circle = "".join(f"G1 X{x:.4f} Y{y:.4f}\n" for x, y in round_points)
    found = read_hatches("G0 X1 Y0\nM3\nF600\n" + circle + "G1 X0 Y0\n")
    assert found.tracks()[1:].tolist() == [-1] + [0] * 36 + [1]


def test_samples_keep_speed_and_settle() -> None:
    dt = 1e-4
    timing = Timing(jump_mm_s=2000, settle_s=1e-3, lead_s=2e-3)
    made = sample_hatches(read_hatches(TWO), dt, timing)
    assert len(made.t_s) == pytest.approx((2e-3 + 10e-3 + 0.5e-3 + 1e-3 + 10e-3 + 2e-3) / dt, abs=2)
    for track in (0, 1):
        on = np.flatnonzero(made.track == track)
        np.testing.assert_array_equal(np.diff(on), 1)
        speed = np.diff(made.xy_mm[0][on]) / dt
        np.testing.assert_allclose(np.abs(speed), 1000, rtol=1e-9)
    between = np.flatnonzero((made.t_s > 12e-3) & (made.track < 0) & (made.t_s < 13.5e-3))
    np.testing.assert_allclose(made.xy_mm[1][between[-8:]], 1.0)
    assert np.all(made.xy_mm[:, :20] == 0)


@given(
    st.lists(st.tuples(st.integers(-50, 50), st.integers(-50, 50), st.booleans()), min_size=1),
    st.sampled_from([1e-4, 2.5e-5]),
)
def test_every_sample_lies_on_its_track(points: list[tuple[int, int, bool]], dt: float) -> None:
    lines = [f"{'M3' if on else 'M5'}\nG1 X{x / 10} Y{y / 10}" for x, y, on in points]
    found = read_hatches("F6000\n" + "\n".join(lines) + "\nM3\nG1 X99 Y99")
    made = sample_hatches(found, dt, Timing())
    tracks = found.tracks()
    for k in np.unique(made.track[made.track >= 0]):
        rows = np.flatnonzero(tracks == k)
        corners = np.concatenate([found.start_mm[rows], found.end_mm[rows]])
        inside = made.xy_mm[:, made.track == k]
        assert np.all(corners.min(0) - 1e-9 <= inside.T)
        assert np.all(corners.max(0) + 1e-9 >= inside.T)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("M3\nG1 X1", "line 2: G1 before any speed"),
        ("M3\nF600\nG1 X1 Ya", "line 3: cannot read 'YA'"),
        ("M3\nF600\nG1 X1.2.3", "line 3: X is '1.2.3'"),
        ("M3\nF600\nG1 X10000000", "not a number up to 1e6"),
        ("M3\nF0\nG1 X1", "line 2: F must be above 0"),
        ("M3\nF600\nG2 X1 I1", "line 3: arcs"),
        ("G0 X1\nG0 X2", "marks nothing"),
        ("", "marks nothing"),
        ("M3\nF600\nG4 P-1", "dwell"),
    ],
)
def test_refusals_name_the_line(text: str, words: str) -> None:
    with pytest.raises(GcodeError) as error:
        read_hatches(text)
    assert words in str(error.value)


def test_too_long_and_passed_over() -> None:
    found = read_hatches("M3\nF1\nSET_FAN_SPEED FAN=a X=1\nM400\nG1 X1000\nG4 P5")
    assert found.passed_over == ("SET_FAN_SPEED", "M400")
    assert found.dwell_s.tolist() == [0.005]
    with pytest.raises(GcodeError, match="give one layer"):
        sample_hatches(found, 2.5e-5, Timing())
