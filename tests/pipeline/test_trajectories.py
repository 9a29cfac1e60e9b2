"""Tables of the motion: against the plan, the written file and distances worked out plainly."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stillpath.cli.main import run
from stillpath.gcode.errors import GcodeError
from stillpath.gcode.firmware.writing import StreamWriter
from stillpath.models.store import load_machine
from stillpath.pipeline.compensate import compensate_file
from stillpath.pipeline.options import Options
from stillpath.pipeline.progress import Progress, StopWork
from stillpath.pipeline.simulate import plan_file
from stillpath.pipeline.trajectories import TrajectoryFormat, write_trajectories
from stillpath.simulation.measures import contour_error
from tests.gcode.container_files import binary, package
from tests.gcode.cutting import HEAD
from tests.gcode.prints import polygon

SMALL = HEAD + ";LAYER_CHANGE\n;Z:0.2\nG1 X120 Y100 F6000\n" + "\n".join(polygon(6, 15)) + "\n"


@pytest.fixture
def source(tmp_path: Path) -> Path:
    path = tmp_path / "in.gcode"
    path.write_text(SMALL)
    return path


def load(path: Path) -> dict[str, np.ndarray]:
    with np.load(path) as found:
        return dict(found)


@pytest.mark.slow
def test_the_whole_print(source: Path, tmp_path: Path, cache: Path) -> None:
    machine, options = load_machine("ender3"), Options()
    target = tmp_path / "t.npz"
    rows = write_trajectories(source, target, machine, options, format="npz", cache_dir=cache)
    table = load(target)
    assert {len(v) for v in table.values()} == {rows}
    assert np.allclose(table["t_s"], 1e-3 * np.arange(rows))
    planned = np.stack([table["x_mm"], table["y_mm"]])
    for name in ("before", "after"):
        simulated = np.stack([table[f"{name}_sim_x_mm"], table[f"{name}_sim_y_mm"]])
        expected = 1e3 * contour_error(planned, simulated)
        assert table[f"{name}_contour_um"] == pytest.approx(expected, abs=1e-6)
    report = compensate_file(source, tmp_path / "o.gcode", machine, options, cache_dir=cache)
    for channel in report.channels[:2]:
        error = table[f"{channel.name}_contour_um"][table["extruding"] > 0]
        rms = float(np.sqrt(np.mean(error**2)))
        assert rms == pytest.approx(channel.extruding.contour_rms_um, rel=1e-6)
        # The print ends with its last line: the nozzle stands on it and rings.
        behind = table["t_s"] > table["t_s"][table["extruding"] > 0][-1]
        most = max(float(error.max()), float(table[f"{channel.name}_contour_um"][behind].max()))
        assert most == pytest.approx(channel.extruding.contour_max_um, rel=1e-6)
    # The written file is planned by itself, and moves as the table says.
    plan_file(tmp_path / "o.gcode", tmp_path / "p.npz", machine)
    own = load(tmp_path / "p.npz")
    after = np.stack([table["after_x_mm"], table["after_y_mm"]])
    path = np.stack([own["x"], own["y"]])
    for k in range(0, rows, 97):
        assert np.min(np.hypot(*(path - after[:, k : k + 1]))) < 0.11  # 1 ms at 100 mm/s
    lines = SMALL.split("\n")
    assert all(lines[k - 1].startswith("G1") for k in np.unique(table["line"]))
    assert set(table["layer"]) <= {-1, 0}


def test_a_machine_stands_where_its_line_ended(tmp_path: Path, cache: Path) -> None:
    """Not where the last sample before the end was: that would be a jump when motion goes on."""
    source = tmp_path / "in.gcode"
    source.write_text(HEAD + "M204 S3000\nG1 X70 Y20 F9000\nG4 P300\nG1 X90 Y31 E3\nG4 P300\n")
    target = tmp_path / "t.npz"
    machine, options = load_machine("ender3"), Options(method="none")
    write_trajectories(source, target, machine, options, format="npz", cache_dir=cache)
    table = load(target)
    for line, x_mm, y_mm in ((-2, 70.0, 20.0), (-1, 90.0, 31.0)):
        at = np.flatnonzero((np.diff(table["x_mm"]) == 0.0) & (abs(table["x_mm"][1:] - x_mm) < 0.1))
        assert len(at) > 250, line
        for name in ("x_mm", "after_x_mm"):
            np.testing.assert_allclose(table[name][at + 1], x_mm, atol=1e-9)
        np.testing.assert_allclose(table["y_mm"][at + 1], y_mm, atol=1e-9)


@pytest.mark.parametrize("options", [Options(), Options(method="advise")])
def test_a_part_of_it_as_text(source: Path, tmp_path: Path, cache: Path, options: Options) -> None:
    machine = load_machine("ender3")
    whole, part = tmp_path / "w.npz", tmp_path / "p.csv"
    write_trajectories(source, whole, machine, options, format="npz", cache_dir=cache)
    rows = write_trajectories(
        source, part, machine, options, window_s=(0.25, 0.75), cache_dir=cache
    )
    table = load(whole)
    with part.open(newline="") as file:
        read = list(csv.DictReader(file))
    assert rows == len(read) == 500
    assert list(read[0]) == list(table)
    assert ("before_contour_um" in read[0]) == (options.method != "advise")
    for name, values in table.items():
        column = np.array([float(row[name]) for row in read])
        assert column == pytest.approx(values[250:750], abs=6e-3)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["in.gcode", "p.csv", "w.npz"]


def test_of_a_live_job_to_its_end_in_any_container(tmp_path: Path, cache: Path) -> None:
    machine, options, text = load_machine("ender3"), Options(method="live"), SMALL.encode()
    sources = {"a.gcode": text, "b.bgcode": binary(text), "c.gcode.3mf": package({1: text})}
    found, target = [], tmp_path / "t.csv"
    for name, data in sources.items():
        source = tmp_path / name
        source.write_bytes(data)
        write_trajectories(
            source, target, machine, options, window_s=(0.5, np.inf), cache_dir=cache
        )
        found.append(target.read_text())
    assert found == [found[0]] * 3


def test_an_advised_file_tells_its_progress_and_can_be_cancelled(
    source: Path, tmp_path: Path, cache: Path
) -> None:
    seen: list[Progress] = []

    def cancel(progress: Progress) -> None:
        seen.append(progress)
        if progress.fraction > 0.85:
            raise StopWork

    with pytest.raises(StopWork):
        write_trajectories(
            *(source, tmp_path / "t.csv", load_machine("ender3"), Options(method="advise")),
            cache_dir=cache,
            progress=cancel,
        )
    read = next(k for k, one in enumerate(seen) if one.stage == "planning")
    assert any(one.stage == "verifying" for one in seen[:read])
    assert max(one.fraction for one in seen[:read]) <= 0.8 <= seen[read].fraction
    assert [p.name for p in tmp_path.iterdir()] == ["in.gcode"]


def test_the_same_bytes(source: Path, tmp_path: Path, cache: Path) -> None:
    machine = load_machine("ender3")
    for form in ("csv", "npz"):
        made = []
        for name in ("one", "two"):
            target = tmp_path / f"{name}.{form}"
            write_trajectories(
                source,
                target,
                machine,
                Options(),
                format=form,
                window_s=(0.0, 0.3),
                cache_dir=cache,
            )
            made.append(target.read_bytes())
        assert made[0] == made[1]


@pytest.mark.parametrize("form", ["npz", "csv"])
def test_a_section_that_the_last_check_reverts_is_as_sliced(
    source: Path,
    tmp_path: Path,
    cache: Path,
    monkeypatch: pytest.MonkeyPatch,
    form: TrajectoryFormat,
) -> None:
    right, target = StreamWriter.piece, tmp_path / f"t.{form}"

    def wrong(self: StreamWriter, *given: Any) -> bytes:
        return right(self, *given) + b"M117 not of the file\n"

    monkeypatch.setattr(StreamWriter, "piece", wrong)
    options, machine = Options(method="shaper:mzv"), load_machine("ender3")
    rows = write_trajectories(source, target, machine, options, format=form, cache_dir=cache)
    if form == "npz":
        table = load(target)
    else:
        with target.open(newline="") as lines:
            found = list(csv.DictReader(lines))
        table = {name: np.array([float(row[name]) for row in found]) for name in found[0]}
    assert {len(v) for v in table.values()} == {rows}
    assert np.allclose(table["t_s"], 1e-3 * np.arange(rows))
    assert np.array_equal(table["after_x_mm"], table["x_mm"])


@pytest.mark.parametrize(
    ("start_s", "stop_s", "message"),
    [
        (2.0, 1.0, "2 s to 1 s is not a period"),
        (-1.0, None, "not a period"),
        (1e5, None, r"nothing moves from 100000 s on: the print ends at [\d.]+ s"),
    ],
)
def test_no_such_time(
    source: Path, tmp_path: Path, cache: Path, start_s: float, stop_s: float | None, message: str
) -> None:
    with pytest.raises(GcodeError, match=message):
        write_trajectories(
            source,
            tmp_path / "t.csv",
            load_machine("ender3"),
            Options(),
            window_s=(start_s, stop_s),
            cache_dir=cache,
        )
    assert [p.name for p in tmp_path.iterdir()] == ["in.gcode"]


def test_from_the_command_line(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / "t.NPZ"
    given = ["trajectories", str(source), "-m", "ender3", "-o", str(target)]
    assert run([*given, "--from", "0.1", "--to", "0.3"]) == 0
    assert "200 rows" in capsys.readouterr().out
    assert len(load(target)["t_s"]) == 200
    assert run([*given, "--format", "xlsx"]) == 2
    assert run([*given, "--budget-um", "0"]) == 2
    assert "csv or npz" in capsys.readouterr().err
    assert run([*given[:-1], str(source)]) == 2
    assert source.read_text() == SMALL
    assert run([*given, "--method", "magic"]) == 2
    assert "method" in capsys.readouterr().err
