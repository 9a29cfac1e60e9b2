"""Fixtures of all tests."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def shared_dir() -> Path:
    """Folder of shared test data: STILLPATH_SHARED, or `shared` beside the checkout.

    A missing folder skips the test (pytest -ra lists it), and fails it in CI.
    """
    root = Path(__file__).resolve().parent.parent
    folder = Path(os.environ.get("STILLPATH_SHARED", root.parent / "shared"))
    if not folder.is_dir():
        message = f"no shared test data at {folder}; set STILLPATH_SHARED"
        if os.environ.get("CI", "").lower() == "true":
            pytest.fail(message)
        pytest.skip(message)
    return folder
