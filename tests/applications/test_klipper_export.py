"""`stillpath klipper export` and `simulate --live`."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

from stillpath.applications.live.export import write_export
from stillpath.cli.main import run
from stillpath.compensation.base import DesignError
from stillpath.compensation.defaults import DT_S
from stillpath.models.firmware import Marlin
from stillpath.models.store import load_machine
from stillpath.pipeline.compensate import compensate_file
from stillpath.pipeline.file_motion import FileMotion
from stillpath.pipeline.files import default_cache_dir
from stillpath.pipeline.live_design import design_live, live_filter
from stillpath.pipeline.measuring.reference_shaper import cached_shaper
from stillpath.pipeline.options import Options
from stillpath.pipeline.simulate import simulate_motion
from tests.integrations.interrupted import two_objects

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("name", ["ender3", "annex-k3"])
def test_no_member_is_worse_than_with_the_shaper(name: str) -> None:
    machine = load_machine(name)
    made = design_live(machine, cached_shaper(machine, default_cache_dir()))
    assert made.worst <= 1.001
    assert made.mean < 1.0
    assert made.peak_accel_mm_s2 <= machine.command.accel_mm_s2
    late = np.arange(made.taps.shape[1]) - made.taps.shape[1] // 2
    assert made.taps.sum(axis=1) == pytest.approx(1.0, abs=1e-13)
    assert made.taps @ late == pytest.approx(0.0, abs=1e-10)


def test_an_export_is_signed_and_made_again_the_same(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, again = tmp_path / "a.json", tmp_path / "b.json"
    assert run(["klipper", "export", "-m", "voron-v24-250", "-o", str(first)]) == 0
    said = capsys.readouterr().out
    write_export(load_machine("voron-v24-250"), again)
    assert first.read_bytes() == again.read_bytes()
    document = json.loads(first.read_text())
    digest = document.pop("digest")
    text = json.dumps(document, sort_keys=True, separators=(",", ":"))
    assert hashlib.sha256(text.encode()).hexdigest() == digest
    assert digest[:12] in said
    assert document["kinematics"] == "corexy"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.json", "b.json"]


def test_other_firmwares_are_refused(tmp_path: Path) -> None:
    machine = load_machine("ender3").model_copy(update={"firmware": Marlin()})
    with pytest.raises(DesignError, match="only Klipper has print-time compensation"):
        write_export(machine, tmp_path / "out.json")
    assert not list(tmp_path.iterdir())


def test_live_is_about_as_good_as_the_file(tmp_path: Path) -> None:
    machine = load_machine("ender3")
    source = tmp_path / "in.gcode"
    source.write_text(two_objects())
    shaper = cached_shaper(machine, default_cache_dir())
    live = live_filter(machine, design_live(machine, shaper).taps)
    motion = FileMotion(source, None, machine, None, DT_S, None)
    ours = simulate_motion(motion, live=live)
    file = compensate_file(source, tmp_path / "out.gcode", machine, Options())
    error = {
        kind: {c.name: c.extruding.contour_rms_um for c in result.channels}
        for kind, result in (("live", ours), ("file", file))
    }
    assert error["live"]["before"] == pytest.approx(error["file"]["before"], rel=0.03)
    assert error["live"]["after"] <= 1.5 * error["file"]["after"]
    assert error["live"]["after"] < error["live"]["shaper"]
    assert ours.time_s == ours.original_time_s


def test_simulate_live_writes_a_report(tmp_path: Path) -> None:
    source = tmp_path / "in.gcode"
    source.write_text(two_objects())
    report = tmp_path / "report"
    given = ["simulate", str(source), "-m", "ender3", "--live", "--report", str(report)]
    assert run(given) == 0
    document = json.loads((report / "report.json").read_text())
    assert [c["name"] for c in document["channels"]] == ["before", "after", "shaper"]
