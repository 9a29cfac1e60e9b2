"""One application for the tests here that do not need one of their own: workers take a while."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from starlette.testclient import TestClient

from tests.service.api.serving import PRINTERS, opened


@pytest.fixture(scope="package")
def data_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where it keeps its files."""
    return tmp_path_factory.mktemp("data")


@pytest.fixture(scope="package")
def client(data_dir: Path) -> Iterator[TestClient]:
    """Its client; there is one printer, `left`, that does not answer."""
    printers = data_dir / "printers.toml"
    printers.write_text(PRINTERS)
    with opened(data_dir, printers=printers) as found:
        yield found
