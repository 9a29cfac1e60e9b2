"""The best-tuned shaper: same optimum as brute force, and its cache."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from stillpath.models.machine import Machine
from stillpath.models.reference_motion import reference_motion, reference_motion_of
from stillpath.models.store import builtin_machines, load_machine
from stillpath.pipeline.measuring import reference_shaper
from stillpath.pipeline.measuring.reference_shaper import (
    FREQUENCIES_HZ,
    BestShaper,
    cached_shaper,
    evaluate_shaper,
    tune_shaper,
    tuning_digest,
)


def changed(machine: Machine) -> Machine:
    """Return a machine whose X and Y have each other's plants."""
    axes = {"x": machine.axes["y"], "y": machine.axes["x"]}
    return machine.model_copy(update={"axes": axes})


def test_reference_motion_is_a_planner_s() -> None:
    y_d, extruding = reference_motion()
    velocity = np.diff(y_d, axis=1) / 1e-3
    assert 20 < y_d.shape[1] * 1e-3 < 30
    assert len(extruding) == y_d.shape[1]
    assert 0.6 < extruding.mean() < 0.95
    assert np.hypot(*velocity).max() <= 250 + 1e-6
    # Corners at 5 mm/s: a reversal steps by 10, and one sample may hold two such corners.
    assert np.hypot(*np.diff(velocity, axis=1)).max() < 25
    assert np.all(velocity[:, 0] ** 2 < 10)
    assert np.all(velocity[:, -1] == 0)


def test_same_optimum_as_brute_force(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a third of the grid and a short motion, every type and pair."""
    monkeypatch.setattr(reference_shaper, "FREQUENCIES_HZ", FREQUENCIES_HZ[::3])
    y_d, extruding = reference_motion()
    y_d, extruding = y_d[:, 9000:13000] - y_d[:, 9000:9001], extruding[9000:13000]
    machine = load_machine("voron-v24-250")
    best = tune_shaper(machine, y_d, 1e-3, extruding)
    trial = reference_shaper._Trial(machine, y_d, 1e-3, extruding)
    count = len(reference_shaper.FREQUENCIES_HZ)
    value, kind, i, j = min(
        (trial.rms(kind, i, j, 10**6), kind, i, j)
        for kind in ("zv", "mzv")
        for i in range(count)
        for j in range(count)
    )
    assert best.contour_rms_um <= 1e3 * value * 1.01
    if best.type in ("zv", "mzv"):
        assert (best.type, best.fx_hz, best.fy_hz) == (
            kind,
            reference_shaper.FREQUENCIES_HZ[i],
            reference_shaper.FREQUENCIES_HZ[j],
        )


def test_shifted_copies_are_the_shaped_command() -> None:
    """The shortcut (plant first, then shaper) gives the figure of the long way."""
    machine = load_machine("ender3")
    y_d, extruding = reference_motion()
    y_d, extruding = y_d[:, :6000], extruding[:6000]
    # The long way measures every second sample.
    trial = reference_shaper._Trial(machine, y_d, 1e-3, np.arange(6000) % 2 == 0)
    long_way = evaluate_shaper(
        machine, y_d, 1e-3, np.ones(6000, bool), "ei", FREQUENCIES_HZ[40], FREQUENCIES_HZ[22]
    )
    assert trial.rms("ei", 40, 22, 10**6) * 1e3 == pytest.approx(long_way.contour_rms_um, rel=1e-6)


def test_a_machine_is_tuned_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []

    def tune(*_: object) -> BestShaper:
        calls.append(1)
        return BestShaper("mzv", 40.0, 50.0, 0.1, 1.5, 20.0)

    monkeypatch.setattr(reference_shaper, "tune_shaper", tune)
    machine = changed(load_machine("ender3"))
    folder = tmp_path / "cache"
    first = cached_shaper(machine, folder)
    assert cached_shaper(machine, folder) == first
    assert len(calls) == 1
    (file,) = folder.iterdir()
    # What the best shaper does not depend on.
    assert cached_shaper(machine.model_copy(update={"title": "Mine"}), folder) == first
    assert len(calls) == 1
    for broken in ("", "{", "[]", json.dumps({"type": "mzv"}), '{"type": 1}'):
        file.write_text(broken)
        assert cached_shaper(machine, folder) == first
    assert len(calls) == 6
    assert json.loads(file.read_text())["fx_hz"] == 40.0
    # Where nothing can be written, it is tuned each time.
    assert cached_shaper(machine, file) == first
    assert len(calls) == 7


@pytest.mark.parametrize("name", builtin_machines())
def test_that_of_a_built_in_machine_comes_with_the_program(name: str, tmp_path: Path) -> None:
    """After a change of such a machine: python benchmarks/reference_shapers.py --write."""
    best = cached_shaper(load_machine(name), tmp_path)
    assert best.contour_rms_um > 0
    assert list(tmp_path.iterdir()) == []


def test_what_it_depends_on() -> None:
    machine = load_machine("ender3")
    firmware = machine.firmware
    slow = firmware.planner.model_copy(update={"max_velocity_mm_s": 150.0})
    limited = machine.model_copy(update={"firmware": firmware.model_copy(update={"planner": slow})})
    others = {tuning_digest(other) for other in (limited, changed(machine))}
    assert len(others | {tuning_digest(machine)}) == 3
    assert tuning_digest(machine.model_copy(update={"title": "Mine"})) == tuning_digest(machine)


def test_what_comes_with_the_program_is_what_is_found(tmp_path: Path) -> None:
    machine = load_machine("voron-v0")
    shipped = cached_shaper(machine, tmp_path)
    y_d, extruding = reference_motion_of(machine)
    found = tune_shaper(machine, y_d, 1e-3, extruding)
    assert (found.type, found.fx_hz, found.fy_hz) == (shipped.type, shipped.fx_hz, shipped.fy_hz)
    assert found.contour_rms_um == pytest.approx(shipped.contour_rms_um, rel=1e-9)
