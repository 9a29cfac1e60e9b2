"""What the program for slicers reads: the slicer's environment, the user's settings; and that it
is quick and needs nothing."""

from __future__ import annotations

import argparse
import ast
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import stillpath_post
from stillpath_post import Failure, PrintJob, Settings, read_settings

from tests.integrations.conventions import windows_split
from tests.integrations.cura import SCRIPT
from tests.integrations.octoprint import PLUGIN
from tests.integrations.posting import PROGRAM, ROOT, post

OUTPUT = "SLIC3R_PP_OUTPUT_NAME"
HOST = "SLIC3R_PP_HOST"


def settings(tmp_path: Path, text: str = "", **given: Any) -> Settings:
    file = tmp_path / "post.toml"
    file.write_text(text, encoding="utf-8")
    names = vars(stillpath_post._parser().parse_args(["part.gcode"]))
    return Settings(argparse.Namespace(**{**names, "config": str(file), **given}))


# The printer and its machine

MACHINES = """
machine = "fallback"
[machines]
"MK4 *" = "some-mk4"
"MK4 fast" = "fast-mk4"
"Größe *mm" = "big"
"""


@pytest.mark.parametrize(
    ("printers", "machine"),
    [
        (["MK4 fast", "MK4"], "fast-mk4"),
        (["mk4 SLOW"], "some-mk4"),
        (["my own", "MK4 0.4 nozzle"], "some-mk4"),
        (["Größe 300 mm"], "big"),
        (["MK4"], "fallback"),
        (["XMK4 1"], "fallback"),
        ([], "fallback"),
    ],
)
def test_the_printer_chooses_the_machine(tmp_path: Path, printers: list[str], machine: str):
    assert settings(tmp_path, MACHINES).machine_for(printers) == machine
    assert settings(tmp_path, MACHINES, machine="told").machine_for(printers) == "told"


def test_an_unknown_printer_is_told_with_the_line_to_write(tmp_path: Path):
    with pytest.raises(Failure) as caught:
        settings(tmp_path).machine_for(['Voron "2.4" ü'])
    line = re.search(r'write (".* = "NAME")', str(caught.value))
    assert line is not None
    assert str(tmp_path) in str(caught.value)
    assert caught.value.code == 2
    made = settings(tmp_path, f"[machines]\n{line[1]}\n")
    assert made.machine_for(['Voron "2.4" ü']) == "NAME"


def test_names_of_the_printer_in_the_environment(tmp_path: Path):
    environment = {
        "SLIC3R_PRINTER_MODEL": "MK4",
        "SLIC3R_PRINTER_SETTINGS_ID": '"My \\"MK4\\" 0.4";"other"',
        "SLIC3R_PHYSICAL_PRINTER_SETTINGS_ID": "",
        "SLIC3R_GCODE_FLAVOR": "klipper",
    }
    job = PrintJob(tmp_path / "x.gcode", environment=environment)
    assert job.printers == ['My "MK4" 0.4', "MK4"]
    assert job.flavour == "klipper"
    assert PrintJob(tmp_path / "x.gcode", "told", environment).printers == ["told"]


# The finished file


def test_the_report_goes_beside_the_finished_file(tmp_path: Path):
    temporary = tmp_path / ".8_0.gcode.pp"
    finished = tmp_path / "out" / "büste v2.gcode"
    finished.parent.mkdir()

    def job(**said: object) -> PrintJob:
        return PrintJob(temporary, environment={k: str(v) for k, v in said.items()})

    plain = job(**{HOST: "File", OUTPUT: finished})
    assert (plain.folder, plain.name, plain.stem) == (finished.parent, finished.name, "büste v2")
    assert job(**{HOST: "File", OUTPUT: tmp_path / "gone" / "a.gcode"}).folder is None
    sent = job(**{HOST: "OctoPrint", OUTPUT: "folder/a.gcode"})
    assert (sent.folder, sent.stem) == (None, "a")
    # BambuStudio: the output is its own temporary file.
    assert job(**{HOST: "File", OUTPUT: temporary}).folder is None
    assert job().stem == "8_0"


def test_another_script_may_have_renamed_the_output(tmp_path: Path):
    temporary, elsewhere = tmp_path / "x.gcode.pp", tmp_path / "elsewhere"
    elsewhere.mkdir()
    note = tmp_path / "x.gcode.pp.output_name"
    environment = {HOST: "File", OUTPUT: str(tmp_path / "a.gcode")}
    for line, folder in (("b.gcode", tmp_path), (str(elsewhere / "b.gcode"), elsewhere)):
        note.write_text(f"{line}\nand more\n")
        job = PrintJob(temporary, environment=environment)
        assert (job.folder, job.stem) == (folder, "b")
        assert note.read_text() == f"{line}\nand more\n"


