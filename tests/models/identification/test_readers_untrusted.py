"""Whatever the bytes: a measurement, or one sentence that says what is wrong."""

from __future__ import annotations

import contextlib
import io
import json
import pickle
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from hypothesis import given, settings
from hypothesis import strategies as st

from stillpath.models.errors import ModelError
from stillpath.models.identification.readers import ReadSettings, read_content, read_measurements
from stillpath.models.identification.readers.reading import LARGEST_BYTES
from stillpath.models.identification.types import DrivenLog, Measurement

RNG = np.random.default_rng(7)


def _table(header: str, values: np.ndarray, *, end: str = "") -> bytes:
    rows = (",".join(f"{v:.4f}" for v in row) for row in values)
    return (header + "\n" + "\n".join(rows) + "\n" + end).encode()


def _counted(columns: int, step: float = 1.0) -> np.ndarray:
    values = np.abs(RNG.normal(1, 0.2, (70, columns + 1)))
    values[:, 0] = np.arange(70) * step
    return values


def _mat(compressed: bool, **variables: object) -> bytes:
    out = io.BytesIO()
    scipy.io.savemat(out, variables, do_compression=compressed)
    return out.getvalue()


MODEL = {"num": [0.1], "den": [1.0, -0.9], "Ts": 0.001}
VALID: dict[str, bytes] = {
    "raw_data_x_1.csv": _table("#time,accel_x,accel_y,accel_z", _counted(3, 0.0005)),
    "resonances_x_1.csv": _table("freq,psd_x,psd_y,psd_z,psd_xyz", _counted(4, 1.6)),
    "calibration_data_x_1.csv": _table("freq,psd_x,psd_y,psd_z,psd_xyz,mzv(50)", _counted(5, 1.6)),
    "m956.csv": _table("Sample,X,Y,Z", _counted(3), end="Rate 1344, overflows 0\n"),
    "sweep.csv": _table("time_s,cmd_acc,meas_acc", _counted(2, 0.001)),
    "frf.csv": _table("freq_hz,mag,phase_deg,sd", _counted(3)),
    "tf.json": json.dumps(MODEL).encode(),
    "zpk.json": b'{"zeros": [], "poles": ["-20+300j", [-20, -300]], "gain": 90400.0}',
    "ss.json": b'{"A": [[-100.0]], "B": [[1.0]], "C": [[100.0]], "D": [[0]]}',
    "own.json": b'{"kind": "modes", "modes": [{"f_hz": 40, "zeta": 0.1}]}',
    "tf.mat": _mat(False, **MODEL),
    "struct.mat": _mat(True, x=MODEL),
}
SETTINGS = (ReadSettings(), ReadSettings(repair_rounding=True), ReadSettings(dc_gain=1.05))


@pytest.mark.parametrize("name", VALID)
def test_the_samples_are_valid(name: str) -> None:
    assert read_content(VALID[name], name)


def _finite(measured: Measurement) -> bool:
    arrays = [getattr(measured, f, None) for f in ("time_s", "f_hz", "response", "command")]
    return all(a is None or bool(np.isfinite(a).all()) for a in arrays)


@settings(max_examples=400)
@given(st.sampled_from(sorted(VALID)), st.sampled_from(SETTINGS), st.data())
def test_changed_bytes_are_read_or_refused(
    name: str, known: ReadSettings, data: st.DataObject
) -> None:
    content = bytearray(VALID[name])
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(content)))
        gone = data.draw(st.sampled_from([0, 1, 1, 4, 40]))
        new = data.draw(st.one_of(st.binary(max_size=6), st.sampled_from(_POISON)))
        content[at : at + gone] = new
    with contextlib.suppress(ModelError):
        measured = read_content(bytes(content), name, settings=known)
        assert measured
        assert all(_finite(m) for m in measured)


_POISON = (
    b"nan", b"-inf", b"1e400", b"\n", b",", b",,", b"\x00", b"#", b'"', b"[", b"{", b"null",
    b"true", b"-", b"1e308", b"1e-308", b"\xff\xfe", b"\r", b"\x1c", b"99999999999999999999",
)  # fmt: skip


@settings(max_examples=150)
@given(st.binary(max_size=300), st.sampled_from(["a.csv", "raw_data_x_1.csv", "m.json", "m.mat"]))
def test_any_bytes(content: bytes, name: str) -> None:
    with pytest.raises(ModelError):
        read_content(content, name)


