"""Machines over HTTP: revisions with ETags, differences, approval, and what a job remembers."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from datetime import date
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

from stillpath.applications.machines.resolve import PinnedMachine
from stillpath.models.machine import Machine
from stillpath.models.store import builtin_machines
from stillpath.service.api import create_app
from stillpath.service.settings import Settings
from tests.applications.test_machine_config_g import CONFIG_G
from tests.applications.test_machine_m503 import M503
from tests.cli.test_machine_cli import CONFIG
from tests.service.machines import make_machine, make_plants
from tests.service.runners import pretend
from tests.service.test_api import assert_problem, over, until

MINE = "/v1/machines/mine"


def open_client(folder: Path, **settings: Any) -> TestClient:
    app = create_app(Settings(data_dir=folder, **settings), runner=pretend)
    return TestClient(app, base_url="http://localhost", raise_server_exceptions=False)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("data")


@pytest.fixture(scope="module")
def service(folder: Path) -> Iterator[TestClient]:
    with open_client(folder) as opened:
        yield opened


@pytest.fixture
def client(service: TestClient, folder: Path) -> Iterator[TestClient]:
    """The one service of this module, without machines of its own."""
    yield service
    shutil.rmtree(folder / "machines", ignore_errors=True)


def put(client: TestClient, machine: Machine, where: str = MINE, **headers: str) -> Any:
    return client.put(
        where,
        content=machine.model_dump_json(),
        params={"author": "anna", "message": "why"},
        headers=headers,
    )


def changed(f_hz: float) -> Machine:
    plants = make_plants(f_hz, on=date(2026, 3, 2))
    return make_machine(axes={"x": plants, "y": plants})


def test_a_machine_from_birth_to_deletion(client: TestClient):
    first = put(client, changed(52.3))
    assert first.status_code == 201, first.text
    assert first.headers["location"] == MINE
    document = first.json()
    assert (document["number"], document["author"], document["message"]) == (1, "anna", "why")
    assert document["provenance"]["x"]["residual"] == 0.004
    shown = client.get(MINE)
    assert Machine.model_validate(shown.json()) == changed(52.3)
    assert shown.headers["etag"] == first.headers["etag"] == f'"{changed(52.3).revision}"'

    second = put(client, changed(49.8), **{"If-Match": shown.headers["etag"]})
    assert (second.status_code, second.json()["number"]) == (200, 2)
    assert client.get(MINE).headers["etag"] == second.headers["etag"] != first.headers["etag"]
    found = client.get(f"{MINE}/diff", params={"from": 1, "to": 2}).json()
    assert [c["text"] for c in found["changes"]] == [
        "X mode 52.3 -> 49.8 Hz (-4.8 %), zeta 0.050 -> 0.050",
        "Y mode 52.3 -> 49.8 Hz (-4.8 %), zeta 0.050 -> 0.050",
    ]

    back = client.post(f"{MINE}/revisions/1/rollback", params={"author": "bob"})
    assert (back.json()["number"], back.json()["restored"]) == (3, 1)
    assert back.headers["etag"] == first.headers["etag"]
    history = client.get(f"{MINE}/revisions").json()
    assert [r["number"] for r in history["revisions"]] == [1, 2, 3]
    assert "X fell from 52.3 to 49.8 Hz" in history["drift"][0]["text"]
    one = client.get(f"{MINE}/revisions/2").json()
    assert Machine.model_validate(one["machine"]) == changed(49.8)

    assert client.delete(MINE).status_code == 204
    assert_problem(client.get(MINE), 404, "mine")
    assert_problem(client.delete(MINE), 404)


def test_nobody_loses_a_change(client: TestClient):
    assert_problem(put(client, changed(50.0), **{"If-Match": '"abc"'}), 412, "without If-Match")
    old = put(client, changed(50.0)).headers["etag"]
    assert_problem(put(client, changed(51.0)), 428, "Take another name", "If-Match")
    assert put(client, changed(51.0), **{"If-Match": f'"other", {old}'}).status_code == 200
    stale = {"If-Match": old}
    assert_problem(put(client, changed(52.0), **stale), 412, "revision 2", old.strip('"'))
    assert_problem(client.post(f"{MINE}/revisions/1/rollback", headers=stale), 412)
    assert_problem(client.delete(MINE, headers=stale), 412)
    assert put(client, changed(52.0), **{"If-Match": "*"}).json()["number"] == 3
    assert len(client.get(f"{MINE}/revisions").json()["revisions"]) == 3


def test_what_has_not_changed_is_not_sent_again(client: TestClient):
    for where in ("/v1/machines/ender3", MINE):
        put(client, changed(50.0))
        tag = client.get(where).headers["etag"]
        again = client.get(where, headers={"If-None-Match": tag})
        assert (again.status_code, again.content, again.headers["etag"]) == (304, b"", tag)
        assert client.get(where, headers={"If-None-Match": '"x"'}).status_code == 200


TINY = re.sub(r'("max_accel_mm_s2":)[^,}]+', r"\g<1>5e-324", make_machine().model_dump_json())
SLOW = re.sub(r'("f_hz":)[^,}]+', r"\g<1>1e-300", make_machine().model_dump_json())


@pytest.mark.parametrize(
    ("where", "body", "status", "words"),
    [
        (MINE, b"{", 422, ["not JSON"]),
        (MINE, b"", 422, ["not JSON"]),
        (MINE, b"[" * 100_000, 422, ["not JSON"]),
        (MINE, b"{}", 422, ["missing", "Field required"]),
        (MINE, b" " * 4_000_001, 413, ["4000000 bytes"]),
        (MINE, b'{"title": "\\ud800"}', 422, ["not JSON"]),
        (MINE, b'{"title": "\xff"}', 422, ["not JSON"]),
        (MINE, make_machine().model_dump_json().replace("My", "\\u001b["), 422, ["title"]),
        (MINE, TINY, 422, ["5e-324", "not a plausible size"]),
        (MINE, SLOW, 422, ["1e-300", "not a plausible size"]),
        ("/v1/machines/yours", None, 422, ["'mine', not 'yours'"]),
        ("/v1/machines/ender3", None, 409, ["built-in", "another name"]),
        ("/v1/machines/Mine", None, 422, ["cannot be a machine's name"]),
        ("/v1/machines/.trash", None, 422, ["cannot be a machine's name"]),
        (f"{MINE}?author=", None, 422, ["author"]),
        (f"{MINE}?author=%1b[31m", None, 422, ["author"]),
        (f"{MINE}?message=%00", None, 422, ["message"]),
    ],
)
def test_bad_documents_leave_nothing(
    client: TestClient, folder: Path, where: str, body: bytes | str | None, status: int, words
):
    content = make_machine().model_dump_json() if body is None else body
    document = assert_problem(client.put(where, content=content), status)
    assert any(word in document["detail"] for word in words)
    assert not (folder / "machines").exists()


@pytest.mark.parametrize(
    ("method", "path", "status"),
    [
        ("GET", "/v1/machines/nope/revisions", 404),
        ("GET", "/v1/machines/ender3/revisions", 409),
        ("GET", "/v1/machines/ender3/diff?from=1&to=1", 409),
        ("DELETE", "/v1/machines/ender3", 409),
        ("DELETE", "/v1/machines/..%2Fjobs", 404),
        ("POST", "/v1/machines/ender3/revisions/1/approve", 409),
        ("POST", "/v1/machines/nope/revisions/1/rollback", 404),
        ("GET", "/v1/machines/mine/revisions/7", 404),
        ("GET", "/v1/machines/mine/revisions/0", 422),
        ("GET", "/v1/machines/mine/diff?from=1", 422),
        ("GET", "/v1/machines/mine/diff?from=1&to=9", 404),
        ("GET", "/v1/machines/nope/design?axis=x", 404),
        ("GET", "/v1/machines/ender3/design", 422),
        ("GET", "/v1/machines/ender3/design?axis=x&basis=fourier", 422),
        ("GET", "/v1/machines/ender3/design.html?axis=x&robust=yes", 422),
    ],
)
def test_what_is_not_there(client: TestClient, method: str, path: str, status: int):
    put(client, changed(50.0))
    assert_problem(client.request(method, path), status)


def test_the_list_shows_own_machines_and_damaged_ones(client: TestClient, folder: Path):
    put(client, changed(50.0))
    put(client, make_machine("spoiled"), "/v1/machines/spoiled")
    client.post(f"{MINE}/revisions/1/approve", params={"author": "bob"})
    (folder / "machines" / "spoiled" / "000001.json").write_text("{")
    listed = {m["name"]: m for m in client.get("/v1/machines").json()}
    assert list(listed) == [*builtin_machines(), "mine", "spoiled"]
    assert (listed["mine"]["origin"], listed["mine"]["number"]) == ("own", 1)
    assert listed["mine"]["approved"] == 1
    assert "000001.json" in listed["spoiled"]["problem"]
    assert_problem(client.get("/v1/machines/spoiled"), 422, "000001.json")
    assert_problem(client.post("/v1/jobs?machine=spoiled", content=b"G1 X1"), 422, "damaged")


def test_a_user_s_machine_of_a_name_that_was_built_in_later(
    client: TestClient, monkeypatch: pytest.MonkeyPatch
):
    """It is approved, looked at and deleted like any other, but not changed."""
    with monkeypatch.context() as earlier:  # a version whose library had no such machine
        for module in ("applications.machines.store", "service.api.machines"):
            earlier.setattr(f"stillpath.{module}.builtin_machines", list)
        where = "/v1/machines/ender3"
        etag = put(client, make_machine("ender3"), where).headers["etag"]
    assert client.post(f"{where}/revisions/1/approve").status_code == 200
    [revision] = client.get(f"{where}/revisions").json()["revisions"]
    assert revision["approval"]["author"] == "local"
    assert client.get(f"{where}/revisions/1").status_code == 200
    assert_problem(put(client, make_machine("ender3"), where, **{"If-Match": etag}), 409, "another")
    assert client.delete(where).status_code == 204
    assert_problem(client.get(f"{where}/revisions"), 409, "built-in")


@pytest.mark.slow
def test_only_approved_revisions_where_that_is_switched_on(tmp_path: Path):
    with open_client(tmp_path, require_approval=True) as client:
        put(client, changed(50.0))
        jobs = "/v1/jobs?machine=mine"
        assert_problem(client.post(jobs, content=b"G1 X1"), 422, "approve mine --revision 1")
        approved = client.post(f"{MINE}/revisions/1/approve", params={"author": "bob"}).json()
        assert approved["approval"]["author"] == "bob"
        put(client, changed(60.0), **{"If-Match": "*"})
        job = client.post(jobs, content=b"G1 X1").json()
        assert pinned(tmp_path, job).machine == changed(50.0)
        assert client.post("/v1/jobs?machine=ender3", content=b"G1 X1").status_code == 202


def pinned(folder: Path, job: dict[str, Any]) -> PinnedMachine:
    return PinnedMachine.read(
        folder / "jobs" / job["id"] / "machine.json", job["machine"], job["machine_revision"]
    )


@pytest.mark.slow
def test_a_job_keeps_the_machine_it_was_accepted_with(tmp_path: Path):
    with open_client(tmp_path) as client:
        put(client, changed(50.0))
        slow = client.post("/v1/jobs?machine=ender3", content=b"slow").headers["location"]
        until(client, slow, lambda job: job["state"] == "running")
        waiting = client.post("/v1/jobs?machine=mine", content=b"G1 X1")
        put(client, changed(60.0), **{"If-Match": "*"})
        client.delete(MINE)
        kept = pinned(tmp_path, waiting.json())
        assert (kept.machine, kept.number) == (changed(50.0), 1)
        # Measured in March 2026 or typed in: warned of by the clock of the day.
        assert all("measure it again" in warning for warning in kept.warnings)
        client.delete(slow)
        assert until(client, waiting.headers["location"], over)["state"] == "done"


def settings(client: TestClient, text: str, headers: dict[str, str] | None = None, **query: Any):
    return client.post(f"{MINE}/settings", content=text, params=query, headers=headers or {})


def test_a_machine_of_an_answer_to_m503_and_its_next_revision(client: TestClient):
    assert_problem(settings(client, M503), 422, "travel=XxYxZ", "235x235x250")
    made = settings(client, M503, travel="235x235x250", file="a/m503.txt", fy=29, author="anna")
    assert made.status_code == 201, made.text
    assert made.headers["location"] == MINE
    assert (made.json()["message"], made.json()["author"]) == ("from m503.txt", "anna")
    machine = client.get(MINE).json()
    assert machine["firmware"]["steps_per_mm"]["y"] == 80.4
    assert machine["axes"]["y"]["nominal"]["modes"][0]["f_hz"] == 29
    later = M503.replace("P510", "P900")
    assert_problem(settings(client, later), 428, "If-Match")
    assert_problem(settings(client, later, {"If-Match": '"0"'}), 412)
    again = settings(client, later, {"If-Match": made.headers["etag"]})
    assert (again.status_code, again.json()["number"]) == (200, 2)
    assert client.get(MINE).json()["firmware"]["planner"]["accel_mm_s2"] == 900


def test_a_machine_of_a_printer_cfg(client: TestClient):
    made = settings(client, CONFIG, file="printer.cfg", title="Mine", fx=51)
    assert made.status_code == 201, made.text
    machine = client.get(MINE).json()
    assert (machine["title"], machine["kinematics"]) == ("Mine", "corexy")
    assert machine["axes"]["x"]["nominal"]["modes"][0]["f_hz"] == 51
    same = settings(client, CONFIG, {"If-Match": made.headers["etag"]})
    assert (same.status_code, same.json()["number"]) == (200, 1)
    # What it includes does not come along: the history says what is unknown.
    unread = "; not read, so unknown: mainsail.cfg"
    assert made.json()["message"] == f"from printer.cfg{unread}"
    later = CONFIG.replace("square_corner_velocity: ", "square_corner_velocity: 1")
    again = settings(client, later, {"If-Match": made.headers["etag"]})
    assert (again.status_code, again.json()["number"]) == (200, 2)
    assert client.get(MINE).json()["axes"] == machine["axes"]
    other = CONFIG.replace("corexy", "cartesian")
    answer = settings(client, other, {"If-Match": again.headers["etag"]})
    assert_problem(answer, 422, "was measured as corexy", "from-config")


def test_a_machine_of_a_config_g(client: TestClient):
    text = f'{CONFIG_G}M98 P"macros/fast.g"\n'
    made = settings(client, text, file="config.g", fy=41)
    assert made.status_code == 201, made.text
    assert made.json()["message"] == "from config.g; not read, so unknown: macros/fast.g"
    machine = client.get(MINE).json()
    assert (machine["kinematics"], machine["firmware"]["ring_length"]) == ("corexy", 80)
    assert machine["axes"]["y"]["nominal"]["modes"][0]["f_hz"] == 41
    later = text.replace("M201 X6000", "M201 X5200")
    again = settings(client, later, {"If-Match": made.headers["etag"]})
    assert (again.status_code, again.json()["number"]) == (200, 2)
    assert client.get(MINE).json()["firmware"]["x"]["max_accel_mm_s2"] == 5200
    refused = settings(client, text.replace("M669 K1", "M669 K3"), {"If-Match": "*"})
    assert_problem(refused, 422, "neither cartesian nor CoreXY")


@pytest.mark.parametrize(
    ("text", "query", "words"),
    [
        ("[printer]\n", {"file": "printer.cfg"}, ["printer.cfg: [printer] lacks max_velocity"]),
        ("{}", {}, ["settings.txt: no [section] in it", "printer.cfg, ", "answer to M503"]),
        (M503, {"travel": "far"}, ["far", "235x235x250"]),
        (M503, {"travel": "1x1x1", "fx": "0"}, ["fx: must be at least 1 (given: '0')"]),
        (M503.replace("M92", "M93"), {"travel": "1x1x1"}, ["no M92 X in it"]),
    ],
)
def test_settings_that_are_none_are_refused(client: TestClient, text, query, words):
    assert_problem(settings(client, text, **query), 422, *words)
    assert client.get(MINE).status_code == 404


def test_what_is_too_large_to_be_a_document_is_said_in_megabytes(client: TestClient):
    answer = client.post("/v1/machines/mine/settings", content=b"#" * 4_000_001)
    assert_problem(answer, 413, "(4 MB)", "right file")
