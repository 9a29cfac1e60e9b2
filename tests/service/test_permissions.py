"""What lies on the disk is the service's only."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from stillpath.service.database.engine import open_database
from stillpath.service.instance_lock import exclusive
from stillpath.service.permissions import private_file, private_folder
from stillpath.service.settings import Settings

pytestmark = pytest.mark.skipif(os.name != "posix", reason="modes of POSIX")


@pytest.fixture(autouse=True)
def generous() -> object:
    """As most systems are."""
    before = os.umask(0o022)
    yield
    os.umask(before)


def mode(path: Path) -> int:
    return path.stat().st_mode & 0o777


def test_data_of_a_service(tmp_path: Path) -> None:
    folder = tmp_path / "data"
    engine = open_database(Settings(data_dir=folder))
    with engine.begin(), exclusive(folder):
        assert mode(folder) == 0o700
        found = {path.name: mode(path) for path in folder.glob("stillpath.sqlite3*")}
        assert set(found.values()) == {0o600}
        assert "stillpath.sqlite3-wal" in found
    engine.dispose()


def test_what_an_earlier_version_left_open_is_closed(tmp_path: Path) -> None:
    folder = tmp_path / "data"
    open_database(Settings(data_dir=folder)).dispose()
    folder.chmod(0o755)
    (folder / "stillpath.sqlite3").chmod(0o644)
    with exclusive(folder):
        open_database(Settings(data_dir=folder)).dispose()
    assert (mode(folder), mode(folder / "stillpath.sqlite3")) == (0o700, 0o600)


def test_a_group_that_was_let_in_stays(tmp_path: Path) -> None:
    folder = tmp_path / "data"
    private_folder(folder)
    folder.chmod(0o750)
    private_folder(folder)
    assert mode(folder) == 0o750
    private_file(folder / "key")
    assert mode(folder / "key") == 0o600


def test_a_database_of_another_user_is_refused_at_the_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As one whose service root has started once: SQLite reads it, and takes no job."""
    folder = tmp_path / "data"
    open_database(Settings(data_dir=folder)).dispose()
    file = folder / "stillpath.sqlite3"
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != file)  # tests may be root's
    with pytest.raises(PermissionError) as refused:
        open_database(Settings(data_dir=folder))
    assert refused.value.filename == str(file)
