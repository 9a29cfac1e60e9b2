"""Ring tests: printed by bodies with dry friction that the model does not know, and read back."""

from __future__ import annotations

import gzip
import json
import re
from dataclasses import replace
from datetime import date
from pathlib import Path

import numpy as np
import pytest

from stillpath.applications.machines.envelope import with_firmware
from stillpath.applications.proof.confirming import verify_ring
from stillpath.applications.proof.recorders import RingSettings
from stillpath.applications.proof.ring_figures import RingReport
from stillpath.applications.proof.ring_motion import is_ring_test, read_ring_motion, ring_motion
from stillpath.applications.proof.ring_test import (
    AXES,
    TITLE,
    RingTest,
    plants_line,
    write_ring_test,
)
from stillpath.cli.main import run
from stillpath.cli.own_machines import open_machines
from stillpath.models.confirmation import Confirmation, confirmation_text, plants_digest
from stillpath.models.errors import ModelError
from stillpath.models.machine import Machine
from stillpath.models.plants import FirSpec, PlantSetSpec, PlantSpec
from stillpath.models.ripple import AxisRipple, RippleHarmonic, RippleSource
from stillpath.models.store import load_machine
from tests.service.ringing import SENSOR, TRUE, Chain, machine_of, recorded

EXAMPLES = Path(__file__).parents[2] / "examples" / "firmware"
TODAY = date(2026, 11, 24)


@pytest.fixture(scope="module")
def machine() -> Machine:
    return machine_of({axis: chain.spec() for axis, chain in TRUE.items()})


