"""The application in this process, with a pretended pipeline that is quick."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from starlette.testclient import TestClient

from stillpath.service.api import create_app
from stillpath.service.settings import Settings
from tests.service.runners import light
from tests.service.test_api import JOBS

__all__ = ["PRINTERS", "opened", "post"]

PRINTERS = """
[printer.left]
kind = "octoprint"
url = "http://127.0.0.1:9"
machine = "ender3"
method = "shaper:ei"
budget_um = 12
"""


def opened(folder: Path, **settings: Any) -> TestClient:
    """Return a client of an application of its own; it runs within a `with` statement."""
    app = create_app(
        Settings(data_dir=folder, requests_per_minute=100_000, **settings), runner=light
    )
    return TestClient(app, base_url="http://localhost", raise_server_exceptions=False)


def post(client: TestClient, content: bytes, query: str = "", **headers: str) -> Any:
    """Hand a file in."""
    return client.post(f"{JOBS}{query}", content=content, headers=headers)
