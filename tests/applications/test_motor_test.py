"""The search for lost steps: what is written, and what a console's text leads to."""

from __future__ import annotations

import math
import os
import subprocess
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import pytest

from stillpath.applications.proof.motor_test import borne, levels_of, motor_test
from stillpath.cli.main import run
from stillpath.models.errors import ModelError
from stillpath.models.store import load_machine
from tests.gcode.cutting import ender3_with
from tests.gcode.plain_reader import read
from tests.service.jobs.site import STILLPATH


def console(*counts: tuple[int, int]) -> str:
    return "\n".join(f"// mcu: stepper_x:{x} stepper_y:{y} stepper_z:0" for x, y in counts)


def console_of_four_motors(*counts: tuple[int, int]) -> str:
    """Return what Klipper says where each axis has a second motor, and those move as counted."""
    return "\n".join(
        f"// mcu: stepper_x:0 stepper_x1:{x} stepper_y:0 stepper_y1:{y} stepper_z:0"
        for x, y in counts
    )


@pytest.mark.parametrize("name", ["ender3", "voron-v24-250"])
def test_what_is_written(name: str) -> None:
    machine = load_machine(name)
    text = motor_test(machine, 20_000.0)
    levels = levels_of(text)
    assert levels[0].accel_mm_s2 == machine.firmware.planner.max_accel_mm_s2
    assert levels[-1].accel_mm_s2 == 20_000
    assert all(1.0 < b.accel_mm_s2 / a.accel_mm_s2 < 1.26 for a, b in pairwise(levels))
    assert text.count("GET_POSITION") == len(levels) + 1
    reading = read(text.encode())
    for k, axis in enumerate(("x", "y")):
        assert machine.travel[axis].min_mm <= reading.low_mm[k]
        assert reading.high_mm[k] <= machine.travel[axis].max_mm
    # The printer is left as it was, but for a shaper that nobody states.
    assert text.index("SHAPER_FREQ_X=0") < text.index("level 1")
    assert "the shaper stays off until FIRMWARE_RESTART" in text
    assert "ACCEL=5000 " in text.split("SET_VELOCITY_LIMIT")[-1]


@pytest.mark.parametrize("console", [console, console_of_four_motors])
def test_what_the_console_says(console: Callable[..., str]) -> None:
    levels = levels_of(motor_test(load_machine("ender3"), 9000.0))
    fine = [(100, -200), (103, -198), (96, -205), (100, -215)]
    assert len(levels) == 4
    assert borne(levels, console(*fine, fine[0]), 16) == 4
    assert borne(levels, console(*fine, (1000, 0)), 16) == 3
    assert borne(levels, console(fine[0], (100, -216), *fine[:3]), 16) == 0
    with pytest.raises(ModelError, match="holds 4 answers"):
        borne(levels, console(*fine), 16)
    with pytest.raises(ModelError, match="has no levels"):
        levels_of("G28")


FINE = [(0, 0)] * 5
START, RESUMED = (f"Starting SD card print (position {at})" for at in (0, 7))


def echoed(
    most: float, counts: list[tuple[int, int]], over: str = "echo: the search is over\n"
) -> str:
    """Return a console with the lines of M118, as a host shows what it sends and receives."""
    told = levels_of(motor_test(load_machine("ender3"), most))
    lines = [f"Recv: {console(counts[0])}"]
    for number, (level, count) in enumerate(zip(told, counts[1:], strict=False), 1):
        text = (
            f"level {number}: accel {level.accel_mm_s2:.0f} mm/s2, "
            f"step {level.speed_step_mm_s:.1f} mm/s"
        )
        lines += [f"Send: M118 {text}", f"echo: {text}", f"Recv: {console(count)}"]
    return "\n".join([*lines, over])