@pytest.fixture(scope="module")
def ring(machine: Machine, cache: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("ring")
    write_ring_test(machine, folder / "ring.gcode", cache_dir=cache)
    return folder / "ring.gcode"


@pytest.fixture(scope="module")
def log(ring: Path, machine: Machine) -> Path:
    path = ring.with_name("adxl345-ring.csv")
    path.write_bytes(recorded(ring, machine).raw_data())
    return path


@pytest.fixture(scope="module")
def told(ring: Path, machine: Machine, log: Path) -> RingReport:
    return verify_ring(ring, [log], machine, today=TODAY)


def verdicts(report: RingReport) -> list[str]:
    return [axis.verdict for axis in report.axes]


def said_of(path: Path, ring: Path, machine: Machine, content: bytes) -> RingReport:
    path.write_bytes(content)
    return verify_ring(ring, [path], machine, today=TODAY)


# The file


def test_half_of_the_stops_are_compensated(ring: Path, machine: Machine) -> None:
    motion = read_ring_motion(ring, machine)
    for axis in ("x", "y"):
        off, on = (motion.of(axis, compensated=half) for half in (False, True))
        assert len(off) == len(on) == 12
    assert motion.command.rows.shape[1] < 120_000  # two minutes at 1 kHz
    assert is_ring_test(ring)


def test_it_stays_within_the_travel_and_extrudes_nothing(ring: Path, machine: Machine) -> None:
    rows = read_ring_motion(ring, machine).command.rows
    for row, axis in zip(rows, ("x", "y"), strict=True):
        assert row.min() >= machine.travel[axis].min_mm
        assert row.max() <= machine.travel[axis].max_mm
    commands = [line.split(";")[0] for line in ring.read_text().splitlines()]
    assert not any(word.startswith("E") for line in commands for word in line.split()[1:])
    assert not any(line.startswith(("M104", "M109", "M140", "M190")) for line in commands)


def test_klipper_logs_every_sensor_once(machine: Machine) -> None:
    *logged, name = logged_lines(machine, RingSettings("head", "bed"))
    assert logged == [
        "ACCELEROMETER_MEASURE CHIP=head",
        "ACCELEROMETER_MEASURE CHIP=bed",
        f"ACCELEROMETER_MEASURE CHIP=head NAME={name}",
        f"ACCELEROMETER_MEASURE CHIP=bed NAME={name}",
    ]


def logged_lines(machine: Machine, settings: RingSettings) -> list[str]:
    """Return the lines that log, and at the end the name of the logs."""
    lines = RingTest(machine, settings).text().splitlines()
    logged = [line for line in lines if line.startswith("ACCELEROMETER")]
    return [*logged, logged[-1].partition("NAME=")[2]]


@pytest.mark.parametrize(
    ("kind", "chip", "words"),
    [
        ("klipper", "adxl345 head", r"one word: of a section \[adxl345 head\] it is head"),
        ("klipper", "head;", "one word"),
        ("reprapfirmware", "P0", "a number, such as 0"),
    ],
)
def test_a_sensor_that_the_firmware_would_stop_at_is_refused(
    kind: str, chip: str, words: str, machine: Machine
) -> None:
    """`accel_chip: adxl345 head` is what [resonance_tester] has."""
    if kind != "klipper":
        section = json.loads((EXAMPLES / f"{kind}.json").read_text())
        machine = with_firmware(machine, section)
    for settings in (RingSettings(chip), RingSettings(None, chip)):
        with pytest.raises(ModelError, match=words):
            RingTest(machine, settings)


def test_logs_have_the_name_of_their_own_test(machine: Machine, told: RingReport) -> None:
    """The log of another test is not there to be taken for this one's."""
    settings = RingSettings()
    name = logged_lines(machine, settings)[-1]
    assert re.fullmatch("ring-[0-9a-f]{6}", name)
    assert logged_lines(confirmed(machine, told), settings)[-1] == name
    other = machine_of({"x": Chain((45.0, 120.0)).spec(), "y": TRUE["y"].spec()})
    assert logged_lines(other, settings)[-1] != name
    instruction = " ".join(RingTest(machine, settings).recorder.instruction)
    assert f"/tmp/*-{name}.csv" in instruction
    assert "send `ACCELEROMETER_MEASURE` once before" in instruction


@pytest.mark.parametrize("kind", ["marlin", "reprapfirmware"])
def test_other_firmwares_have_ring_tests(
    kind: str, machine: Machine, cache: Path, tmp_path: Path
) -> None:
    section = json.loads((EXAMPLES / f"{kind}.json").read_text())
    made = with_firmware(machine, section)
    write_ring_test(made, tmp_path / "ring.gcode", cache_dir=cache)
    motion = read_ring_motion(tmp_path / "ring.gcode", made)
    assert len(motion.of("y", compensated=True)) == 12


@pytest.mark.parametrize("kind", ["klipper", "marlin", "reprapfirmware"])
def test_stops_may_be_harder_than_the_firmware_would_make_them(
    kind: str, machine: Machine, cache: Path, tmp_path: Path
) -> None:
    """Of what comes after them nothing is."""
    if kind != "klipper":
        machine = with_firmware(machine, json.loads((EXAMPLES / f"{kind}.json").read_text()))
    allowed = machine.firmware.allowance("x")
    asked_mm_s2 = 2.0 * allowed.accel_mm_s2
    path = tmp_path / "ring.gcode"
    write_ring_test(machine, path, RingSettings(accel_mm_s2=asked_mm_s2), cache_dir=cache)
    motion = read_ring_motion(path, machine)
    for k, axis in enumerate(AXES):
        for stop in motion.of(axis, compensated=False):
            braking = motion.planned_mm[k, round(1e3 * stop.from_s) : round(1e3 * stop.at_s)]
            # Marlin's ramps of whole steps are a fifth steeper.
            assert ramp_mm_s2(braking) == pytest.approx(asked_mm_s2, rel=0.25)
    behind = path.read_bytes() + b"G1 X60 Y150 F9000\nG1 X160\nG1 X60\n"
    ends = ring_motion(behind, "longer", machine).planned_mm[0, -1500:]
    assert ramp_mm_s2(ends) == pytest.approx(allowed.travel_accel_mm_s2, rel=0.1)


def ramp_mm_s2(position_mm: np.ndarray) -> float:
    """Acceleration along a ramp, sampled each ms: not the largest, since corners step."""
    accels = 1e6 * np.abs(np.diff(position_mm, 2))
    return float(np.median(accels[accels > 500.0]))


def test_a_printer_that_takes_no_higher_limit_has_no_harder_stops(machine: Machine) -> None:
    capped = machine.firmware.model_copy(update={"limits_capped": True})
    with pytest.raises(ModelError, match=r"with 9000 mm/s2 .* takes no more than its own"):
        RingTest(machine.model_copy(update={"firmware": capped}), RingSettings(accel_mm_s2=9000.0))


@pytest.mark.slow
def test_one_that_stays_as_planned_is_not_written(
    machine: Machine, cache: Path, tmp_path: Path
) -> None:
    command = machine.command.model_copy(update={"accel_mm_s2": 3000.0, "speed_step_mm_s": 0.1})
    weak = machine.model_copy(update={"command": command})
    with pytest.raises(ModelError, match=r"2 of the 2 parts .* would stay as planned"):
        write_ring_test(weak, tmp_path / "ring.gcode", cache_dir=cache)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("reach_mm", [10.0, 30.0])
def test_a_travel_without_room_is_refused(machine: Machine, reach_mm: float) -> None:
    small = machine.model_copy(
        update={
            "travel": machine.travel
            | {"x": machine.travel["x"].model_copy(update={"min_mm": 0.0, "max_mm": reach_mm})}
        }
    )
    with pytest.raises(ModelError, match=r"moves x by 20 mm at least.*correct the machine"):
        RingTest(small, RingSettings())


# What a log says


def test_a_machine_like_its_plants_is_confirmed(told: RingReport, log: Path) -> None:
    assert verdicts(told) == ["confirmed", "confirmed"]
    for axis in told.axes:
        assert axis.as_planned is not None
        assert axis.compensated is not None
        assert axis.gain == pytest.approx(1.08, abs=0.02)  # the sensor's own
        assert axis.compensated.measured_um < 0.05 * axis.as_planned.measured_um
        # Dry friction damps what is large.
        low, high = axis.as_planned.predicted_um
        assert 0.8 * low < axis.as_planned.measured_um < high
        found = axis.confirmation
        assert found is not None
        assert found.sources[0].name == log.name
        assert found.tested_on == TODAY


@pytest.mark.parametrize("friction_n", [1.0, 2.5])
def test_guides_that_rub_are_named(
    friction_n: float, ring: Path, machine: Machine, tmp_path: Path
) -> None:
    """They stop what rings by micrometres: neither noise nor a wrong phase, nor half a log."""
    true = {axis: replace(chain, friction_n=friction_n) for axis, chain in TRUE.items()}
    content = recorded(ring, machine, true).raw_data()
    report = said_of(tmp_path / "a.csv", ring, machine, content)
    assert "confirmed" not in verdicts(report)
    for axis in report.axes:
        assert "See to it that the axis moves freely" in axis.text or "It rings at" in axis.text
        assert "OUTPUT=raw_data) hold the phase" not in axis.text
        assert "log the whole file" not in axis.text
        assert axis.as_planned is None or (
            axis.as_planned.measured_um < 0.2 * axis.as_planned.predicted_um[0]
        )


def test_friction_that_is_known_counts_in_what_is_predicted(
    machine: Machine, told: RingReport, cache: Path, tmp_path: Path
) -> None:
    """What the command adds against it does not ring."""
    true = {axis: replace(chain, friction_n=1.0) for axis, chain in TRUE.items()}
    held_mm = {"x": 0.0193, "y": 0.0315}
    axes = {a: p.model_copy(update={"friction_mm": held_mm[a]}) for a, p in machine.axes.items()}
    rubbing = machine.model_copy(update={"axes": axes})
    ring = tmp_path / "ring.gcode"
    write_ring_test(rubbing, ring, cache_dir=cache)
    content = recorded(ring, rubbing, true).raw_data()
    report = said_of(tmp_path / "a.csv", ring, rubbing, content)
    for axis, smooth in zip(report.axes, told.axes, strict=True):
        assert axis.compensated is not None
        assert smooth.compensated is not None
        wanted = pytest.approx(smooth.compensated.predicted_um, rel=0.3)
        assert axis.compensated.predicted_um == wanted


def test_ripple_that_is_known_counts_in_what_is_predicted(
    machine: Machine, cache: Path, tmp_path: Path
) -> None:
    """Of belts, whose teeth pass by with some 60 Hz."""
    harmonics = (RippleHarmonic(number=1, amplitude_um=10.0, phase_deg=10.0),)
    belt = AxisRipple(sources=(RippleSource(name="belt", pitch_mm=2.0, harmonics=harmonics),))
    rippled = machine.model_copy(update={"ripple": {"a": belt, "b": belt}})
    ring = tmp_path / "ring.gcode"
    write_ring_test(rippled, ring, cache_dir=cache)
    content = recorded(ring, rippled).raw_data()
    told = said_of(tmp_path / "a.csv", ring, rippled, content)
    assert verdicts(told) == ["confirmed", "confirmed"]
    blind = said_of(tmp_path / "a.csv", ring, machine, content)
    assert verdicts(blind) == ["not confirmed", "not confirmed"]


def test_a_copy_of_a_log_is_no_repeat(
    told: RingReport, log: Path, ring: Path, machine: Machine
) -> None:
    """As a browser names what it downloads again."""
    copy = log.with_name("adxl345-ring (1).csv")
    copy.write_bytes(log.read_bytes())
    twice = verify_ring(ring, [log, copy], machine, today=TODAY)
    assert twice.axes == told.axes
    assert twice.notes == [*told.notes, f"{copy.name} is a copy of {log.name}: it counts once."]


def test_a_mode_that_moved_is_not_confirmed(ring: Path, machine: Machine, tmp_path: Path) -> None:
    moved = {**TRUE, "x": Chain((43.0, 112.0))}
    report = said_of(tmp_path / "a.csv", ring, machine, recorded(ring, machine, moved).raw_data())
    assert verdicts(report) == ["not confirmed", "confirmed"]
    assert "It rings at 42." in report.axes[0].text
    assert "measure the machine again" in report.axes[0].text


def test_a_sensor_that_one_axis_does_not_move_says_nothing_of_it(
    ring: Path, machine: Machine, tmp_path: Path
) -> None:
    content = recorded(ring, machine, sees=(1.0, 0.02)).raw_data()
    report = said_of(tmp_path / "a.csv", ring, machine, content)
    assert verdicts(report) == ["confirmed", "says nothing"]
    assert "it is not fixed to the part that moves in Y" in report.axes[1].text


@pytest.mark.parametrize(
    "what",
    ["another motion", *(pytest.param(w, marks=pytest.mark.slow) for w in ("part of it", "noise"))],
)
def test_logs_that_say_nothing(what: str, ring: Path, machine: Machine, tmp_path: Path) -> None:
    if what == "part of it":
        record, words = recorded(ring, machine, part_s=(0.0, 15.0)), "log the whole file"
    elif what == "noise":
        noisy = replace(SENSOR, noise_mm_s2=4000.0)
        record, words = recorded(ring, machine, sensor=noisy), "noise of the log"
    else:
        record = recorded(ring, machine)
        record = replace(record, accel_mm_s2=record.accel_mm_s2[::-1].copy())
        words = "is not of this file"
    report = said_of(tmp_path / "a.csv", ring, machine, record.raw_data())
    assert verdicts(report) == ["says nothing", "says nothing"]
    assert all(words in axis.text for axis in report.axes)
    assert all(axis.confirmation is None for axis in report.axes)


@pytest.mark.shared
def test_real_logs_of_other_motion_say_nothing(
    ring: Path, machine: Machine, shared_dir: Path, tmp_path: Path
) -> None:
    files = sorted((shared_dir / "measurements" / "serval").glob("*accel*.csv.gz"))
    assert files
    for file in files:
        content = gzip.decompress(file.read_bytes())
        report = said_of(tmp_path / "real.csv", ring, machine, content)
        assert verdicts(report) == ["says nothing", "says nothing"]


@pytest.mark.parametrize("plant", [Chain((45.0, 120.0)).spec(), FirSpec(taps=(1.0,), dt_s=1e-3)])
def test_a_ring_test_for_other_plants_says_nothing(
    plant: PlantSpec, machine: Machine, ring: Path, log: Path
) -> None:
    axes = {**machine.axes, "x": PlantSetSpec(nominal=plant)}
    other = machine.model_copy(update={"axes": axes})
    report = verify_ring(ring, [log], other, today=TODAY)
    assert verdicts(report) == ["says nothing", "confirmed"]
    assert "write a new ring test" in report.axes[0].text


def test_a_half_that_is_not_compensated_says_nothing(machine: Machine, tmp_path: Path) -> None:
    """As was written where all pieces stayed as planned."""
    ring = tmp_path / "ring.gcode"
    plants = ", ".join(plants_line(a, plants_digest(machine.axes[a])) for a in ("x", "y"))
    text = RingTest(machine, RingSettings()).text()
    ring.write_text(f"; {TITLE}{machine.title}\n; {plants}\n{text}")
    content = recorded(ring, machine).raw_data()
    report = said_of(tmp_path / "a.csv", ring, machine, content)
    assert verdicts(report) == ["says nothing", "says nothing"]
    assert all("write a new ring test" in axis.text for axis in report.axes)


def test_a_log_without_raw_accelerations_is_refused(
    ring: Path, machine: Machine, tmp_path: Path
) -> None:
    path = tmp_path / "resonances_x_1.csv"
    path.write_bytes(recorded(ring, machine).resonances())
    with pytest.raises(ModelError, match="holds no raw accelerations but a Spectrum"):
        verify_ring(ring, [path], machine)


# What the machine remembers


def confirmed(machine: Machine, told: RingReport) -> Machine:
    axes: dict[str, Confirmation] = {
        a.axis: a.confirmation for a in told.axes if a.confirmation is not None
    }
    return machine.model_copy(update={"confirmations": axes})


def test_what_reports_say(machine: Machine, told: RingReport) -> None:
    assert confirmation_text(machine) == "never confirmed on this machine"
    known = confirmed(machine, told)
    text = confirmation_text(known)
    assert text.startswith("X confirmed on 2026-11-24: predicted 0.")
    assert "; Y confirmed on 2026-11-24" in text
    # Of other plants, and of a copy under another name, it says nothing.
    anew = known.model_copy(update={"axes": load_machine("ender3").axes})
    assert "never confirmed with the plants it has now" in confirmation_text(anew)
    copy = known.model_copy(update={"name": "another"})
    assert confirmation_text(copy) == "never confirmed on this machine"


def test_a_machine_without_confirmations_keeps_its_revision(
    machine: Machine, told: RingReport
) -> None:
    assert machine.model_copy(update={"confirmations": {}}).revision == machine.revision
    assert confirmed(machine, told).revision != machine.revision
    text = confirmed(machine, told).model_dump_json()
    assert Machine.model_validate_json(text).confirmations == confirmed(machine, told).confirmations


def test_the_command_remembers(
    ring: Path,
    log: Path,
    machine: Machine,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("STILLPATH_DATA_DIR", str(tmp_path / "data"))
    (tmp_path / "mine.json").write_text(machine.model_dump_json())
    assert run(["machines", "import", str(tmp_path / "mine.json")]) == 0
    store = open_machines().store
    args = ["verify", str(ring), str(log), "-m", "mine"]
    assert run([*args, "--no-remember"]) == 0
    assert not store.current("mine").machine.confirmations
    # A report that cannot be written takes the verdict with it neither from the screen nor here.
    assert run([*args, "--report", str(tmp_path / "mine.json" / "told")]) == 1
    said = capsys.readouterr()
    assert "X confirmed" in said.out
    assert "Not a directory" in said.err
    assert set(store.current("mine").machine.confirmations) == {"x", "y"}
    assert run([*args, "--report", str(tmp_path / "told")]) == 0
    report = json.loads((tmp_path / "told" / "ring-test.json").read_text())
    assert report["axes"][0]["verdict"] == "confirmed"
    assert np.isfinite(report["axes"][0]["misses"])
