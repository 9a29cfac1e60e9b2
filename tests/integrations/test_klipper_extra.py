"""The parts of the extra that need no Klipper: filter, memory, installer."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from stillpath.applications.live.export import export_document, export_text
from stillpath.compensation.live_filter import FADE, LiveFilter, design_taps, shaper_taps
from stillpath.models.machine import CommandLimits, MotorLimits
from stillpath.models.store import load_machine
from stillpath.pipeline.live_design import LiveDesign, live_filter
from stillpath.pipeline.measuring.reference_shaper import BestShaper
from tests.compensation.test_live_filter import mode
from tests.integrations.hostile_exports import HOSTILE
from tests.loading import module_at

EXTRA = Path(__file__).resolve().parents[2] / "integrations/klipper/extra"
DT_S = 1e-3


@pytest.fixture(scope="module")
def extra() -> ModuleType:
    return module_at(EXTRA / "stillpath/__init__.py", "klipper_extra_stillpath")


def zigzag(count: int, accel: float = 5e3, size: float = 40.0) -> list[tuple[float, ...]]:
    """Moves as `trapq_append` gets them: there and back along X and a little Y."""
    moves, t, x, y, v = [], 1.0, 50.0, 50.0, 200.0
    for k in range(count):
        way = size if k % 2 == 0 else -size
        ramp = v / accel
        cruise = (size - v * ramp) / v
        norm = float(np.hypot(way, 1.0))
        moves.append((t, ramp, cruise, ramp, x, y, 0.0, way / norm, 1.0 / norm, 0.0, 0.0, v, accel))
        gone = v * ramp + v * cruise
        x, y = x + way / norm * gone, y + gone / norm
        t += 2 * ramp + cruise
        if k % 5 == 4:
            t += 0.3
    return moves


def given(taps: np.ndarray, accel: float = 1e5, of_motors: float = np.inf) -> Any:
    return SimpleNamespace(
        taps=[list(row) for row in taps], reach=taps.shape[1] // 2, sample_s=DT_S,
        velocity_mm_s=1e3, accel_mm_s2=accel, motor_velocity_mm_s=np.inf,
        motor_accel_mm_s2=of_motors,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("accel", "of_motors", "batch"),
    [
        pytest.param(1e5, np.inf, 250, marks=pytest.mark.slow),
        (5200.0, np.inf, 37),
        (1e5, 5200.0, 100),
    ],
)
def test_it_filters_as_the_prediction_does(
    extra: ModuleType, accel: float, of_motors: float, batch: int
) -> None:
    taps = np.stack([design_taps([mode(f, 0.05)], np.ones(1), 150.0) for f in (45.0, 30.0)])
    bounds = [(-1e3, 1e3)] * 2
    ours = extra.Filter(given(taps, accel, of_motors), bounds)
    ours.rest_at(50.0, 50.0)
    moves = zigzag(40)
    end = round(moves[-1][0] / DT_S) + 1500
    command: dict[int, tuple[float, ...]] = {}
    waiting = list(moves)
    for until in range(0, end, batch):
        while waiting and waiting[0][0] <= until * DT_S + ours.preview_s + 0.3:
            assert not ours.late_move(waiting[0][0])
            ours.plan.add(*waiting.pop(0))
        for k, before, now, after in ours.push(until + 2):
            command[k] = tuple(
                (a + 6 * b + c) / 8 for a, b, c in zip(before, now, after, strict=True)
            )

    plan = extra.command.Plan()
    plan.rest_at(50.0, 50.0)
    for move in moves:
        plan.add(*move)
    x: list[float] = []
    y: list[float] = []
    plan.sample(0, end, DT_S, x, y)
    live = LiveFilter(taps, DT_S, 1e3, accel, np.array(bounds), np.inf, of_motors)
    padded = np.pad(np.array([x, y]), ((0, 0), (live.margin, live.margin)), mode="edge")
    wanted = live.command(padded)
    assert (ours.limited > 0) == (min(accel, of_motors) < 1e4)
    for k, place in command.items():
        assert place == pytest.approx(wanted[:, k], abs=1e-9) if k < end - batch else True
    moving = np.flatnonzero(np.any(np.abs(np.diff(wanted[:, : end - batch])) > 1e-6, axis=0))
    assert set(moving[1:].tolist()) <= command.keys()


def test_what_the_motors_of_a_corexy_bear_goes_along(extra: ModuleType, tmp_path: Path) -> None:
    command = CommandLimits(accel_mm_s2=12_000.0, motors=MotorLimits(accel_mm_s2=17_000.0))
    machine = load_machine("voron-v24-250").model_copy(update={"command": command})
    shaper = BestShaper("zv", 50.0, 50.0, 0.1, 0.0, 0.0)
    taps = np.stack([shaper_taps(pulses, DT_S) for pulses in shaper.pulses])
    design = LiveDesign(taps, (0.0, 0.0), 0.0, shaper, 1.0, 1.0, {}, 0.0)
    file = tmp_path / "export.json"
    file.write_text(export_text(export_document(machine, design)))
    for one in (extra.read_export(file), live_filter(machine, taps)):
        assert (one.velocity_mm_s, one.accel_mm_s2) == (500.0, 12_000.0)
        assert (one.motor_velocity_mm_s, one.motor_accel_mm_s2) == (np.inf, 17_000.0)


@pytest.mark.slow
def test_memory_does_not_grow_with_the_print(extra: ModuleType) -> None:
    taps = np.stack([design_taps([mode(45.0, 0.05)], np.ones(1), 150.0)] * 2)
    ours = extra.Filter(given(taps), [(-1e3, 1e3)] * 2)
    ours.rest_at(50.0, 50.0)
    held = []
    for moves in (zigzag(60), [(m[0] + 600.0, *m[1:]) for m in zigzag(200)]):
        for move in moves:
            ours.plan.add(*move)
            ours.push(int((move[0] - 0.2) / DT_S))
            held.append(len(ours.x) + len(ours.dx) + len(ours.plan.phases) + len(ours.blocked))
    assert max(held[60:]) <= max(held[:60]) + 50
    # A rest of ten hours costs nothing.
    ours.push(36_000_000)
    assert len(ours.x) < 2000


def test_what_may_use_all_of_the_motors_passes(extra: ModuleType) -> None:
    taps = np.stack([design_taps([mode(45.0, 0.05)], np.ones(1), 150.0)] * 2)
    ours = extra.Filter(given(taps), [(-1e3, 1e3)] * 2)
    ours.rest_at(50.0, 50.0)
    moves = zigzag(20)
    ours.block(moves[0][0] - 0.5, moves[-1][0] + 1.0)
    for move in moves:
        ours.plan.add(*move)
    plan = extra.command.Plan()
    plan.rest_at(50.0, 50.0)
    for move in moves:
        plan.add(*move)
    end = int((moves[-1][0]) / DT_S)
    x: list[float] = []
    plan.sample(0, end + 10, DT_S, x, [])
    for k, _, now, _ in ours.push(end - 2 * FADE):
        assert now[0] == pytest.approx(x[k], abs=1e-12)


@pytest.mark.parametrize(
    "what", [what for what in HOSTILE if what not in ("kinematics", "delta", "limits")]
)
def test_bad_exports_are_refused(
    what: str, extra: ModuleType, export: Callable[[str], dict[str, Any]], tmp_path: Path
) -> None:
    """Those that do not fit the printer: on Klipper's own host, `test_klipper_live`."""
    change, reason = HOSTILE[what]
    file = tmp_path / "export.json"
    file.write_text(change(export("ender3")))
    with pytest.raises(extra.export.Refused) as refused:
        extra.read_export(file)
    assert reason in str(refused.value)