@pytest.mark.parametrize(
    ("name", "stem"),
    [
        ("a.gcode", "a"),
        ("a.b.GCODE", "a.b"),
        ("a.bgcode", "a"),
        ("plate_1.gcode.3mf", "plate_1"),
        ("no-extension", "no-extension"),
        (".gcode", "gcode"),
    ],
)
def test_stems(tmp_path: Path, name: str, stem: str):
    assert PrintJob(tmp_path / "x", environment={OUTPUT: name, HOST: "Duet"}).stem == stem


# Settings

GOOD = """\
# ümlaut
server = "http://nas:8000"  # a comment
key = 'a "b" # c'
on-error = "keep"
timeout = 2.5
wait = 600

[machines]
"A \\"quoted\\" \\u00e9 # name" = "m1"
'single \\ quotes' = "m2"
bare-name = "m3"
"""


def test_the_plain_reader_agrees_with_the_library(tmp_path: Path):
    tomllib = pytest.importorskip("tomllib")
    for text in (
        GOOD,
        stillpath_post.TEMPLATE,
        re.sub('(?m)^# (?=[a-z"].*= )', "", stillpath_post.TEMPLATE),
    ):
        assert stillpath_post._plain_toml(text, tmp_path) == tomllib.loads(text)
    for wrong in (
        "x = {b = 1}",
        'log = "C:\\Users\\me\\x.log"',
        "timeout = 007",
        '[machines]\n"MK4" = "mine"',
    ):
        with pytest.raises(Failure, match=r"line [23]: cannot be read: .* single quotes"):
            stillpath_post._plain_toml(f"machines = 1\n{wrong}\n", tmp_path)


def test_the_command_line_counts_more_than_the_settings(tmp_path: Path, monkeypatch):
    monkeypatch.delenv("STILLPATH_KEY", raising=False)
    read = settings(tmp_path, GOOD)
    assert (read.server, read.key, read.timeout, read.wait) == (
        "http://nas:8000",
        'a "b" # c',
        2.5,
        600.0,
    )
    told = settings(tmp_path, GOOD, server="http://b", timeout=1.0, local=False)
    assert (told.server, told.timeout) == ("http://b", 1.0)
    assert settings(tmp_path, GOOD, local=True).server == ""


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("servr = 'x'", ("servr", "server")),
        ("timeout = 'x'", ("timeout", "type")),
        ("timeout = 0", ("timeout is 0 s", "more than 0")),
        ("timeout = 1e8", ("timeout is 1e+08 s", "less than 10000000 s")),
        ("machines = 3", ("machines",)),
        ("on_error = 'maybe'", ("on_error", "keep")),
        ("a = \n", ("line 1",)),
    ],
)
def test_bad_settings_are_named(tmp_path: Path, text: str, words: tuple[str, ...]):
    with pytest.raises(Failure) as caught:
        settings(tmp_path, text)
    for word in words:
        assert word in str(caught.value)


@pytest.mark.parametrize("wrong", ["wait = 0", "timeout = 'x'", "servr = 'x'"])
def test_keeping_counts_for_wrong_settings_too(tmp_path: Path, wrong: str):
    (tmp_path / "post.toml").write_text(f'{wrong}\non-error = "keep"\n')
    (tmp_path / "x.gcode").write_text("G28\n")
    done = post("--config", "post.toml", "x.gcode", home=tmp_path)
    assert done.returncode == 0
    assert "NOT compensated" in done.stderr


