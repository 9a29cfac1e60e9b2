"""Handing in: the same file again, the same request again, quotas, lists."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

from tests.service.api.serving import opened, post
from tests.service.test_api import assert_problem, over, until


def folders(data_dir: Path) -> set[str]:
    return {path.name for path in data_dir.glob("jobs/*")}


def test_the_same_file_is_answered_with_the_job_that_is_there(client: TestClient, data_dir: Path):
    first = post(client, b"G1 X11", "&name=a.gcode")
    until(client, first.headers["location"], over)
    before = folders(data_dir)
    again = post(client, b"G1 X11", "&name=a.gcode")
    assert (again.status_code, again.json()["id"]) == (200, first.json()["id"])
    assert again.json()["state"] == "done"
    assert folders(data_dir) == before
    assert list((data_dir / "incoming").iterdir()) == []
    for other in (
        "&name=a.gcode&fresh=true",
        "&name=b.gcode",
        "&name=a.gcode&method=none",
        "&name=a.gcode&batch=b1",
    ):
        assert post(client, b"G1 X11", other).status_code == 202, other
    assert post(client, b"G1 X12", "&name=a.gcode").status_code == 202


def test_updated_code_does_the_same_file_again(client: TestClient, monkeypatch: pytest.MonkeyPatch):
    """A checkout that is updated has the version that it had."""
    design = "/v1/machines/ender3/design?axis=x"
    later = {"Prefer": "respond-async"}
    first = post(client, b"G1 X14", "&name=a.gcode")
    asked = client.get(design, headers=later).json()
    for job in (first.json(), asked):
        until(client, job["links"]["self"], over)
    for module in ("intake", "computing"):
        monkeypatch.setattr(f"stillpath.service.api.{module}.build", lambda: "0.1.0+0123456789ab")
    again = post(client, b"G1 X14", "&name=a.gcode")
    assert (again.status_code, again.json()["id"] == first.json()["id"]) == (202, False)
    assert client.get(design, headers=later).json()["id"] != asked["id"]


def test_parameters_in_the_form_are_not_ignored(client: TestClient, data_dir: Path):
    before = folders(data_dir)
    form = {"file": ("a.gcode", b"G1 X13"), "method": (None, "none"), "note": (None, "mine")}
    refused = client.post("/v1/jobs?machine=ender3", files=form)
    assert_problem(refused, 422, "method:", "?method=...")
    assert folders(data_dir) == before
    del form["method"]
    assert client.post("/v1/jobs?machine=ender3", files=form).status_code == 202


def test_what_failed_is_tried_again(client: TestClient):
    first = post(client, b"bad")
    assert until(client, first.headers["location"], over)["state"] == "failed"
    assert post(client, b"bad").status_code == 202


def test_a_repeated_request_makes_one_job(client: TestClient, data_dir: Path):
    first = post(client, b"G1 X21", "&fresh=true", **{"Idempotency-Key": "k-1"})
    again = post(client, b"G1 X21", "&fresh=true", **{"Idempotency-Key": "k-1"})
    assert (first.status_code, again.status_code) == (202, 200)
    assert first.json()["id"] == again.json()["id"]
    before = folders(data_dir)
    other = {"Idempotency-Key": "k-1"}
    assert_problem(post(client, b"G1 X22", "&fresh=true", **other), 422, "k-1", "new key")
    assert_problem(post(client, b"G1 X21", "&method=none", **other), 422, "k-1")
    assert folders(data_dir) == before
    assert_problem(post(client, b"G1 X21", **{"Idempotency-Key": "a b"}), 422, "idempotency-key")
    client.delete(first.headers["location"])
    assert post(client, b"G1 X21", "&fresh=true", **other).status_code == 202


def test_a_misspelt_filter_does_not_select_everything(client: TestClient):
    job = post(client, b"G1 X31").json()["id"]
    refused = client.get("/v1/jobs?batc=mine&limit=5")
    assert_problem(refused, 422, "batc: is not known here (given: 'mine')")
    assert [error["name"] for error in refused.json()["errors"]] == ["batc"]
    assert client.head(f"/v1/jobs/{job}/result?x=1").status_code == 422
    assert_problem(client.delete(f"/v1/jobs/{job}?dry_run=true"), 422, "dry_run")
    measured = "/v1/machines/mine/measurements?base=ender3&trail=true"
    assert_problem(client.post(measured, files={"file": ("a.csv", b"1")}), 422, "trail")
    assert client.get("/metrics?collector=1").status_code == 200


def test_pages_batches_and_states(client: TestClient):
    made = [post(client, f"G1 X{n}".encode(), "&batch=pages").json()["id"] for n in range(5)]
    found: list[str] = []
    where = "/v1/jobs?batch=pages&limit=2"
    for _ in range(3):
        answer = client.get(where)
        found += [job["id"] for job in answer.json()["jobs"]]
        if answer.json()["next"] is None:
            break
        where = answer.links["next"]["url"]
        assert f"cursor={answer.json()['next']}" in where
    assert found == made[::-1]
    assert "link" not in client.get("/v1/jobs?batch=nothing").headers
    for job in made:
        until(client, f"/v1/jobs/{job}", over)
    states = client.get("/v1/jobs?batch=pages&state=done&state=failed").json()["jobs"]
    assert {job["state"] for job in states} == {"done"}
    assert client.get("/v1/jobs?batch=pages&state=queued").json()["jobs"] == []
    assert client.get("/v1/jobs?batch=a%00b").json()["jobs"] == []
    assert_problem(client.get("/v1/jobs?cursor=junk"), 422, "cursor")
    assert_problem(client.get("/v1/jobs?state=lost"), 422, "state")
    assert_problem(client.get("/v1/jobs?limit=0"), 422, "limit")


@pytest.mark.slow
def test_a_full_quota_refuses_until_a_job_ends(tmp_path: Path):
    with opened(tmp_path, max_jobs_per_owner=1) as client:
        where = post(client, b"slow").headers["location"]
        refused = post(client, b"G1 X1")
        assert_problem(refused, 429, "the limit is 1", "cancel")
        assert refused.headers["retry-after"].isdecimal()
        design = client.get(
            "/v1/machines/ender3/design?axis=x", headers={"Prefer": "respond-async"}
        )
        assert_problem(design, 429, "cancel")
        client.post(f"{where}/cancel")
        key = {"Idempotency-Key": "k-1"}
        first = post(client, b"slow 2", **key)
        assert first.status_code == 202
        again = post(client, b"slow 2", **key)  # its answer was lost on the way
        assert (again.status_code, again.json()["id"]) == (200, first.json()["id"])
        assert_problem(post(client, b"slow 3", **key), 422, "k-1")
        assert_problem(post(client, b"slow 3", **{"Idempotency-Key": "k-2"}), 429, "the limit is 1")
    with opened(tmp_path / "small", max_bytes_per_owner=100) as client:
        assert_problem(post(client, b"x" * 101), 507, "100", "delete")
        assert post(client, b"x" * 60).status_code == 202
        assert_problem(post(client, b"y" * 60), 507, "keeps")
        assert len(folders(tmp_path / "small")) == 1
        assert list((tmp_path / "small" / "incoming").iterdir()) == []


def test_an_upload_that_breaks_off_leaves_nothing(client: TestClient, data_dir: Path):
    before = folders(data_dir)
    jobs = len(client.get("/v1/jobs?limit=200").json()["jobs"])
    messages = [
        {"type": "http.request", "body": b"x" * 70_000, "more_body": True},
        {"type": "http.disconnect"},
    ]
    sent: list[Any] = []

    async def receive() -> Any:
        return messages.pop(0) if messages else {"type": "http.disconnect"}

    async def send(message: Any) -> None:
        sent.append(message)

    scope = {
        "type": "http",
        "asgi": {"version": "3.0"},
        "http_version": "1.1",
        "method": "POST",
        "path": "/v1/jobs",
        "raw_path": b"/v1/jobs",
        "root_path": "",
        "scheme": "http",
        "query_string": b"machine=ender3",
        "headers": [(b"host", b"localhost")],
        "client": ("127.0.0.1", 1),
        "server": ("127.0.0.1", 80),
    }
    assert client.portal is not None
    client.portal.call(_call, client.app, scope, receive, send)
    assert sent[0]["status"] < 500
    assert folders(data_dir) == before
    assert list((data_dir / "incoming").iterdir()) == []
    assert len(client.get("/v1/jobs?limit=200").json()["jobs"]) == jobs


async def _call(app: Any, scope: Any, receive: Any, send: Any) -> None:
    async with asyncio.timeout(60):
        await app(scope, receive, send)
