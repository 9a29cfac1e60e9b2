"""Measurements over HTTP: a revision with its figures, or a problem and nothing at all."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

from stillpath.applications.identification.figures import IdentificationReport
from stillpath.applications.identification.run import InputFile
from stillpath.applications.proof.ring_test import write_ring_test
from stillpath.models.machine import Machine
from stillpath.models.plants import PairsSpec
from stillpath.models.typed_in import typed_in
from stillpath.service.api import create_app
from stillpath.service.settings import Settings
from tests.models.identification.recordings import (
    BROKEN,
    QUICK_QUERY,
    TAZ,
    broken,
    one_mode,
    quick_raw,
)
from tests.service.machines import make_machine
from tests.service.ringing import recorded
from tests.service.runners import pretend
from tests.service.test_api import assert_problem

MINE = "/v1/machines/mine"
MEASUREMENTS = f"{MINE}/measurements"
KEPT = ("machines", "identifications")


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("data")


@pytest.fixture(scope="module")
def service(data: Path) -> Iterator[TestClient]:
    app = create_app(Settings(data_dir=data), runner=pretend)
    with TestClient(app, base_url="http://localhost", raise_server_exceptions=False) as opened:
        yield opened


@pytest.fixture
def client(service: TestClient, data: Path) -> Iterator[TestClient]:
    """The one service of this module, with a machine `mine`."""
    machine = make_machine(kinematics="cartesian")
    made = service.put(MINE, content=machine.model_dump_json(), params={"author": "anna"})
    assert made.status_code == 201, made.text
    yield service
    for folder in KEPT:
        shutil.rmtree(data / folder, ignore_errors=True)


def post(client: TestClient, *files: InputFile, where: str = MEASUREMENTS, **more: Any) -> Any:
    parts = []
    for file in files:
        label = file.condition.label
        parts.append(("file", (f"{file.name}@{label}" if label else file.name, file.content)))
    while True:
        answer = client.post(where, files=parts, params=QUICK_QUERY | more)
        if answer.status_code != 202:
            return answer
        # The computer is busy. Who asks again waits for the job that runs already.


def kept(data: Path) -> dict[str, bytes]:
    """Machines and identifications; the job database writes as it likes."""
    return {
        str(p.relative_to(data)): p.read_bytes()
        for folder in KEPT
        for p in (data / folder).rglob("*")
        if p.is_file()
    }


def test_a_revision_with_its_figures(client: TestClient) -> None:
    before = client.get(MINE).headers["etag"].strip('"')
    files = [quick_raw("x"), quick_raw("y")]
    answer = post(client, *files, author="anna", message="new belts")
    assert answer.status_code == 201, answer.text
    document = answer.json()
    assert answer.headers["location"] == f"{MINE}/revisions/2"
    revision = document["revision"]
    assert (revision["number"], revision["author"]) == (2, "anna")
    assert revision["message"] == "new belts"
    assert [s["name"] for s in revision["sources"]] == [file.name for file in files]
    report = IdentificationReport.model_validate(document["report"])
    assert report.base_revision == before
    machine = Machine.model_validate(client.get(MINE).json())
    assert machine.revision == report.machine_revision
    plant = machine.axes["x"].nominal
    assert isinstance(plant, PairsSpec)
    assert plant.poles[0].f_hz == pytest.approx(42.0, rel=1e-3)

    found = client.get(f"{MINE}/identification")
    assert IdentificationReport.model_validate(found.json()) == report
    assert b"NaN" not in found.content
    page = client.get(f"{MINE}/identification.html")
    assert page.headers["content-type"].startswith("text/html")
    assert "Axis X, strongest mode" in page.text
    # Of another state nothing is known.
    client.post(f"{MINE}/revisions/1/rollback")
    assert_problem(client.get(f"{MINE}/identification"), 404, "/measurements")
    assert_problem(client.get(f"{MINE}/identification.html"), 404)


def test_a_trial_stores_nothing(client: TestClient, data: Path) -> None:
    before = kept(data)
    answer = post(client, quick_raw("x"), trial=True)
    assert (answer.status_code, answer.json()["revision"]) == (200, None)
    assert answer.json()["report"]["axes"][0]["modes"][0]["f_hz"] == pytest.approx(42.0, rel=1e-3)
    assert kept(data) == before


@pytest.mark.slow
def test_a_new_machine_from_a_base(client: TestClient) -> None:
    where = "/v1/machines/new/measurements"
    assert_problem(post(client, quick_raw("x"), where=where), 404, "base")
    made = post(client, quick_raw("x"), where=where, base="ender3", title="Left of the door")
    assert made.status_code == 201, made.text
    machine = Machine.model_validate(client.get("/v1/machines/new").json())
    assert (machine.name, machine.title) == ("new", "Left of the door")
    assert_problem(post(client, quick_raw("x"), title="a\x1b"), 422, "title")
    bad = "/v1/machines/Not%20Good/measurements"
    assert_problem(post(client, quick_raw("x"), where=bad, base="ender3"), 422)


def test_conditions_follow_the_name(client: TestClient) -> None:
    heavy = quick_raw("y", one_mode(35.0 / 1.625**0.5, 0.08 / 1.625**0.5), condition="+0.5kg")
    assert post(client, quick_raw("y"), heavy).status_code == 201
    mass = Machine.model_validate(client.get(MINE).json()).schedules["y"].mass
    assert mass is not None
    assert mass.moving_mass_kg == pytest.approx(0.8, rel=0.01)


def test_broken_files_leave_the_store_as_it_was(client: TestClient, data: Path) -> None:
    files = broken("gap")
    before = kept(data)
    assert_problem(post(client, *files), 422, files[0].name, *BROKEN["gap"])
    assert kept(data) == before


@pytest.mark.parametrize(
    ("query", "words"),
    [
        ({"axis": "q"}, ["axis 'q'"]),
        ({"accel_per_hz": "nan"}, ["accel_per_hz"]),
        ({"min_freq": 90}, ["min_freq 90"]),
        ({"firmware_date": "soon"}, ["firmware_date"]),
    ],
)
def test_bad_parameters(
    client: TestClient, data: Path, query: dict[str, Any], words: list[str]
) -> None:
    before = kept(data)
    assert_problem(post(client, quick_raw("x"), **query), 422, *words)
    assert kept(data) == before


def test_what_is_no_form(client: TestClient, data: Path) -> None:
    before = kept(data)
    plain = client.post(MEASUREMENTS, content=b"#time,accel_x")
    assert_problem(plain, 422, "multipart/form-data")
    typed = {"content-type": "multipart/form-data; boundary=x"}
    for body in (b"", b"--x\r\n", b"--x--\r\n", b"\x00" * 100):
        assert client.post(MEASUREMENTS, content=body, headers=typed).status_code == 422
    bare = {"content-type": "multipart/form-data"}
    assert_problem(client.post(MEASUREMENTS, content=b"", headers=bare), 422)
    assert_problem(client.post(MEASUREMENTS, files={"note": (None, "text")}), 422, "no file")
    many = [quick_raw("x")] + [InputFile(f"{k}.csv", b"") for k in range(40)]
    assert_problem(post(client, *many), 422, "40")
    assert kept(data) == before


def test_names_of_files_are_only_names(client: TestClient, data: Path) -> None:
    before = kept(data)
    for name in ("../../taz_x.json", "C:\\taz_x.json", "taz_x\n.json"):
        file = InputFile(name, TAZ.encode())
        answer = post(client, file, trial=True, axis="x", repair_rounding=True)
        assert answer.status_code == 200, answer.text
        (source,) = answer.json()["report"]["sources"]
        assert not set(source["name"]) & set("/\\\n")
    assert kept(data) == before


def test_a_test_of_belts_is_told_from_one_of_an_axis(client: TestClient) -> None:
    """Its direction was lost from its name, and the message said to give X or Y."""
    belts = replace(quick_raw("x"), name="raw_data_axis=1.000,-1.000_belt.csv")
    answer = post(client, belts, trial=True)
    assert_problem(answer, 422, belts.name, "moves both axes at once", "along X and along Y")
    assert_problem(post(client, belts, trial=True, axis="x"), 422, "its name says axis 1.000,-1")


def test_a_damaged_archive_is_told(client: TestClient, data: Path) -> None:
    model = InputFile("taz_x.json", TAZ.encode())
    assert post(client, model, repair_rounding=True).status_code == 201
    (file,) = (data / "identifications").iterdir()
    file.write_text("{")
    assert_problem(client.get(f"{MINE}/identification"), 422, file.name, "damaged")


@pytest.mark.slow
def test_a_ring_test_goes_along_with_its_log(
    client: TestClient, cache: Path, tmp_path: Path
) -> None:
    """As the page sends them, of a machine whose resonances were typed in."""
    axes = {axis: typed_in(f_hz, 0.07) for axis, f_hz in {"x": 52.0, "y": 32.0}.items()}
    machine = make_machine(kinematics="corexy").model_copy(update={"axes": axes})
    etag = client.get(MINE).headers["etag"]
    put = client.put(MINE, content=machine.model_dump_json(), headers={"If-Match": etag})
    assert put.status_code == 200, put.text
    ring = tmp_path / "ring.gcode"
    write_ring_test(machine, ring, cache_dir=cache)
    log = InputFile("adxl345-ring.csv", recorded(ring, machine).raw_data())
    alone = post(client, InputFile("ring.gcode", ring.read_bytes()), trial="true")
    assert_problem(alone, 422, "ring.gcode is a ring test: give what was logged while it ran")
    answer = post(client, InputFile("ring.gcode", ring.read_bytes()), log)
    assert answer.status_code == 201, answer.text
    about = client.get(MINE).json()["axes"]["x"]["provenance"]
    assert about["kind"] == "ring test"
    assert [source["name"] for source in about["sources"]] == ["adxl345-ring.csv"]