class OldStepper:
    """A motor of X in Klipper before 2023-02, which does not say what it follows."""

    def __init__(self) -> None:
        self.kinematics: Any = "Klipper's kinematics"
        self.queue: Any = "Klipper's queue"
        self.at = 12.5

    def set_stepper_kinematics(self, kinematics: Any) -> Any:
        before, self.kinematics = self.kinematics, kinematics
        return before

    def set_trapq(self, queue: Any) -> Any:
        before, self.queue = self.queue, queue
        return before

    def calc_position_from_coord(self, coord: tuple[float, ...]) -> float:
        return coord[0]

    def get_commanded_position(self) -> float:
        return self.at

    def set_position(self, coord: tuple[float, ...]) -> None:
        self.at = coord[0]


def test_motors_of_an_old_klipper_are_taken_and_given_back(extra: ModuleType) -> None:
    stepper = OldStepper()
    library = SimpleNamespace(cartesian_stepper_alloc=lambda _axis: "ours", free=None)
    ffi = (SimpleNamespace(gc=lambda thing, _free: thing), library)
    motor = extra.Motor(stepper, ffi, SimpleNamespace(trapq=lambda: "our queue"))
    motor.engage()
    assert (stepper.kinematics, stepper.queue, stepper.at) == ("ours", "our queue", 12.5)
    motor.release()
    assert stepper.kinematics == "Klipper's kinematics"
    assert stepper.queue == "Klipper's queue"
    assert stepper.at == 12.5


