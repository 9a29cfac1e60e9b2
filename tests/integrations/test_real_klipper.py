"""Klipper's own host: streams that break off, and what it makes of our files."""

from __future__ import annotations

from itertools import cycle
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from stillpath.applications.proof.motor_test import borne, levels_of, motor_test
from stillpath.models.firmware.klipper import FirmwareShaper
from stillpath.models.machine import Machine
from stillpath.models.store import load_machine
from stillpath.pipeline.compensate import compensate_file
from stillpath.pipeline.options import Options
from stillpath.pipeline.simulate import plan_file
from tests.integrations.interrupted import (
    EVENTS,
    ONCE,
    SAMPLE_S,
    asked,
    disturbed,
    homed,
    run,
    two_objects,
)
from tests.integrations.klipper_host import NO_KLIPPER, PYTHON, printer_cfg, steps_of
from tests.integrations.klipper_moves import COLUMNS, compared, of_the_package, recorded

pytestmark = [pytest.mark.slow, pytest.mark.skipif(PYTHON is None, reason=NO_KLIPPER)]

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
GEAR = EXAMPLES / "cura_ender3_gear24.gcode"
HEPTAGON = EXAMPLES / "ps_ender3_pauses_hept24f.gcode"
_STILL_MM, _SHORT = 1e-5, 60
_OFF_MM = 0.005


MACHINES = ("ender3", "voron-v24-250")


@pytest.fixture(scope="module", params=MACHINES)
def written(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, Machine]:
    """A written file, and its machine."""
    return write(two_objects(), homed(load_machine(request.param)), tmp_path_factory.mktemp("made"))


def write(text: str, machine: Machine, folder: Path) -> tuple[Path, Machine]:
    (folder / "in.gcode").write_text(text)
    made = folder / "out.gcode"
    result = compensate_file(folder / "in.gcode", made, machine, Options(robust="off"))
    assert not result.put_back
    return made, machine


@pytest.mark.parametrize(
    ("written", "event"), list(zip(cycle(MACHINES), EVENTS, strict=False)), indirect=["written"]
)
def test_no_break_asks_for_more_than_the_motors_bear(
    written: tuple[Path, Machine], event: str, tmp_path: Path
) -> None:
    file, machine = written
    bears = machine.command
    for text in disturbed(file.read_text(), event, 3 if event in ONCE else 20):
        found = asked(run(text, machine, tmp_path), machine)
        assert found.step_mm_s <= bears.speed_step_mm_s
        assert found.ramp_mm_s <= bears.speed_step_mm_s + 10e-3 * bears.accel_mm_s2


def test_an_excluded_object_changes_nothing_behind_it(
    written: tuple[Path, Machine], tmp_path: Path
) -> None:
    """The host goes on to the next one, and prints the last as if nothing had been excluded."""
    file, machine = written
    whole, excluded, _ = (
        run(text, machine, tmp_path).sampled(SAMPLE_S, machine.kinematics == "corexy")
        for text in (file.read_text(), *disturbed(file.read_text(), "EXCLUDE_OBJECT", 2))
    )
    assert excluded.shape[1] < whole.shape[1] - round(4.0 / SAMPLE_S)
    # The last object lasts 4.4 s; 0.04 mm is what a sample of time makes at the fastest line.
    tail = round(4.3 / SAMPLE_S)
    assert np.abs(excluded[:, -tail:] - whole[:, -tail:]).max() < 0.04


def test_the_host_moves_as_we_read_the_file_back(
    written: tuple[Path, Machine], tmp_path: Path
) -> None:
    check_motion(*written, tmp_path)


FILES = {
    "two objects": two_objects,
    "gear": lambda: GEAR.read_text().partition(";LAYER:1")[0],
    "heptagon": lambda: HEPTAGON.read_text().partition(";Z:0.8")[0],
}


@pytest.mark.parametrize(("file", "name"), list(zip(FILES, cycle(MACHINES), strict=False)))
def test_the_host_plans_what_we_read_back(name: str, file: str, tmp_path: Path) -> None:
    """Column by column, move by move: what it appends to its queues."""
    made, machine = write(FILES[file](), of_the_package(homed(load_machine(name))), tmp_path)
    text = made.read_text()
    run(text, machine, tmp_path)
    found = compared(text, machine, recorded(tmp_path))
    assert found.moves > 2000
    assert found.extruding > 1000
    assert set(found.largest) == set(COLUMNS)
    assert max(found.largest.values()) < 1e-6
    assert found.stand_s < 1e-6


