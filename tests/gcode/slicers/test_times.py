"""Times in the lines of slicers: read, and written again in the same form."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stillpath.gcode.slicers.times import TimeKind, may_tell_time, read_times

K = TimeKind


@pytest.mark.parametrize(
    ("line", "told"),
    [
        (b"; estimated printing time (normal mode) = 1d 2h 3m 4s\n", [(K.TOTAL, 93_784.0, False)]),
        (b"; estimated printing time (silent mode) = 31m 29s\n", [(K.TOTAL, 1889.0, True)]),
        (b"; estimated printing time = 59s\r\n", [(K.TOTAL, 59.0, False)]),
        (
            b"; estimated first layer printing time (normal mode) = 0.815957s\n",
            [(K.FIRST_LAYER, 0.815957, False)],
        ),
        (
            b"; model printing time: 25m 3s; total estimated time: 1h 0m 20s\n",
            [(K.TOTAL, 1503.0, False), (K.TOTAL, 3620.0, False)],
        ),
        (b";TIME:580\n", [(K.TOTAL, 580.0, False)]),
        (b";PRINT.TIME:1263\n", [(K.TOTAL, 1263.0, False)]),
        (b";TIME_ELAPSED:35.034915\n", [(K.ELAPSED, 35.034915, False)]),
        (b";Print Time: 5523\n", [(K.TOTAL, 5523.0, False)]),
        (b";PRINTING_TIME: 25\n", [(K.ELAPSED, 25.0, False)]),
        (b";REMAINING_TIME: 5498\n", [(K.REMAINING, 5498.0, False)]),
        (b"; Calculated-during-export Build Time: 10.16 minutes\r\n", [(K.TOTAL, 609.6, False)]),
        (b"; Estimated-in-GUI Build Time:         10.18 minutes\n", [(K.TOTAL, 610.8, False)]),
        (b"; --- print time: 806s ---\n", [(K.TOTAL, 806.0, False)]),
        (b";estimated_time(s): 9602.18\n", [(K.TOTAL, 9602.18, False)]),
        (b";   Build time: 1 hour 23 minutes\n", [(K.TOTAL, 4980.0, False)]),
        (b";   Build Time: 0 hours 1 minute\r\n", [(K.TOTAL, 60.0, False)]),
        (b";file_total_lines: 10371\n", [(K.LINES, 10371.0, False)]),
        (b"M73 P3 R27\n", [(K.PERCENT, 3.0, False), (K.REMAINING, 1620.0, False)]),
        (b"M73 Q0 S12 ; silent\n", [(K.PERCENT, 0.0, True), (K.REMAINING, 720.0, True)]),
        (b"M73 C5\n", [(K.UNTIL_STOP, 300.0, False)]),
        (b"M73 D0.50\n", [(K.UNTIL_STOP, 30.0, True)]),
        # As in the metadata of binary G-code.
        (b"estimated printing time (normal mode)=32m 6s\n", [(K.TOTAL, 1926.0, False)]),
    ],
)
def test_every_form(line: bytes, told: list[tuple[TimeKind, float, bool]]) -> None:
    found = read_times(line)
    assert [(f.kind, f.seconds, f.silent) for f in found] == [
        (kind, pytest.approx(seconds), silent) for kind, seconds, silent in told
    ]
    assert may_tell_time(line) or not line.startswith((b";", b"M"))
    for field in found:
        assert line[field.start : field.end] == field.text
        assert field.written(field.seconds) == field.text


@pytest.mark.parametrize(
    "line",
    [
        b"M730 P1\n",
        b"M73\n",
        b"N5 M73 P3 R27*12\n",
        b"M117 Time Left 0h9m\n",
        b";TYPE:WALL-OUTER\n",
        b";TIME:\n",
        b"; fan_below_layer_time = 100\n",
        b"; time estimate: pre = 9.997506, post = 9.766298\n",
        b"; machine_start_gcode = M73 P0 R1\n",
        b";TIME_ELAPSED:12.5 or so\n",
        b"; " + b"x" * 30_000,
    ],
)
def test_other_lines_tell_no_time(line: bytes) -> None:
    assert read_times(line) == []


@pytest.mark.parametrize(
    ("line", "seconds", "written"),
    [
        (b";TIME:580\n", 580.5, b"581"),
        (b";TIME_ELAPSED:35.034915\n", 36.0, b"36.000000"),
        (b"; estimated printing time (normal mode) = 59m 59s\n", 3601.2, b"1h 0m 1s"),
        (b"; estimated printing time (normal mode) = 1h 0m 1s\n", 3599.0, b"59m 59s"),
        (b"; estimated printing time (normal mode) = 59s\n", 60.0, b"1m 0s"),
        (b"; estimated printing time (normal mode) = 23h 59m 59s\n", 86_400.0, b"1d 0h 0m 0s"),
        (b"; estimated printing time (normal mode) = 1m 59s\n", 119.5, b"2m 0s"),
        (b"; estimated first layer printing time (normal mode) = 0.815957s\n", 1.5, b"1.500000s"),
        (b"; Calculated-during-export Build Time: 10.16 minutes\n", 612.0, b"10.20"),
        (b";TIME:5\n", -3.0, b"0"),
        (b";   Build time: 0 hours 59 minutes\n", 3630.0, b"1 hours 1 minutes"),
    ],
)
def test_another_time_in_the_same_form(line: bytes, seconds: float, written: bytes) -> None:
    (field,) = read_times(line)
    assert field.written(seconds) == written


@given(st.integers(0, 10**7))
def test_what_is_written_is_read_back(seconds: int) -> None:
    (field,) = read_times(b"; estimated printing time (normal mode) = 1s\n")
    line = b"; estimated printing time (normal mode) = " + field.written(seconds)
    (again,) = read_times(line)
    assert again.seconds == seconds
