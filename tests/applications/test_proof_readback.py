"""Logs of prints read back: simulated on plants that differ from the model by a known amount."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from stillpath.applications.proof.coupon import coupon_program
from stillpath.applications.proof.page import write_readback
from stillpath.applications.proof.program import PrintSettings
from stillpath.applications.proof.readback import verify_log
from stillpath.applications.proof.tower import tower_program
from stillpath.models.errors import ModelError
from stillpath.models.firmware.klipper import FirmwareShaper
from stillpath.models.machine import Machine
from stillpath.models.shaping import AxisShaper, Shaping
from stillpath.models.store import load_machine
from tests.service.recorded import record


@pytest.fixture(scope="module")
def machine() -> Machine:
    return load_machine("ender3")


@pytest.fixture(scope="module")
def printed(machine: Machine, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("printed") / "coupon.gcode"
    path.write_text(coupon_program(machine, PrintSettings())[0].text())
    return path


def modes(report) -> dict[str, float]:
    return {axis.axis: axis.f_hz / axis.model_hz for axis in report.axes}


@pytest.mark.parametrize("friction_mm", [None, 0.05])
def test_a_machine_like_its_model(friction_mm, machine, printed, tmp_path):
    update = {"friction_mm": friction_mm}
    axes = {a: plants.model_copy(update=update) for a, plants in machine.axes.items()}
    machine = machine.model_copy(update={"axes": axes})
    record(printed, machine, tmp_path / "log.csv", start_s=280, seconds=40)
    report = verify_log(printed, tmp_path / "log.csv", machine)
    assert report.outcome == "the model holds"
    assert [axis.axis for axis in report.axes] == ["x", "y"]
    for axis in report.axes:
        assert axis.f_hz == pytest.approx(axis.model_hz, rel=1e-3)
        assert axis.zeta == pytest.approx(axis.model_zeta, rel=0.02)
        assert axis.gain == pytest.approx(1.0, abs=0.01)
        assert axis.correlation > 0.99
        assert axis.nrmse < 0.05
        assert axis.corners.measured_um == pytest.approx(axis.corners.predicted_um, rel=0.05)
    sensor = np.array(report.sensor)
    assert sensor @ sensor.T == pytest.approx(np.eye(2), abs=1e-9)
    assert report.clock_ppm == pytest.approx(100, abs=20)


def test_a_mode_that_fell_is_found_and_said(machine, printed, tmp_path):
    log = tmp_path / "log.csv"
    record(printed, machine, log, frequency=(0.97, 1.0), start_s=300, clock=1 - 2e-4, seed=5)
    report = verify_log(printed, log, machine)
    assert report.outcome == "the machine has changed"
    assert modes(report)["x"] == pytest.approx(0.97, abs=0.005)
    assert modes(report)["y"] == pytest.approx(1.0, abs=0.005)
    said = re.fullmatch(
        r"The machine's X mode is 3\.0 % lower than the model "
        r"\((\d+\.\d+) ± (\d+\.\d+) Hz, model (\d+\.\d+) Hz\): measure again\.",
        report.verdicts[0],
    )
    assert said is not None
    assert float(said[1]) == pytest.approx(0.97 * float(said[3]), abs=0.005 * float(said[3]))
    x = report.axes[0]
    assert x.nrmse_fitted < 0.5 * x.nrmse
    write_readback(report, tmp_path / "report")
    page = (tmp_path / "report" / "readback.html").read_text()
    assert "3.0 % lower" in page
    assert "<script" not in page
    assert "http" not in re.sub(r"http-equiv", "", page)
    assert json.loads((tmp_path / "report" / "readback.json").read_text())["machine"] == "ender3"


@pytest.mark.parametrize(
    ("told", "type_", "outcome", "said"),
    [
        (True, "mzv", "the model holds", "the model holds"),
        (True, "none", "the model holds", "the model holds"),
        (False, "mzv", "the shaper is not known", "nothing is said of the machine"),
        (False, "none", "the model holds", "the model holds"),
    ],
)
def test_the_firmware_s_shaper(told, type_, outcome, said, machine, printed, tmp_path):
    """In a file as sliced, which leaves the shaper as printer.cfg has it."""
    sliced, log = tmp_path / "sliced.gcode", tmp_path / "log.csv"
    lines = printed.read_text().splitlines(keepends=True)
    sliced.write_text("".join(x for x in lines if not x.startswith("SET_INPUT_SHAPER")))
    axes = [AxisShaper(type_, machine.axes[a].nominal.modes[1].f_hz) for a in "xy"]
    record(sliced, machine, log, start_s=280, seconds=40, shaping=Shaping(*axes))
    stated = None
    if told:
        x_hz, y_hz = (axis.f_hz if axis.is_on else 0.0 for axis in axes)
        stated = FirmwareShaper(freq_x_hz=x_hz, freq_y_hz=y_hz)
    firmware = machine.firmware.model_copy(update={"shaper": stated})
    report = verify_log(sliced, log, machine.model_copy(update={"firmware": firmware}))
    assert report.outcome == outcome
    assert all(said in verdict for verdict in report.verdicts), report.verdicts
    assert any("firmware.shaper" in note for note in report.notes) is not told


def test_a_log_of_another_print_is_recognised(machine, printed, tmp_path):
    other = tmp_path / "tower.gcode"
    other.write_text(tower_program(machine, "y", PrintSettings(), 2)[0].text())
    record(other, machine, tmp_path / "log.csv", start_s=250)
    report = verify_log(printed, tmp_path / "log.csv", machine)
    assert report.outcome == "another print"
    assert report.axes == []
    assert "not of this print" in report.verdicts[0]
    write_readback(report, tmp_path / "report")


def test_nothing_but_noise_is_another_print(machine, printed, tmp_path):
    record(printed, machine, tmp_path / "log.csv", sees=(0.0, 0.0), start_s=250, seconds=20)
    assert verify_log(printed, tmp_path / "log.csv", machine).outcome == "another print"


@pytest.mark.slow
def test_a_sensor_on_the_head_of_a_bed_slinger_sees_x_only(machine, printed, tmp_path):
    record(printed, machine, tmp_path / "log.csv", sees=(1.0, 0.0), start_s=300, seed=2)
    report = verify_log(printed, tmp_path / "log.csv", machine)
    assert [axis.axis for axis in report.axes] == ["x"]
    assert report.outcome == "the model holds"
    assert any("no motion of Y" in note for note in report.notes)


@pytest.mark.parametrize("scale", [pytest.param(0.70, marks=pytest.mark.slow), 0.01, 1000])
def test_a_wrong_scale_is_not_taken_for_a_change_of_the_machine(scale, machine, printed, tmp_path):
    log = tmp_path / "log.csv"
    noise = {"noise_mm_s2": 60.0 * scale, "step_mm_s2": 37.0 * scale}
    record(printed, machine, log, sees=(scale, scale), start_s=300, **noise)
    report = verify_log(printed, tmp_path / "log.csv", machine)
    assert modes(report)["x"] == pytest.approx(1.0, abs=0.002)
    read = [float(re.search(r"reads (\S+) of the predicted", v)[1]) for v in report.verdicts]
    assert read == pytest.approx([scale, scale], rel=0.02)


@pytest.mark.slow
def test_homing_in_mid_print_is_no_motion(machine, printed, tmp_path):
    twice = tmp_path / "twice.gcode"
    twice.write_text(2 * printed.read_text())
    record(printed, machine, tmp_path / "log.csv", start_s=300)
    report = verify_log(twice, tmp_path / "log.csv", machine)
    assert report.outcome == "the model holds"
    assert modes(report)["x"] == pytest.approx(1.0, abs=0.002)


def test_one_mode_of_several_moved(machine, printed, tmp_path):
    document = machine.model_dump(mode="json")
    most, less = document["axes"]["x"]["nominal"]["modes"][1:3]
    most["share"], less["share"] = 0.85, 0.15
    document["axes"]["x"] = {"nominal": {"kind": "relative_modes", "modes": [most, less]}}
    known = Machine.model_validate(document)
    most["f_hz"] *= 0.97
    record(printed, Machine.model_validate(document), tmp_path / "log.csv", start_s=300)
    report = verify_log(printed, tmp_path / "log.csv", known)
    assert modes(report)["x"] == pytest.approx(0.97, abs=0.01)
    assert report.axes[0].nrmse_fitted < 0.05


def test_damping_that_changed(machine, printed, tmp_path):
    record(printed, machine, tmp_path / "log.csv", damping=2.0, start_s=300)
    report = verify_log(printed, tmp_path / "log.csv", machine)
    assert report.axes[0].zeta == pytest.approx(2 * report.axes[0].model_zeta, rel=0.05)
    assert "the damping does not" in report.verdicts[0]


def test_a_log_of_reprapfirmware_needs_no_resonance_test(machine, printed, tmp_path):
    log = tmp_path / "0_2026-11-21.csv"
    record(printed, machine, log, start_s=300, seconds=20, rate_hz=1344, clock=1.0, rrf=True)
    report = verify_log(printed, log, machine)
    assert report.outcome == "the model holds"
    assert not any("resonance test" in note for note in report.notes)


def test_files_that_are_no_log(machine, printed, tmp_path):
    log = tmp_path / "log.csv"
    t = np.arange(3000) / 1000
    spectrum = np.column_stack([5 + t[:120] * 1e3, *(1 + t[:120] * k for k in range(1, 5))])
    np.savetxt(log, spectrum, "%.3f", ",", header="freq,psd_x,psd_y,psd_z,psd_xyz", comments="")
    with pytest.raises(ModelError, match="no raw accelerations but a Spectrum"):
        verify_log(printed, log, machine)
    rows = np.column_stack([t, *(np.sin(t * k) * 1e3 for k in (40, 50, 60))])
    np.savetxt(log, rows, "%.6f", ",", header="#time,accel_x,accel_y,accel_z", comments="")
    with pytest.raises(ModelError, match=r"3\.0 s are too short"):
        verify_log(printed, log, machine)
    rows[:, 0] *= 5
    np.savetxt(log, rows, "%.6f", ",", header="#time,accel_x,accel_y,accel_z", comments="")
    with pytest.raises(ModelError, match="200 samples per second are too few"):
        verify_log(printed, log, machine)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "rate_hz", "clock", "start_s", "seconds"),
    [
        ("voron-v24-250", 3200, 1 + 3e-4, 255, 60),
        ("generic-bedslinger", 1600, 1 - 3e-4, 200, 90),
        ("annex-k3", 3200, 1 + 1e-4, -15, 120),
        ("taz6-x", 3200, 1 - 1e-4, 300, 20),
    ],
)
def test_compensated_prints(name, rate_hz, clock, start_s, seconds, tmp_path, coupon_of):
    machine, printed, log = load_machine(name), coupon_of(name)[0], tmp_path / "log.csv"
    record(
        printed,
        machine,
        log,
        frequency=(0.97, 1.02),
        rate_hz=rate_hz,
        clock=clock,
        start_s=start_s,
        seconds=seconds,
        seed=7,
    )
    report = verify_log(printed, log, machine)
    assert modes(report)["x"] == pytest.approx(0.97, abs=0.005)
    assert modes(report)["y"] == pytest.approx(1.02, abs=0.005)
    assert report.outcome == "the machine has changed"
