"""`stillpath identify --ripple`: passes in, a machine that knows its ripple out."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from pathlib import Path

import pytest

from stillpath.applications.identification.ripple import parse_basis
from stillpath.applications.machines.store import MachineStore
from stillpath.cli.main import run
from stillpath.models.errors import ModelError
from stillpath.models.store import read_machine
from tests.models.test_ripple_passes import log, machine


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("STILLPATH_DATA_DIR", str(tmp_path / "data"))
    (tmp_path / "base.json").write_text(machine().model_dump_json())
    (tmp_path / "pass.csv").write_text(log())
    return tmp_path


def learn(folder: Path, *more: str) -> int:
    return run(
        ["identify", str(folder / "pass.csv"), "--axis", "x", "--ripple", "belt:2:1,2", *more]
    )


def test_a_file_as_output(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = folder / "out.json"
    assert learn(folder, "--base", str(folder / "base.json"), "-o", str(out)) == 0
    said = capsys.readouterr().out
    assert "harmonic 1: 20.0" in said
    assert "Hz from folding" in said
    first = read_machine(out.read_bytes()).ripple["x"].sources[0].harmonics[0]
    assert first.amplitude_um == pytest.approx(20.0, rel=0.01)


@pytest.mark.parametrize(
    "written", [lambda text: gzip.compress(text.encode()), lambda text: text.encode("utf-16")]
)
def test_a_pass_is_stored_as_any_measurement_may_be(
    written: Callable[[str], bytes], folder: Path
) -> None:
    (folder / "pass.csv").write_bytes(written(log()))
    assert learn(folder, "--base", str(folder / "base.json")) == 0


def test_revisions_of_a_machine(folder: Path) -> None:
    assert learn(folder, "--base", str(folder / "base.json"), "-m", "mine") == 0
    (folder / "pass.csv").write_text(log(share=0.5))
    assert learn(folder, "-m", "mine", "--gain", "0.5") == 0
    store = MachineStore(folder / "data" / "machines")
    current = store.current("mine")
    assert current.number == 2
    base = machine()
    told = f"all but the ripple of axis X is of {base.title} ({base.name}): {base.source}"
    assert current.machine.source == told
    amplitude = current.machine.ripple["x"].sources[0].harmonics[0].amplitude_um
    assert amplitude == pytest.approx(15.0, rel=0.01)


def test_refusals_leave_nothing(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "pass.csv").write_text(log(comment=""))
    out = folder / "out.json"
    assert learn(folder, "--base", str(folder / "base.json"), "-o", str(out)) == 2
    assert "was homed" in capsys.readouterr().err
    assert not out.exists()
    assert run(["identify", str(folder / "pass.csv"), "--ripple", "belt:2"]) == 2
    assert "--axis" in capsys.readouterr().err
    (folder / "pass.csv").write_text(log())
    (folder / "again.csv").write_text(log())
    for more, word in (
        (("--gain", "1.5"), "gain 1.5"),
        ((str(folder / "again.csv"),), "is a copy"),
    ):
        assert learn(folder, *more, "-m", "mine", "--base", str(folder / "base.json")) == 2
        assert word in capsys.readouterr().err
    assert "mine" not in MachineStore(folder / "data" / "machines")


def test_a_report_that_ripple_has_not_is_refused(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert learn(folder, "--base", str(folder / "base.json"), "--report", str(folder / "r")) == 2
    assert "leave --report out" in capsys.readouterr().err
    assert not (folder / "r").exists()


def test_a_file_of_more_rows_than_a_pass_has(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = "0,1,2\n" * 1_002_000
    (folder / "pass.csv").write_text(f"# homed\ntime_s,position_mm,measured_mm\n{rows}")
    assert learn(folder, "--base", str(folder / "base.json")) == 2
    assert "at most 1000000 samples are read" in capsys.readouterr().err


def test_a_title_that_no_machine_has(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = ("--base", str(folder / "base.json"), "-o", str(folder / "out.json"))
    assert learn(folder, *made, "--title", 201 * "t") == 2
    said = capsys.readouterr().err
    assert "title" in said
    assert said.count("\n") == 1


def test_a_basis_is_read_from_its_parts() -> None:
    basis = parse_basis("motor pole:0.8:1,4@output")
    assert (basis.name, basis.pitch_mm, basis.numbers) == ("motor pole", 0.8, (1, 4))
    assert basis.enters == "output"
    assert parse_basis("belt:2").numbers == (1, 2, 3)


@pytest.mark.parametrize(
    "text", [f"{65 * 'b'}:2", "belt", "belt:x", "belt:2:0", "belt:2:1,1", "belt:2@side", ":2"]
)
def test_parts_that_are_not(text: str) -> None:
    with pytest.raises(ModelError, match="--ripple"):
        parse_basis(text)


def test_motors_are_axes_of_ripple_alone(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert learn(folder, "--base", str(folder / "base.json"), "--axis", "a") == 2
    assert "belongs to x or y" in capsys.readouterr().err
    assert run(["identify", str(folder / "pass.csv"), "--axis", "a"]) == 2
    assert "axis" in capsys.readouterr().err
