"""Every route against every kind of caller. A route without a rule here fails."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from fastapi import FastAPI
from starlette.testclient import TestClient

from stillpath.service.api import create_app
from stillpath.service.jobs.state import Claimed, Failed
from stillpath.service.security.callers import Scope
from stillpath.service.settings import Settings
from tests.service.database.examples import make_job
from tests.service.runners import pretend

OPEN, READ, SUBMIT, ADMIN = "open", "read", "submit", "admin"

RULES = {
    "GET /v1/jobs": READ,
    "POST /v1/jobs": SUBMIT,
    "GET /v1/jobs/{job_id}": READ,
    "DELETE /v1/jobs/{job_id}": SUBMIT,
    "POST /v1/jobs/{job_id}/cancel": SUBMIT,
    "GET /v1/jobs/{job_id}/events": READ,
    "GET /v1/jobs/{job_id}/result": READ,
    "POST /v1/jobs/{job_id}/result/link": READ,
    "GET /v1/jobs/{job_id}/report": READ,
    "GET /v1/jobs/{job_id}/report.json": READ,
    "GET /v1/jobs/{job_id}/layers": READ,
    "GET /v1/jobs/{job_id}/layers/{n}": READ,
    "GET /v1/jobs/{job_id}/trajectories": READ,
    "GET /v1/machines": READ,
    "GET /v1/machines/{name}": READ,
    "PUT /v1/machines/{name}": ADMIN,
    "DELETE /v1/machines/{name}": ADMIN,
    "POST /v1/machines/{name}/settings": ADMIN,
    "GET /v1/machines/{name}/revisions": READ,
    "GET /v1/machines/{name}/revisions/{number}": READ,
    "GET /v1/machines/{name}/diff": READ,
    "POST /v1/machines/{name}/revisions/{number}/approve": ADMIN,
    "POST /v1/machines/{name}/revisions/{number}/rollback": ADMIN,
    "GET /v1/machines/{name}/response": READ,
    "GET /v1/machines/{name}/design": READ,
    "GET /v1/machines/{name}/design.html": READ,
    "GET /v1/machines/{name}/stillpath.json": READ,
    # For a trial; to keep what was found is for admins.
    "POST /v1/machines/{name}/measurements": SUBMIT,
    "GET /v1/machines/{name}/identification": READ,
    "GET /v1/machines/{name}/identification.html": READ,
    "GET /v1/loops": READ,
    "POST /v1/machines/{name}/controllers": READ,
    "GET /v1/schemas/report.json": OPEN,
    "GET /api/version": READ,
    "GET /printers/{name}/api/version": READ,
    "POST /api/files/local": SUBMIT,
    "POST /printers/{name}/api/files/local": SUBMIT,
    "GET /v1/keys": ADMIN,
    "POST /v1/keys": ADMIN,
    "DELETE /v1/keys/{key_id}": ADMIN,
    "GET /v1/audit": ADMIN,
    "GET /v1/printers": READ,
    "GET /v1/printers/{name}/check": READ,
    "POST /v1/printers/{name}/accept": ADMIN,
    "GET /healthz": OPEN,
    "GET /readyz": OPEN,
    "GET /metrics": ADMIN,
}
# What the description leaves out: the same without a body, and the page, which shows nobody's data.
HIDDEN = {
    **{
        f"HEAD /v1/jobs/{{job_id}}/{name}": READ
        for name in ("result", "report", "report.json", "layers", "layers/{n}")
    },
    "GET /": OPEN,
    "HEAD /": OPEN,
    "GET /assets/{version}/{path:path}": OPEN,
    "HEAD /assets/{version}/{path:path}": OPEN,
    "GET /help/{name:path}": OPEN,
    "HEAD /help/{name:path}": OPEN,
    "GET /printers/{name}": OPEN,
    "GET /printers/{name}/": OPEN,
    "GET /openapi.json": OPEN,
    "HEAD /openapi.json": OPEN,
}

ROLES = ["no key", "bad key", "revoked", "expired", "read", "submit", "admin", "other"]


@dataclass(frozen=True)
class World:
    """A service that asks for keys, and a key of every kind."""

    app: FastAPI
    client: TestClient
    keys: dict[str, str | None]

    def job(self) -> str:
        """Return the id of a new job of ada's that has failed."""
        job = make_job(owner="ada", created_at=time.time())
        store = self.app.state.store
        store.add(job)
        store.apply(job.id, Claimed(time.time(), "worker"))
        store.apply(job.id, Failed(1, time.time(), {"status": 422, "detail": "too large"}))
        return job.id

    def call(self, rule: str, role: str, job_id: str):
        method, path = rule.replace(":path", "").split()
        values = {"job_id": job_id, "number": 1, "n": 0, "version": 1, "path": "x"}
        values |= dict.fromkeys(("name", "key_id"), "nobody")
        key = self.keys[role]
        headers = {} if key is None else {"Authorization": f"Bearer {key}"}
        if path.endswith("/measurements"):
            path += "?trial=true"
        return self.client.request(method, path.format_map(values), headers=headers)


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    settings = Settings(
        data_dir=tmp_path_factory.mktemp("data"),
        requests_per_minute=1_000_000,
        first_key="sp_" + "f" * 32,
    )
    app = create_app(settings, keys_required=True, runner=pretend)
    # From elsewhere: whoever is on this computer may read the metrics.
    with TestClient(
        app,
        base_url="http://stillpath.example",
        client=("203.0.113.7", 50000),
        raise_server_exceptions=False,
    ) as client:
        store = app.state.keys

        def key(owner: str, *scopes: Scope, expires_at: float | None = None) -> str:
            return store.create(name="test", owner=owner, scopes=scopes, expires_at=expires_at)[1]

        keys = {
            "no key": None,
            "bad key": "sp_" + "x" * 32,
            "revoked": key("ada", *Scope),
            "expired": key("ada", *Scope, expires_at=time.time() + 0.05),
            "read": key("ada", Scope.READ),
            "submit": key("ada", Scope.SUBMIT),
            "admin": key("root", Scope.ADMIN),
            "other": key("bob", Scope.READ, Scope.SUBMIT),
        }
        store.revoke(store.find(keys["revoked"]).id)
        time.sleep(0.1)
        yield World(app, client, keys)


