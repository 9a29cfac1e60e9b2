"""Shake&Tune's recordings, and files stored with gzip or Zstandard."""

from __future__ import annotations

import gzip
import io
import json
import pickle

import numpy as np
import pytest
from zstandard import FLUSH_FRAME, ZstdCompressor

from stillpath.models.errors import ModelError
from stillpath.models.identification.readers import ReadSettings, read_content
from stillpath.models.identification.readers.compressed import unpacked
from stillpath.models.identification.types import AccelerationLog

NAME = "inputshaper_20250301_120000_axis_X.stdata"


def recording(name: str = "axis_X_20250301_120001", n: int = 400) -> dict[str, object]:
    rng = np.random.default_rng(3)
    accel = rng.normal((0, 0, 9800), 3000, (n, 3))
    return {
        "name": name,
        "samples": [[75.3 + i / 3200, *map(float, a)] for i, a in enumerate(accel)],
    }


def stdata(*recordings: object) -> bytes:
    """Return a file as Shake&Tune writes it: frames of unknown size, a JSON object a line."""
    out = io.BytesIO()
    with ZstdCompressor(level=11).stream_writer(out, closefd=False) as stream:
        for one in recordings:
            stream.write((json.dumps(one) + "\n").encode())
        stream.flush(FLUSH_FRAME)
    return out.getvalue()


def as_csv(one: dict[str, object]) -> bytes:
    rows = (",".join(map(repr, sample)) for sample in one["samples"])
    return ("#time,accel_x,accel_y,accel_z\n" + "\n".join(rows) + "\n").encode()


def test_it_is_the_log_that_klipper_would_write() -> None:
    (log,) = read_content(stdata(recording()), NAME)
    (same,) = read_content(as_csv(recording()), "raw_data_x_20250301_120000.csv")
    assert isinstance(log, AccelerationLog)
    assert isinstance(same, AccelerationLog)
    assert log.axis == same.axis == "x"
    assert log.source == NAME
    np.testing.assert_array_equal(log.time_s, same.time_s)
    np.testing.assert_array_equal(log.accel_mm_s2, same.accel_mm_s2)


def test_belts_lie_on_diagonals() -> None:
    content = stdata(recording("belt_A_20250301_120001"), recording("belt_B_20250301_120301"))
    assert [log.axis for log in read_content(content, "belts.stdata")] == [
        "1.000,-1.000",
        "1.000,1.000",
    ]


def test_an_unlabelled_recording_needs_its_axis() -> None:
    content = stdata(recording("my_test_20250301_120001"))
    (log,) = read_content(content, "mine.stdata", settings=ReadSettings(axis="y"))
    assert log.axis == "y"


@pytest.mark.parametrize(
    ("content", "name", "says"),
    [
        (stdata(recording("vib_010_000_20250301")), "v.stdata", "is no resonance test of X or Y"),
        (stdata(recording("belt_Z_20250301")), "cz.stdata", "'belt_Z_20250301' is no resonance"),
        (stdata(recording()), "inputshaper_axis_Y.stdata", "holds axis x"),
        (stdata({"name": "axis_X", "samples": [[0.0, 1.0, 2.0]]}), NAME, r"line 1, samples\[0\]"),
        (stdata({"name": "axis_X", "samples": []}), NAME, "at least 64 are needed"),
        (stdata(recording(n=30)), NAME, "at least 64 are needed"),
        (stdata(recording(), {"name": "axis_Y"}), NAME, "line 2, samples: Field required"),
        (stdata(recording())[:-400], NAME, "copy it again|copy the file again"),
        (stdata(recording())[:6] + b"damage" * 9, NAME, "damaged or cut off"),
        (gzip.compress(as_csv(recording()))[:-9], "raw_data_x.csv.gz", "damaged or cut off"),
    ],
)
def test_faults_are_named(content: bytes, name: str, says: str) -> None:
    settings = ReadSettings(axis="y") if "axis_Y" in name else None
    with pytest.raises(ModelError, match=says) as error:
        read_content(content, name, settings=settings)
    assert str(error.value).startswith(name)


@pytest.mark.parametrize("protocol", [2, 4, 5])
def test_recordings_before_2025_02_are_told_to_be_repeated(protocol: int) -> None:
    """They are pickles, which run whatever somebody put into them."""
    content = ZstdCompressor().compress(pickle.dumps([recording()], protocol=protocol))
    with pytest.raises(ModelError, match=r"Shake&Tune before 2025-02.*measure again"):
        read_content(content, NAME)


@pytest.mark.parametrize("pack", [gzip.compress, ZstdCompressor().compress])
def test_other_files_may_be_compressed(pack: object) -> None:
    packed = pack(as_csv(recording()))  # type: ignore[operator]
    (log,) = read_content(packed, "raw_data_x_20250301_120000.csv.gz")
    assert log.axis == "x"
    assert len(log.time_s) == 400
    with pytest.raises(ModelError, match="unpacks to more than 1000 bytes"):
        unpacked(packed, "raw_data_x.csv.gz", 1000)
