"""A watched folder, with pretended processes; its clock is ours."""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from stillpath.applications.machines.resolve import Resolver
from stillpath.applications.machines.store import MachineStore
from stillpath.cli.batch.items import Group, print_files
from stillpath.cli.batch.output import Outcome, OutputFolder
from stillpath.cli.batch.watching import Watcher
from stillpath.cli.batch.worker_pool import LocalBackend, worker_pool
from stillpath.pipeline.options import Options
from tests.checkout import PYTHONPATH
from tests.cli.batch.pretending import PretendedWorker
from tests.service.machines import make_machine, with_accel

ROOT = Path(__file__).parents[3]


class Watching:
    """A watcher whose clock is set forward by hand."""

    def __init__(self, watcher: Watcher, told: list[Outcome]) -> None:
        self.told = told
        self._watcher = watcher
        self._now = 0.0

    def look(self, after_s: float = 1.0) -> bool:
        self._now += after_s
        return self._watcher.look(self._now)

    def until_quiet(self) -> list[Outcome]:
        """Look until nothing is under way, and return what was told since."""
        before = len(self.told)
        deadline = time.monotonic() + 60
        while self.look():
            assert time.monotonic() < deadline
            time.sleep(0.01)
        return self.told[before:]


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    monkeypatch.setattr("stillpath.cli.batch.worker_pool.LocalWorker", PretendedWorker)
    (tmp_path / "in").mkdir()
    return tmp_path / "in"


@contextmanager
def watching(
    folder: Path, machine: str = "ender3", *, output: Path | None = None, approval: bool = False
) -> Iterator[Watching]:
    told: list[Outcome] = []
    machines = Resolver(MachineStore(folder.parent / "machines"), require_approval=approval)
    options = Options()
    with (
        OutputFolder.opened(output or folder.parent / "out") as kept,
        worker_pool(LocalBackend(machines, options, 2), kept, options, 2) as made,
    ):
        group = Group(tuple(machine.split(",")))
        yield Watching(Watcher(folder, group, made, kept, settle_s=2.0, tell=told.append), told)


def results(folder: Path) -> list[str]:
    out = folder.parent / "out"
    return sorted(p.relative_to(out).as_posix() for p in out.rglob("*.stillpath.*"))


def test_a_file_is_done_when_it_has_stopped_growing(folder):
    with watching(folder) as watch:
        for size in range(5):
            (folder / "a.gcode").write_text("G28\n" + "G1 X1\n" * size)
            assert watch.look()
            assert not watch.told
        watch.look()
        assert not watch.told
        assert [o.state for o in watch.until_quiet()] == ["done"]
        assert watch.until_quiet() == []
    assert results(folder) == ["ender3/a.stillpath.gcode"]
    assert (folder / "a.gcode").read_text().startswith("G28")


def test_a_copy_that_came_to_a_halt_is_waited_for(folder):
    """Its slicer's last comment is missing; half of the file was compensated after two seconds."""
    head = ";FLAVOR:Marlin\n;Generated with Cura_SteamEngine 5.10.2\nG28\nG1 X1\n"
    with watching(folder) as watch:
        (folder / "a.gcode").write_text(head)
        for _ in range(30):
            assert watch.look()
        assert not watch.told
        (folder / "a.gcode").write_text(head + "G1 X2\nM104 S0\n;End of Gcode\n")
        assert [o.state for o in watch.until_quiet()] == ["done"]
        assert (folder.parent / "out/ender3/a.stillpath.gcode").read_text().endswith("Gcode\n")
        (folder / "b.gcode").write_text(head)
        assert watch.look()
        assert watch.look(after_s=30.0)
        assert len(watch.told) == 1
        watch.look(after_s=31.0)
        assert [o.state for o in watch.until_quiet()] == ["done"]


def test_atomic_renames(folder):
    with watching(folder) as watch:
        for content in ("G28 ; first", "G28 ; second"):
            (folder / "upload.tmp").write_text(content)
            watch.until_quiet()
            (folder / "upload.tmp").rename(folder / "a.gcode")
            assert len(watch.until_quiet()) == 1
    text = (folder.parent / "out/ender3/a.stillpath.gcode").read_text()
    assert text.endswith("second")