def test_every_route_has_a_rule(tmp_path: Path):
    app = create_app(Settings(data_dir=tmp_path), keys_required=True)
    described = {
        f"{method.upper()} {path}"
        for path, methods in app.openapi()["paths"].items()
        for method in methods
    }
    assert described == set(RULES)
    assert set(_undescribed(app.router)) == set(HIDDEN)


@pytest.mark.slow
@pytest.mark.parametrize("rule", RULES | HIDDEN)
def test_a_route_admits_whom_it_should(world: World, rule: str):
    needed = (RULES | HIDDEN)[rule]
    for role in ROLES:
        answer = world.call(rule, role, world.job() if "{job_id}" in rule else "")
        where = f"{rule} as {role}: {answer.status_code} {answer.text[:300]}"
        assert answer.status_code < 500 or "readyz" in rule, where
        expected = _expected(needed, role)
        if expected is not None:
            assert answer.status_code == expected, where
            _check_refusal(answer, expected)
        elif role == "other" and "{job_id}" in rule:
            assert answer.status_code == 404, where
            assert rule.startswith("HEAD") or answer.json()["title"] == "No such job"
        elif "{job_id}" in rule:
            assert answer.status_code in (200, 204, 409), where
        else:
            assert answer.status_code not in (401, 403, 429), where


def test_measurements_are_kept_for_admins_only(world: World):
    rule = "POST /v1/machines/{name}/measurements?trial=false"
    assert world.call(rule, "submit", "").status_code == 403
    assert world.call(rule, "admin", "").status_code == 404


def test_lists_hold_ones_own_jobs_only(world: World):
    job_id = world.job()

    def listed(role: str) -> set[str]:
        headers = {"X-Api-Key": world.keys[role]}
        page = world.client.get("/v1/jobs?limit=100", headers=headers).json()
        return {job["owner"] for job in page["jobs"] if job["id"] == job_id or role == "other"}

    assert listed("read") == {"ada"}
    assert listed("admin") == {"ada"}
    assert listed("other") == set()


def test_a_deleted_job_of_another_owner_stays(world: World):
    job_id = world.job()
    for rule in ("DELETE /v1/jobs/{job_id}", "POST /v1/jobs/{job_id}/cancel"):
        assert world.call(rule, "other", job_id).status_code == 404
    assert world.call("GET /v1/jobs/{job_id}", "read", job_id).status_code == 200


def test_both_headers_are_understood(world: World):
    key = world.keys["read"]
    for headers in ({"X-Api-Key": key}, {"Authorization": f"bearer {key}"}):
        assert world.client.get("/v1/jobs", headers=headers).status_code == 200
    for headers in (
        {"Authorization": f"Basic {key}"},
        {"Authorization": key},
        {"X-Api-Key": f"{key} "[:-2]},
        {"X-Api-Key": "ключ".encode()},
        {"Authorization": "Bearer "},
    ):
        assert world.client.get("/v1/jobs", headers=headers).status_code == 401


def test_metrics_are_for_admins_wherever_they_are(world: World):
    with_rights = {"X-Api-Key": world.keys["admin"]}
    assert world.client.get("/metrics", headers=with_rights).status_code == 200
    local = TestClient(world.app, base_url="http://localhost", client=("127.0.0.1", 50000))
    assert local.get("/metrics").status_code == 401  # a proxy may be on this computer
    assert local.get("/v1/jobs").status_code == 401
    rebound = {"Host": "evil.example"}
    assert local.get("/metrics", headers=rebound).status_code == 401


def _undescribed(router: Any) -> Iterator[str]:
    for route in router.routes:
        inner = getattr(route, "original_router", None)
        if inner is not None:
            yield from _undescribed(inner)
        elif not route.include_in_schema:
            yield from (f"{method} {route.path}" for method in route.methods)


def _expected(needed: str, role: str) -> int | None:
    """Return the status of a caller who is turned away, None for one who is not."""
    if needed == OPEN:
        return None
    if role in ("no key", "bad key", "revoked", "expired"):
        return 401
    has = {"read": {READ}, "submit": {SUBMIT}, "admin": {READ, SUBMIT, ADMIN}}
    return None if needed in has.get(role, {READ, SUBMIT}) else 403


def _check_refusal(answer, status: int) -> None:
    assert answer.headers["content-type"] == "application/problem+json"
    if answer.content:
        assert answer.json()["status"] == status
    if status == 401:
        assert answer.headers["www-authenticate"].startswith("Bearer")
