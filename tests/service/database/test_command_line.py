"""The command line on machines that several computers share, and on a database that is away."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from stillpath.cli.main import run
from stillpath.service.database.engine import open_database
from stillpath.service.database.errors import StoreError
from stillpath.service.settings import Settings
from tests.service.machines import make_machine

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture(autouse=True)
def data_dir(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("STILLPATH_DATA_DIR", str(tmp_path / "data"))
    return tmp_path / "data"


def machine_file(folder: Path) -> Path:
    file = folder / "mine.json"
    file.write_text(make_machine("mine").model_dump_json())
    return file


def test_machines_in_the_database(
    postgres_url: str,
    tmp_path: Path,
    data_dir: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    monkeypatch.setenv("STILLPATH_DATABASE_URL", postgres_url)
    assert run(["machines", "import", str(machine_file(tmp_path))]) == 0
    assert run(["machines", "history", "mine"]) == 0
    assert not (data_dir / "machines").exists()
    # Seen by whoever names the same database, and by nobody else.
    monkeypatch.setenv("STILLPATH_DATA_DIR", str(tmp_path / "elsewhere"))
    assert run(["machines", "show", "mine"]) == 0
    monkeypatch.delenv("STILLPATH_DATABASE_URL")
    assert run(["machines", "show", "mine"]) == 2
    assert "mine" in capsys.readouterr().err


def test_machines_beside_a_sqlite_database_stay_files(
    tmp_path: Path, data_dir: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("STILLPATH_DATABASE_URL", f"sqlite:///{tmp_path / 'db'}")
    assert run(["machines", "import", str(machine_file(tmp_path))]) == 0
    assert (data_dir / "machines" / "mine" / "000001.json").exists()
    assert not (tmp_path / "db").exists()


def test_a_database_that_is_away_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setenv("STILLPATH_DATABASE_URL", "postgresql://anna:geheim@127.0.0.1:1/x")
    assert run(["machines"]) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "127.0.0.1:1/x does not answer" in error
    assert "geheim" not in error


@pytest.mark.parametrize("arguments", [["compensate", "--help"], ["machines"]])
def test_commands_without_a_database_do_not_load_it(arguments: list[str]):
    code = (
        "import sys; from stillpath.cli.main import run; "
        f"assert run({arguments!r}) == 0; "
        "heavy = {'sqlalchemy', 'alembic', 'psycopg', 'distributed'} & {*sys.modules}; "
        "sys.exit(' '.join(heavy) or 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


def test_a_lost_database_is_not_made_anew_beside_files_of_jobs(
    data_dir: Path, capsys: pytest.CaptureFixture[str]
):
    assert run(["migrate"]) == 0
    (data_dir / "jobs" / "7aba" / "source").mkdir(parents=True)
    assert run(["migrate"]) == 0
    (data_dir / "jobs" / "7aba" / "source" / "part.gcode").write_text("G1 X1\n")
    assert run(["migrate"]) == 0
    database, log = data_dir / "stillpath.sqlite3", data_dir / "stillpath.sqlite3-wal"
    log.write_bytes(b"what was written last")
    for lose in (database.unlink, database.touch):
        lose()
        assert run(["migrate"]) == 2
        assert "put the database back" in capsys.readouterr().err
        assert log.read_bytes() == b"what was written last"
        assert not database.exists() or not database.stat().st_size
    (data_dir / "jobs").rename(data_dir / "kept")
    assert run(["migrate"]) == 0


def test_a_wrong_database_does_not_cost_a_bucket_its_files(
    postgres_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("STILLPATH_DATABASE_URL", postgres_url)
    monkeypatch.setenv("STILLPATH_STORAGE_URL", (tmp_path / "files").as_uri())
    file = tmp_path / "files" / "jobs" / "7aba" / "source" / "part.gcode"
    file.parent.mkdir(parents=True)
    file.write_text("G1 X1\n")
    with pytest.raises(StoreError, match=r"7aba.*put the database back"):
        open_database(Settings())
    file.unlink()
    open_database(Settings()).dispose()
