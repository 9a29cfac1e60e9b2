"""`stillpath batch` from outside, with pretended processes."""

from __future__ import annotations

import csv
import io
import json
import os
import signal
import threading
import time
from pathlib import Path

import pytest

from stillpath.applications.machines.store import MachineStore
from stillpath.cli.main import run
from tests.cli.batch.pretending import PretendedWorker
from tests.service.machines import make_machine, with_accel


@pytest.fixture(autouse=True)
def here(monkeypatch, tmp_path):
    monkeypatch.setattr("stillpath.cli.batch.worker_pool.LocalWorker", PretendedWorker)
    monkeypatch.setenv("STILLPATH_DATA_DIR", str(tmp_path / "data"))
    monkeypatch.chdir(tmp_path)


def fill(**texts: str) -> None:
    Path("in").mkdir(exist_ok=True)
    for name, text in texts.items():
        Path(f"in/{name}.gcode").write_text(text)


def batch(*more: str) -> int:
    return run(["batch", "in", "--machine", "ender3", "-o", "out", *more])


def states() -> dict[str, str]:
    files = json.loads(Path("out/summary.json").read_text())["files"]
    return {f"{Path(row['source']).stem}@{row['machine']}": row["state"] for row in files}


def test_goes_on_after_a_bad_file(capsys):
    fill(a="G28", b="bad", c="G28")
    assert batch("--jobs", "2") == 2
    assert states() == {"a@ender3": "done", "b@ender3": "failed", "c@ender3": "done"}
    assert Path("out/ender3/a.stillpath.gcode").read_text() == "; compensated for ender3\nG28"
    assert Path("in/a.gcode").read_text() == "G28"
    assert sorted(p.name for p in Path("out").iterdir()) == [
        ".stillpath", "ender3", "reports", "summary.csv", "summary.html", "summary.json",
    ]  # fmt: skip
    with Path("out/summary.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["after_um"] for row in rows] == ["1.0", "", "1.0"]
    assert "line 7" in rows[1]["error"]
    page = Path("out/summary.html").read_text()
    assert 'href="reports/ender3/a.gcode/report.html"' in page
    assert "2 done, 1 failed" in page
    shown = capsys.readouterr()
    assert "2 done, 1 failed" in shown.out
    assert "b.gcode for ender3: failed: line 7" in shown.err


def test_trouble_of_the_computer_is_another_code():
    fill(a="full", b="bad")
    assert batch() == 1


def test_done_before_is_not_done_again():
    fill(a="G28", b="G28 X")
    assert batch() == 0
    times = [path.stat().st_mtime_ns for path in Path("out/ender3").iterdir()]
    fill(b="G28 Y", c="G28 Z")
    assert batch() == 0
    assert states() == {"a@ender3": "done before", "b@ender3": "done", "c@ender3": "done"}
    assert Path("out/ender3/a.stillpath.gcode").stat().st_mtime_ns in times
    assert batch("--tolerance-um", "5") == 0
    assert set(states().values()) == {"done"}
    Path("out/ender3/a.stillpath.gcode").unlink()
    assert batch("--tolerance-um", "5") == 0
    assert states()["a@ender3"] == "done"


def test_updated_code_does_everything_again(monkeypatch):
    fill(a="G28")
    assert batch() == 0
    monkeypatch.setattr("stillpath.cli.batch.worker_pool.build", lambda: "0.1.0+0123456789ab")
    assert batch() == 0
    assert states() == {"a@ender3": "done"}


def test_a_group_of_machines_and_a_map():
    fill(a="G28", petg_b="G28")
    assert batch("--machine", "ender3,voron-v0", "--machine-map", "petg_*=annex-k3") == 0
    assert set(states()) == {"a@ender3", "a@voron-v0", "petg_b@annex-k3"}
    assert run(["batch", "in", "-o", "out", "--machine-map", "petg_*=annex-k3"]) == 2
    assert states() == {"a@": "failed", "petg_b@annex-k3": "done before"}


def test_a_new_revision_is_new_work():
    store = MachineStore(Path("data/machines"))
    machine = make_machine("mine")
    store.add_revision("mine", machine, author="me", message="")
    fill(a="G28")
    assert batch("--machine", "mine") == 0
    assert batch("--machine", "mine") == 0
    assert states() == {"a@mine": "done before"}
    store.add_revision("mine", with_accel(machine, 1234.0), author="me", message="")
    assert batch("--machine", "mine") == 0
    assert states() == {"a@mine": "done"}


def test_names_stay_names():
    fill(**{"=cmd|' <b>x&y": "G28", "#50% ü": "G28"})
    assert batch() == 0
    page = Path("out/summary.html").read_text()
    assert "<b>" not in page
    assert "%2350%25%20%C3%BC.gcode/report.html" in page
    assert len(list(Path("out/ender3").iterdir())) == 2


def test_usage(capsys):
    fill(a="G28")
    assert run(["batch", "in", "-o", "out"]) == 2
    assert run(["batch", "gone", "-m", "ender3", "-o", "out"]) == 2
    assert run(["batch", "in", "-m", "ender3", "-o", "in/a.gcode"]) == 2
    assert batch("--method", "magic") == 2
    assert "method" in capsys.readouterr().err
    assert not Path("out").exists()


def test_two_machines_of_one_name_are_refused(capsys):
    """Their results would lie over each other."""
    fill(a="G28")
    Path("copy.json").write_text(make_machine("ender3").model_dump_json())
    assert batch("--machine", "voron-v0,ender3,copy.json") == 2
    assert "ender3 and copy.json are both called 'ender3'" in capsys.readouterr().err
    assert batch("--machine-map", "b*=copy.json,ender3") == 2
    watch = ["watch", "in", "--machine", "copy.json,ender3", "-o", "out"]
    assert run(watch) == 2
    assert "copy.json and ender3 are both called" in capsys.readouterr().err
    assert not Path("out").exists()
    assert batch("--machine", "ender3", "--machine-map", "b*=copy.json") == 0  # of other files


def test_an_unknown_machine_fails_each_file():
    fill(a="G28", b="G28")
    assert batch("--machine", "ender4") == 2
    assert set(states().values()) == {"failed"}


@pytest.mark.skipif(os.name != "posix", reason="sends signals")
def test_interrupted(monkeypatch):
    fill(a="G28", b="slow")
    told = io.StringIO()
    monkeypatch.setattr("sys.stderr", told)

    def interrupt() -> None:
        deadline = time.monotonic() + 60
        while "a.gcode" not in told.getvalue() and time.monotonic() < deadline:
            time.sleep(0.02)
        os.kill(os.getpid(), signal.SIGTERM)

    thread = threading.Thread(target=interrupt)
    thread.start()
    with pytest.raises(SystemExit) as caught:
        batch("--jobs", "2")
    thread.join()
    assert caught.value.code == 143
    assert "1 of 2 are finished" in told.getvalue()
    assert not list(Path("out/.stillpath/work").iterdir())
    fill(b="G28 Y")
    assert batch() == 0
    assert states() == {"a@ender3": "done before", "b@ender3": "done"}
