"""Fixtures of all tests."""

from __future__ import annotations

import os
import warnings
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def shared_dir() -> Path:
    """Folder of shared test data: STILLPATH_SHARED, or `shared` beside the checkout.

    A missing folder skips the test with a warning, and fails it in CI.
    """
    root = Path(__file__).resolve().parent.parent
    folder = Path(os.environ.get("STILLPATH_SHARED", root.parent / "shared"))
    if not folder.is_dir():
        message = f"no shared test data at {folder}; set STILLPATH_SHARED"
        if os.environ.get("CI", "").lower() == "true":
            pytest.fail(message)
        warnings.warn(message, pytest.PytestWarning, stacklevel=1)
        pytest.skip(message)
    return folder
