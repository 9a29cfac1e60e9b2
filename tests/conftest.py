"""What all tests share: quiet numerical libraries, and the folder of shared test data."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import pytest

# Before numpy and numba are imported anywhere.
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

_MISSING = "no shared test data: set STILLPATH_SHARED, or put the folder beside the checkout"
_ROOT = Path(__file__).resolve().parent.parent
if "NUMBA_CACHE_DIR" not in os.environ and not os.access(_ROOT / "models", os.W_OK):
    os.environ["NUMBA_CACHE_DIR"] = str(Path(tempfile.gettempdir()) / "stillpath-tests-numba")


def _shared() -> Path | None:
    named = os.environ.get("STILLPATH_SHARED")
    folder = Path(named) if named else _ROOT.parent / "shared"
    return folder if folder.is_dir() else None


def _in_ci() -> bool:
    return os.environ.get("CI", "").lower() in ("1", "true", "yes")


@pytest.fixture(scope="session")
def shared_dir() -> Path:
    """Folder of shared test data; tests that use it carry the marker `shared`."""
    folder = _shared()
    assert folder is not None, _MISSING  # a test without it is stopped before, by its marker
    return folder


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Give the marker to whatever uses the fixture, so that `-m shared` finds all of them."""
    for item in items:
        if "shared_dir" in getattr(item, "fixturenames", ()):
            item.add_marker("shared")


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Judge the marker, whichever way a test finds its data."""
    if item.get_closest_marker("shared") is not None and _shared() is None:
        if _in_ci():
            pytest.fail(_MISSING)
        pytest.skip(_MISSING)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Say it loudly when a part of the evidence was left out."""
    skipped = [
        report
        for report in terminalreporter.getreports("skipped")
        if "no shared test data" in str(report.longrepr).lower()
    ]
    if skipped:
        terminalreporter.write_line(
            f"NOT CHECKED: {len(skipped)} tests need the shared test data (STILLPATH_SHARED)",
            yellow=True,
            bold=True,
        )
