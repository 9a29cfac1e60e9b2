"""The documentation as the service shows it: every page, every link, and nothing else."""

from __future__ import annotations

import re
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import urljoin, urlsplit

import pytest
from fastapi import FastAPI
from markdown.extensions.toc import slugify
from starlette.testclient import TestClient

from stillpath.service.api import documentation, pages, problems
from stillpath.service.api.documentation import help_names, linked, slug

ROOT = Path(documentation.__file__).resolve().parents[2]
HERE = "http://localhost"
LAYERS = ("applications", "cli", "gcode", "integrations", "pipeline", "reports", "service")


class Page(HTMLParser):
    """What a page refers to, what can be referred to, and its words."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.addresses: list[str] = []
        self.ids: list[str] = []
        self.styled: list[str] = []
        self.words = ""
        self._in_code = 0
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self.addresses += [v for k, v in attrs if k in ("href", "src") and v is not None]
        self.ids += [v for v in (given.get("id"),) if v]
        self.styled += [tag for k, _ in attrs if k == "style" or k.startswith("on")]
        self._in_code += tag in ("code", "pre")

    def handle_endtag(self, tag: str) -> None:
        self._in_code -= tag in ("code", "pre")

    def handle_data(self, data: str) -> None:
        self.words += "" if self._in_code else data


@pytest.fixture(scope="module")
def client() -> Iterator[TestClient]:
    app = FastAPI()
    problems.install(app)
    app.include_router(pages.router)
    app.include_router(documentation.router)
    with TestClient(app, base_url=HERE) as opened:
        yield opened


@pytest.fixture(scope="module")
def all_pages(client: TestClient) -> dict[str, Page]:
    return {name: Page(client.get(f"/help/{name}").text) for name in help_names()}


def test_every_document_is_a_page(client: TestClient):
    files = {p.relative_to(ROOT / "docs").as_posix() for p in (ROOT / "docs").rglob("*.md")}
    assert {f"{name}.md" for name in help_names()} == files
    for name in help_names():
        answer = client.get(f"/help/{name}")
        assert answer.status_code == 200, name
        assert answer.headers["content-type"] == "text/html; charset=utf-8"
        assert answer.text.count("<h1") == 1, name


def test_what_the_texts_have_beyond_plain_markdown_is_not_shown_as_it_is_written(
    all_pages: dict[str, Page],
):
    for name, page in all_pages.items():
        assert not re.search(r"!!!|\{ \.|\[ \]|^#+ |\*\*|</?\w+>|<!--|\]\(", page.words), name
        assert page.styled == [], name  # the policy allows no style or script in the page


def test_a_note_and_a_picture_look_like_one(client: TestClient):
    page = client.get("/help/index").text
    note = page.partition("<blockquote>")[2].partition("</blockquote>")[0]
    assert "A built-in machine is somebody else's printer" in note
    assert 'href="tutorials/bed-slinger"' in note
    assert '<img src="images/corner.svg"' in page


def test_every_link_leads_somewhere(client: TestClient, all_pages: dict[str, Page]):
    targets = {f"/help/{name}": page.ids for name, page in all_pages.items()}
    seen: dict[str, int] = {}
    for name, page in all_pages.items():
        assert len(page.ids) == len(set(page.ids)), name
        for address in page.addresses:
            assert not address.startswith("/"), address  # a proxy may have us below a path
            there = urlsplit(urljoin(f"{HERE}/help/{name}", address))
            if there.netloc != "localhost":
                assert there.scheme == "https", (name, address)
                continue
            if there.path not in seen:
                seen[there.path] = client.get(there.path).status_code
            assert seen[there.path] == 200, (name, address)
            if there.fragment and there.path.startswith("/help/"):
                assert there.fragment in targets[there.path], (name, address)
    assert len(seen) > len(all_pages)


def test_a_file_of_the_repository_is_plain_words(client: TestClient):
    assert "<span>Contributing</span>" in client.get("/help/index").text


def test_headings_have_the_ids_of_the_documentation_site():
    for words in ("Against the real planner", "What --where does: 1.9 µm, x/y", "M204 S, P  -- T"):
        assert slug(words) == slugify(words, "-")


def test_a_page_has_the_headers_of_the_page(client: TestClient):
    first, page = client.get("/"), client.get("/help/safety")
    for name in (
        "content-security-policy",
        "x-content-type-options",
        "referrer-policy",
        "cross-origin-opener-policy",
        "cache-control",
    ):
        assert page.headers[name] == first.headers[name]
    again = client.get("/help/safety", headers={"If-None-Match": page.headers["etag"]})
    assert again.status_code == 304
    assert client.head("/help/safety").content == b""


@pytest.mark.parametrize(
    ("name", "kind"),
    [("images/corner.svg", "image/svg+xml"), ("images/design.webp", "image/webp")],
)
def test_pictures_are_served(client: TestClient, name: str, kind: str):
    answer = client.get(f"/help/{name}")
    assert answer.headers["content-type"] == kind
    assert answer.content == (ROOT / "docs" / name).read_bytes()


@pytest.mark.parametrize("path", ["/help/", "/help", "/help/index.md"])
def test_the_start_has_short_addresses(client: TestClient, path: str):
    assert "Start here" in client.get(path).text


@pytest.mark.parametrize(
    "name",
    [
        "nothing",
        "site_pages.py",
        "images",
        "..%2fREADME",
        "..%2fREADME.md",
        "tutorials%2f..%2f..%2fpyproject.toml",
        "%2fetc%2fpasswd",
        "images%2f..%2f..%2fservice%2fweb%2ficon.svg",
        "%00",
    ],
)
def test_nothing_else_is_served(client: TestClient, name: str):
    answer = client.get(f"/help/{name}")
    assert answer.status_code == 404
    assert answer.headers["content-type"] == "application/problem+json"
    assert "/help/index" in answer.json()["detail"]


def test_documents_that_the_program_names_exist():
    for layer in LAYERS:
        for path in (p for p in (ROOT / layer).rglob("*") if p.suffix in (".py", ".j2", ".js")):
            for name in re.findall(r"\bdocs/([a-z/-]+)\.md\b", path.read_text("utf-8")):
                assert name in help_names(), (path, name)
            for name in re.findall(r'\bhelpLink\("([\w/-]+)', path.read_text("utf-8")):
                assert name in help_names(), (path, name)


def test_a_static_page_gets_links_in_its_words_only():
    page = "<title>docs/proof.md</title><body title='docs/proof.md'><p>docs/proof.md, docs/no.md"
    assert linked(page) == page.replace(
        "<p>docs/proof.md", '<p><a href="../../../help/proof">docs/proof.md</a>'
    )
