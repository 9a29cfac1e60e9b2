"""Trajectories over HTTP, of a job that went the real pipeline."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from starlette.testclient import TestClient

from stillpath.service.api import create_app
from stillpath.service.settings import Settings
from tests.gcode.cutting import HEAD
from tests.gcode.prints import polygon
from tests.service.test_api import JOBS, assert_problem, over, until

pytestmark = pytest.mark.slow

TEXT = (HEAD + "G1 X120 Y100 F6000\n" + "\n".join(polygon(6, 15)) + "\n").encode()
PART = {"start_s": 0.5, "stop_s": 1.0}


@pytest.fixture(scope="module")
def data_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("data")


@pytest.fixture(scope="module")
def client(data_dir: Path) -> Iterator[TestClient]:
    app = create_app(Settings(data_dir=data_dir))
    with TestClient(app, base_url="http://localhost", raise_server_exceptions=False) as opened:
        yield opened


@pytest.fixture(scope="module")
def where(client: TestClient) -> str:
    """Path of the trajectories of a job that is done."""
    answer = client.post(f"{JOBS}&name=hexagon.gcode", content=TEXT)
    job = until(client, answer.headers["location"], over)
    assert job["state"] == "done", job
    return job["links"]["trajectories"]


def test_text_and_arrays_hold_the_same(client: TestClient, where: str):
    text = client.get(where, params=PART)
    assert text.headers["content-type"].startswith("text/csv")
    assert 'filename="hexagon.stillpath.csv"' in text.headers["content-disposition"]
    header, *rows = csv.reader(io.StringIO(text.text))
    assert {"t_s", "x_mm", "after_x_mm", "before_contour_um", "line", "extruding"} <= set(header)
    assert len(rows) == 500
    arrays = client.get(where, params=PART | {"format": "npz"})
    assert 'filename="hexagon.stillpath.npz"' in arrays.headers["content-disposition"]
    with np.load(io.BytesIO(arrays.content), allow_pickle=False) as found:
        assert found.files == header
        for name, column in zip(header, zip(*rows, strict=True), strict=True):
            np.testing.assert_allclose(found[name], np.array(column, float), rtol=0, atol=0.0051)


def test_the_whole_print(client: TestClient, where: str):
    _, *rows = csv.reader(io.StringIO(client.get(where).text))
    assert float(rows[0][0]) == 0.0
    assert len(rows) > 1000
    assert_problem(client.get(where, params={"start_s": 1e6}), 422, "the print ends at")


def test_nothing_is_left_behind(
    client: TestClient, where: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert client.get(where, params=PART).status_code == 200
    assert client.get(where, params={"start_s": 1e6}).status_code == 422
    assert list(tmp_path.iterdir()) == []


def test_what_the_disk_has_lost_or_damaged_is_computed_anew(
    client: TestClient, where: str, data_dir: Path
):
    part = {"start_s": 0.5, "stop_s": 0.6}
    whole = client.get(where, params=part).text
    for harm in (Path.unlink, lambda path: path.write_bytes(b"x" * path.stat().st_size)):
        stored = [
            path
            for path in data_dir.glob("jobs/*/*/result/hexagon.stillpath.csv")
            if path.read_text() == whole
        ]
        harm(max(stored, key=lambda path: path.stat().st_mtime_ns))
        assert_problem(client.get(where, params=part), 503, "ask again")
        assert client.get(where, params=part).text == whole


def test_an_upload_that_is_damaged_or_gone_is_told(client: TestClient, data_dir: Path):
    answer = client.post(f"{JOBS}&fresh=true&method=none", content=TEXT)
    job = until(client, answer.headers["location"], over)
    (source,) = (data_dir / "jobs" / job["id"] / "source").iterdir()
    whole = source.read_bytes()
    source.write_bytes(whole[: len(whole) // 2])
    assert_problem(client.get(job["links"]["trajectories"]), 404, "SHA-256 differs")
    source.unlink()
    assert_problem(client.get(job["links"]["trajectories"]), 404, "no longer")
