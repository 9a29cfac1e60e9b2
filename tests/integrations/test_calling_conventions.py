"""Slicers call the program: their ways told in `conventions`, its answers from the real process."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.integrations.conventions import (
    posix_call,
    superslicer_call,
    windows_call,
    windows_quote,
    windows_split,
)
from tests.integrations.posting import PROGRAM, environment

TEXT = b"G28\nG1 X10 Y10 F6000\n"
NAMES = (
    ".8_0.gcode.pp",
    ".PrusaSlicer.upload.1a2b-3c4d-5e6f-7a8b",
    'it\'s "two" parts.gcode',
    "büste – Größe 2.gcode",
    "$HOME `id` $(id) \\ * ;&|<>#!.gcode",
    "-o.gcode",
    "new\nline.gcode",
)
SHELLS = [shell for name in ("sh", "bash", "dash", "zsh") if (shell := shutil.which(name))]
Call = Callable[[str, str, str], list[str]]


@pytest.fixture
def program(tmp_path: Path) -> Path:
    """The command as pip installs it: a file of its own in a folder of programs."""
    path = tmp_path / "bin" / "stillpath-post"
    path.parent.mkdir()
    called = f"exec {shlex.quote(sys.executable)} {shlex.quote(str(PROGRAM))}"
    path.write_text(f'#!/bin/sh\n{called} "$@"\n')
    path.chmod(0o755)
    return path


def run(call: list[str], tmp_path: Path, **more: str) -> subprocess.CompletedProcess[bytes]:
    """As slicers do: stderr is read to its end; stdout and stdin are whatever the slicer has."""
    with subprocess.Popen(
        call,
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        env=environment(tmp_path, **more),
    ) as process:
        assert process.stderr is not None
        said = process.stderr.read()
        return subprocess.CompletedProcess(call, process.wait(60), None, said)


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="calls shells")
@pytest.mark.parametrize(
    ("call", "name"),
    [*((posix_call, name) for name in NAMES), *((superslicer_call, name) for name in NAMES[2:5:2])],
)
def test_paths_of_all_kinds(address: str, program: Path, tmp_path: Path, call: Call, name: str):
    folder = tmp_path / "Meine Drucke (ä'\")"
    folder.mkdir()
    path = folder / name
    path.write_bytes(TEXT)
    line = f"{program} --server {address} --machine ender3"
    said = {"SLIC3R_PP_HOST": "OctoPrint", "SLIC3R_PP_OUTPUT_NAME": "part.gcode"}
    done = run(call(line, str(path), SHELLS[0]), tmp_path, **said)
    assert (done.returncode, done.stderr) == (0, b"")
    assert path.read_bytes() == b"; compensated\n" + TEXT
    assert [p.name for p in folder.iterdir()] == [name]
    assert (tmp_path / "data" / "stillpath" / "reports" / "part.stillpath.html").is_file()


@pytest.mark.skipif(os.name != "posix", reason="calls shells")
@pytest.mark.parametrize("shell", SHELLS)
def test_shells_and_quoted_options(address: str, tmp_path: Path, shell: str):
    """The user's line is raw shell: what he quotes is one argument."""
    alone = tmp_path / "my tools" / "stillpath_post.py"
    alone.parent.mkdir()
    alone.write_bytes(PROGRAM.read_bytes())
    settings = tmp_path / "my settings.toml"
    settings.write_text(f'server = "{address}"\n[machines]\n"My *" = "ender3"\n')
    path = tmp_path / "part.gcode"
    path.write_bytes(TEXT)
    line = f"'{sys.executable}' -I '{alone}' --config \"{settings}\""
    done = run(posix_call(line, str(path), shell), tmp_path, SLIC3R_PRINTER_SETTINGS_ID="My MK4")
    assert (done.returncode, done.stderr) == (0, b"")
    assert path.read_bytes() == b"; compensated\n" + TEXT


@pytest.mark.skipif(os.name != "posix", reason="calls shells")
def test_superslicer_finds_the_interpreter_of_a_script(address: str, tmp_path: Path):
    path = tmp_path / "part.gcode"
    path.write_bytes(TEXT)
    call = superslicer_call(f"{PROGRAM} --server {address} --machine ender3", str(path))
    assert call[2].startswith("python3 /")
    done = run(call, tmp_path)
    assert (done.returncode, done.stderr) == (0, b"")
    assert path.read_bytes() == b"; compensated\n" + TEXT


@pytest.mark.skipif(os.name != "posix", reason="calls shells")
def test_a_failure_is_what_the_slicer_shows(address: str, program: Path, tmp_path: Path):
    path = tmp_path / ".8_0.gcode.pp"
    path.write_bytes(b"bad\n")
    renamed = tmp_path / ".8_0.gcode.pp.output_name"
    renamed.write_text("better.gcode\n")
    line = f"{program} --server {address} --machine ender3"
    done = run(posix_call(line, str(path)), tmp_path, SLIC3R_PP_HOST="File")
    assert done.returncode == 2
    assert done.stderr == b"stillpath-post: line 7: X1e400 is too large ('G1 X1e400')\n"
    assert path.read_bytes() == b"bad\n"
    assert renamed.read_text() == "better.gcode\n"


# Windows: the rules as functions


def test_what_windows_documents():
    """The examples of Microsoft's *Parsing C command-line arguments*."""
    for rest, arguments in (
        ('"a b c" d e', ["a b c", "d", "e"]),
        (r'"ab\"c" "\\" d', ['ab"c', "\\", "d"]),
        (r'a\\\b d"e f"g h', [r"a\\\b", "de fg", "h"]),
        (r"a\\\"b c d", [r"a\"b", "c", "d"]),
        (r'a\\\\"b c" d e', [r"a\\b c", "d", "e"]),
        ('a"b"" c d', ['ab" c d']),
    ):
        assert windows_split(f"x.exe {rest}") == ["x.exe", *arguments]


@given(st.lists(st.text(st.characters(codec="utf-8", exclude_characters="\0")), max_size=4))
def test_every_argument_survives_windows(arguments: list[str]):
    line = " ".join(["x.exe", *map(windows_quote, arguments)])
    assert windows_split(line) == ["x.exe", *arguments]


@pytest.mark.parametrize("name", [name for name in NAMES if not set(name) & set('"*|<>\n')])
@pytest.mark.parametrize(
    ("line", "begin"),
    [
        (r"C:\Stillpath\stillpath-post.exe", [r"C:\Stillpath\stillpath-post.exe"]),
        (
            r'"C:\Program Files\Stillpath\stillpath-post.exe" --machine "my machine"',
            [r"C:\Program Files\Stillpath\stillpath-post.exe", "--machine", "my machine"],
        ),
        (
            r'"C:\Python 3\python.exe" "C:\my tools\stillpath_post.py" --server http://nas:8000',
            [
                r"C:\Python 3\python.exe",
                r"C:\my tools\stillpath_post.py",
                "--server",
                "http://nas:8000",
            ],
        ),
    ],
)
def test_lines_of_the_documents_on_windows(line: str, begin: list[str], name: str):
    path = f"C:\\Users\\Jürgen Groß\\AppData\\Local\\Temp\\{name}"
    programs = {begin[0]}
    called = windows_call(line, path, programs.__contains__)
    assert windows_split(called) == [*begin, path]
    with pytest.raises(FileNotFoundError):
        windows_call("stillpath-post --machine m", path, programs.__contains__)
