"""A machine from RepRapFirmware's config.g; values by the firmware's rules, worked out by hand."""

from __future__ import annotations

from pathlib import Path

import pytest

from stillpath.cli.main import run
from stillpath.models.machine import Machine, MotorLimits
from stillpath.models.store import read_machine

CONFIG_G = """\
; Configuration file for a Duet 3
G90
M83
M550 P"printer; M566 X1"             ; a name that holds a command
M569 P0.0 S1
M669 K1 ; CoreXY
M584 X0.0 Y0.1 Z0.2 E0.3:0.4
M92 X100 Y80.00 Z400 E420:415
M350 X32 Y16 E16:16 I1               ; scales the 100 of X
M203 X18000 Y15000 Z900 E7200:6000 I6
M201 X6000 Y5000.5 Z350 E3000:2500
M566 X540 Y600 Z12 E300:2 P1
M204 P4000 T5500
M208 X-4:300 Y0:305
M208 Z-0.5 S1
M208 Z240 S0
M404 N2.85
M572 D1 S0.09
M572 D0 S0.045
M593 P"ZVD" F43.5 S0.08
M207 S1.2 R0.1 F2400 T1200 Z0.3
M595 P80
M563 P0 D0 H1 F0
"""


@pytest.fixture(autouse=True)
def data_dir(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STILLPATH_DATA_DIR", str(tmp_path / "data"))


@pytest.fixture
def sys(tmp_path: Path) -> Path:
    """Return the folder of the printer's card that config.g is in."""
    folder = tmp_path / "card" / "sys"
    folder.mkdir(parents=True)
    return folder


@pytest.fixture
def make(sys: Path, capsys: pytest.CaptureFixture[str]):
    """Return a function that makes `mine` of a text: its exit code and what it says."""

    def made(text: str, *more: str) -> tuple[int, str]:
        file = sys / "config.g"
        file.write_text(text)
        code = run(["machines", "from-config", str(file), "--name", "mine", *more])
        return code, " ".join("".join(capsys.readouterr()).split())

    return made


@pytest.fixture
def stored(capsys: pytest.CaptureFixture[str]):
    def read() -> Machine:
        assert run(["machines", "show", "mine"]) == 0
        return read_machine(capsys.readouterr().out.encode(), "mine")

    return read


def test_what_a_config_g_sets(make, stored) -> None:
    code, said = make(CONFIG_G)
    machine = stored()
    firmware = machine.firmware
    assert code == 0
    assert machine.kinematics == "corexy"
    assert {axis: (ends.min_mm, ends.max_mm) for axis, ends in machine.travel.items()} == {
        "x": (-4.0, 300.0),
        "y": (0.0, 305.0),
        "z": (-0.5, 240.0),
    }
    x, y, z, e = firmware.drives
    # 100 steps/mm at 16 microsteps are 200 at 32.
    assert [drive.steps_per_mm for drive in (x, y, z, e)] == [200.0, 80.0, 400.0, 420.0]
    assert [drive.max_speed_mm_s for drive in (x, y, z, e)] == [300.0, 250.0, 15.0, 100.0]
    assert [drive.max_accel_mm_s2 for drive in (x, y, z, e)] == [6000.0, 5000.5, 350.0, 2500.0]
    # The firmware takes 0.1 mm/s at least.
    assert [drive.jerk_mm_s for drive in (x, y, z, e)] == [9.0, 10.0, 0.2, 0.1]
    assert (firmware.min_speed_mm_s, firmware.jerk_policy) == (0.1, 1)
    assert (firmware.print_accel_mm_s2, firmware.travel_accel_mm_s2) == (4000.0, 5500.0)
    assert firmware.extruder.filament_diameter_mm == 2.85
    assert machine.pressure_advance_s == 0.045
    assert firmware.shaper.model_dump() == {"type": "zvd", "freq_hz": 43.5, "damping": 0.08}
    assert firmware.retraction.model_dump() == {
        "retract_length_mm": 1.2,
        "retract_speed_mm_s": 40.0,
        "unretract_extra_length_mm": 0.1,
        "unretract_speed_mm_s": 20.0,
    }
    assert firmware.ring_length == 80
    assert machine.axes["x"].nominal.modes[0].f_hz == pytest.approx(43.5)
    # 1.5 times what a diagonal needs, as far as M201 lets the motors.
    assert machine.command.motors == MotorLimits(accel_mm_s2=7501)
    assert "step_clock_hz=750000 (937500 on Duet 2)" in said
    assert "ring_length" not in said
    assert (
        "config.g line 8: M92 E420:415: extruders differ; the machine has the first one's" in said
    )
    assert "M201 E3000:2500: extruders differ; the machine has the least of it" in said
    assert "M207 Z0.3: the machine does not know that G10 lifts" in said


@pytest.mark.parametrize(
    ("before", "after", "steps"),
    [
        ("M92 X100 ", "M350 X64\nM92 X100 ", 50.0),  # 32 behind it: half
        ("M350 X32", "M350 X16", 100.0),
        ("M92 X100 ", "M92 S32 X100 ", 100.0),  # 50 at 16, 100 at 32
    ],
)
def test_steps_follow_the_microstepping(make, stored, before: str, after: str, steps: float):
    assert make(CONFIG_G.replace(before, after))[0] == 0
    assert stored().firmware.x.steps_per_mm == steps


def test_speeds_in_mm_per_s(make, stored) -> None:
    text = CONFIG_G.replace("M203 X18000 Y15000 Z900 E7200:6000 I6", "M203 S1 X300 Y250 Z15 E100")
    assert make(text.replace("M566 X540 Y600", "M205 X9 Y10\nM566"))[0] == 0
    x, y, _, e = stored().firmware.drives
    assert (x.max_speed_mm_s, y.max_speed_mm_s, e.max_speed_mm_s) == (300.0, 250.0, 100.0)
    assert (x.jerk_mm_s, y.jerk_mm_s) == (9.0, 10.0)


def test_what_it_leaves_out_is_the_firmwares_default(make, stored) -> None:
    assert make("M669 K0\nM201 X4000\n", "--fx", "51")[0] == 0
    machine = stored()
    assert machine.kinematics == "cartesian"
    assert (machine.firmware.x.max_accel_mm_s2, machine.firmware.y.max_accel_mm_s2) == (4e3, 1e3)
    assert (machine.travel["z"].min_mm, machine.travel["z"].max_mm) == (0.0, 200.0)
    assert machine.firmware.shaper.type == "none"
    assert [machine.axes[axis].nominal.modes[0].f_hz for axis in "xy"] == [51.0, 50.0]


def test_files_that_it_calls(make, stored, sys: Path) -> None:
    (sys / "Drives.g").write_text('M201 X7000 Y6500 Z300 E2000\nM98 P"limits/travel.g"\n')
    (sys / "limits").mkdir()
    (sys / "limits" / "travel.g").write_text("M208 X0:180 Y0:180 Z0:170\n")
    (sys.parent / "macros").mkdir()
    (sys.parent / "macros" / "speed.g").write_text("M203 X12000 Y12000 Z600 E3000\n")
    (sys / "config-override.g").write_text("; saved by M500\nM208 S1 Z-1.25\n")
    text = 'M669 K1\nM98 P"drives.g"\nM98 P"0:/macros/speed.g"\nM501\nM566 X600 Y600 Z12 E120\n'
    assert make(text)[0] == 0
    machine = stored()
    assert machine.firmware.x.max_accel_mm_s2 == 7000.0
    assert machine.firmware.x.max_speed_mm_s == 200.0
    assert (machine.travel["x"].max_mm, machine.travel["z"].min_mm) == (180.0, -1.25)
    assert run(["machines", "history", "mine"]) == 0


_MOVED = 'M505 P"printing"\nM98 P"limits.g"\nM501\n'


def test_files_in_another_folder_of_the_system(make, stored, sys: Path) -> None:
    """M505 was passed over: the file of that name beside config.g was read instead."""
    (sys / "limits.g").write_text("M201 X7000 Y6500 Z300 E2000\n")
    (sys / "Printing").mkdir()
    (sys / "Printing" / "limits.g").write_text("M201 X4000 Y4000 Z300 E2000\n")
    (sys / "Printing" / "config-override.g").write_text("M208 S1 Z-1.25\n")
    code, said = make(CONFIG_G + _MOVED)
    assert code == 0
    assert "not read" not in said
    machine = stored()
    assert (machine.firmware.x.max_accel_mm_s2, machine.travel["z"].min_mm) == (4000.0, -1.25)


def test_another_folder_of_the_system_that_is_not_there(make, stored, sys: Path) -> None:
    (sys / "limits.g").write_text("M201 X7000 Y6500 Z300 E2000\n")
    code, said = make(CONFIG_G + _MOVED)
    assert code == 0
    assert "/sys/printing/limits.g: not read, so what it sets is unknown" in said
    assert "/sys/printing/config-override.g: not read" in said
    assert stored().firmware.x.max_accel_mm_s2 == 6000.0


def test_files_that_are_not_there(make, stored) -> None:
    call = 'M98 P"/macros/speeds.g"\n'
    code, said = make(call + "M669 K1\nM92 X80 Y80 Z400 E400\nM203 X9000 Y9000 Z600 E3000\n")
    assert code == 2
    assert "no M201 X Y Z E in it (acceleration); it may be in /macros/speeds.g" in said
    code, said = make(CONFIG_G + call)
    assert code == 0
    assert "/macros/speeds.g: not read, so what it sets is unknown" in said
    assert stored().firmware.x.max_accel_mm_s2 == 6000.0


def test_numbers_that_have_names(make, stored) -> None:
    text = CONFIG_G.replace("M208 X-4:300", "global xEnd = 310 ; mm\nM208 X-4:{global.xEnd}")
    assert make(text.replace("M201 X6000", "M201 X{ 5500 }"))[0] == 0
    machine = stored()
    assert (machine.travel["x"].max_mm, machine.firmware.x.max_accel_mm_s2) == (310.0, 5500.0)


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        ("M669 K1", "M665 R105 L215 H250", "kinematics (M669 K3) are neither cartesian"),
        ("M669 K1", "M669 K8", "kinematics (M669 K8) are neither cartesian"),
        ("M669 K1", "M669 K1 X1:0:0 Y1:-1:0", "config.g line 6: M669 with a matrix of its own"),
        ("M669 K1", "M669 K1 S100 T0.2", "line 6: M669 S and T cut moves into segments"),
        ('P"ZVD"', 'P"custom" H0.4:0.7', 'M593 P"custom" cannot be restored behind a stream'),
        (
            "M201 X6000",
            "M201 X{var.a * 2}",
            "line 11: M201 has {var.a * 2}, which only the printer",
        ),
        ("M208 X-4:300", "M208 X-4:{var.x}", "line 14: M208 has {var.x}, which only the printer"),
        ("M201 X6000", "M201 Xfast", "config.g line 11: M201 X: a number is needed"),
        (
            "M201 X6000",
            "var a = 100 * 2\nM201 X{var.a}",
            "line 12: M201 has {var.a}, which only the printer can evaluate",
        ),
        (
            "M201 X6000",
            "if exists(global.fast)\n  ; faster\n  M201 X9000\nM201 X6000",
            "line 13: M201 stands under a condition",
        ),
        ("M208 X-4:300", "M208 X300:-4", "min_mm 300.0 must be below max_mm -4.0"),
        ("M204 P4000", 'M98 P"config.g"\nM204 P4000', "line 13: config.g is called while it is"),
        ("M204 P4000", 'if {true}\n  M505 P"b"\nM204 P4000', "M505 stands under a condition"),
        ("M593", "M593 " + "X1 " * 100 + ";", "more than 255"),
    ],
)
def test_what_is_refused(make, before: str, after: str, words: str) -> None:
    code, said = make(CONFIG_G.replace(before, after))
    assert code == 2
    assert words in said
    assert run(["machines", "show", "mine"]) == 2


