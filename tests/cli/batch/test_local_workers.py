"""Real processes: what they do, and how they die."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from stillpath.service.processes import METHOD, loaded_context
from tests.checkout import PYTHONPATH
from tests.service.jobs.site import STILLPATH

ROOT = Path(__file__).parents[3]
PRINT = "G28\n" + "".join(f"G1 X{20 + 15 * (n % 2)} Y{20 + 5 * n} E{n} F6000\n" for n in range(20))

pytestmark = [pytest.mark.slow, pytest.mark.skipif(os.name != "posix", reason="kills processes")]


def children(pid: int) -> list[int]:
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            text = path.read_text()
        except OSError:
            continue
        if int(text.rpartition(")")[2].split()[1]) == pid:
            found.append(int(path.parent.name))
    return found


def worker_processes(pid: int) -> list[int]:
    """The processes that work: copies of the one that loads the libraries, or our own children."""
    mothers = [child for child in children(pid) if b"forkserver" in command_line(child)]
    if mothers:
        return [child for mother in mothers for child in children(mother)]
    return [child for child in children(pid) if b"spawn_main" in command_line(child)]


def command_line(pid: int) -> bytes:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return b""


@pytest.fixture
def files(tmp_path) -> Path:
    folder = tmp_path / "in"
    folder.mkdir()
    for n in range(3):
        (folder / f"part{n}.gcode").write_text(PRINT + f"; {n}\n")
    return folder


def start(folder: Path, *more: str) -> subprocess.Popen[str]:
    arguments = ["batch", str(folder), "-m", "ender3", "-o", str(folder.parent / "out"), *more]
    return subprocess.Popen(
        [*STILLPATH, *arguments],
        env=os.environ | {"PYTHONPATH": PYTHONPATH},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def test_a_batch_for_real(files):
    with start(files, "--jobs", "2") as process:
        stdout, stderr = process.communicate(timeout=600)
    assert process.returncode == 0, stderr
    assert "3 done" in stdout
    summary = json.loads((files.parent / "out/summary.json").read_text())
    assert all(row["after_um"] < row["before_um"] for row in summary["files"])
    assert (files.parent / "out/reports/ender3/part0.gcode/report.html").exists()


def test_a_process_that_dies_costs_one_file(files):
    with start(files, "--jobs", "1") as process:
        deadline = time.monotonic() + 120
        while not worker_processes(process.pid) and time.monotonic() < deadline:
            time.sleep(0.02)
        os.kill(worker_processes(process.pid)[0], signal.SIGKILL)
        _, stderr = process.communicate(timeout=600)
    assert process.returncode == 1
    assert "ended by signal 9" in stderr
    assert len(list((files.parent / "out/ender3").iterdir())) == 2
    with start(files, "--jobs", "1") as process:
        stdout, _ = process.communicate(timeout=600)
    assert process.returncode == 0
    assert "1 done, 2 done before" in stdout


def test_processes_end_with_their_parent(files):
    with start(files, "--jobs", "2") as process:
        deadline = time.monotonic() + 120
        while len(worker_processes(process.pid)) < 2 and time.monotonic() < deadline:
            time.sleep(0.02)
        working = worker_processes(process.pid)
        time.sleep(1)
        process.send_signal(signal.SIGKILL)
        process.communicate(timeout=60)
    deadline = time.monotonic() + 60
    while any(Path(f"/proc/{pid}").exists() for pid in working) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not any(Path(f"/proc/{pid}").exists() for pid in working)
    with start(files, "--jobs", "2") as process:
        process.communicate(timeout=600)
    assert process.returncode == 0
    assert not list((files.parent / "out/.stillpath/work").iterdir())


@pytest.mark.skipif(METHOD != "forkserver", reason="processes are no copies here")
def test_processes_begin_with_the_libraries_loaded():
    ours, theirs = multiprocessing.Pipe()
    with ours, theirs:
        process = loaded_context().Process(target=tell_loaded, args=(theirs,))
        process.start()
        loaded = ours.recv()
        process.join()
        process.close()
    assert {"numba", "scipy", "stillpath.pipeline.compensate", "stillpath.reports"} <= loaded


def tell_loaded(connection):
    connection.send(set(sys.modules))
