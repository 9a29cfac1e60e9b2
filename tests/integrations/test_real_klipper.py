"""Klipper's own host: streams that break off, and what it makes of our files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from models.machine import Machine
from models.store import load_machine
from service.pipeline.options import Options
from service.pipeline.road import compensate_file, plan_file
from tests.integrations.interrupted import EVENTS, SAMPLE_S, asked, disturbed, run, two_objects
from tests.integrations.klipper_host import NO_KLIPPER, PYTHON

pytestmark = [pytest.mark.slow, pytest.mark.skipif(PYTHON is None, reason=NO_KLIPPER)]

_STILL_MM, _STAND = 1e-5, 60
_OFF_MM = 0.005
MACHINES = ("ender3", "voron-v24-250")


@pytest.fixture(scope="module", params=MACHINES)
def written(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Machine]:
    """A written file, and its machine."""
    folder = tmp_path_factory.mktemp("written")
    (folder / "in.gcode").write_text(two_objects())
    # The homed place is the host's: an endstop at 0.
    machine = load_machine(request.param)
    firmware = machine.firmware.model_copy(update={"home_mm": (0.0, 0.0, 0.0)})
    machine = machine.model_copy(update={"firmware": firmware})
    result = compensate_file(folder / "in.gcode", folder / "out.gcode", machine, Options(robust="off"))
    assert not result.put_back
    return folder / "out.gcode", machine


@pytest.mark.parametrize("event", EVENTS)
def test_no_break_asks_for_more_than_the_motors_bear(
    event: str, written: tuple[Path, Machine], tmp_path: Path
) -> None:
    file, machine = written
    bears = machine.command
    for text in disturbed(file.read_text(), event, 12 if event in ("PAUSE, RESUME", "babystep", "host stalls") else 3):
        found = asked(run(text, machine, tmp_path), machine)
        assert found.step_mm_s <= bears.speed_step_mm_s
        assert found.ramp_mm_s <= bears.speed_step_mm_s + 10e-3 * bears.accel_mm_s2


def test_the_host_moves_as_we_read_the_file_back(written: tuple[Path, Machine], tmp_path: Path) -> None:
    """Place by place, from each stand to the next: only a wait of some ms may lie between."""
    file, machine = written
    plan_file(file, tmp_path / "plan.npz", machine, rate_hz=1 / SAMPLE_S)
    with np.load(tmp_path / "plan.npz") as table:
        ours = np.stack((table["x"], table["y"]))
    theirs = run(file.read_text(), machine, tmp_path).sampled(SAMPLE_S, machine.kinematics == "corexy")
    theirs += ours[:, -1:] - theirs[:, -1:]
    stretches = _between_stands(ours)
    assert len(stretches) >= 4
    late = theirs.shape[1] - ours.shape[1]
    for begin, end in reversed(stretches):
        late, off_mm = _shifted(ours, theirs, slice(begin, end), late)
        assert off_mm < _OFF_MM, (begin * SAMPLE_S, off_mm)


def _between_stands(place_mm: NDArray[np.float64]) -> list[tuple[int, int]]:
    """Where X and Y move, from one stand of some ms to the next."""
    moves = np.any(np.abs(np.diff(place_mm, axis=1)) > _STILL_MM, axis=0)
    at = np.flatnonzero(moves)
    breaks = np.flatnonzero(np.diff(at) > _STAND) + 1
    return [(int(part[0]), int(part[-1])) for part in np.split(at, breaks) if len(part) > _STAND]


def _shifted(
    ours: NDArray[np.float64], theirs: NDArray[np.float64], part: slice, about: int
) -> tuple[int, float]:
    """By how many samples theirs is late, near a guess, and the largest distance then."""
    at = np.arange(part.start, part.stop)

    def off_mm(late: float) -> float:
        places = [np.interp(at + late, np.arange(len(p)), p) for p in theirs]
        return float(np.hypot(*(np.stack(places) - ours[:, at])).max())

    late = float(about)
    for reach, step in ((2000, 40), (40, 4), (4, 0.5), (0.5, 0.05)):
        late = min(late + np.arange(-reach, reach + step, step), key=off_mm)
    return round(late), off_mm(late)
