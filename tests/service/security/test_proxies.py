"""Behind a proxy: who the caller is, and what he cannot make himself."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import httpx2
import pytest
from pydantic import ValidationError

from stillpath.service.api.proxies import Proxies
from stillpath.service.settings import Settings
from tests.nginx import nginx
from tests.service.test_server import PRETEND, finished, server

FIRST = "sp_" + "p" * 32
ADMIN = {"X-Api-Key": FIRST}
NAME = "prints.example.org"


def seen(peer: str, trusted: list[str], *headers: tuple[str, str]) -> dict[str, Any]:
    """Return the scope that the application is given."""
    scopes: list[Any] = []

    async def app(scope: Any, receive: Any, send: Any) -> None:
        scopes.append(scope)

    scope = {
        "type": "http",
        "scheme": "http",
        "client": (peer, 1234),
        "headers": [(b"host", b"inner"), *((n.encode(), v.encode()) for n, v in headers)],
    }
    asyncio.run(Proxies(app, trusted=trusted)(scope, None, None))  # type: ignore[arg-type]
    return scopes[0]


@pytest.mark.parametrize(
    ("peer", "said", "caller"),
    [
        ("10.0.0.1", ["203.0.113.9"], "203.0.113.9"),
        ("10.0.0.1", ["127.0.0.1, 203.0.113.9"], "203.0.113.9"),  # the first he wrote himself
        ("10.0.0.1", ["127.0.0.1", "203.0.113.9, 10.2.0.1"], "203.0.113.9"),
        ("10.0.0.1", ["10.3.0.1, 10.2.0.1"], "10.3.0.1"),
        ("10.0.0.1", ["203.0.113.9:4711"], "203.0.113.9"),
        ("10.0.0.1", ["[2001:db8::1]:4711"], "2001:db8::1"),
        ("::ffff:10.0.0.1", ["::ffff:203.0.113.9"], "203.0.113.9"),
        ("10.0.0.1", ["somebody"], "10.0.0.1"),
        ("10.0.0.1", ["203.0.113.9, somebody"], "10.0.0.1"),
        ("10.0.0.1", [], "10.0.0.1"),
        ("203.0.113.7", ["203.0.113.9"], "203.0.113.7"),
        ("127.0.0.1", ["203.0.113.9"], "127.0.0.1"),
    ],
)
def test_the_last_address_that_is_no_proxy_of_ours(peer: str, said: list[str], caller: str) -> None:
    scope = seen(peer, ["10.0.0.0/8"], *(("x-forwarded-for", text) for text in said))
    assert scope["client"][0] == caller


def test_host_and_scheme_only_from_the_trusted() -> None:
    said = (("x-forwarded-host", NAME), ("x-forwarded-proto", "https"))
    for trusted, host, scheme in ((["::1"], NAME, "https"), ([], "inner", "http")):
        scope = seen("::1", trusted, *said)
        assert [v for n, v in scope["headers"] if n == b"host"] == [host.encode()]
        assert scope["scheme"] == scheme
    assert seen("::1", ["::1"], ("x-forwarded-proto", "gopher"))["scheme"] == "http"


def test_a_setting_that_is_no_address() -> None:
    assert Settings(trusted_proxies=["10.1.2.3/8"]).trusted_proxies == ["10.0.0.0/8"]
    with pytest.raises(ValidationError, match="'proxy' is not an address or network"):
        Settings(trusted_proxies=["proxy"])


@pytest.mark.slow
@pytest.mark.nginx
def test_the_nginx_of_the_documents(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (
        ("KEYS", "true"),
        ("FIRST_KEY", FIRST),
        ("ALLOWED_HOSTS", f'["{NAME}"]'),
        ("TRUSTED_PROXIES", '["127.0.0.1"]'),
    ):
        monkeypatch.setenv(f"STILLPATH_{name}", value)
    data = tmp_path / "data"
    data.mkdir()
    front = tmp_path / "nginx"
    front.mkdir()
    with server(PRETEND, data) as (inner, _), nginx(front, inner.base_url.port) as port:
        base = f"https://127.0.0.1:{port}"
        with httpx2.Client(base_url=base, verify=False, timeout=60) as client:
            client.headers["Host"] = NAME
            assert client.get("/healthz").status_code == 200
            for spoofed in ({}, {"Host": "localhost"}, {"X-Forwarded-For": "127.0.0.1"}):
                assert client.get("/metrics", headers=spoofed).status_code == 403
                for other in ("//metrics", "/./metrics", "/%6detrics", "/metrics?x"):
                    assert "stillpath_jobs" not in client.get(other, headers=spoofed).text
                assert client.get("/v1/jobs", headers=spoofed).status_code == 401
            assert inner.get("/metrics").status_code == 401
            assert inner.get("/metrics", headers=ADMIN).status_code == 200
            foreign = {"Host": "evil.example"} | ADMIN
            assert client.get("/v1/jobs", headers=foreign).status_code == 403

            same_site = ADMIN | {"Origin": f"https://{NAME}"}
            # Larger than what nginx would take or buffer by default.
            content = b"nap 1\n".ljust(4 << 20, b";")
            made = client.post("/v1/jobs?machine=ender3", content=content, headers=same_site)
            assert made.status_code == 202, made.text
            where = made.headers["location"]
            with client.stream("GET", f"{where}/events", headers=ADMIN) as events:
                first = next(line for line in events.iter_lines() if line.startswith("data:"))
            assert '"done"' not in first  # as they come, not all at the end
            client.headers.update(ADMIN)
            assert finished(client, where)["state"] == "done"
            assert client.get(f"{where}/result", headers=ADMIN).status_code == 200

            lies = {"X-Forwarded-For": "198.51.100.1", "X-Forwarded-Host": "evil.example"}
            assert client.get("/v1/jobs", headers=ADMIN | lies).status_code == 200
            audit = client.get("/v1/audit", headers=ADMIN)
            assert audit.status_code == 200
            assert "198.51.100.1" not in audit.text
