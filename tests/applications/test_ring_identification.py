"""Plants from a ring test that was written for resonances that somebody typed in."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import date
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import freqs

from stillpath.applications.identification.run import Identified, InputFile, identify_files
from stillpath.applications.machines.envelope import derived_envelope, with_firmware
from stillpath.applications.proof.ring_test import write_ring_test
from stillpath.cli.main import run
from stillpath.cli.own_machines import open_machines
from stillpath.models.errors import ModelError
from stillpath.models.machine import Machine
from stillpath.models.plants import frequency_response
from stillpath.models.store import load_machine
from stillpath.models.typed_in import typed_in
from tests.service.ringing import SENSOR, TRUE, Chain, recorded

TYPED_HZ = {"x": 52.0, "y": 32.0}
"""What is stated; the axes ring at 46 and 36 Hz."""
FIRMWARE = Path(__file__).parents[2] / "examples" / "firmware"


def typed(base: str = "generic-corexy") -> Machine:
    axes = {axis: typed_in(f_hz, 0.07) for axis, f_hz in TYPED_HZ.items()}
    return load_machine(base).model_copy(update={"axes": axes, "name": "mine"})


def with_acceleration(machine: Machine, accel_mm_s2: float) -> Machine:
    firmware = machine.firmware.driven_at(accel_mm_s2)
    slow = machine.model_copy(update={"firmware": firmware})
    return slow.model_copy(update={"command": derived_envelope(slow)})


@pytest.fixture(scope="module")
def ring(cache: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("ring") / "ring.gcode"
    write_ring_test(typed(), path, cache_dir=cache)
    return path


@pytest.fixture(scope="module")
def log(ring: Path) -> InputFile:
    return InputFile("adxl345-ring-3f0c2a.csv", recorded(ring, typed()).raw_data())


@pytest.fixture(scope="module")
def found(ring: Path, log: InputFile) -> Identified:
    return identify_files([test_of(ring), log], typed())


def test_of(ring: Path) -> InputFile:
    return InputFile(ring.name, ring.read_bytes())


test_of.__test__ = False  # type: ignore[attr-defined]


def held_um(chain: Chain) -> float:
    """How far the carriage's friction holds it behind its command."""
    stiffness_n_m = sum(chain.masses_kg) * (2 * np.pi * chain.f_hz[0]) ** 2
    return 1e6 * chain.friction_n / stiffness_n_m


@pytest.mark.parametrize("axis", ["x", "y"])
def test_the_plant_is_that_of_the_bodies(found: Identified, axis: str) -> None:
    """Up to and beyond the mode that rings most, in size and phase."""
    truth = TRUE[axis].spec()
    f_hz = np.arange(5.0, 1.3 * TRUE[axis].f_hz[0], 1.0)
    _, want = freqs(truth.num, truth.den, 2 * np.pi * f_hz)
    got = frequency_response(found.machine.axes[axis].nominal, f_hz)
    missed = np.linalg.norm(got - want) / np.linalg.norm(want)
    stated = frequency_response(typed().axes[axis].nominal, f_hz)
    assert missed < 0.15
    assert np.linalg.norm(stated - want) / np.linalg.norm(want) > 0.7
    assert got[0] == pytest.approx(want[0], abs=0.01)


def test_gentle_stops_are_enough(cache: Path, tmp_path: Path) -> None:
    """At 1000 mm/s2 0.15 N of friction hold .62 kg back by a quarter of what rings."""
    gentle = with_acceleration(typed(), 1000.0)
    write_ring_test(gentle, tmp_path / "ring.gcode", cache_dir=cache)
    content = recorded(tmp_path / "ring.gcode", gentle).raw_data()
    files = [test_of(tmp_path / "ring.gcode"), InputFile("adxl345-ring.csv", content)]
    made = identify_files(files, gentle)
    for axis, chain in TRUE.items():
        truth = chain.spec()
        f_hz = np.arange(5.0, 1.3 * chain.f_hz[0], 1.0)
        _, want = freqs(truth.num, truth.den, 2 * np.pi * f_hz)
        got = frequency_response(made.machine.axes[axis].nominal, f_hz)
        assert np.linalg.norm(got - want) < 0.15 * np.linalg.norm(want)


