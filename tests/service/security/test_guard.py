"""The guard before the application: hosts, origins, sizes, headers."""

from __future__ import annotations

from pathlib import Path

import pytest
from fastapi import FastAPI, Request
from starlette.responses import HTMLResponse
from starlette.testclient import TestClient

from stillpath.service.api import problems
from stillpath.service.api.guard import Guard, hosts_of
from stillpath.service.api.limits import COUNTED
from stillpath.service.settings import Settings


def open_client(
    *allowed: str, trusts_all: bool = True, base_url: str = "http://localhost:8000"
) -> TestClient:
    app = FastAPI()
    app.add_middleware(Guard, allowed_hosts=allowed, trusts_all=trusts_all)
    problems.install(app)

    @app.api_route("/x", methods=["GET", "POST", "DELETE"])
    def x() -> dict:
        return {}

    @app.post("/document")
    def document(body: dict) -> dict:
        return body

    @app.post("/stream")
    async def stream(request: Request) -> dict:
        request.scope[COUNTED] = True
        return {"size": sum([len(chunk) async for chunk in request.stream()])}

    @app.get("/page")
    def page(policy: str | None = None) -> HTMLResponse:
        return HTMLResponse("", headers={"Content-Security-Policy": policy} if policy else None)

    @app.get("/healthz")
    def healthz() -> dict:
        return {}

    return TestClient(app, base_url=base_url, raise_server_exceptions=False)


@pytest.mark.parametrize(
    "host", ["localhost", "localhost:8000", "LOCALHOST", "127.0.0.1", "127.0.0.1:1", "[::1]:8000"]
)
def test_this_computers_names_are_answered(host: str):
    assert open_client().get("/x", headers={"Host": host}).status_code == 200


@pytest.mark.parametrize(
    "host",
    [
        *("evil.example", "localhost.evil.example", "evil.example:8000", "127.0.0.1.nip.io"),
        *("192.168.1.5", "0.0.0.0", "user@evil.example", "localhost@evil.example", "[::1", "", " "),
    ],
)
def test_other_names_are_refused(host: str):
    for method in ("GET", "POST"):
        answer = open_client().request(method, "/x", headers={"Host": host})
        assert answer.status_code == 403
        assert answer.headers["content-type"] == "application/problem+json"


def test_names_can_be_allowed():
    client = open_client("hub.local")
    assert client.get("/x", headers={"Host": "HUB.local:8000"}).status_code == 200
    assert client.get("/x", headers={"Host": "localhost"}).status_code == 200
    assert client.get("/x", headers={"Host": "a.hub.local"}).status_code == 403
    assert client.get("/healthz", headers={"Host": "10.1.2.3"}).status_code == 200


def test_which_names_are_answered(tmp_path: Path):
    plain = Settings(data_dir=tmp_path)
    named = Settings(data_dir=tmp_path, allowed_hosts=["hub.local"])
    assert list(hosts_of(plain, keys_required=False)) == []
    assert list(hosts_of(plain, keys_required=True)) == ["*"]
    assert list(hosts_of(named, keys_required=True)) == ["hub.local"]


@pytest.mark.parametrize(
    ("origin", "site", "status"),
    [
        (None, None, 200),
        ("http://localhost:8000", None, 200),
        ("http://localhost:9000", None, 403),
        ("http://localhost:9000", "same-origin", 200),  # a proxy that leaves the port out
        ("http://localhost:9000", "same-site", 403),
        ("http://evil.example", None, 403),
        ("http://evil.example", "cross-site", 403),
        ("null", None, 403),
        ("http://localhost:8000.evil.example", None, 403),
        ("http://[::1", None, 403),
    ],
)
def test_changes_come_from_our_own_page(origin: str | None, site: str | None, status: int):
    given = {"Origin": origin, "Sec-Fetch-Site": site}
    headers = {name: value for name, value in given.items() if value is not None}
    client = open_client()
    answer = client.post("/x", headers=headers)
    assert answer.status_code == status
    if status == 403:
        assert "Host header" in answer.json()["detail"]
    assert client.delete("/x", headers=headers).status_code == status
    if site != "cross-site":
        assert client.get("/x", headers=headers).status_code == 200


@pytest.mark.parametrize(
    ("site", "mode", "status"),
    [
        ("cross-site", "no-cors", 403),
        ("cross-site", "cors", 403),
        ("cross-site", "navigate", 200),
        ("same-site", "cors", 200),
        ("same-origin", "cors", 200),
        ("none", "navigate", 200),
    ],
)
def test_other_sites_may_link_but_not_load(site: str, mode: str, status: int):
    headers = {"Sec-Fetch-Site": site, "Sec-Fetch-Mode": mode}
    assert open_client().get("/x", headers=headers).status_code == status


@pytest.mark.parametrize("name", ["X-Forwarded-For", "Forwarded", "X-Real-IP"])
def test_a_proxy_lends_its_place_to_nobody(name: str):
    headers = {name: "203.0.113.9"}
    answer = open_client().get("/x", headers=headers)
    assert answer.status_code == 403
    assert "STILLPATH_KEYS" in answer.json()["detail"]
    with_keys = open_client("*", trusts_all=False)
    assert with_keys.get("/x", headers=headers).status_code == 200


def test_long_urls_and_headers_are_refused():
    client = open_client()
    assert client.get("/x?" + "a" * 9000).status_code == 414
    assert client.get("/x", headers={"X-Long": "a" * 40_000}).status_code == 431
    assert client.get("/x", headers={f"X-{n}": "a" for n in range(120)}).status_code == 431
    assert client.get("/x?" + "a" * 8000, headers={"X-Long": "a" * 20_000}).status_code == 200


def test_an_encoded_body_is_refused():
    client = open_client()
    refused = client.post("/x", content=b"\x1f\x8b", headers={"Content-Encoding": "gzip"})
    assert refused.status_code == 415
    assert "'gzip'" in refused.json()["detail"]
    assert "send it as it is" in refused.json()["detail"]
    assert client.post("/x", headers={"Content-Encoding": "Identity"}).status_code == 200


def test_documents_are_limited_and_streams_are_not():
    client = open_client()
    large = b'{"a": "' + b"x" * (5 << 20) + b'"}'
    json = {"Content-Type": "application/json"}
    for content in (large, iter([large[: 1 << 20]] * 6)):
        answer = client.post("/document", content=content, headers=json)
        assert answer.status_code == 413
        assert answer.headers["content-type"] == "application/problem+json"
    assert client.post("/document", json={"a": 1}).json() == {"a": 1}
    assert client.post("/stream", content=large).json() == {"size": len(large)}


def test_every_answer_tells_browsers_what_it_may_do():
    client = open_client()
    for path, status in (("/x", 200), ("/page", 200), ("/nope", 404)):
        answer = client.get(path)
        assert answer.status_code == status
        assert answer.headers["x-content-type-options"] == "nosniff"
        assert answer.headers["referrer-policy"] == "no-referrer"
        assert answer.headers["cross-origin-resource-policy"] == "same-origin"
        assert "default-src 'none'" in answer.headers["content-security-policy"]
        assert "private" in answer.headers["cache-control"]
    refused = client.get("/x", headers={"Host": "evil.example"})
    assert refused.headers["x-content-type-options"] == "nosniff"
    assert "sandbox" in client.get("/x").headers["content-security-policy"]
    assert client.get("/page?policy=own").headers["content-security-policy"] == "own"
