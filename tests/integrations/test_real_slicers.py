"""Whole ways: PrusaSlicer and CuraEngine slice, the real pipeline compensates."""

from __future__ import annotations

import os
import re
import shlex
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.gcode.container_files import binary, package
from tests.gcode.cutting import HEAD
from tests.gcode.prints import polygon
from tests.integrations.cura import Cura, layers_of
from tests.integrations.posting import PROGRAM, environment, finish, post, start
from tests.integrations.slicers import box, cura_definitions, cura_engine, prusa_slicer

pytestmark = pytest.mark.slow

COMMAND = shlex.join([sys.executable, str(PROGRAM)])
STAMP = b"; Processed by stillpath "
TEXT = (HEAD + "G1 X120 Y100 F6000\n" + "\n".join(polygon(6, 15)) + "\n").encode()


# On this computer


@pytest.mark.parametrize(
    ("name", "content", "begins"),
    [
        (".8_0.gcode.pp", TEXT, b";"),
        ("upload", binary(TEXT), b"GCDE"),
        ("plate.gcode.3mf", package({1: TEXT}), b"PK"),
    ],
)
def test_every_kind_of_file(tmp_path: Path, name: str, content: bytes, begins: bytes):
    path = tmp_path / "prints" / name
    path.parent.mkdir()
    path.write_bytes(content)
    done = post("--machine", "ender3", "--no-report", path, home=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    made = path.read_bytes()
    assert made.startswith(begins)
    assert made != content
    assert [p.name for p in path.parent.iterdir()] == [name]
    again = post("--machine", "ender3", path, home=tmp_path)
    assert again.returncode == 2
    assert re.match(r"stillpath-post: line \d+: this file was already processed", again.stderr)
    assert path.read_bytes() == made


@pytest.mark.skipif(os.name != "posix" or sys.platform == "darwin", reason="names are text there")
def test_a_name_that_is_not_text(tmp_path: Path):
    path = tmp_path / os.fsdecode(b"pi\xe8ce.gcode")
    path.write_bytes(TEXT)
    done = post("--machine", "ender3", path, home=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert STAMP in path.read_bytes()
    report = path.with_name(os.fsdecode(b"pi\xe8ce.stillpath.html"))
    assert "pi?ce.gcode" in report.read_text()


def test_what_cannot_be_done_here(tmp_path: Path):
    path = tmp_path / "x.gcode"
    content = b"G28\nG1 X10 F6000\nG1 X9999\n"
    path.write_bytes(content)
    for arguments, words in (
        ((), ("line 3", "9999")),
        (("--method", "magic"), ("method", "magic")),
        (("--machine", "nope"), ("nope", "ender3")),
    ):
        done = post("--machine", "ender3", *arguments, path, home=tmp_path)
        assert (done.returncode, done.stderr.count("\n")) == (2, 1), done
        for word in words:
            assert word in done.stderr
        assert path.read_bytes() == content


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGKILL, -9)])
def test_being_stopped_at_work(tmp_path: Path, number: int, code: int):
    path = tmp_path / "prints" / "x.gcode"
    path.parent.mkdir()
    # Long enough that no computer has ended before the first line of progress.
    content = TEXT + ("\n".join(polygon(6, 15)) + "\n").encode() * 40_000
    path.write_bytes(content)
    process = start("--machine", "ender3", path, home=tmp_path)
    assert process.stdout is not None
    for line in process.stdout:
        if "compensating" in line:
            process.send_signal(number)
            break
    assert finish(process).returncode == code
    assert path.read_bytes() == content
    if number != signal.SIGKILL:
        assert [p.name for p in path.parent.iterdir()] == [path.name]


# PrusaSlicer


def slice_with_prusa(tmp_path: Path, *scripts: str) -> tuple[subprocess.CompletedProcess, Path]:
    program = prusa_slicer()
    folder = tmp_path / "Meine Drucke (ä)"
    folder.mkdir()
    target = folder / "it's büste.gcode"
    settings = {
        "post_process": ";".join(scripts),
        "gcode_flavor": "marlin",
        "machine_limits_usage": "ignore",
        "printer_settings_id": "My Ender (0.4 mm)",
    }
    config = tmp_path / "config.ini"
    config.write_text("".join(f"{name} = {value}\n" for name, value in settings.items()))
    call = [program, "--export-gcode", "--load", config, "--center", "100,100", "-o", target]
    done = subprocess.run(
        [*call, box(tmp_path / "box.stl", 12, 8, 0.6)],
        capture_output=True,
        text=True,
        env=environment(tmp_path, LC_ALL="C.UTF-8", SHELL="/bin/sh"),
        check=False,
    )
    return done, target


