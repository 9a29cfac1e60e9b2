"""Raw accelerations and recorded drives: identity, and a message of its own for each fault."""

from __future__ import annotations

import bz2
import io
import lzma
import tarfile
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from stillpath.models.errors import ModelError
from stillpath.models.identification.readers import ReadSettings, read_content, read_measurements
from stillpath.models.identification.types import AccelerationLog, DrivenLog

N = 400


def klipper(time_s: np.ndarray, accel: np.ndarray, head: str = "") -> str:
    rows = (f"{t:.6f},{a[0]:.6f},{a[1]:.6f},{a[2]:.6f}" for t, a in zip(time_s, accel, strict=True))
    return head + "#time,accel_x,accel_y,accel_z\n" + "\n".join(rows) + "\n"


def some_log(n: int = N, rate_hz: float = 3200.0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    return 75.3 + np.arange(n) / rate_hz, rng.normal((0, 0, 9800), 3000, (n, 3))


def read(text: str, name: str = "raw_data_x_20240101_120000.csv", **known: object) -> object:
    (log,) = read_content(text.encode(), name, settings=ReadSettings.model_validate(known))
    return log


def changed(text: str, line: int, new: str) -> str:
    """Replace a line, counted from 1."""
    lines = text.split("\n")
    lines[line - 1] = new
    return "\n".join(lines)


@given(
    arrays.arrays(np.float64, (80, 3), elements=st.floats(-900, 900, allow_nan=False), unique=True),
    st.sampled_from(["", '##{"errors": 0, "overflows": 0}\n', "## LIS2DW\r\n"]),
)
def test_klipper_log_is_read_as_written(accel: np.ndarray, head: str) -> None:
    time_s = 12.5 + np.arange(80) / 1600
    accel[0] = 950.0  # too much for a log in m/s^2
    log = read(klipper(time_s, accel, head))
    assert isinstance(log, AccelerationLog)
    np.testing.assert_allclose(log.time_s, time_s, atol=6e-7)
    np.testing.assert_allclose(log.accel_mm_s2, accel, atol=6e-7)
    assert log.axis == "x"
    assert log.notes == ()


@pytest.mark.parametrize(
    ("name", "axis"),
    [
        ("raw_data_x_20240101_120000.csv", "x"),
        ("raw_data_y_lis2dw_20240101_120000.csv", "y"),
        ("raw_data_axis=1.000,-1.000_20240101_120000.csv", "1.000,-1.000"),
        ("raw_data_axis=1.000,1.000,0.000_belt.csv", "1.000,1.000,0.000"),
        ("adxl345-20240101_120000.csv", None),
        ("belt_20230929_120000_A.csv", "1.000,-1.000"),
        ("belts_20240501_120000_B.csv", "1.000,1.000"),
        ("shaketune-belt_A.csv", "1.000,-1.000"),
        ("run-Y.csv", "y"),
        ("voron_z_tilt_raw_data_x.csv", "x"),
        ("x_max_run_y.csv", None),
        ("qidi-x-plus-y1.csv", None),
        ("x1.csv", "x"),
        ("resonances_y (1).csv", "y"),
        ("resonances x 20250101.csv", "x"),
        ("X axis final (2).csv", "x"),
        ("genius X Yaxis.csv", "y"),
    ],
)
def test_axis_is_in_the_name(name: str, axis: str | None) -> None:
    log = read(klipper(*some_log()), name)
    assert isinstance(log, AccelerationLog)
    assert log.axis == axis


def test_the_settings_say_the_axis_where_the_name_does_not(tmp_path: Path) -> None:
    for name in ("adxl345-20240101.csv", "x_max_run_y.csv", "raw_data_axis=0.000,-1.000_a.csv"):
        path = tmp_path / name
        path.write_text(klipper(*some_log()))
        assert read_measurements(path, settings=ReadSettings(axis="y"))[0].axis == "y"


@pytest.mark.parametrize(
    ("name", "says"),
    [("raw_data_x_a.csv", "x"), ("run-X.csv", "x"), ("raw_data_axis=1.000,1.000_a.csv", "1.000")],
)
def test_a_name_that_says_another_axis_is_refused(name: str, says: str) -> None:
    words = f"{name}: its name says axis {says}.*given as axis y; give no axis, or rename the file"
    with pytest.raises(ModelError, match=words):
        read(klipper(*some_log()), name, axis="y")


@pytest.mark.parametrize(("unit", "one_mm_s2"), [("g", 1 / 9806.65), ("m/s^2", 1e-3)])
def test_gravity_tells_the_unit(unit: str, one_mm_s2: float) -> None:
    time_s, accel = some_log()
    log = read(klipper(time_s, accel * one_mm_s2))
    assert isinstance(log, AccelerationLog)
    np.testing.assert_allclose(log.accel_mm_s2, accel, atol=1e-6 / one_mm_s2)
    (note,) = log.notes
    assert f"accelerations in {unit}" in note
    stated = read(klipper(time_s, accel * one_mm_s2), acceleration_unit=unit)
    assert isinstance(stated, AccelerationLog)
    np.testing.assert_array_equal(stated.accel_mm_s2, log.accel_mm_s2)
    assert stated.notes == ()


@pytest.mark.parametrize("numbers_too", [False, True])
def test_a_spreadsheet_may_quote_its_fields(numbers_too: bool) -> None:
    time_s, accel = some_log()
    head, *rows = klipper(time_s, accel).splitlines()
    lines = [head, *rows] if numbers_too else [head]
    quoted = [",".join(f'"{field}"' for field in line.split(",")) for line in lines]
    log = read("\r\n".join(quoted + ([] if numbers_too else rows)) + "\r\n")
    assert isinstance(log, AccelerationLog)
    np.testing.assert_allclose(log.accel_mm_s2, accel, atol=6e-7)


def test_archives_are_to_be_unpacked() -> None:
    text = klipper(*some_log()).encode()
    zipped, tarred = io.BytesIO(), io.BytesIO()
    with zipfile.ZipFile(zipped, "w") as archive:
        archive.writestr("raw_data_x_1.csv", text)
    with tarfile.open(fileobj=tarred, mode="w:gz") as archive:
        entry = tarfile.TarInfo("raw_data_x_1.csv")
        entry.size = len(text)
        archive.addfile(entry, io.BytesIO(text))
    packed = {
        "zip archive": zipped.getvalue(),
        "tar archive": tarred.getvalue(),
        "bzip2": bz2.compress(text),
        "xz": lzma.compress(text),
    }
    for kind, content in packed.items():
        with pytest.raises(ModelError, match=rf"logs: a .*{kind}.* unpack it and give the files"):
            read_content(content, "logs")


def test_gap_says_where_and_how_long() -> None:
    time_s, accel = some_log()
    keep = np.delete(np.arange(N), np.arange(100, 140))
    with pytest.raises(ModelError, match=r"line 102: gap in time: 12.8. ms .*40 samples.* 32 may"):
        read(klipper(time_s[keep], accel[keep]))
    one_lost = np.delete(np.arange(N), 100)
    read(klipper(time_s[one_lost], accel[one_lost]))


def test_a_few_lost_messages_are_noted_and_many_refused() -> None:
    time_s, accel = some_log(8000)
    places = np.arange(500, 8000, 1500)
    some = np.delete(np.arange(8000), [at + k for at in places for k in range(10)])
    log = read(klipper(time_s[some], accel[some]))
    assert isinstance(log, AccelerationLog)
    assert any("50 samples (0.63%) are missing in 5 gaps" in note for note in log.notes)
    np.testing.assert_allclose(log.time_s, time_s[some], atol=6e-7)
    many = np.delete(np.arange(8000), [at + k for at in places for k in range(20)])
    with pytest.raises(ModelError, match=r"5 gaps in all, 1.27% .* and 1% in all"):
        read(klipper(time_s[many], accel[many]))


def test_time_must_rise() -> None:
    time_s, accel = some_log()
    time_s[50] = time_s[49]
    with pytest.raises(ModelError, match=r"raw_data_x_\S+, line 52: time .* does not rise"):
        read(klipper(time_s, accel))


def test_dead_columns() -> None:
    time_s, accel = some_log()
    accel[:, 0] = 0.0
    text = klipper(time_s, accel)
    with pytest.raises(ModelError, match=r"sensor's x is dead .*sensor_axis"):
        read(text)
    log = read(text, sensor_axis="y")
    assert isinstance(log, AccelerationLog)
    assert log.notes == ("the sensor's x = 0 is constant",)
    with pytest.raises(ModelError, match="sensor's x is dead"):
        read(text, "raw_data_axis=1.000,-1.000_b.csv")
    read(text, "raw_data_y.csv")
    with pytest.raises(ModelError, match="every column of the sensor is constant"):
        read(klipper(time_s, np.full((N, 3), 9.0)))


@pytest.mark.parametrize("value", ["nan", "inf", "abc", "", "1e300", "0x10", "1_0"])
def test_bad_value_names_line_and_column(value: str) -> None:
    text = changed(klipper(*some_log()), 7, f"75.3,1.0,{value},2.0")
    with pytest.raises(
        ModelError, match=rf"line 7: accel_y is '{value}'|cannot be read as numbers"
    ):
        read(text)


def test_missing_field_names_its_line() -> None:
    text = changed(klipper(*some_log()), 8, "75.3,1.0,2.0")
    with pytest.raises(ModelError, match="line 8: 3 fields where 4 are expected"):
        read(text)


def test_last_line_cut_off_is_left_out() -> None:
    text = klipper(*some_log())
    whole = read(text)
    assert isinstance(whole, AccelerationLog)
    assert whole.notes == ()
    for cut in (8, 18, 40):  # within the last row: a shorter number, fewer fields, one field
        log = read(text[:-cut])
        assert isinstance(log, AccelerationLog)
        np.testing.assert_array_equal(log.time_s, whole.time_s[:-1])
        assert log.notes == (f"line {N + 1}, the last, is cut off and left out",)
    unended = read(text[:-1])
    assert isinstance(unended, AccelerationLog)
    np.testing.assert_array_equal(unended.accel_mm_s2, whole.accel_mm_s2)


def test_too_short_missing_column_and_overflow() -> None:
    time_s, accel = some_log()
    with pytest.raises(ModelError, match="63 samples, at least 64"):
        read(klipper(time_s[:63], accel[:63]))
    with pytest.raises(ModelError, match="column 'accel_z' is missing; there are: time, accel_x"):
        read(klipper(time_s, accel).replace("accel_z", "other"))
    with pytest.raises(ModelError, match="overflowed 12 times"):
        read(klipper(time_s, accel, "##{'errors': 0, 'overflows': 12}\n"))


def m956(axes: str, accel_g: np.ndarray, rate_hz: int = 1344, overflows: int = 0) -> str:
    rows = (f"{i}," + ",".join(f"{value:.3f}" for value in row) for i, row in enumerate(accel_g))
    head = "Sample," + ",".join(axes)
    return f"{head}\n" + "\n".join(rows) + f"\nRate {rate_hz}, overflows {overflows}\n"


@pytest.mark.parametrize("axes", ["XYZ", "XZ", "X"])
def test_m956(axes: str) -> None:
    accel_g = np.random.default_rng(1).normal(0, 0.5, (200, len(axes)))
    for text in (m956(axes, accel_g), m956(axes, accel_g)[:-1]):
        log = read(text, "0_2024-01-02_10.11.12.csv")
        assert isinstance(log, AccelerationLog)
        np.testing.assert_allclose(np.diff(log.time_s), 1 / 1344)
        assert not log.may_hold_test
        for i, axis in enumerate("XYZ"):
            column = log.accel_mm_s2[:, i]
            if axis in axes:
                expected = accel_g[:, axes.index(axis)] * 9806.65
                np.testing.assert_allclose(column, expected, atol=0.00051 * 9806.65)
            else:
                assert np.isnan(column).all()


def test_m956_faults() -> None:
    accel_g = np.random.default_rng(1).normal(0, 0.5, (200, 2))
    good = m956("XZ", accel_g)
    with pytest.raises(ModelError, match="overflowed 3 times"):
        read(m956("XZ", accel_g, overflows=3))
    with pytest.raises(ModelError, match="last line `Rate"):
        read(good[: good.index("Rate")])
    with pytest.raises(ModelError, match=r"line 202: the firmware says 'Failed to collect"):
        read(good[: good.index("Rate")] + "Failed to collect data from accelerometer\n")
    with pytest.raises(ModelError, match="sampling rate 0 Hz"):
        read(m956("XZ", accel_g, rate_hz=0))
    with pytest.raises(ModelError, match="sensor's y was not recorded, but axis y"):
        read(good, "y.csv")
    read(good, "y.csv", sensor_axis="z")
    lines = good.split("\n")
    with pytest.raises(ModelError, match="4 samples are missing"):
        read("\n".join(lines[:50] + lines[54:]))


def test_swept_sine_with_axes() -> None:
    rng = np.random.default_rng(5)
    values = rng.normal(size=(2, 100, 2))
    lines = ["time_s,cmd_acc,meas_acc,axis"]
    for i, axis in enumerate("XY"):
        lines += [f"{k / 500!r},{u!r},{y!r},{axis}" for k, (u, y) in enumerate(values[i].tolist())]
    content = "\n".join(lines).encode()
    with pytest.raises(ModelError, match=r"sweep.csv: it holds axis x, but was given as axis y"):
        read_content(content, "sweep.csv", settings=ReadSettings(axis="y"))
    logs = read_content(content, "sweep.csv")
    assert [log.axis for log in logs] == ["x", "y"]
    for log, expected in zip(logs, values, strict=True):
        assert isinstance(log, DrivenLog)
        np.testing.assert_array_equal(np.column_stack([log.command, log.measured]), expected)
        np.testing.assert_allclose(log.time_s, np.arange(100) / 500)


@given(st.sampled_from([",", ";", "\t", "  "]), st.booleans())
def test_drive_with_columns_of_any_name(mark: str, by_number: bool) -> None:
    rng = np.random.default_rng(9)
    u, y = rng.normal(size=(2, 90)).tolist()
    lines = ["#" + mark.join(["T", "n", "u", "acc"])]
    lines += [mark.join([f"{k / 500!r}", str(k), f"{u[k]!r}", f"{y[k]!r}"]) for k in range(90)]
    if by_number:
        lines.pop(0)
        known: dict[str, object] = {"time_column": 0, "command_column": "2", "measured_column": 3}
    else:
        known = {"time_column": "t", "command_column": "u", "measured_column": "acc"}
    log = read("\n".join(lines) + "\n", "log.txt", **known)
    assert isinstance(log, DrivenLog)
    np.testing.assert_array_equal(log.command, u)
    np.testing.assert_array_equal(log.measured, y)


def test_drive_faults() -> None:
    rows = "".join(f"{k / 500},{k % 7},{k % 5}\n" for k in range(90))
    with pytest.raises(ModelError, match="column 'meas_acc' is missing"):
        read("time_s,cmd_acc,y\n" + rows)
    with pytest.raises(
        ModelError, match=r"call those columns time_s, cmd_acc and .* first line.*\(time_column"
    ):
        read("t,u,y\n" + rows)
    with pytest.raises(ModelError, match="no column 7, counted from 0; it has 3"):
        read("t,u,y\n" + rows, time_column="t", command_column=7, measured_column="y")
    flat = "".join(f"{k / 500},1,{k % 5}\n" for k in range(90))
    with pytest.raises(ModelError, match="command column is constant"):
        read("time_s,cmd_acc,meas_acc\n" + flat)
    same = {"time_column": "t", "command_column": "u", "measured_column": "u"}
    with pytest.raises(ModelError, match="are the same numbers"):
        read("t,u,y\n" + rows, **same)
    in_ms = "".join(f"{2 * k},{k % 7},{k % 5}\n" for k in range(90))
    with pytest.raises(ModelError, match=r"2 s apart .*time must be in seconds"):
        read("time_s,cmd_acc,meas_acc\n" + in_ms)


@pytest.mark.shared
def test_robot_logs_are_read(shared_dir: Path) -> None:
    """The flexible link of 2009: t, n, u, v, theta, a at 500 Hz."""
    settings = ReadSettings(time_column="t", command_column="u", measured_column="a")
    files = sorted((shared_dir / "measurements" / "ryanGT_flexlink").glob("*.txt"))
    assert len(files) == 4
    for path in files:
        (log,) = read_measurements(path, settings=settings)
        assert isinstance(log, DrivenLog)
        assert len(log.time_s) == 2000
        np.testing.assert_allclose(np.diff(log.time_s), 0.002, atol=1e-9)
        assert log.axis is None
