"""How the page is served: policy, caching, compression; and that it needs nothing from outside."""

from __future__ import annotations

import gzip
import hashlib
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from fastapi import FastAPI
from starlette.testclient import TestClient

from stillpath.service.api import documentation, pages, problems
from stillpath.service.api.pages import page_files

WEB = Path(pages.__file__).resolve().parents[1] / "web"
OWN = [p for p in sorted(WEB.rglob("*.js")) if "vendor" not in p.parts]
_IMPORT = re.compile(r'\b(?:from |import |import\()"([^"\s]+)"')


@pytest.fixture(scope="module")
def client() -> Iterator[TestClient]:
    app = FastAPI()
    problems.install(app)
    app.include_router(pages.router)
    app.include_router(documentation.router)
    with TestClient(app, base_url="http://localhost") as opened:
        yield opened


def asset(path: str) -> str:
    return f"/assets/{page_files().version}/{path}"


def test_the_page_allows_nothing_but_this_service(client: TestClient):
    answer = client.get("/")
    assert answer.headers["content-type"] == "text/html; charset=utf-8"
    policy = dict(
        part.strip().split(" ", 1) for part in answer.headers["content-security-policy"].split(";")
    )
    assert policy["default-src"] == "'none'"
    assert policy["script-src"] == policy["style-src"] == policy["connect-src"] == "'self'"
    assert policy["frame-ancestors"] == "'none'"
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert answer.headers["cache-control"] == "no-cache"
    assert "{{" not in answer.text
    for address in re.findall(r'(?:src|href)="([^"#]+)"', answer.text):
        assert client.get(f"/{address}").status_code == 200, address


def test_files_are_kept_for_good_under_the_address_of_their_version(client: TestClient):
    answer = client.get(asset("app.js"))
    assert answer.headers["content-type"].startswith("text/javascript")
    assert "immutable" in answer.headers["cache-control"]
    assert answer.headers["x-content-type-options"] == "nosniff"
    again = client.get(asset("app.js"), headers={"If-None-Match": f'"x", {answer.headers["etag"]}'})
    assert again.status_code == 304
    assert again.content == b""
    # A service of another version is asked: answered, but not for good.
    other = client.get("/assets/000000000000/app.js")
    assert other.content == answer.content
    assert other.headers["cache-control"] == "no-cache"


def test_gzip_is_sent_to_whoever_takes_it(client: TestClient):
    plain = client.get(asset("app.js"), headers={"Accept-Encoding": "identity"})
    assert "content-encoding" not in plain.headers
    refused = client.get(asset("app.js"), headers={"Accept-Encoding": "br, gzip;q=0"})
    assert "content-encoding" not in refused.headers
    with client.stream("GET", asset("app.js"), headers={"Accept-Encoding": "gzip"}) as packed:
        raw = b"".join(packed.iter_raw())
    assert packed.headers["content-encoding"] == "gzip"
    assert packed.headers["vary"] == "Accept-Encoding"
    assert gzip.decompress(raw) == plain.content
    assert client.head(asset("app.js")).content == b""


@pytest.mark.parametrize(
    "path", ["nothing.js", "__init__.py", "vendor/README.md", "..%2fapi%2fpages.py", "index.html"]
)
def test_nothing_else_is_served(client: TestClient, path: str):
    answer = client.get(asset(path))
    assert answer.status_code == 404
    assert answer.headers["content-type"] == "application/problem+json"


def test_every_import_is_a_file_of_the_page():
    for file in OWN:
        for name in _IMPORT.findall(file.read_text("utf-8")):
            assert name.startswith("."), f"{file}: {name}"
            assert (file.parent / name).resolve().is_file(), f"{file}: {name}"


def test_nothing_is_named_that_lies_elsewhere():
    for file in [*OWN, *WEB.glob("styles/*.css"), WEB / "index.html", WEB / "icon.svg"]:
        text = file.read_text("utf-8").replace("http://www.w3.org/2000/svg", "")
        assert not re.search(r"https?://|[\"'(]//", text), file
        assert not re.search(r"\binnerHTML\b|\beval\(|new Function|insertAdjacentHTML", text), file


def test_browsers_without_a_dark_side_get_the_light_one():
    """Without colours the curves of a chart cannot be told apart."""
    style = (WEB / "styles" / "base.css").read_text("utf-8")
    both, _, fallback = style.partition("@supports not (color: light-dark(")
    light = re.findall(r"(--[\w-]+): light-dark\((#\w+), #\w+\);", both)
    assert len(light) == both.count("light-dark(") > 10
    assert re.findall(r"(--[\w-]+): (#\w+);", fallback.partition("}")[0]) == light


def test_vendored_files_are_those_of_the_table():
    table = (WEB / "vendor" / "README.md").read_text("utf-8")
    named = dict(re.findall(r"\| `([\w.]+)` \|.*`([0-9a-f]{64})`", table))
    found = {
        file.name: hashlib.sha256(file.read_bytes()).hexdigest()
        for file in (WEB / "vendor").rglob("*")
        if file.suffix in (".js", ".css")
    }
    assert found == named
    assert {p.parent.name for p in (WEB / "vendor").rglob("LICENSE")} == {"three", "uplot"}


def test_modules_stay_small():
    sizes = {p.relative_to(WEB).as_posix(): len(p.read_text("utf-8").splitlines()) for p in OWN}
    assert max(sizes.values()) <= 400, sizes