def logged(*runs: str) -> str:
    return "".join(f"{START}\n{run}\nExiting SD card print (position 9)\n" for run in runs)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (logged(console(*FINE, (0, 0)), console(*FINE)), 4),
        (logged(f"{console(*FINE[:3])}\n{RESUMED}\n{console(*FINE[:2])}"), 4),
        (logged(console(*FINE), "another print"), 4),
        (logged(console(*FINE), console(*FINE[:4])), "holds 4 answers"),
        (console((0, 0), *FINE), "holds 6 answers"),
        (echoed(6000.0, FINE[:2]) + echoed(9000.0, FINE) + console((50, 50)), 4),
        (echoed(9000.0, FINE) + echoed(9000.0, FINE[:4], ""), "last search has no end"),
        (echoed(9000.0, FINE[:4]), "other levels"),
        (echoed(12000.0, FINE), "other levels"),
        ("\n".join(reversed(echoed(9000.0, FINE).splitlines())), "oldest line first"),
    ],
)
def test_only_one_whole_run_counts(text: str, said: int | str) -> None:
    levels = levels_of(motor_test(load_machine("ender3"), 9000.0))
    if isinstance(said, int):
        assert borne(levels, text, 16) == said
        return
    with pytest.raises(ModelError, match=said):
        borne(levels, text, 16)


def test_answers_of_two_printers_are_refused() -> None:
    levels = levels_of(motor_test(load_machine("ender3"), 9000.0))
    mixed = f"{console(*4 * [(0, 0)])}\n{console_of_four_motors((0, 0))}"
    with pytest.raises(ModelError, match="answer 5 to GET_POSITION lists other steppers"):
        borne(levels, mixed, 16)


def test_other_firmwares_and_limits_that_are_not_above() -> None:
    with pytest.raises(ModelError, match="runs marlin"):
        motor_test(ender3_with("marlin"), 9000.0)
    with pytest.raises(ModelError, match="5000 mm/s2 already"):
        motor_test(load_machine("ender3"), 5000.0)
    for most in (1e12, math.inf, math.nan):
        with pytest.raises(ModelError, match=r"beyond 16 levels .* search up to 142109 at most"):
            motor_test(load_machine("ender3"), most)
    assert len(levels_of(motor_test(load_machine("ender3"), 142_108.0))) == 16


def test_from_the_search_to_the_machine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("STILLPATH_DATA_DIR", str(tmp_path / "data"))
    written, said = tmp_path / "motors.gcode", tmp_path / "console.txt"
    assert run(["machines", "put", str(machine_file(tmp_path))]) == 0
    assert run(["motor-test", "--machine", "mine", "-o", str(written), "--to", "9000"]) == 0
    best = levels_of(written.read_text())[2]
    said.write_text(console((5, 5), (5, 5), (6, 5), (5, 9), (5, 90)))
    assert run(["machines", "motors", "ender3", str(written), str(said)]) == 2
    assert "stored" not in capsys.readouterr().out  # as it is built in
    assert run(["machines", "motors", "mine", str(written), str(said), "--margin", ".8"]) == 0
    assert "level 4 lost steps" in capsys.readouterr().out
    assert run(["machines", "show", "mine"]) == 0
    shown = capsys.readouterr().out
    assert f'"accel_mm_s2": {round(0.8 * best.accel_mm_s2)}.0' in shown
    said.write_text(console((5, 5), (5, 50), (5, 50), (5, 50), (5, 50)))
    assert run(["machines", "motors", "mine", str(written), str(said)]) == 2
    assert "lost at the printer's own limits" in capsys.readouterr().err


@pytest.mark.skipif(os.name != "posix", reason="limits the size of files")
def test_a_full_disk_leaves_no_half_of_it(tmp_path: Path) -> None:
    """Limits would be raised and never restored."""
    command = [*STILLPATH, "motor-test", "-m", "ender3", "-o", str(tmp_path / "motors.gcode")]
    limited = ["sh", "-c", 'ulimit -f 4; exec "$@"', "sh", *command]
    # Python would keep the halves of its compiled modules, too.
    environment = os.environ | {"PYTHONDONTWRITEBYTECODE": "1"}
    ran = subprocess.run(limited, capture_output=True, text=True, check=False, env=environment)
    assert (ran.returncode, "motors.gcode: File too large" in ran.stderr) == (1, True)
    assert list(tmp_path.iterdir()) == []


def machine_file(folder: Path) -> Path:
    machine = load_machine("ender3").model_copy(update={"name": "mine"})
    file = folder / "mine.json"
    file.write_text(machine.model_dump_json())
    return file