def test_a_line_behind_a_block_counts(make, stored) -> None:
    block = 'if fileexists("0:/sys/own.g")\n  M98 P"own.g"\nelse\n  echo "none"\nM201 X6000'
    code, said = make(CONFIG_G.replace("M201 X6000", block))
    assert code == 0
    assert "own.g (config.g line 12, under a condition): not read" in said
    assert stored().firmware.x.max_accel_mm_s2 == 6000.0


def test_what_it_does_not_say_is_stated(make, stored) -> None:
    code, said = make(
        CONFIG_G.replace("M595 P80\n", ""), "--set", "ring_length=60", "--set", "prepare_least_s=0"
    )
    assert code == 0
    assert (stored().firmware.ring_length, stored().firmware.prepare_least_s) == (60, 0.0)
    assert "assumed, for config.g does not say it: step_clock_hz=750000" in said


def test_new_settings_of_a_machine(make, stored, sys: Path, capsys) -> None:
    """What config.g does not say stays, and so do the plants."""
    make(CONFIG_G, "--set", "step_clock_hz=937500", "--set", "extruder.nozzle_diameter_mm=0.6")
    before = stored()
    text = CONFIG_G.replace("M201 X6000", "M201 X4000").replace("M593", ";M593")
    (sys / "config.g").write_text(text.replace("M208 X-4:300", "M208 X-4:290"))
    assert run(["machines", "set-firmware", "mine", str(sys / "config.g")]) == 0
    assert "assumed" not in capsys.readouterr().out
    after = stored()
    assert after.firmware.x.max_accel_mm_s2 == 4000.0
    assert after.command.motors == MotorLimits(accel_mm_s2=6000)
    assert after.travel["x"].max_mm == 290.0
    assert after.firmware.step_clock_hz == 937500.0
    assert after.firmware.extruder.nozzle_diameter_mm == 0.6
    assert after.firmware.shaper.type == "none"
    assert after.axes == before.axes
    (sys / "config.g").write_text(CONFIG_G.replace("M669 K1", "M669 K0"))
    assert run(["machines", "set-firmware", "mine", str(sys / "config.g")]) == 2
    assert "measured as corexy, and this is of a cartesian printer" in capsys.readouterr().err


def test_a_klipper_machine_becomes_one_with_reprapfirmware(sys: Path, capsys, stored) -> None:
    (sys / "config.g").write_text(CONFIG_G)
    words = ["machines", "set-firmware", "voron-v24-250", str(sys / "config.g"), "--as", "mine"]
    assert run(words) == 0
    assert "assumed, for config.g does not say it" in capsys.readouterr().out
    machine = stored()
    assert machine.firmware.kind == "reprapfirmware"
    assert machine.axes["x"].provenance is not None or machine.axes["x"].members


def test_m503_says_where_a_config_g_goes(make, sys: Path, capsys) -> None:
    make(CONFIG_G)
    file = str(sys / "config.g")
    assert run(["machines", "from-m503", file, "--name", "n", "--travel", "9x9x9"]) == 2
    assert "config.g: give that to machines from-config" in capsys.readouterr().err
