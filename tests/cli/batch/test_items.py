"""What files and folders stand for."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from stillpath.cli.arguments import CommandRefused
from stillpath.cli.batch.items import Group, items_of, parse_map, result_name
from stillpath.models.errors import ModelError


def fill(folder: Path, *names: str, text: str = "G28\n") -> None:
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


def test_a_folder_stands_for_its_print_files(tmp_path):
    fill(tmp_path, "b.gcode", "sub/a.BGCODE", "c.gcode.3mf", "notes.txt", ".trash/x.gcode")
    fill(tmp_path, "old.stillpath.gcode", ".hidden.gcode", "out/m/b.gcode", "b.gcode.error.txt")
    fill(tmp_path, "renamed.gcode", text="; Processed by stillpath 1 machine=x\nG28\n")
    items = items_of([tmp_path], Group(("m",)), output=tmp_path / "out")
    assert [item.place for item in items] == ["b.gcode", "c.gcode.3mf", "sub/a.BGCODE"]
    assert items[2].output("m") == "m/sub/a.stillpath.BGCODE"
    assert items[2].report("m") == "reports/m/sub/a.BGCODE"


def test_a_file_counts_once_and_for_each_machine(tmp_path):
    fill(tmp_path, "a.gcode")
    items = items_of([tmp_path / "a.gcode", tmp_path], Group(("m", "n")), output=tmp_path / "out")
    assert [(i.place, i.machine) for i in items] == [("a.gcode", "m"), ("a.gcode", "n")]


def test_two_files_of_one_name_are_refused(tmp_path):
    fill(tmp_path, "x/a.gcode", "y/a.gcode")
    with pytest.raises(ModelError, match=r"would both become a\.stillpath\.gcode"):
        items_of([tmp_path / "x", tmp_path / "y"], Group(("m",)), output=tmp_path / "out")
    assert len(items_of([tmp_path], Group(("m",)), output=tmp_path / "out")) == 2


@pytest.mark.parametrize("output", ["plates", "plates/../plates/.", "."])
def test_a_folder_within_the_output_is_refused(tmp_path, output):
    fill(tmp_path, "plates/a.gcode")
    with pytest.raises(ModelError, match=r"--output .*plates.*; name an output folder in it"):
        items_of([tmp_path / "plates"], Group(("m",)), output=tmp_path / output)
    # A file that was named is done all the same.
    named = items_of([tmp_path / "plates/a.gcode"], Group(("m",)), output=tmp_path / output)
    assert [item.place for item in named] == ["a.gcode"]


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(CommandRefused, match=r"nothing\.gcode does not exist"):
        items_of([tmp_path / "nothing.gcode"], Group(("m",)), output=tmp_path / "out")


@pytest.mark.skipif(sys.platform == "win32", reason="makes a named pipe")
def test_pipes_are_refused(tmp_path):
    os.mkfifo(tmp_path / "pipe.gcode")
    with pytest.raises(CommandRefused, match="is a pipe or a device"):
        items_of([tmp_path / "pipe.gcode"], Group(("m",)), output=tmp_path / "out")


def test_machines_by_pattern():
    group = parse_map("a, b", ["petg_*=c", "plates/*=d,e"])
    assert group.of("petg_part.gcode") == ("c",)
    assert group.of("deep/petg_part.gcode") == ("c",)
    assert group.of("plates/x.gcode") == ("d", "e")
    assert group.of("x.gcode") == ("a", "b")
    assert parse_map(None, ["x*=c"]).of("y.gcode") == ("",)


@pytest.mark.parametrize("entry", ["petg", "=m", "x*=", "x*=,"])
def test_patterns_that_say_nothing(entry):
    with pytest.raises(ModelError, match="PATTERN=MACHINE"):
        parse_map("m", [entry])


def test_no_machine_at_all():
    with pytest.raises(ModelError, match="--machine"):
        parse_map(None, [])


@pytest.mark.parametrize(
    ("name", "result"),
    [
        ("part.gcode", "part.stillpath.gcode"),
        ("part.gcode.3mf", "part.stillpath.gcode.3mf"),
        ("v1.2/part", "v1.2/part.stillpath.gcode"),
        ("part.bgcode", "part.stillpath.bgcode"),
    ],
)
def test_names_of_results(name, result):
    assert result_name(name) == result