@pytest.mark.parametrize("axis", ["x", "y"])
def test_dry_friction_is_found(found: Identified, axis: str) -> None:
    friction_mm = found.machine.axes[axis].friction_mm
    assert 1e3 * friction_mm == pytest.approx(held_um(TRUE[axis]), rel=0.5)
    assert not found.machine.axes[axis].friction_assumed


@pytest.mark.slow
def test_where_none_rubs_none_is_found(ring: Path) -> None:
    smooth = {axis: replace(chain, friction_n=0.0) for axis, chain in TRUE.items()}
    content = recorded(ring, typed(), smooth).raw_data()
    made = identify_files([test_of(ring), InputFile("adxl345-a.csv", content)], typed())
    assert all(1e3 * (made.machine.axes[axis].friction_mm or 0.0) < 0.3 for axis in "xy")


def test_the_machine_says_what_it_was_made_of(found: Identified, log: InputFile) -> None:
    about = found.machine.axes["x"].provenance
    assert about is not None
    assert (about.kind, about.sources) == ("ring test", (log.source,))
    assert about.measured_on == date.today()
    assert about.phase == "aligned at low frequency"
    assert len(found.machine.axes["x"].members) > 3


@pytest.mark.slow
def test_friction_that_is_known_is_not_counted_twice(
    ring: Path, log: InputFile, found: Identified
) -> None:
    again = identify_files([test_of(ring), log], found.machine)
    for axis in ("x", "y"):
        before, after = (one.machine.axes[axis].friction_mm for one in (found, again))
        assert after == pytest.approx(before, rel=0.1)


@pytest.mark.slow
def test_two_logs_are_repeats(ring: Path, log: InputFile, found: Identified) -> None:
    sensor = replace(SENSOR, offset_s=33.0, turn_rad=(0.1, 0.5, 0.2))
    other = recorded(ring, typed(), sensor=sensor).raw_data()
    files = [test_of(ring), log, InputFile("adxl345-ring-2.csv", other)]
    both = identify_files(files, typed())
    assert len(both.machine.axes["x"].provenance.sources) == 2
    f_hz = np.arange(5.0, 60.0)
    one, two = (frequency_response(m.machine.axes["x"].nominal, f_hz) for m in (found, both))
    assert np.linalg.norm(one - two) / np.linalg.norm(one) < 0.08


@pytest.mark.slow
def test_a_log_of_one_axis_leaves_the_other_as_it_was(ring: Path) -> None:
    """As of a sensor on the head of a bed slinger, which does not move in Y."""
    content = recorded(ring, typed(), sees=(1.0, 0.0)).raw_data()
    made = identify_files([test_of(ring), InputFile("adxl345-head.csv", content)], typed())
    assert made.machine.axes["y"] == typed().axes["y"]
    assert made.machine.axes["x"].provenance.kind == "ring test"
    (said,) = [note for note in made.report.axes[0].notes if "Y is not measured" in note]
    assert "it is not fixed to the part that moves in Y" in said