def test_the_host_stands_for_the_smooth_time_of_pressure_advance(tmp_path: Path) -> None:
    machine = of_the_package(homed(load_machine("ender3")))
    text = "G28\nG90\nM83\nG1 X10 Y10 Z5 F3000\n"
    # The package's host is older and stands for another value of the advance, too.
    changes = ("ADVANCE=.05", "ADVANCE=.06", "SMOOTH_TIME=.1", "ADVANCE=0 EXTRUDER=extruder")
    for k, change in enumerate(changes):
        text += f"G1 X{20 + 10 * k} E1\nSET_PRESSURE_ADVANCE {change}\n"
    text += "G1 X100 E1\n"
    run(text, machine, tmp_path)
    found = compared(text, machine, recorded(tmp_path))
    assert found.stands == len(changes)
    assert found.stand_s < 1e-6
    assert max(found.largest.values()) < 1e-6


@pytest.mark.parametrize(
    "lines",
    [
        "SET_INPUT_SHAPER SHAPER_FREQ_X=40\nSET_INPUT_SHAPER SHAPER_FREQ_Y=30\n",
        "SET_INPUT_SHAPER SHAPER_FREQ_X=20\nM204 S900\nSET_INPUT_SHAPER SHAPER_FREQ_X=60\n",
        "SET_INPUT_SHAPER SHAPER_FREQ_X=40\nG4 P100\nSET_PRESSURE_ADVANCE ADVANCE=.03\n",
        "SET_INPUT_SHAPER SHAPER_FREQ_X=40\nG1 E-1\nG1 E1\nSET_INPUT_SHAPER SHAPER_FREQ_Y=30\n",
    ],
)
def test_the_host_stands_once_for_lines_at_one_rest(lines: str, tmp_path: Path) -> None:
    machine = of_the_package(homed(load_machine("ender3")))
    shaper = FirmwareShaper(freq_x_hz=57.8, freq_y_hz=45.2)
    firmware = machine.firmware.model_copy(update={"shaper": shaper})
    machine = machine.model_copy(update={"firmware": firmware})
    text = f"G28\nG90\nM83\nG1 X10 Y10 Z5 F3000\nG1 X50 E1\n{lines}G1 X100 E1\n"
    steps_of(text, printer_cfg(machine, shaper=True), tmp_path)
    assert compared(text, machine, recorded(tmp_path)).stand_s < 1e-6


def test_the_host_of_before_the_cruise_ratio(tmp_path: Path) -> None:
    """Its max_accel_to_decel stays as it is where a file sets ACCEL, and follows ACCEL_TO_DECEL."""
    machine = of_the_package(homed(load_machine("ender3")))
    text = "G28\nG90\nM83\nG1 X10 Y10 Z5 F12000\n"
    changes = (
        "M204 S600",
        "SET_VELOCITY_LIMIT ACCEL=2000 MINIMUM_CRUISE_RATIO=0.9",
        "SET_VELOCITY_LIMIT ACCEL=4000 ACCEL_TO_DECEL=900",
        "SET_VELOCITY_LIMIT ACCEL_TO_DECEL=9000",
    )
    for k, change in enumerate(changes):
        text += f"{change}\n" + "".join(
            f"G1 X{20 + 20 * k + step} Y{20 + step % 3} E.1\n" for step in range(20)
        )
    run(text, machine, tmp_path)
    assert max(compared(text, machine, recorded(tmp_path)).largest.values()) < 1e-6
    newer = homed(load_machine("ender3"))
    assert compared(text, newer, recorded(tmp_path)).largest["cruise speed"] > 0.05


@pytest.mark.parametrize("line", ["M119", "QUERY_ENDSTOPS", "SET_SERVO SERVO=brush ANGLE=30"])
def test_the_host_brakes_for_it(line: str, tmp_path: Path) -> None:
    machine = of_the_package(homed(load_machine("ender3")))
    text = f"G28\nG90\nM83\nG1 X10 Y10 Z5 F3000\nG1 X50 E1\n{line}\nG1 X90 E1\n"
    steps_of(text, printer_cfg(machine, "[servo brush]\npin: P27"), tmp_path)
    assert max(compared(text, machine, recorded(tmp_path)).largest.values()) < 1e-6


