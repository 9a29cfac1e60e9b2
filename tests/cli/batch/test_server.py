"""Batches through a server: the real one, with a pretended pipeline."""

from __future__ import annotations

import errno
import json
from pathlib import Path

import pytest

from stillpath.applications.machines.store import MachineStore
from stillpath.cli.batch.server import _failure_of
from stillpath.cli.main import run
from stillpath.compensation.base import DesignError
from stillpath.gcode.errors import GcodeError
from stillpath.models.errors import ModelError
from stillpath.service.client import ClientError
from stillpath.service.jobs.problems import (
    FILE_EMPTY,
    FILE_TOO_LARGE,
    TOO_LONG,
    TOO_MUCH_MEMORY,
    input_damaged,
    input_gone,
    never_fits,
    problem,
    problem_of,
    storage_away,
)
from tests.service.machines import make_machine, with_accel
from tests.service.test_server import PRETEND, server

pytestmark = pytest.mark.slow


def rows(output: Path) -> dict[str, dict]:
    files = json.loads((output / "summary.json").read_text())["files"]
    return {Path(row["source"]).stem: row for row in files}


def test_a_batch_through_a_server(tmp_path, monkeypatch):
    files, output, data = tmp_path / "in", tmp_path / "out", tmp_path / "data"
    files.mkdir()
    data.mkdir()
    for name, text in (("a", "G28 ; a\n"), ("b", "bad\n"), ("c", "G28 ; c\n")):
        (files / f"{name}.gcode").write_text(text)
    monkeypatch.setenv("STILLPATH_REQUIRE_APPROVAL", "1")
    store = MachineStore(data / "machines")
    store.add_revision("mine", make_machine("mine"), author="me", message="")

    with server(PRETEND, data) as (client, _):
        address = str(client.base_url)

        def batch(machine: str) -> int:
            command = ["batch", str(files), "-m", machine, "-o", str(output), "--server", address]
            return run(command)

        assert batch("ender3") == 2
        found = rows(output)
        assert {name: row["state"] for name, row in found.items()} == {
            "a": "done", "b": "failed", "c": "done",
        }  # fmt: skip
        assert "X1e400" in found["b"]["error"]
        assert found["a"]["after_um"] < found["a"]["before_um"]
        assert isinstance(found["a"]["warnings"], list)
        result = output / "ender3" / "a.stillpath.gcode"
        assert result.read_text() == "; compensated\nG28 ; a\n"
        assert (output / "reports/ender3/a.gcode/report.html").exists()

        assert batch("ender3") == 2
        assert rows(output)["a"]["state"] == "done before"
        jobs = client.get("/v1/jobs").json()["jobs"]
        assert len({job["batch"] for job in jobs}) == 1
        assert len([job for job in jobs if job["state"] == "done"]) == 2
        result.unlink()
        assert batch("ender3") == 2
        assert result.exists()
        # The same upload with the same model was answered at once.
        assert len(client.get("/v1/jobs", params={"state": "done"}).json()["jobs"]) == 2

        (files / "b.gcode").unlink()
        assert batch("mine") == 2
        assert "approve" in rows(output)["a"]["error"]
        store.approve("mine", 1, author="boss", message="")
        assert batch("mine") == 0
        # A newer revision that nobody approved changes nothing.
        store.add_revision(
            "mine", with_accel(make_machine("mine"), 1234.0), author="me", message=""
        )
        assert batch("mine") == 0
        assert batch("nobodys") == 2
        assert "no machine nobodys" in rows(output)["a"]["error"]


@pytest.mark.parametrize(
    ("problem", "trouble"),
    [
        (problem_of(GcodeError("line 3")), "file"),
        (problem(422, FILE_EMPTY, ""), "file"),
        (problem(413, FILE_TOO_LARGE, ""), "file"),
        (problem_of(OSError(errno.EFBIG, "")), "computer"),
        (problem_of(ModelError("no plant")), "machine"),
        (problem_of(DesignError("too stiff")), "machine"),
        (problem(422, "Machine not usable", ""), "machine"),
        (problem(422, "Invalid parameter", ""), "machine"),
        (problem(401, "Unauthorized", ""), "machine"),
        (problem(409, "Job cancelled", ""), "computer"),
        (problem(422, TOO_LONG, ""), "work"),
        (problem(422, TOO_MUCH_MEMORY, ""), "work"),
        (never_fits(1, 1), "work"),
        (problem_of(RuntimeError()), "work"),
        (storage_away(OSError()), "computer"),
        (input_gone("part.gcode"), "computer"),
        (input_damaged("part.gcode"), "computer"),
        (problem(429, "Quota exceeded", ""), "computer"),
    ],
    ids=lambda value: value if isinstance(value, str) else value["title"],
)
def test_whose_fault_a_refusal_is(problem, trouble):
    """What is the file's own fault is not tried again by `watch`, broken work once."""
    assert _failure_of(ClientError("why", problem["status"], problem)).trouble == trouble


def test_a_server_that_is_not_there(tmp_path, capsys):
    (tmp_path / "a.gcode").write_text("G28")
    command = ["batch", str(tmp_path / "a.gcode"), "-m", "ender3", "-o", str(tmp_path / "out")]
    with pytest.raises(SystemExit) as caught:
        run([*command, "--server", "ftp://nowhere"])
    assert caught.value.code == 2
    assert "address" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
