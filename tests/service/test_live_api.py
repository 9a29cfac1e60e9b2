"""Live printing over HTTP: its report, its filter, and which machines can."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

from stillpath.models.store import load_machine
from stillpath.pipeline.live_printing import simulate_live
from tests.service.test_api import assert_problem, open_client
from tests.service.test_server import REAL, finished, server

SOURCE = b"G28\nG90\nM83\nG1 Z0.3 F600\nG1 X60 Y60 F9000\n" + b"".join(
    b"G1 X%d Y60 E2\nG1 X%d Y140 E2\n" % (60 + 4 * n, 60 + 4 * n) for n in range(20)
)
FILTER = "/v1/machines/ender3/stillpath.json"


def post(client: Any, asked: dict[str, str]) -> str:
    answer = client.post("/v1/jobs", params=asked, content=SOURCE)
    assert answer.status_code == 202, answer.text
    return str(answer.headers["location"])


@pytest.mark.slow
def test_a_real_server_prints_live_and_compares(tmp_path: Path) -> None:
    from stillpath.applications.live.export import write_export

    source = tmp_path / "part.gcode"
    source.write_bytes(SOURCE)
    machine = load_machine("ender3")
    (expected,) = simulate_live(source, machine, cache_dir=tmp_path / "cache").ways
    data = tmp_path / "data"
    data.mkdir()
    with server(REAL, data) as (client, _):
        asked = {"machine": "ender3", "name": source.name}
        live, both = (  # one after the other: the filter is designed once
            finished(client, post(client, asked | more))
            for more in ({"method": "live"}, {"compare_live": "true"})
        )
        assert (live["state"], both["state"]) == ("done", "done")
        assert live["result_name"] == "part.gcode"
        assert both["result_name"] == "part.stillpath.gcode"
        assert client.get(live["links"]["result"]).content == SOURCE
        reports = [client.get(job["links"]["report_json"]).json() for job in (live, both)]
        assert [[way["name"] for way in r["ways"]] for r in reports] == [["live"], ["file", "live"]]
        for report in reports:
            way = report["ways"][-1]
            assert way["contour_rms_um"] == pytest.approx(expected.contour_rms_um, rel=1e-9)
            assert way["contour_range_um"] == pytest.approx(expected.contour_range_um, rel=1e-9)
        assert "Print it live" in client.get(live["links"]["report"]).text
        rows = client.get(live["links"]["trajectories"], params={"stop_s": 1}).text
        assert rows.startswith("t_s,x_mm")
        answer = client.get(FILTER)
        assert answer.headers["content-disposition"] == 'attachment; filename="stillpath.json"'
        write_export(machine, tmp_path / "stillpath.json", tmp_path / "cache")
        assert answer.content == (tmp_path / "stillpath.json").read_bytes()
        (job,) = client.get("/v1/jobs", params={"kind": "live"}).json()["jobs"]
        assert json.loads(client.get(job["links"]["result"]).content) == answer.json()


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory):
    with open_client(tmp_path_factory.mktemp("data")) as opened:
        yield opened


def test_machines_say_whether_they_can_print_live(client: TestClient) -> None:
    marlin = load_machine("ender3").model_dump(mode="json")
    marlin |= {"name": "mine", "firmware": {"kind": "marlin"}}
    assert client.put("/v1/machines/mine", json=marlin).status_code == 201
    listed = {m["name"]: m["live_refusal"] for m in client.get("/v1/machines").json()}
    assert listed["ender3"] is None
    assert "mine runs marlin: only Klipper" in listed["mine"]
    answer = client.get("/v1/machines/mine/stillpath.json")
    assert_problem(answer, 422, "mine runs marlin: only Klipper has print-time compensation")
    assert_problem(client.get("/v1/machines/nobody/stillpath.json"), 404, "nobody")