@pytest.mark.parametrize(
    ("platform", "environment", "path"),
    [
        ("linux", {"XDG_CONFIG_HOME": "/c"}, "/c/stillpath/post.toml"),
        ("linux", {}, "~/.config/stillpath/post.toml"),
        ("darwin", {}, "~/Library/Application Support/stillpath/post.toml"),
        ("win32", {"APPDATA": "/roaming"}, "/roaming/stillpath/post.toml"),
        ("linux", {"STILLPATH_POST_CONFIG": "/x.toml"}, "/x.toml"),
    ],
)
def test_where_settings_lie(monkeypatch, platform: str, environment: dict[str, str], path: str):
    monkeypatch.setattr(sys, "platform", platform)
    for name in ("XDG_CONFIG_HOME", "APPDATA", "STILLPATH_POST_CONFIG"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    assert stillpath_post.default_settings_path() == Path(path).expanduser()


def test_a_user_without_a_home(monkeypatch, capsys):
    """Some services run as such."""
    monkeypatch.setattr(os.path, "expanduser", lambda path: path)
    for name in ("XDG_CONFIG_HOME", "STILLPATH_POST_CONFIG"):
        monkeypatch.delenv(name, raising=False)
    assert stillpath_post.main(["x.gcode"]) == 2
    said = "stillpath-post: this user has no home folder; set HOME to one\n"
    assert capsys.readouterr().err == said


def test_set_up_makes_settings_once_and_shows_the_line(tmp_path: Path):
    done = post("--setup", home=tmp_path)
    assert done.returncode == 0
    made = tmp_path / "config" / "stillpath" / "post.toml"
    assert str(made) in done.stdout
    assert done.stdout.rstrip().endswith(str(PROGRAM))
    assert read_settings(made) == {"machines": {}}
    made.write_text("machine = 'mine'\n")
    assert post("--setup", home=tmp_path).returncode == 0
    assert made.read_text() == "machine = 'mine'\n"


def test_the_line_for_windows_survives_its_quoting(tmp_path: Path, monkeypatch, capsys):
    program = "C:\\Program Files\\Stillpath\\stillpath-post"
    monkeypatch.setattr(sys, "argv", [program])
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setattr(Path, "absolute", lambda self: self)
    stillpath_post._set_up(settings(tmp_path), stillpath_post.Voice())
    line = capsys.readouterr().out.splitlines()[-1].strip()
    assert windows_split(line) == [f"{program}.exe"]


# Mistakes


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), ("no FILE",)),
        (("--bogus", "x.gcode"), ("--bogus",)),
        (("--tolerance-um", "two", "x.gcode"), ("--tolerance-um", "two")),
        (("--machine", "ender3", "gone.gcode"), ("there is no file", "gone.gcode")),
        (("--machine", "ender3", "."), ("is a folder",)),
        (("--config", "gone.toml", "x.gcode"), ("gone.toml",)),
        (("empty.gcode",), ("empty.gcode", "empty")),
        (("x.gcode",), ("no machine",)),
        (
            ("--log", "~no.such.user/x.log", "x.gcode"),
            ("no log: ~no.such.user/x.log", "no machine"),
        ),
        (("--machine", "ender3", "circle.gcode"), ("there is no file", "circle.gcode")),
    ],
)
def test_mistakes_are_one_line(tmp_path: Path, arguments: tuple[str, ...], words: tuple[str, ...]):
    (tmp_path / "empty.gcode").touch()
    (tmp_path / "x.gcode").write_text("G28\n")
    (tmp_path / "circle.gcode").symlink_to("circle.gcode")
    done = post(*arguments, home=tmp_path)
    errors = [line for line in done.stderr.splitlines() if ": warning: " not in line]
    assert (done.returncode, len(errors), done.stdout) == (2, 1, "")
    for word in words:
        assert word in done.stderr


def test_without_the_package_a_server_is_asked_for(tmp_path: Path):
    alone = tmp_path / "stillpath_post.py"
    alone.write_bytes(PROGRAM.read_bytes())
    (tmp_path / "x.gcode").write_text("G28\n")
    command = [sys.executable, "-I", "-S", str(alone)]  # no packages but Python's own
    done = post("--machine", "ender3", "x.gcode", home=tmp_path, command=command)
    assert done.returncode == 2
    assert "--server URL" in done.stderr


# Quick, and alone


def test_nothing_heavy_is_imported_before_the_work():
    code = f"""
import json, sys
sys.path.insert(0, {str(PROGRAM.parent)!r})
import stillpath_post
for arguments in (["--help"], ["--bogus"], ["--machine", "ender3", "/gone.gcode"]):
    try:
        stillpath_post.main(arguments)
    except SystemExit:
        pass
print(json.dumps(sorted(sys.modules)))
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT
    )
    loaded = {name.partition(".")[0] for name in json.loads(done.stdout.splitlines()[-1])}
    assert not loaded & {"numpy", "numba", "scipy", "pydantic", "typer", "rich", "service"}


@pytest.mark.parametrize(
    ("path", "allowed"),
    [
        (PROGRAM, {"stillpath"}),  # asked for only when no server is named
        (SCRIPT, {"UM", "Script"}),
        *(
            (path, {"flask", "octoprint"} if path.name in ("__init__.py", "hosting.py") else set())
            for path in sorted((PLUGIN / "octoprint_stillpath").glob("*.py"))
        ),
    ],
    ids=lambda value: value.name if isinstance(value, Path) else "",
)
def test_they_need_python_3_8_and_its_standard_library_only(path: Path, allowed: set[str]):
    imported = set()
    for node in ast.walk(ast.parse(path.read_bytes(), feature_version=(3, 8))):
        if isinstance(node, ast.Import):
            imported |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and not node.level:
            imported.add((node.module or "").partition(".")[0])
    assert imported - allowed <= set(sys.stdlib_module_names)


def test_one_client_in_all_files():
    client = re.compile(r"(?s)# Client of the service:.*# End of the client\.\n")
    files = (PROGRAM, SCRIPT, PLUGIN / "octoprint_stillpath" / "client.py")
    found = [client.findall(file.read_text("utf-8")) for file in files]
    assert found[0] == found[1] == found[2]
    assert len(found[0]) == 1
