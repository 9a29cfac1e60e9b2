"""The documentation site: its nav names every page, it builds, it loads nothing from elsewhere."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
import yaml

from tests.checkout import PYTHONPATH
from tests.loading import module_at

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))
PICTURES = sorted((DOCS / "images").iterdir())
TAKEN_OVER = {"contributing.md", "changes.md"}
HOSTS = re.compile(
    r"googleapis|gstatic|jsdelivr|unpkg|cdnjs|cloudflare|bootstrapcdn|typekit|google-analytics"
)
LOADED = re.compile(
    r"<(?:link|script|img|iframe|source|video|audio|object)\b"
    r"[^>]*?\b(?:src|href|data)=[\"']?([^\"' >]+)"
)
MOST_BYTES, MOST_BYTES_IN_ALL = 150_000, 1_500_000


@pytest.fixture(scope="module")
def settings() -> dict[str, Any]:
    found: dict[str, Any] = yaml.safe_load((ROOT / "mkdocs.yml").read_text())
    return found


def in_nav(entries: Any) -> Iterator[str]:
    if isinstance(entries, str):
        yield entries
    elif entries:
        for entry in entries.values() if isinstance(entries, dict) else entries:
            yield from in_nav(entry)


def made_pages() -> set[str]:
    module = module_at(DOCS / "site_pages.py", "site_pages")
    return {name for name in module.GENERATED if name.endswith(".md")} | TAKEN_OVER


def test_nav_names_every_page_once_and_none_that_is_missing(settings: dict[str, Any]):
    named = list(in_nav(settings["nav"]))
    assert len(named) == len(set(named))
    assert set(named) == {page.relative_to(DOCS).as_posix() for page in PAGES} | made_pages()


def test_nothing_is_fetched_from_elsewhere(settings: dict[str, Any]):
    assert settings["theme"]["font"] is False
    assert "repo_url" not in settings  # the theme would ask the host for stars
    for page in [*PAGES, ROOT / "mkdocs.yml", *(DOCS / "stylesheets").iterdir()]:
        assert not HOSTS.search(page.read_text()), page
    for picture in DOCS.glob("images/*.svg"):
        text = picture.read_text().replace("http://www.w3.org/2000/svg", "")
        assert not re.search(r"https?://|<script|href", text), picture


def test_every_picture_is_shown_and_small():
    text = "".join(page.read_text() for page in PAGES)
    for picture in PICTURES:
        assert f"images/{picture.name})" in text, picture
        assert picture.stat().st_size < MOST_BYTES, picture
    assert sum(picture.stat().st_size for picture in PICTURES) < MOST_BYTES_IN_ALL


def test_commands_in_new_pages_exist():
    from typer.main import get_command

    from stillpath.cli.main import app

    commands = set(get_command(app).commands)  # type: ignore[attr-defined]
    for page in PAGES:
        blocks = re.findall(r"^```(?:sh|console)\n(.*?)^```", page.read_text(), re.MULTILINE | re.S)
        called = re.findall(
            r"^\$? ?(?:\./run )?stillpath ([a-z-]+)", "\n".join(blocks), re.MULTILINE
        )
        assert set(called) <= commands, page


def test_the_page_of_the_command_line_names_every_command_and_no_option_that_is_missing():
    from typer.main import get_command

    from stillpath.cli.main import app

    def options(command: Any) -> Iterator[str]:
        for parameter in command.params:
            yield from (*parameter.opts, *parameter.secondary_opts)
        for inner in getattr(command, "commands", {}).values():
            yield from options(inner)

    root = get_command(app)
    page = (DOCS / "cli.md").read_text()
    for name in root.commands:  # type: ignore[attr-defined]
        assert re.search(rf"(`|^stillpath ){name}\b", page, re.MULTILINE), name
    assert set(re.findall(r"--[a-z][a-z0-9-]*", page)) <= {"--help", *options(root)}


@pytest.mark.slow
def test_the_site_builds_and_is_whole_in_itself(tmp_path: Path):
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    built = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True,
        env=os.environ | {"PYTHONPATH": PYTHONPATH, "NO_MKDOCS_2_WARNING": "1"},
    )  # fmt: skip
    assert built.returncode == 0, built.stderr[-3000:]
    pages = sorted(tmp_path.rglob("*.html"))
    assert len(pages) >= len(PAGES)
    for page in pages:
        text = page.read_text()
        assert "Content-Security-Policy" in text
        for address in LOADED.findall(text):
            assert not urlsplit(address).netloc or address.startswith("data:"), (page, address)
    commands = (tmp_path / "reference" / "commands.html").read_text()
    assert "stillpath compensate" in commands
    assert "--tolerance-um" in commands
    assert "/v1/jobs" in (tmp_path / "reference" / "requests.html").read_text()
