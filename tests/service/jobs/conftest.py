"""What the tests of jobs share."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.service.jobs.site import Site


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    """A place of jobs of its own."""
    site = Site(tmp_path / "data")
    yield site
    site.close()
