"""Keys, limits and the audit log at the application."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from starlette.testclient import TestClient

from stillpath.service.api import create_app
from stillpath.service.settings import Settings
from tests.service.jobs.site import until
from tests.service.runners import pretend

FIRST = "sp_" + "f" * 32
ADMIN = {"X-Api-Key": FIRST}
WISH = {"name": "slicer", "owner": "ada", "scopes": ["read", "submit"]}


def open_client(folder: Path, *, keys: bool = True, **settings: Any) -> TestClient:
    given = {"requests_per_minute": 100_000, "first_key": FIRST} | settings
    app = create_app(Settings(data_dir=folder, **given), keys_required=keys, runner=pretend)
    return TestClient(
        app,
        base_url="http://localhost",
        client=("203.0.113.7", 50000),
        raise_server_exceptions=False,
    )


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    with open_client(tmp_path_factory.mktemp("data")) as opened:
        yield opened


def audit(client: TestClient, **query: Any) -> list[dict[str, Any]]:
    return client.get("/v1/audit", params=query, headers=ADMIN).json()["entries"]


def test_a_key_from_its_making_to_its_end(client: TestClient):
    answer = client.post("/v1/keys", json=WISH | {"expires_in_days": 2}, headers=ADMIN)
    assert answer.status_code == 201
    assert answer.headers["cache-control"] == "no-store"
    made = answer.json()
    mine = {"Authorization": f"Bearer {made['key']}"}
    assert client.get("/v1/jobs", headers=mine).status_code == 200
    listed = client.get("/v1/keys", headers=ADMIN)
    assert made["key"] not in listed.text
    [shown] = [key for key in listed.json() if key["id"] == made["id"]]
    assert shown["used_at"] is not None
    assert (shown["owner"], shown["scopes"]) == ("ada", ["read", "submit"])
    assert client.delete(f"/v1/keys/{made['id']}", headers=ADMIN).status_code == 204
    refused = client.get("/v1/jobs", headers=mine)
    assert refused.status_code == 401
    assert "revoked" in refused.json()["detail"]
    assert client.delete("/v1/keys/nobody", headers=ADMIN).status_code == 404
    actions = [(row["action"], row["subject"]) for row in audit(client)]
    assert ("key.create", made["id"]) in actions
    assert ("key.revoke", made["id"]) in actions


def done(client: TestClient, content: bytes, headers: dict[str, str]) -> str:
    job = client.post("/v1/jobs?machine=ender3", content=content, headers=headers).json()
    where: str = job["links"]["self"]
    until(lambda: client.get(where, headers=headers).json()["state"] == "done")
    return where


def test_a_link_stands_for_a_key_for_one_result(
    client: TestClient, monkeypatch: pytest.MonkeyPatch
):
    made = client.post("/v1/keys", json=WISH, headers=ADMIN).json()
    mine = {"X-Api-Key": made["key"]}
    where, other = done(client, b"G1 X1", mine), done(client, b"G1 X2", mine)
    whole = client.get(f"{where}/result", headers=mine).content
    answer = client.post(f"{where}/result/link", headers=mine)
    assert (answer.status_code, answer.headers["cache-control"]) == (200, "no-store")
    href = answer.json()["href"]
    assert made["key"] not in href
    assert client.get(href).content == whole
    assert client.get(href, headers={"Range": "bytes=2-"}).content == whole[2:]
    assert client.head(href).status_code == 200
    query = href.partition("?")[2]
    assert client.get(f"{where}/result").status_code == 401
    assert client.get(f"{other}/result?{query}").status_code == 401
    assert client.get(f"{where}/report.json?{query}").status_code in (401, 422)
    assert client.delete(f"{where}?{query}").status_code in (401, 422)
    longer = href.replace("until=", "until=9")
    assert "expired or was changed" in client.get(longer).json()["detail"]
    assert client.get(href.replace(made["id"], "first")).status_code == 401
    assert client.post(f"{where}/result/link").status_code == 401
    with monkeypatch.context() as later:
        later.setattr(
            "stillpath.service.api.access.time", SimpleNamespace(time=lambda: time.time() + 3700)
        )
        assert client.get(href).status_code == 401
    assert client.delete(f"/v1/keys/{made['id']}", headers=ADMIN).status_code == 204
    assert "revoked" in client.get(href).json()["detail"]


def test_where_no_key_is_needed_a_link_has_none(tmp_path: Path):
    with open_client(tmp_path, keys=False) as local:
        where = done(local, b"G1 X1", {})
        assert local.post(f"{where}/result/link").json()["href"] == f"{where}/result"


@pytest.mark.parametrize(
    "change",
    [{"owner": "../x"}, {"scopes": ["everything"]}, {"expires_in_days": 1e300}, {"more": 1}],
)
def test_odd_wishes_are_refused(client: TestClient, change: dict[str, Any]):
    assert client.post("/v1/keys", json=WISH | change, headers=ADMIN).status_code == 422


def test_the_audit_log_tells_who_did_what(client: TestClient):
    mine = client.post("/v1/keys", json=WISH, headers=ADMIN).json()
    headers = {"X-Api-Key": mine["key"]}
    job = client.post("/v1/jobs?machine=ender3", content=b"slow", headers=headers).json()
    assert client.post(f"/v1/jobs/{job['id']}/cancel", headers=headers).status_code == 200
    assert client.delete(f"/v1/jobs/{job['id']}", headers=headers).status_code == 204
    rows = {row["action"]: row for row in audit(client) if row["subject"] == job["id"]}
    assert set(rows) == {"submit", "cancel", "delete"}
    for row in rows.values():
        assert (row["owner"], row["key_id"], row["remote"]) == ("ada", mine["id"], "203.0.113.7")
    assert rows["submit"]["details"] == {
        "machine": "ender3",
        "revision": job["machine_revision"],
        "source_sha256": job["source_sha256"],
    }


def test_changes_of_machines_are_in_the_audit_log(client: TestClient):
    document = client.get("/v1/machines/ender3", headers=ADMIN).json() | {"name": "mine"}
    put = client.put("/v1/machines/mine", json=document, headers=ADMIN)
    assert put.status_code == 201
    assert client.post("/v1/machines/mine/revisions/1/approve", headers=ADMIN).status_code == 200
    assert client.delete("/v1/machines/mine", headers=ADMIN).status_code == 204
    actions = [row["action"] for row in audit(client) if row["subject"] == "mine"]
    assert actions == ["machine.delete", "machine.approve", "machine.change"]


def test_who_was_turned_away_is_written_once_a_minute(client: TestClient):
    for _ in range(20):
        assert client.get("/v1/jobs", headers={"X-Api-Key": "sp_" + "z" * 32}).status_code == 401
    rows = audit(client, action="denied", limit=1000)
    assert 1 <= len([row for row in rows if row["details"]["why"].startswith("401")]) <= 2
    assert "zzz" not in str(rows)


def test_who_is_turned_away_is_written_although_the_clock_was_set_back(
    client: TestClient, monkeypatch: pytest.MonkeyPatch
):
    def turned_away() -> int:
        assert client.get("/v1/jobs", headers={"X-Api-Key": "sp_" + "z" * 32}).status_code == 401
        return len(audit(client, action="denied"))

    ahead = SimpleNamespace(time=lambda: time.time() + 1e8)
    with monkeypatch.context() as until_set:
        until_set.setattr("stillpath.service.security.audit.time", ahead)
        before = turned_away()
    assert turned_away() == before + 1


def test_a_whole_network_turned_away_fills_no_disk(client: TestClient):
    for k in range(20):
        other = TestClient(
            client.app, base_url="http://localhost", client=(f"2001:db8:7::{k:x}", 50000)
        )
        assert other.get("/v1/jobs").status_code == 401
    rows = audit(client, action="denied", limit=1000)
    assert 1 <= len([row for row in rows if row["remote"].startswith("2001:db8:7:")]) <= 2


def test_the_audit_log_has_pages(client: TestClient):
    for _ in range(5):
        client.post("/v1/keys", json=WISH, headers=ADMIN)
    everything = [row["id"] for row in audit(client, limit=1000)]
    assert everything == sorted(everything, reverse=True)
    found: list[int] = []
    query: dict[str, Any] = {"limit": 2}
    while query.get("before", 1) is not None:
        page = client.get("/v1/audit", params=query, headers=ADMIN).json()
        found += [row["id"] for row in page["entries"]]
        query["before"] = page["next_before"]
    assert found == everything


def test_requests_are_limited_but_watching_is_not(tmp_path: Path):
    with open_client(tmp_path, requests_per_minute=20) as client:
        job = client.post("/v1/jobs?machine=ender3", content=b"G1 X1", headers=ADMIN).json()
        for _ in range(60):
            assert client.get(f"/v1/jobs/{job['id']}", headers=ADMIN).status_code == 200
        answers = [client.get("/v1/printers", headers=ADMIN) for _ in range(40)]
        refused = [answer for answer in answers if answer.status_code == 429]
        assert refused
        assert int(refused[0].headers["retry-after"]) >= 1
        # Whoever has no key is counted apart, and cannot use up what belongs to a key.
        statuses = {client.get("/v1/printers").status_code for _ in range(60)}
        assert statuses == {401, 429}
        assert client.get("/healthz").status_code == 200


def test_without_keys_this_computer_is_answered_and_a_wrong_key_is_not(tmp_path: Path):
    with open_client(tmp_path, keys=False) as client:
        assert client.get("/v1/jobs").status_code == 200
        assert client.get("/v1/keys").json() == []  # no first key was made
        assert client.get("/v1/jobs", headers={"X-Api-Key": "sp_" + "z" * 32}).status_code == 401
        made = client.post("/v1/keys", json=WISH).json()["key"]
        job = client.post("/v1/jobs?machine=ender3", content=b"G1 X1").json()
        hers = {"X-Api-Key": made}
        assert client.get(f"/v1/jobs/{job['id']}", headers=hers).status_code == 404
        assert client.post("/v1/keys", json=WISH, headers=hers).status_code == 403