@pytest.mark.parametrize("name", VALID)
def test_every_cut_is_read_or_refused(name: str) -> None:
    whole = VALID[name]
    for size in range(0, len(whole), max(1, len(whole) // 60)):
        with contextlib.suppress(ModelError):
            assert read_content(whole[:size], name)


@pytest.mark.parametrize(("delimiter", "mark"), [(";", ""), ("\t", ""), (";", "#")])
def test_what_spreadsheets_write(delimiter: str, mark: str) -> None:
    """Tables in UTF-16 are read; decimal commas have a message of their own."""
    at = np.arange(100)
    rows = [(f"{mark}time_s", "cmd_acc", "meas_acc")]
    rows += [(f"{0.01 * k:.2f}", f"{k % 7:.1f}", f"{k % 5:.1f}") for k in at]
    text = "\r\n".join(delimiter.join(row) for row in rows) + "\r\n"
    for encoding in ("utf-8", "utf-16"):
        (driven,) = read_content(text.encode(encoding), "drive_x.csv")
        assert isinstance(driven, DrivenLog)
        np.testing.assert_allclose(driven.time_s, 0.01 * at)
    with pytest.raises(ModelError, match=r"line 2: time_s is '0,00', .*: export the file with po"):
        read_content(text.replace(".", ",").encode(), "drive_x.csv")


def test_files_that_are_not_read(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"cannot read none\.csv: No such file"):
        read_measurements(tmp_path / "none.csv")
    empty = tmp_path / "empty.csv"
    empty.write_bytes(b" \n")
    with pytest.raises(ModelError, match=r"empty\.csv: the file is empty"):
        read_measurements(empty)
    large = tmp_path / "large.csv"
    with large.open("wb") as file:
        file.truncate(LARGEST_BYTES + 1)
    with pytest.raises(ModelError, match=r"large\.csv: 200000001 bytes, more than"):
        read_measurements(large)
    with pytest.raises(ModelError, match="not a known format"):
        read_content(pickle.dumps({"num": [1]}), "model.pkl")
    with pytest.raises(ModelError, match=r"known format.*accelerations alone .*\(machines from-"):
        # What adxl345spi writes, and OctoPrint's Pinput Shaping with it.
        read_content(b"time, x, y, z\n0.0, 0.1, 0.0, 1.0\n0.1, 0.1, 0.0, 1.0\n", "AXIS_X_1.csv")
    with pytest.raises(ModelError, match=r"looked for .*The first line is 'hello there'"):
        read_content(b"hello there\n1,2\n", "a.csv")
    for start in (b"", b"# My printer\n\n[mcu]\nserial: /dev/null\n"):
        with pytest.raises(ModelError, match=r"printer\.cfg: .*holds no measurement"):
            read_content(start + b"[printer]\nkinematics: corexy\n", "printer.cfg")
    with pytest.raises(ModelError, match="say what repeats"):
        read_content(b"# homed\ntime_s,position_mm,measured_mm\n0,1,1\n.1,2,2\n", "pass.csv")
    with pytest.raises(ModelError, match="0 frequencies, at least 8"):
        read_content(b"freq_hz,mag,phase_deg\n", "a.csv")
    with pytest.raises(ModelError, match="header but no row"):
        read_content(b"time_s,cmd_acc,meas_acc\n", "a.csv")


def test_byte_order_mark_and_line_ends() -> None:
    text = VALID["resonances_x_1.csv"]
    (plain,) = read_content(text, "resonances_x_1.csv")
    for other in (b"\xef\xbb\xbf" + text, text.replace(b"\n", b"\r\n"), text + b"\n\n"):
        (same,) = read_content(other, "resonances_x_1.csv")
        np.testing.assert_array_equal(same.psd["xyz"], plain.psd["xyz"])  # type: ignore[union-attr]


LOG = "#time,accel_x,accel_y,accel_z\n"


def rows(count: int, row: str) -> bytes:
    return (row * count).encode()


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (LOG.encode() + rows(1_002_000, "1,2,3,4\n"), "1002001 lines, at most 1000000 samples"),
        (LOG.encode() + rows(1_002_000, "1,2,3,4\r"), "1002000 lines, at most 1000000 samples"),
        (b"freq,psd_x\n" + rows(100, "5,1\n") + b"1" * 30_000, "line 102: longer than 20000"),
        (b'{"num": [' + b"1," * 8_000_000 + b"1]}", "at most 16000000 are read of a model"),
        (
            b"freq_hz,real,imag\n" + rows(50_001, "5,1,1\n"),
            "50001 frequencies, at most 50000 are read",
        ),
        (
            b"freq_hz,real,imag,label\n" + b"".join(b"5,1,1,%d\n" % n for n in range(300)),
            "300 labels and axes, at most 200 are read",
        ),
        (
            b"time_s,cmd_acc,meas_acc,axis\n" + b"".join(b"5,1,1,%d\n" % n for n in range(300)),
            "'axis' has 300 values, at most 16 axes",
        ),
        (
            LOG.encode() + b"".join(b"%g,%d,1,2\n" % (0.09 * n, n % 7) for n in range(50_000)),
            "it lasts 4500 s, at most 3600 s are read",
        ),
    ],
)
def test_more_than_can_be_measured_is_refused(content: bytes, said: str) -> None:
    with pytest.raises(ModelError, match=said):
        read_content(content, "raw_data_x.csv")
