"""A slicer's "send to printer": the requests of PrusaSlicer, Cura and OrcaSlicer."""

from __future__ import annotations

from pathlib import Path

import pytest
from starlette.testclient import TestClient

from tests.service.api.serving import opened
from tests.service.test_api import assert_problem, over, until

FORM = {"select": (None, "false"), "path": (None, "")}


def test_the_test_of_the_connection(client: TestClient):
    for where in ("/api/version", "/printers/left/api/version", "/printers/ender3/api/version"):
        found = client.get(where).json()
        assert found["text"].startswith("OctoPrint")
        assert {"api", "server"} <= found.keys()
    assert_problem(client.get("/printers/nope/api/version"), 404, "nope", "left")


@pytest.mark.parametrize("where", ["/printers/left", "/printers/ender3/", "/printers/ender3"])
def test_a_browser_at_the_address_of_a_printer_gets_the_page(client: TestClient, where: str):
    answer = client.get(where)
    assert answer.status_code == 200
    assert answer.url.path == "/"
    assert "<title>Stillpath</title>" in answer.text


@pytest.mark.parametrize("where", ["", "/printers/left"])
def test_a_file_for_a_printer(client: TestClient, where: str):
    sent = FORM | {"print": (None, "false"), "file": ("gear.gcode", b"G1 X1\n")}
    answer = client.post(f"{where}/api/files/local", files=sent)
    assert answer.status_code == 201, answer.text
    found = answer.json()
    assert found["done"] is True
    assert found["files"]["local"]["name"] == "gear.gcode"
    assert found["files"]["local"]["origin"] == "local"
    assert answer.headers["location"] == f"http://localhost{found['job']}"
    job = until(client, found["job"], over)
    assert (job["state"], job["printer"], job["print"]) == ("done", "left", False)
    assert job["options"]["method"] == "shaper:ei"
    assert job["options"]["budget_um"] == 12


def test_a_file_for_a_machine(client: TestClient):
    sent = FORM | {"file": ("gear.gcode", b"G1 X2\n")}
    answer = client.post("/printers/ender3/api/files/local", files=sent)
    job = until(client, answer.json()["job"], over)
    assert (job["machine"], job["printer"]) == ("ender3", None)
    with_print = sent | {"print": (None, "true")}
    refused = client.post("/printers/ender3/api/files/local", files=with_print)
    assert_problem(refused, 422, "printer")


@pytest.mark.parametrize(
    ("name", "index", "plate"),
    [
        ("gear.gcode.3mf", "2", 2),
        ("gear.3MF", "10", 10),
        ("gear.gcode", "2", None),
        ("gear.gcode.3mf", "", None),
        ("gear.gcode.3mf", "0", None),
        ("gear.gcode.3mf", "the first", None),
    ],
)
def test_the_plate_that_orcaslicer_names(
    client: TestClient, name: str, index: str, plate: int | None
):
    sent = FORM | {"plateindex": (None, index), "file": (name, b"G1 X3\n")}
    answer = client.post("/printers/ender3/api/files/local", files=sent)
    job = client.get(answer.json()["job"]).json()
    assert job["options"]["plate"] == plate


def test_what_is_wrong(client: TestClient, tmp_path: Path):
    sent = FORM | {"file": ("gear.gcode", b"G1 X2\n")}
    assert_problem(client.post("/printers/nope/api/files/local", files=sent), 404, "nope", "left")
    assert_problem(client.post("/printers/left/api/files/local", files=FORM), 422, "file name")
    assert_problem(client.post("/printers/a%0ab/api/files/local", files=sent), 404)
    odd = tmp_path / "printers.toml"
    odd.write_text(
        '[printer.odd]\nkind = "octoprint"\nurl = "http://127.0.0.1:9"\nmachine = "ender3"\n'
        'method = "live"\nbudget_um = 12\n'
    )
    with opened(tmp_path / "odd", printers=odd) as found:
        refused = found.post("/printers/odd/api/files/local", files=sent)
        assert_problem(refused, 422, "odd", "method live", "STILLPATH_PRINTERS")
    with opened(tmp_path / "alone") as alone:
        assert_problem(alone.post("/api/files/local", files=sent), 422, "/printers/NAME")
