"""Bad files through the whole command line: a clear message, exit code 2, nothing left behind."""

from __future__ import annotations

import contextlib
import json
import os
import random
import signal
import subprocess
import time
from itertools import cycle
from pathlib import Path

import pytest

from stillpath.cli.main import run
from stillpath.models.machine import Machine
from stillpath.models.store import load_machine
from tests.checkout import PYTHONPATH
from tests.service.jobs.site import STILLPATH

ROOT = Path(__file__).resolve().parents[2]
START = "G28\nG1 X10 Y10 F6000\n"
JUNK = random.Random(1).randbytes(20_000)

BAD = {
    "empty": (b"", ["is empty"]),
    "junk": (JUNK, []),
    "binary": (b"GCDE\x01\x00\x00\x00\x01\x00" + JUNK, []),
    "zeros": (bytes(5000), []),
    "no moves": (b"; hello\nM104 S200\n", ["no moves"]),
    "huge": (f"{START}G1 X{'9' * 40} Y3\n".encode(), ["line 3", "X"]),
    "unparsable": (f"{START}G1 X1..2 Y3\n".encode(), ["line 3", "1..2"]),
    "no speed": (f"{START}G1 X20 F0\n".encode(), ["line 3", "F0"]),
    "outside": (f"{START}G1 X5000 Y10\n".encode(), ["line 3", "5000", "310"]),
}


@pytest.mark.parametrize(
    ("name", "where"), list(zip(BAD, cycle(("beside", "in place")), strict=False))
)
def test_bad_files(name: str, where: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    content, words = BAD[name]
    source = tmp_path / "part.gcode"
    source.write_bytes(content)
    target = ["--in-place"] if where == "in place" else ["-o", str(tmp_path / "out.gcode")]
    assert run(["compensate", str(source), *target, "-m", "ender3"]) == 2
    message = capsys.readouterr().err
    assert message.startswith("stillpath: error: ")
    assert message.count("\n") == 1
    for word in words:
        assert word in message
    assert source.read_bytes() == content
    assert list(tmp_path.iterdir()) == [source]


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"kinematics": "delta"}, "kinematics"),
        ({"travel": {}}, "travel"),
        ({"colour": "blue"}, "colour"),
        ({"axes": {}}, "axes"),
        ({"axes": "unstable"}, "pole"),
        *(
            ({"firmware": {"kind": "klipper", "planner": {name: value}}}, f"of X is {value:g} mm/s")
            for name in ("max_velocity_mm_s", "max_accel_mm_s2")
            for value in (1e30, 1e-3)
        ),
    ],
)
def test_bad_machines(change: dict, word: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    good: Machine = load_machine("ender3")
    document = good.model_dump(mode="json") | change
    if document["axes"] == "unstable":
        plant = {"kind": "tf", "num": [-0.1], "den": [1.0, -1.1], "dt_s": 0.001}
        document["axes"] = {axis: {"nominal": plant} for axis in "xy"}
    machine, source = tmp_path / "machine.json", tmp_path / "part.gcode"
    machine.write_text(json.dumps(document))
    source.write_text(START)
    code = run(["compensate", str(source), "-o", str(tmp_path / "o"), "-m", str(machine)])
    message = capsys.readouterr().err
    assert code == 2, message
    assert word in message
    assert sorted(tmp_path.iterdir()) == [machine, source]


def test_a_processed_file_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    source, once = tmp_path / "part.gcode", tmp_path / "once.gcode"
    source.write_text(START + "G1 X60 Y10 E2\nG1 X60 Y60 E4\nG1 X10 Y10 E6\n")
    assert run(["compensate", str(source), "-o", str(once), "-m", "ender3"]) == 0
    capsys.readouterr()
    again = ["compensate", str(once), "-o", str(tmp_path / "twice.gcode"), "-m", "ender3"]
    assert run(again) == 2
    assert "already" in capsys.readouterr().err
    assert not (tmp_path / "twice.gcode").exists()


def writes_into(folder: Path, pid: int) -> bool:
    """Whether a process has begun a file there; on Linux it has no name yet."""
    links = []
    for handle in Path("/proc").glob(f"{pid}/fd/*"):
        with contextlib.suppress(OSError):  # closed meanwhile
            links.append(str(handle.readlink()))
    return any(folder.iterdir()) or any(link.startswith(f"{folder}/") for link in links)


@pytest.mark.skipif(os.name != "posix", reason="sends signals")
def test_an_interrupted_command_leaves_nothing(tmp_path: Path):
    source = ROOT / "examples" / "cura_ender3_gear24.gcode"
    target = tmp_path / "out.gcode"
    command = [*STILLPATH, "compensate", str(source), "-o", str(target), "-m", "ender3"]
    process = subprocess.Popen(
        command, cwd=tmp_path, stderr=subprocess.PIPE, env=os.environ | {"PYTHONPATH": PYTHONPATH}
    )
    deadline = time.monotonic() + 300
    while not writes_into(tmp_path, process.pid) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert process.poll() is None
    process.send_signal(signal.SIGTERM)
    _, error = process.communicate(timeout=300)
    assert process.returncode == 143
    assert list(tmp_path.iterdir()) == []
    assert b"Traceback" not in error
