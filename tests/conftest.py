"""What all tests share: quiet numerical libraries, the folder of shared test data, PostgreSQL."""

from __future__ import annotations

import gc
import os
import signal
import tempfile
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from tests.missing import tell
from tests.nginx import MISSING as _NO_NGINX
from tests.nginx import is_installed as _nginx_is_installed
from tests.service.database.postgres import MISSING as _NO_POSTGRESQL
from tests.service.database.postgres import is_installed, postgres_server, postgres_url

__all__ = ["cache", "postgres_server", "postgres_url", "shared_dir"]

# Before numpy and numba are imported anywhere.
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

# As in `service/environment.py`: modules, kernels and tests are very many objects that stay, and
# looking through them for cycles whenever 700 have come took a quarter of all time.
gc.set_threshold(50_000)

# A shell has it ignored by what runs in the background, which children would inherit.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# A busy computer is no fault of the code.
settings.register_profile("patient", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("patient")

_NO_SMALL_DISK = "no small disk"
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


@pytest.fixture(scope="session")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of what is designed once per machine; the names of its files say for which.

    All processes of a test run share it, and all runs that STILLPATH_TEST_CACHE is told.
    """
    own = tmp_path_factory.getbasetemp()
    run = own.parent if "PYTEST_XDIST_WORKER" in os.environ else own
    folder = Path(os.environ.get("STILLPATH_TEST_CACHE", run / "cache"))
    folder.mkdir(parents=True, exist_ok=True)
    return folder


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """Return one process more than there are cores: a part of all time, tests wait for others."""
    return (os.cpu_count() or 1) + 1


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Give the marker to whatever uses the fixture, so that `-m shared` finds all of them."""
    for item in items:
        names = getattr(item, "fixturenames", ())
        if "shared_dir" in names:
            item.add_marker("shared")
        if "postgres_server" in names:
            item.add_marker("postgresql")
    # Files with slow tests first: at the end no process waits long for the other.
    long = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in long)


def pytest_collection_finish() -> None:
    """Leave out what is there now whenever cycles are looked for."""
    gc.freeze()


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Judge the markers, whichever way a test finds its data."""
    for marker, is_there, missing, in_ci in (
        ("shared", lambda: _shared() is not None, _MISSING, True),
        # `.ci/run` installs it; where that is impossible, the rest is still worth knowing.
        ("postgresql", is_installed, _NO_POSTGRESQL, False),
        ("nginx", _nginx_is_installed, _NO_NGINX, False),
    ):
        if item.get_closest_marker(marker) is not None and not is_there():
            if in_ci and _in_ci():
                pytest.fail(missing)
            pytest.skip(missing)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    tell(terminalreporter, _MISSING, "the shared test data (STILLPATH_SHARED)")
    tell(terminalreporter, _NO_POSTGRESQL, "PostgreSQL")
    tell(terminalreporter, _NO_NGINX, "nginx")
    tell(terminalreporter, _NO_SMALL_DISK, "root, to mount a small disk")