def test_own_output_and_stamped_files_are_left_alone(folder):
    with watching(folder, output=folder / "done") as watch:
        (folder / "a.gcode").write_text("G28")
        (folder / "b.gcode").write_text("; Processed by stillpath 0.1.0 machine=x\nG28")
        (folder / "c.stillpath.gcode").write_text("G28")
        assert len(watch.until_quiet()) == 1
        assert watch.until_quiet() == []
    assert [p.name for p in (folder / "done/ender3").iterdir()] == ["a.stillpath.gcode"]


def test_folders_may_disappear_while_they_are_looked_through(folder):
    """A run that wrote into a folder below the watched one once ended the watch."""
    (folder / "a.gcode").write_text("G28")
    done = threading.Event()

    def come_and_go() -> None:
        while not done.is_set():
            deep = folder / "work" / "job" / "deeper"
            deep.mkdir(parents=True)
            shutil.rmtree(folder / "work")

    thread = threading.Thread(target=come_and_go)
    thread.start()
    try:
        for _ in range(2000):
            assert [p.name for p in print_files(folder, folder / "done")] == ["a.gcode"]
    finally:
        done.set()
        thread.join()


def test_folders_that_may_not_be_entered_are_passed_over(folder, monkeypatch):
    for name in ("a", "shut"):
        (folder / name).mkdir()
        (folder / name / "part.gcode").write_text("G28")
    really = os.stat

    def denied(path, **named):
        if Path(path) == folder / "shut" / "part.gcode":
            raise PermissionError(13, "Permission denied", str(path))
        return really(path, **named)

    monkeypatch.setattr(os, "stat", denied)
    found = print_files(folder, folder / "done")
    assert [p.relative_to(folder).as_posix() for p in found] == ["a/part.gcode"]


