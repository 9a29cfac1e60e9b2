"""A service of its own and Debian's Chromium; a page that fails its test when it logs an error."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, Playwright, expect, sync_playwright

from tests.missing import tell
from tests.web.served import PART, PATIENCE_MS, Service, running
from tests.web.visitor import Visitor

_MISSING = "no Chromium: install Debian's package chromium"
# WebGL without a graphics card.
_FLAGS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Whatever starts a browser is slow."""
    for item in items:
        if "browser" in getattr(item, "fixturenames", ()):
            item.add_marker("slow")


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    tell(terminalreporter, _MISSING, "Debian's Chromium: the web page was not looked at")


@pytest.fixture(scope="session")
def chromium() -> str:
    """Path of the browser."""
    found = shutil.which("chromium") or shutil.which("chromium-browser")
    if found is None:
        pytest.skip(_MISSING)  # `.ci/run` installs it where that is possible
    return found


@pytest.fixture(scope="session")
def playwright() -> Iterator[Playwright]:
    expect.set_options(timeout=PATIENCE_MS)
    with sync_playwright() as started:
        yield started


@pytest.fixture(scope="session")
def browser(chromium: str, playwright: Playwright) -> Iterator[Browser]:
    opened = playwright.chromium.launch(executable_path=chromium, args=_FLAGS)
    yield opened
    opened.close()


@pytest.fixture(scope="session")
def service(browser: Browser, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """A service that asks for no key; without a browser nobody needs it."""
    with running(tmp_path_factory.mktemp("service")) as found:
        yield found


@pytest.fixture(scope="session")
def gear(service: Service) -> dict[str, Any]:
    """A finished job of a real sliced file."""
    job = service.finished(service.submit(PART, "gear.gcode"))
    assert job["state"] == "done", job
    return job


@pytest.fixture(scope="session")
def artefacts() -> Path | None:
    """Folder for screenshots, STILLPATH_ARTEFACTS; without it none are made."""
    named = os.environ.get("STILLPATH_ARTEFACTS")
    if not named:
        return None
    folder = Path(named)
    folder.mkdir(parents=True, exist_ok=True)
    return folder


@pytest.fixture
def visitor(browser: Browser, service: Service, artefacts: Path | None) -> Iterator[Visitor]:
    """No page may log an error or a warning."""
    found = Visitor(browser, service.url, artefacts)
    yield found
    for context in found.contexts:
        context.close()
    assert found.complaints == []
