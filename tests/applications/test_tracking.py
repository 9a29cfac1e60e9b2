"""The command `track`: full preview of a short path, checked from outside."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import toeplitz

from stillpath.applications.design.tracking import read_path, track
from stillpath.cli.main import run
from stillpath.compensation.base import DesignError
from stillpath.models.plants import discretise
from stillpath.models.store import load_machine


def path(samples: int = 400) -> np.ndarray:
    """From 5 mm, two tones within the band, in full motion at the end."""
    t = np.arange(samples) * 1e-3
    return 5 + 3 * np.sin(2 * np.pi * 7 * t) + 0.5 * (1 - np.cos(2 * np.pi * 23 * t))


def columns(file: Path) -> dict[str, np.ndarray]:
    with file.open(newline="") as lines:
        rows = list(csv.DictReader(lines))
    return {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}


def test_the_command_is_the_least_squares_solution_of_the_dissertation() -> None:
    """(2.10) and (3.22), with numpy alone."""
    y = path()
    found = track(load_machine("taz6-x"), "x", y, functions=150, rest_s=0.0)
    spec = load_machine("taz6-x").axes["x"].without_delay().nominal
    g = toeplitz(discretise(spec, 1e-3).impulse_response(400), np.zeros(400))
    _, sigma, wt = np.linalg.svd(g)
    phi = wt[:150].T
    u = phi @ np.linalg.lstsq(g @ phi, y - y[0], rcond=None)[0]
    np.testing.assert_allclose(found.command_mm, y[0] + u, atol=1e-8)
    np.testing.assert_allclose(found.output_mm, y[0] + g @ u, atol=1e-8)
    relative = np.linalg.norm(y - y[0] - g @ u) / np.linalg.norm(y - y[0])
    assert found.error == pytest.approx(relative, rel=1e-6)
    assert found.effort == pytest.approx(np.linalg.norm(u) / np.linalg.norm(y - y[0]), rel=1e-6)
    assert found.j_e == pytest.approx(np.sqrt(1 - 150 / 400), rel=1e-9)
    assert found.j_c == pytest.approx(np.sqrt(np.sum(sigma[:150] ** -2.0) / 400), rel=1e-6)


def test_ce_opt_needs_the_least_effort_of_all_bases() -> None:
    """Chapter 3, and remark 2.6: J_e is the same for all."""
    made = {
        basis: track(load_machine("taz6-x"), "x", path(), basis=basis, functions=200, rest_s=0.0)
        for basis in ("ce-opt", "dct", "bspline")
    }
    assert len({round(each.j_e, 6) for each in made.values()}) == 1
    assert 100 * made["ce-opt"].j_c < min(made["dct"].j_c, made["bspline"].j_c)


@pytest.mark.parametrize("nominal", ["ensemble", "optimum", "frequency"])
def test_a_nominal_model_of_the_set_helps_its_worst_plant(nominal: str) -> None:
    plain = track(load_machine("ender3"), "x", path())
    robust = track(load_machine("ender3"), "x", path(), nominal=nominal)  # type: ignore[arg-type]
    assert max(robust.members) < 0.85 * max(plain.members)
    assert np.mean(robust.members) < np.mean(plain.members)


@pytest.mark.parametrize("basis", ["ce-opt", "robust", "bspline", "dct"])
@pytest.mark.parametrize("machine", ["ender3", "voron-v0", "voron-v24-250", "annex-k3"])
def test_the_default_number_holds_a_slow_path(machine: str, basis: str) -> None:
    """What these plants answer most lies beside their resonance, which the path does not need."""
    t = np.arange(300) * 1e-3
    found = track(load_machine(machine), "x", 10 * (1 - np.cos(9 * t)), basis=basis)
    assert max(found.members) < 0.02


def test_optimum_and_robust_functions_are_the_robust_least_squares_of_the_set() -> None:
    """Docs/fbf.md: proposition 4.2 with (4.28) is ensemble least squares with robust functions."""
    machine, y = load_machine("ender3"), path(250)
    one = track(machine, "x", y, basis="robust", functions=90, nominal="optimum", rest_s=0.1)
    two = track(machine, "x", y, basis="robust", functions=90, nominal="ensemble", rest_s=0.1)
    np.testing.assert_allclose(one.command_mm, two.command_mm, atol=1e-5)
    assert one.j_er == pytest.approx(two.j_er, rel=1e-6)
    assert one.j_er < track(machine, "x", y, functions=90, rest_s=0.1).j_er


def test_the_command_writes_the_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source, target = tmp_path / "path.csv", tmp_path / "out.csv"
    np.savetxt(source, path(), fmt="%.4f")
    command = ["track", str(source), "-m", "taz6-x", "--axis", "x", "-o", str(target)]
    assert run([*command, "--functions", "150", "--rest-s", "0.05"]) == 0
    said = capsys.readouterr().out
    assert "150 functions of 450 samples" in said
    table = columns(target)
    assert list(table) == ["t_s", "path_mm", "command_mm", "output_mm"]
    np.testing.assert_allclose(table["path_mm"][:400], path(), atol=1e-4)
    assert table["t_s"][-1] == pytest.approx(0.449)
    np.testing.assert_allclose(table["path_mm"][400:], table["path_mm"][399])
    # The path begins in full motion, which no command can follow from a standstill.
    assert np.abs(table["output_mm"] - table["path_mm"])[100:400].max() < 0.05


def test_paths_come_from_tables_too(tmp_path: Path) -> None:
    """As `stillpath trajectories` writes them."""
    file = tmp_path / "table.csv"
    file.write_text("t_s,x_mm,y_mm\n0.000,1,2\n0.001,1.5,2.5\n")
    np.testing.assert_array_equal(read_path(file, "x"), [1.0, 1.5])
    np.testing.assert_array_equal(read_path(file, "y"), [2.0, 2.5])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "is empty"),
        ("1\n", "1 samples"),
        ("1\nnan\n2\n", "row 2"),
        ("t_s,z_mm\n0,1\n1,2\n", "no column is called x_mm"),
        ("x_mm,y_mm\n1,2\n3\n4,hello\n,5\n", "row 5"),
        ("1\n1\n1\n", "stays at 1 mm"),
        ("\n".join(map(str, range(2900))), "at most 3000 ms"),
    ],
)
def test_a_wrong_path_is_refused(
    text: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source, target = tmp_path / "path.csv", tmp_path / "out.csv"
    source.write_text(text)
    command = ["track", str(source), "-m", "taz6-x", "--axis", "x", "-o", str(target)]
    assert run(command) == 2
    assert said in capsys.readouterr().err
    assert not target.exists()


def test_what_needs_a_set_is_refused_without_one() -> None:
    machine = load_machine("taz6-x")
    axis = machine.axes["x"].model_copy(update={"members": ()})
    alone = machine.model_copy(update={"axes": machine.axes | {"x": axis}})
    for wrong in ({"basis": "robust"}, {"nominal": "frequency"}):
        with pytest.raises(DesignError, match="needs a set of plants"):
            track(alone, "x", path(), **wrong)  # type: ignore[arg-type]
    for wrong in ({"basis": "sine"}, {"nominal": "best"}):
        with pytest.raises(DesignError, match="there are"):
            track(machine, "x", path(), **wrong)  # type: ignore[arg-type]
    with pytest.raises(DesignError, match="no axis"):
        track(machine, "z", path())