def test_a_full_disk_does_not_end_the_watch(folder, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(OutputFolder, "note", full)
    with watching(folder) as watch:
        (folder / "a.gcode").write_text("bad")
        assert [o.state for o in watch.until_quiet()] == ["failed"]


def test_a_name_too_long_for_a_result_is_told_once(folder):
    """It was compensated again and again."""
    (folder / f"{249 * 'l'}.gcode").write_text("G28")
    with watching(folder) as watch:
        (outcome,) = watch.until_quiet()
        assert (outcome.state, outcome.trouble) == ("failed", "file")
        assert "rename the file" in outcome.error
        tries = PretendedWorker.tries
        watch.look(1000)
        assert watch.until_quiet() == []
        assert PretendedWorker.tries == tries


def test_the_reason_stands_beside_the_file(folder):
    reason = folder / "a.gcode.error.txt"
    with watching(folder) as watch:
        (folder / "a.gcode").write_text("bad")
        assert [o.state for o in watch.until_quiet()] == ["failed"]
        assert "X1e400 is too large" in reason.read_text()
        watch.look(1000)
        assert watch.until_quiet() == []
    tries = PretendedWorker.tries
    with watching(folder) as watch:  # nor is it tried again by the next one
        assert len(watch.until_quiet()) == 1
        assert PretendedWorker.tries == tries
        (folder / "a.gcode").write_text("G28")
        assert [o.state for o in watch.until_quiet()] == ["done"]
        assert not reason.exists()


def test_trouble_is_tried_again(folder):
    with watching(folder, "mine") as watch:
        (folder / "a.gcode").write_text("G28")
        watch.until_quiet()
        assert "mine" in (folder / "a.gcode.error.txt").read_text()
        store = MachineStore(folder.parent / "machines")
        store.add_revision("mine", make_machine("mine"), author="me", message="")
        assert watch.until_quiet() == []
        watch.look(10)
        assert [o.state for o in watch.until_quiet()] == ["done"]
        assert not (folder / "a.gcode.error.txt").exists()


def test_work_that_breaks_is_not_begun_for_ever(folder):
    """Of a printer's own computer each time may take the memory that the print needs."""
    with watching(folder) as watch:
        (folder / "a.gcode").write_text("huge")
        watch.until_quiet()
        tries = PretendedWorker.tries
        assert "out of memory" in (folder / "a.gcode.error.txt").read_text()
        for _ in range(10):
            watch.look(300)
            watch.until_quiet()
        assert PretendedWorker.tries == tries + 1
        assert (
            "not tried again before the file changes" in (folder / "a.gcode.error.txt").read_text()
        )
        (folder / "a.gcode").write_text("G28")
        assert [o.state for o in watch.until_quiet()] == ["done"]
    (folder / "b.gcode").write_text("huge")
    for _ in range(2):
        with watching(folder) as watch:
            assert [o.trouble for o in watch.until_quiet()] == ["work"]


def test_a_revision_must_be_approved(folder):
    store = MachineStore(folder.parent / "machines")
    store.add_revision("mine", make_machine("mine"), author="me", message="")
    with watching(folder, "mine", approval=True) as watch:
        (folder / "a.gcode").write_text("G28")
        watch.until_quiet()
        assert "approve" in (folder / "a.gcode.error.txt").read_text()
        store.approve("mine", 1, author="boss", message="")
        watch.look(10)
        assert [o.state for o in watch.until_quiet()] == ["done"]


def test_a_file_is_done_once_for_each_machine(folder):
    store = MachineStore(folder.parent / "machines")
    store.add_revision("mine", make_machine("mine"), author="me", message="")
    (folder / "a.gcode").write_text("G28")
    with watching(folder, "mine,ender3") as watch:
        assert len(watch.until_quiet()) == 2
    store.add_revision("mine", with_accel(make_machine("mine"), 1234.0), author="me", message="")
    for path in (folder.parent / "out").rglob("*.stillpath.gcode"):
        path.unlink()  # taken to the printer
    os.utime(folder / "a.gcode")
    with watching(folder, "mine,ender3") as watch:
        assert watch.until_quiet() == []
        (folder / "copy.gcode").write_text("G28")
        assert len(watch.until_quiet()) == 2


def test_files_that_go_or_change_while_they_are_worked_on(folder):
    with watching(folder) as watch:
        for name in ("a", "b"):
            (folder / f"{name}.gcode").write_text("slow")
        while len(list((folder.parent / "out/.stillpath/work").iterdir())) < 2:
            watch.look()
        (folder / "a.gcode").unlink()
        (folder / "b.gcode").write_text("G28")
        assert watch.look()
    assert results(folder) == []
    with watching(folder) as watch:
        assert len(watch.until_quiet()) == 1
    assert results(folder) == ["ender3/b.stillpath.gcode"]


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="kill -9")
def test_killed_again_and_again(tmp_path):
    """Every file is done once and whole, however often the process dies."""
    folder, out = tmp_path / "in", tmp_path / "out"
    folder.mkdir()
    program = (
        "import stillpath.cli.batch.worker_pool as pool, sys\n"
        "from tests.cli.batch.pretending import PretendedWorker\n"
        "pool.LocalWorker = PretendedWorker\n"
        "from stillpath.cli.main import run\n"
        f"sys.exit(run(['watch', {str(folder)!r}, '-m', 'ender3', '-o', {str(out)!r},"
        " '--settle-s', '0.2', '--every-s', '0.5', '--jobs', '2']))\n"
    )
    environment = os.environ | {"PYTHONPATH": PYTHONPATH, "PRETENDED_DELAY_S": "0.15"}
    rng = random.Random(7)
    names = [f"part{n:02}" for n in range(12)]
    told: Counter[str] = Counter()

    def start() -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, "-c", program], env=environment, stderr=subprocess.PIPE, text=True
        )

    for _ in range(4):
        process = start()
        for name in [names.pop() for _ in range(3) if names]:
            temporary = folder / f"{name}.tmp"
            temporary.write_text(f"G28 ; {name}\n")
            temporary.rename(folder / f"{name}.gcode")
        time.sleep(0.6 + rng.random() * 1.5)
        process.send_signal(signal.SIGKILL)
        told.update(_done(process.communicate()[1]))
    process = start()
    deadline = time.monotonic() + 120
    done = out / "ender3"
    while len(list(done.glob("*.gcode"))) < 12 and time.monotonic() < deadline:
        time.sleep(0.1)
    process.send_signal(signal.SIGTERM)
    told.update(_done(process.communicate(timeout=60)[1]))
    assert process.returncode == 0
    for n in range(12):
        result = out / f"ender3/part{n:02}.stillpath.gcode"
        assert result.read_text() == f"; compensated for ender3\nG28 ; part{n:02}\n"
        assert (out / f"reports/ender3/part{n:02}.gcode/report.html").exists()
    assert max(told.values()) == 1
    assert not list((out / ".stillpath/work").iterdir())
    assert not list(folder.glob("*.error.txt"))


def _done(text: str) -> list[str]:
    return [line.split(" ")[0] for line in text.splitlines() if ": done: " in line]