@pytest.mark.slow
def test_reprapfirmware_is_measured_by_its_own_recorder(cache: Path, tmp_path: Path) -> None:
    """M956 writes sample numbers in g, a file for each round; identify could make nothing of it."""
    section = json.loads((FIRMWARE / "reprapfirmware.json").read_text())
    machine = with_firmware(typed(), section | {"shaper": {"type": "none"}})
    ring = tmp_path / "ring.gcode"
    write_ring_test(machine, ring, cache_dir=cache)
    record = recorded(ring, machine)
    rate_hz = (len(record.time_s) - 1) / (record.time_s[-1] - record.time_s[0])
    g = record.accel_mm_s2 / 9806.65
    middle = len(g) // 2
    files = [test_of(ring)]
    for number, part in enumerate((g[:middle], g[middle:])):
        rows = "".join(f"{k},{x:.4f},{y:.4f},{z:.4f}\n" for k, (x, y, z) in enumerate(part))
        text = f"Sample,X,Y,Z\n{rows}Rate {rate_hz:.0f}, overflows 0\n"
        files.append(InputFile(f"ring-{number}.csv", text.encode()))
    made = identify_files(files, machine)
    f_hz = np.arange(5.0, 55.0)
    truth = TRUE["x"].spec()
    _, want = freqs(truth.num, truth.den, 2 * np.pi * f_hz)
    got = frequency_response(made.machine.axes["x"].nominal, f_hz)
    assert np.linalg.norm(got - want) / np.linalg.norm(want) < 0.12


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (("ring",), "ring.gcode is a ring test: give what was logged while it ran, too"),
        (("ring", "ring", "log"), "give one ring test with its logs at a time"),
        (("ring", "other"), "other.csv is not of this file"),
        (("endless", "log"), "endless.gcode lasts more than 15 minutes, and a ring test two"),
        (("stuck", "log"), "stuck.gcode: line .*: the move takes .* min at"),
        (
            ("ring", "beginning"),
            "shows 2 stops of X, and 8 are needed: log the whole file",
        ),
    ],
)
def test_what_is_refused(ring: Path, log: InputFile, names: tuple[str, ...], words: str) -> None:
    time_s = np.arange(0.0, 40.0, 1.0 / 3200.0)
    rng = np.random.default_rng(3)
    noise = SENSOR.record(time_s, 300.0 * rng.standard_normal((3, len(time_s))), rng)
    begun = recorded(ring, typed(), part_s=(0.0, 12.5))
    files = {
        "ring": test_of(ring),
        "log": log,
        "stuck": InputFile("stuck.gcode", ring.read_bytes() + b"G1 X100 F2\n"),
        "endless": InputFile("endless.gcode", ring.read_bytes() + b"G1 X100 F6\nG1 X20 F6\n"),
        "other": InputFile("other.csv", noise.raw_data()),
        "beginning": InputFile("beginning.csv", begun.raw_data()),
    }
    with pytest.raises(ModelError, match=words):
        identify_files([files[name] for name in names], typed())


@pytest.mark.slow
@pytest.mark.parametrize("stated", [{"x": 62.0, "y": 26.0}, {"x": 33.0, "y": 50.0}])
def test_the_stated_resonances_may_be_far_off(
    stated: dict[str, float], cache: Path, tmp_path: Path
) -> None:
    axes = {axis: typed_in(f_hz, 0.07) for axis, f_hz in stated.items()}
    machine = typed().model_copy(update={"axes": axes})
    ring = tmp_path / "ring.gcode"
    write_ring_test(machine, ring, cache_dir=cache)
    content = recorded(ring, machine).raw_data()
    made = identify_files([test_of(ring), InputFile("adxl345-a.csv", content)], machine)
    for axis, chain in TRUE.items():
        f_hz = np.arange(5.0, 1.2 * chain.f_hz[0])
        truth = chain.spec()
        _, want = freqs(truth.num, truth.den, 2 * np.pi * f_hz)
        got = frequency_response(made.machine.axes[axis].nominal, f_hz)
        assert np.linalg.norm(got - want) / np.linalg.norm(want) < 0.15


@pytest.mark.slow
def test_on_the_command_line(
    ring: Path, log: InputFile, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    monkeypatch.setenv("STILLPATH_DATA_DIR", str(tmp_path / "data"))
    open_machines().store.add_revision("mine", typed(), author="anna")
    path = tmp_path / log.name
    path.write_bytes(log.content)
    assert run(["identify", str(ring), str(path), "--machine", "mine"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "mine revision 2" in said
    assert "dry friction holds the axis" in said
    made = open_machines().store.current("mine").machine
    assert made.axes["y"].provenance.kind == "ring test"
