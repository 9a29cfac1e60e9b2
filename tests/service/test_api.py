"""The API with a pretended pipeline: uploads, states, problems, cancel, deletion, restarts."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

from stillpath.service.api import create_app
from stillpath.service.api.uploads import safe_name
from stillpath.service.settings import Settings
from tests.service.runners import pretend

JOBS = "/v1/jobs?machine=ender3"


def open_client(folder: Path, **settings: Any) -> TestClient:
    given = {"max_upload_bytes": 100_000, "cancel_grace_s": 1.0, "requests_per_minute": 100_000}
    app = create_app(Settings(data_dir=folder, **(given | settings)), runner=pretend)
    return TestClient(app, base_url="http://localhost", raise_server_exceptions=False)


@pytest.fixture(scope="module")
def data_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("data")


@pytest.fixture(scope="module")
def client(data_dir: Path) -> Iterator[TestClient]:
    with open_client(data_dir) as opened:
        yield opened


def until(client: TestClient, where: str, wanted: Callable[[dict[str, Any]], bool]) -> dict:
    deadline = time.monotonic() + 300
    while time.monotonic() < deadline:
        job = client.get(where).json()
        if wanted(job):
            return job
        time.sleep(0.02)
    raise AssertionError(f"waited in vain: {job}")


def over(job: dict[str, Any]) -> bool:
    return job["state"] in ("done", "failed", "cancelled")


def assert_problem(answer: Any, status: int, *words: str) -> dict[str, Any]:
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    document = answer.json()
    assert document["status"] == status
    assert {"type", "title", "detail"} <= document.keys()
    for word in words:
        assert word in document["detail"]
    return document


def test_a_job_from_upload_to_deletion(client: TestClient, data_dir: Path):
    answer = client.post(f"{JOBS}&name=gear.gcode", content=b"G1 X1\n")
    assert answer.status_code == 202
    where = answer.headers["location"]
    assert answer.json()["links"]["self"] == where
    job = until(client, where, over)
    assert job["state"] == "done"
    assert job["progress"] == 1.0
    assert job["options"] == {
        "method": "fbf",
        "basis": "ce-opt",
        "robust": "auto",
        "along": None,
        "plate": None,
        "tolerance_um": 2.0,
        "times": "new",
        "dialect": None,
    }
    result = client.get(job["links"]["result"])
    assert result.content == b"; compensated\nG1 X1\n"
    assert 'filename="gear.stillpath.gcode"' in result.headers["content-disposition"]
    assert client.get(job["links"]["report_json"]).json()["machine"] == "ender3"
    page = client.get(job["links"]["report"])
    assert page.headers["content-type"].startswith("text/html")
    assert job["summary"]["after_um"] < job["summary"]["before_um"]
    assert job["result_bytes"] == len(result.content)
    assert client.delete(where).status_code == 204
    assert_problem(client.get(where), 404, job["id"])
    assert_problem(client.delete(where), 404)
    assert not (data_dir / "jobs" / job["id"]).exists()


def test_a_form_brings_the_same_bytes(client: TestClient):
    sent = b"G1 X1\r\n" * 9000
    answer = client.post(
        f"{JOBS}&method=shaper:ei",
        files={"other": (None, "ignored"), "file": ("..\\tri angle.gcode", sent)},
    )
    assert answer.status_code == 202
    assert answer.json()["source_name"] == "tri angle.gcode"
    assert answer.json()["source_bytes"] == len(sent)
    job = until(client, answer.headers["location"], over)
    assert client.get(job["links"]["result"]).content.replace(b"\r", b"") == (
        b"; compensated\n" + sent.replace(b"\r", b"")
    )


@pytest.mark.parametrize(
    ("query", "words"),
    [
        ("", ["machine"]),
        ("machine=nope", ["nope", "ender3"]),
        ("machine=../../etc/passwd", ["Known"]),
        ("machine=/tmp/x.json", ["Known"]),
        ("machine=ender3&method=magic", ["method", "magic"]),
        ("machine=ender3&method=shaper:best", ["method"]),
        ("machine=ender3&basis=fourier", ["basis"]),
        ("machine=ender3&robust=yes", ["robust"]),
        ("machine=ender3&along=0", ["along"]),
        ("machine=ender3&tolerance_um=0", ["tolerance_um: must be at least 0.5 µm (given: '0')"]),
        ("machine=ender3&budgetum=10", ["budgetum: is not known here"]),
        ("machine=ender3&tolerance_um=nan", ["tolerance_um"]),
        ("machine=ender3&tolerance_um=wide", ["tolerance_um"]),
        ("machine=%00", ["machine"]),
        ("machine=%ff", ["Known"]),
        ("machine=ender3&batch=a%0ab", ["batch"]),
        ("machine=ender3&method=live&where=walls", ["method live prints the file as sliced"]),
        ("machine=ender3&priority=1000", ["priority"]),
        ("machine=ender3&printer=nope", ["nope"]),
        ("machine=ender3&print=true", ["printer"]),
        ("machine=ender3&webhook=http://127.0.0.1/", ["STILLPATH_WEBHOOK_SECRET"]),
    ],
)
def test_bad_options_are_refused_at_once(client: TestClient, query: str, words: list[str]):
    assert_problem(client.post(f"/v1/jobs?{query}", content=b"G1 X1\n"), 422, *words)


def test_empty_large_and_broken_uploads_leave_nothing(client: TestClient, data_dir: Path):
    before = sorted((data_dir / "jobs").glob("*"))
    assert_problem(client.post(JOBS, content=b""), 422, "no content")
    assert_problem(client.post(JOBS, content=b"x" * 100_001), 413, "100000 bytes")
    assert_problem(client.post(JOBS, content=iter([b"x" * 60_000] * 2)), 413, "100000 bytes")
    assert_problem(client.post(JOBS, files={"file": ("a.gcode", b"")}), 422, "no content")
    assert_problem(client.post(JOBS, files={"file": (None, b"text")}), 422, "file name")
    form = {"content-type": "multipart/form-data; boundary=abc"}
    assert_problem(client.post(JOBS, content=b"junk", headers=form), 422, "cannot be read")
    form = {"content-type": "multipart/form-data"}
    assert_problem(client.post(JOBS, content=b"junk", headers=form), 422, "boundary")
    form = {"content-type": "multipart/form-data; boundary=abc"}
    part = b'--abc\r\nContent-Disposition: form-data; name="file"; filename="a"\r\n\r\nG1 X1'
    assert_problem(client.post(JOBS, content=part, headers=form), 422, "last boundary")
    two = [("file", ("a.gcode", b"G1 X1")), ("file", ("b.gcode", b"G1 X2"))]
    assert_problem(client.post(JOBS, files=two), 422, "one file", "a request of its own")
    long = {"note": "x" * 5000, "file": ("a.gcode", b"G1")}
    answer = client.post(JOBS, files={k: v if k == "file" else (None, v) for k, v in long.items()})
    assert_problem(answer, 422, "4096 bytes")
    assert list((data_dir / "incoming").glob("*")) == []
    assert sorted((data_dir / "jobs").glob("*")) == before


@pytest.mark.parametrize(
    "name",
    [
        # .NET
        "filename=\"=?utf-8?B?Z3LDtg==?=\"; filename*=utf-8''gr%C3%B6%C3%9Fe.gcode",
        "filename*=UTF-8''gr%C3%B6%C3%9Fe.gcode",  # urllib3 before 1.25
        "filename*=utf-8''..%2F..%2Fgr%C3%B6%C3%9Fe.gcode",
    ],
)
def test_names_in_forms_may_be_written_as_in_mails(client: TestClient, name: str):
    disposition = f'Content-Disposition: form-data; name="file"; {name}'
    form = f"--abc\r\n{disposition}\r\n\r\nG1 X31\r\n--abc--\r\n"
    headers = {"content-type": "multipart/form-data; boundary=abc"}
    answer = client.post(JOBS, content=form.encode(), headers=headers)
    assert answer.status_code in (200, 202), answer.text
    assert answer.json()["source_name"] == "größe.gcode"


def test_an_unprintable_file_fails_its_job_with_the_line(client: TestClient):
    where = client.post(JOBS, content=b"bad").headers["location"]
    job = until(client, where, over)
    assert job["state"] == "failed"
    assert (job["error"]["status"], job["error"]["line"]) == (422, 7)
    assert "X1e400" in job["error"]["detail"]
    for name in ("result", "report", "report.json"):
        document = assert_problem(client.get(f"{where}/{name}"), 409, "X1e400")
        assert document["error"]["line"] == 7


def test_a_crash_of_ours_keeps_its_secrets(client: TestClient):
    job = until(client, client.post(JOBS, content=b"crash").headers["location"], over)
    assert job["error"]["status"] == 500
    assert "secret" not in str(job)


def test_a_running_job_can_be_deleted(client: TestClient, data_dir: Path):
    where = client.post(f"{JOBS}&fresh=true", content=b"slow").headers["location"]
    waiting = client.post(f"{JOBS}&fresh=true", content=b"G1 X2").headers["location"]
    running = until(client, where, lambda job: job["state"] == "running")
    assert_problem(client.get(f"{where}/result"), 409, "running")
    assert client.get(waiting).json()["queue_position"] == 0
    assert client.delete(where).status_code == 204
    assert until(client, waiting, over)["state"] == "done"
    assert not (data_dir / "jobs" / running["id"]).exists()


def test_cancel(client: TestClient):
    where = client.post(f"{JOBS}&fresh=true", content=b"slow").headers["location"]
    waiting = client.post(f"{JOBS}&fresh=true", content=b"G1 X5").headers["location"]
    until(client, where, lambda job: job["state"] == "running")
    for job in (waiting, where, where):  # a second time changes nothing
        answer = client.post(f"{job}/cancel")
        assert (answer.status_code, answer.json()["state"]) == (200, "cancelled")
    assert_problem(client.get(f"{where}/result"), 409, "submit the file again")
    # Whoever hands the same file in again gets a new job.
    again = client.post(JOBS, content=b"G1 X5")
    assert again.status_code == 202
    assert until(client, again.headers["location"], over)["state"] == "done"
    assert_problem(client.post(f"{again.headers['location']}/cancel"), 409, "done")
    assert_problem(client.post(f"/v1/jobs/{'0' * 32}/cancel"), 404)


def test_unknown_paths_and_methods_are_problems(client: TestClient):
    assert_problem(client.get("/nowhere"), 404)
    assert_problem(client.put("/v1/jobs"), 405)
    assert_problem(client.get("/v1/machines/nope"), 404, "ender3")
    assert_problem(client.get("/v1/jobs/nope/result"), 404)
    for odd in ("%00", "%ff", "%zz", "..%2f..%2fetc", "a" * 1000):
        assert_problem(client.get(f"/v1/jobs/{odd}"), 404)
    assert_problem(client.delete(f"/v1/jobs/{'0' * 32}"), 404)


def test_health_and_openapi(client: TestClient):
    assert client.get("/healthz").json()["status"] == "ok"
    assert client.get("/readyz").json()["status"] == "ok"
    schema = client.get("/openapi.json").json()
    post = schema["paths"]["/v1/jobs"]["post"]
    assert set(post["requestBody"]["content"]) >= {"multipart/form-data", "text/x.gcode"}
    assert "application/problem+json" in post["responses"]["413"]["content"]


def test_every_route_with_a_name_in_it_may_not_find_it(client: TestClient):
    silent = [
        f"{method.upper()} {path}"
        for path, operations in client.get("/openapi.json").json()["paths"].items()
        for method, operation in operations.items()
        if "{" in path and "404" not in operation["responses"]
    ]
    assert silent == ["PUT /v1/machines/{name}", "POST /v1/machines/{name}/settings"]  # create it


@pytest.mark.parametrize(
    ("given", "safe"),
    [
        ("gear.gcode", "gear.gcode"),
        ("../../etc/passwd", "passwd"),
        ("C:\\prints\\part 1.gcode", "part 1.gcode"),
        ("", "upload.gcode"),
        ("..", "upload.gcode"),
        ("a\x00b\n.gcode", "a_b_.gcode"),
        ("größe.gcode", "größe.gcode"),
        ("gro\u0308ße.gcode", "größe.gcode"),  # as macOS may write it
        ("x" * 300, "x" * 180),
        ("x" * 300 + ".gcode.3MF", "x" * 170 + ".gcode.3MF"),
        ("\u3042" * 300 + ".bgcode", "\u3042" * 57 + ".bgcode"),
    ],
)
def test_safe_name(given: str, safe: str):
    assert safe_name(given) == safe