def installed(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = ["sh", str(EXTRA / "install.sh"), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.fixture
def klipper(tmp_path: Path) -> Path:
    (tmp_path / "klippy/extras").mkdir(parents=True)
    (tmp_path / "klippy/klippy.py").touch()
    (tmp_path / ".git/info").mkdir(parents=True)
    return tmp_path


def test_the_installer_links_and_takes_away(klipper: Path) -> None:
    link, exclude = klipper / "klippy/extras/stillpath", klipper / ".git/info/exclude"
    assert "would run: ln" in installed("-n", "-k", klipper).stdout
    assert not link.exists()
    assert not exclude.exists()
    assert "Linked" in installed("-k", klipper).stdout
    assert link.resolve() == EXTRA / "stillpath"
    assert "Nothing to do" in installed("-k", klipper).stdout
    assert exclude.read_text() == "klippy/extras/stillpath\n"
    assert "would run: rm" in installed("-u", "-n", "-k", klipper).stdout
    assert link.is_symlink()
    assert "Taken away" in installed("-u", "-k", klipper).stdout
    assert not link.is_symlink()
    assert exclude.read_text() == ""
    assert installed("-u", "-k", klipper).returncode == 0
    assert (EXTRA / "stillpath/__init__.py").exists()


def test_lines_of_others_stay(klipper: Path) -> None:
    exclude = klipper / ".git/info/exclude"
    exclude.write_text("klippy/extras/led_effect.py")  # and no end of the line
    installed("-k", klipper)
    assert exclude.read_text() == "klippy/extras/led_effect.py\nklippy/extras/stillpath\n"
    installed("-u", "-n", "-k", klipper)
    assert "klippy/extras/stillpath\n" in exclude.read_text()
    installed("-u", "-k", klipper)
    assert exclude.read_text() == "klippy/extras/led_effect.py\n"


@pytest.mark.parametrize(("version", "is_old"), [("Python 2.7.18", True), ("Python 3.9.2", False)])
def test_the_installer_looks_at_klippers_python(version: str, is_old: bool, tmp_path: Path) -> None:
    ours, python = tmp_path / "klipper", tmp_path / "klippy-env/bin/python"
    (ours / "klippy/extras").mkdir(parents=True)
    (ours / "klippy/klippy.py").touch()
    python.parent.mkdir(parents=True)
    # As each of them answers to `-V` and `-c`.
    python.write_text(f'#!/bin/sh\n[ "$1" = -c ] && exit {int(is_old)}\necho {version}\n')
    python.chmod(0o755)
    tried = installed("-k", ours)
    assert tried.returncode == (2 if is_old else 0)
    assert (ours / "klippy/extras/stillpath").is_symlink() != is_old
    if is_old:
        assert "Klipper runs in Python 2.7.18" in tried.stderr
        assert "3.7 or later" in tried.stderr
        assert installed("-u", "-k", ours).returncode == 0


def test_the_installer_refuses_what_is_no_klipper(tmp_path: Path, klipper: Path) -> None:
    nowhere = installed("-k", tmp_path / "nothing")
    assert nowhere.returncode == 2
    assert "no Klipper in" in nowhere.stderr
    (klipper / "klippy/extras/stillpath").mkdir()
    own = installed("-k", klipper)
    assert own.returncode == 2
    assert "is no link" in own.stderr