def test_prusaslicer_compensates_at_export(tmp_path: Path):
    settings = tmp_path / "config" / "stillpath" / "post.toml"
    settings.parent.mkdir(parents=True)
    settings.write_text('[machines]\n"My Ender *" = "ender3"\n')
    done, target = slice_with_prusa(tmp_path, COMMAND)
    assert done.returncode == 0, done
    made = target.read_bytes()
    assert STAMP in made
    assert b"machine=ender3" in made
    assert made.count(b";LAYER_CHANGE") == 2
    assert b"; prusaslicer_config = end" in made
    names = {p.name for p in target.parent.iterdir()}
    report = target.with_name("it's büste.stillpath.html")
    assert names == {target.name, report.name}
    # Scripts get the whole file, with its end.
    assert "it was cut off" not in report.read_text()


@pytest.mark.parametrize(
    ("scripts", "words"),
    [
        ((f"{COMMAND} --machine nope",), ("no machine is called 'nope'", "Error code: 2")),
        ((COMMAND,), ('no machine is set for the printer "My Ender (0.4 mm)"',)),
    ],
)
def test_prusaslicer_shows_why_it_failed(
    tmp_path: Path, scripts: tuple[str, ...], words: tuple[str, ...]
):
    done, target = slice_with_prusa(tmp_path, *scripts)
    assert done.returncode != 0
    for word in words:
        assert word in done.stderr
    # As PrusaSlicer's command line leaves it: whole, as it was sliced.
    assert target.read_bytes().startswith(b"; generated by PrusaSlicer")
    assert b"; prusaslicer_config = end" in target.read_bytes()
    assert [p.name for p in target.parent.iterdir()] == [target.name]


def test_prusaslicer_with_the_script_twice(tmp_path: Path):
    line = f"{COMMAND} --machine ender3 --no-report"
    done, target = slice_with_prusa(tmp_path, line, line)
    assert done.returncode != 0
    assert re.search(r": line \d+: this file was already processed by stillpath", done.stderr)
    assert STAMP in target.read_bytes()


def test_prusaslicer_keeps_what_was_sliced(tmp_path: Path):
    done, target = slice_with_prusa(tmp_path, f"{COMMAND} --machine nope --on-error keep")
    assert done.returncode == 0
    assert target.read_bytes().startswith(b"; generated by PrusaSlicer")


# Cura


def slice_with_cura(tmp_path: Path) -> str:
    program, definitions = cura_engine(), cura_definitions()
    folders = f"{definitions}:{definitions.parent / 'extruders'}"
    target = tmp_path / "cura.gcode"
    chosen = {
        "machine_start_gcode": "G28\nG92 E0",
        "machine_end_gcode": "M104 S0\nM84",
        "roofing_layer_count": 0,
        "machine_width": 200,
        "machine_depth": 200,
        "center_object": "true",
        "layer_height": 0.2,
    }
    options = [word for key, value in chosen.items() for word in ("-s", f"{key}={value}")]
    subprocess.run(
        [
            program,
            "slice",
            "-j",
            definitions / "fdmprinter.def.json",
            *options,
            "-o",
            target,
            "-l",
            box(tmp_path / "box.stl", 12, 8, 0.7),
        ],
        capture_output=True,
        env=environment(tmp_path, CURA_ENGINE_SEARCH_PATH=folders),
        check=True,
    )
    return target.read_text()


def test_layers_of_cura_engine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    text = slice_with_cura(tmp_path)
    layers = layers_of(text)
    assert "".join(layers) == text
    for name, value in environment(tmp_path).items():
        monkeypatch.setenv(name, value)
    cura = Cura()
    cura.install(monkeypatch)
    script: Any = cura.load()
    script.values |= {"command": COMMAND, "machine": "ender3", "reports": str(tmp_path / "reports")}
    made = cura.write_started([script], list(layers))
    assert cura.shown[-1][0] == "POSITIVE", cura.shown
    assert len(made) == len(layers)
    assert STAMP.decode() in "".join(made[:2])
    assert made[0].endswith(";POSTPROCESSED\n")
    for before, after in zip(layers[1:], made[1:], strict=True):
        assert after.splitlines()[0] == before.splitlines()[0]
    report = tmp_path / "reports" / "part.stillpath.html"
    assert "it was cut off" not in report.read_text()
    # As a whole it is what the program makes of the whole file.
    whole = tmp_path / "whole.gcode"
    whole.write_text(text)
    assert post("--machine", "ender3", "--no-report", whole, home=tmp_path).returncode == 0
    # (but for the numbers of lines: Cura adds one of its own).
    texts = ["".join(made).replace(";POSTPROCESSED\n", ""), whole.read_text()]
    ours, theirs = (re.sub(r", line \d+ of the original", "", one) for one in texts)
    assert ours == theirs