def test_a_file_that_the_host_did_not_get_differs(
    written: tuple[Path, Machine], tmp_path: Path
) -> None:
    made, machine = written
    text = made.read_text()
    run(text, machine, tmp_path)
    host = recorded(tmp_path)
    line = next(x for x in text.split("\n")[-400::-1] if x.startswith("G1 X") and " F" in x)
    other = f"{line.rpartition('F')[0]}F{0.5 * float(line.rpartition('F')[2]):.1f}"
    off = compared(text.replace(line, other), machine, host).largest
    assert off["cruise speed"] > 0.1
    assert off["cruising"] > 1e-4


def test_with_klippers_own_shaper(tmp_path: Path) -> None:
    """The file switches it off for the stream; the host stands still as long as times count."""
    shaper = FirmwareShaper(freq_x_hz=57.8, freq_y_hz=45.2, damping_x=0.05, damping_y=0.05)
    machine = homed(load_machine("ender3"))
    firmware = machine.firmware.model_copy(update={"shaper": shaper})
    machine = machine.model_copy(update={"firmware": firmware})
    made, _ = write(two_objects(), machine, tmp_path)
    text = made.read_text()
    steps_of(text, printer_cfg(machine, shaper=True), tmp_path)
    log = (tmp_path / "klippy.log").read_text()
    told = [x.split()[1] for x in log.split("\n") if x.startswith("shaper_type_x:")]
    assert told == ["shaper_freq_x:0.000", "shaper_freq_x:57.800"]
    found = compared(text, machine, recorded(tmp_path))
    assert max(found.largest.values()) < 1e-6
    assert found.stand_s < 1e-6


@pytest.mark.parametrize("name", MACHINES)
def test_a_search_for_lost_steps_asks_for_what_it_says(name: str, tmp_path: Path) -> None:
    machine = homed(load_machine(name))
    text = motor_test(machine, 1.3 * machine.firmware.largest_accel_mm_s2)
    best = levels_of(text)[-1]
    found = asked(run(text, machine, tmp_path), machine)
    assert 0.95 * best.accel_mm_s2 < found.ramp_mm_s / 10e-3 < 1.3 * best.accel_mm_s2
    assert 0.9 * best.speed_step_mm_s < found.step_mm_s < 1.1 * best.speed_step_mm_s + 12.0
    # No endstop is hit in batch mode, so that counters differ; but there are as many as needed.
    borne(levels_of(text), (tmp_path / "klippy.log").read_text(), 16)


def check_motion(file: Path, machine: Machine, folder: Path) -> None:
    """Place by place, from each stand to the next: only a wait of some ms may lie between."""
    plan_file(file, folder / "plan.npz", machine, rate_hz=1 / SAMPLE_S)
    with np.load(folder / "plan.npz") as table:
        ours = np.stack((table["x"], table["y"]))
    steps = run(file.read_text(), machine, folder)
    theirs = steps.sampled(SAMPLE_S, machine.kinematics == "corexy")
    theirs += ours[:, -1:] - theirs[:, -1:]
    stretches = _between_stands(ours)
    assert len(stretches) >= 3
    late = theirs.shape[1] - ours.shape[1]
    for begin, end in reversed(stretches):
        late, off_mm = _shifted(ours, theirs, slice(begin, end), late)
        assert off_mm < _OFF_MM, (begin * SAMPLE_S, off_mm)


def _between_stands(place_mm: NDArray[np.float64]) -> list[tuple[int, int]]:
    """Where X and Y move, from one stand to the next."""
    moves = np.any(np.abs(np.diff(place_mm, axis=1)) > _STILL_MM, axis=0)
    at = np.flatnonzero(moves)
    breaks = np.flatnonzero(np.diff(at) > 1) + 1
    return [(int(part[0]), int(part[-1])) for part in np.split(at, breaks) if len(part) > _SHORT]


def _shifted(
    ours: NDArray[np.float64], theirs: NDArray[np.float64], part: slice, about: int
) -> tuple[int, float]:
    """By how many samples theirs is late, near a guess, and the largest distance then."""
    at = np.arange(part.start, part.stop)

    def off_mm(late: float) -> float:
        first = max(int(at[0] + late) - 1, 0)
        some = theirs[:, first : max(int(at[-1] + late), first) + 3]
        places = [np.interp(at + late - first, np.arange(len(p)), p) for p in some]
        return float(np.hypot(*(np.stack(places) - ours[:, at])).max())

    late = float(about)
    for reach, step in ((2000, 40), (40, 4), (4, 0.5), (0.5, 0.05)):
        late = min(late + np.arange(-reach, reach + step, step), key=off_mm)
    return round(late), off_mm(late)
