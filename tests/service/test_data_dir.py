"""Where data lie by default: commands and service share a folder; an earlier one stays in use."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from stillpath.applications.machines.store import MachineStore
from stillpath.cli.main import run
from stillpath.cli.own_machines import data_dir
from stillpath.service.database.documents import open_documents
from stillpath.service.database.engine import open_database
from stillpath.service.settings import Settings

pytestmark = pytest.mark.skipif(sys.platform in ("win32", "darwin"), reason="the XDG convention")


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Somebody's folder for data, and another one that commands are started in."""
    monkeypatch.delenv("STILLPATH_DATA_DIR", raising=False)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "home"))
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    return tmp_path / "home" / "stillpath"


def make_a_machine(home: Path) -> None:
    assert run(["machines", "export", "ender3", "-o", "mine.json"]) == 0
    assert run(["machines", "import", "mine.json", "--as", "mine"]) == 0


def test_the_service_has_the_machines_of_the_command_line(home: Path):
    make_a_machine(home)
    settings = Settings()
    assert settings.data_dir == data_dir() == home
    engine = open_database(settings)
    assert MachineStore(open_documents(settings, engine, "machines")).names() == ["mine"]
    engine.dispose()
    assert not Path("stillpath-data").exists()


def test_a_user_without_a_home_keeps_data_where_the_service_is_started(monkeypatch):
    def none() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_DATA_HOME")
    monkeypatch.setattr(Path, "home", none)
    assert Settings().data_dir == Path("stillpath-data")
