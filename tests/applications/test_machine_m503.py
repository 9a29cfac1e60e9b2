"""A machine from what Marlin prints for M503."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from stillpath.cli.main import run
from stillpath.models.machine import CommandLimits
from stillpath.models.store import read_machine
from tests.compensating import compensated

M503 = """\
Send: M503
Recv: echo:; Linear Units:
Recv: echo:  G21 ; (mm)
Recv: echo:; Filament settings (Disabled):
Recv: echo:  M200 S0 D1.75
Recv: echo:; Steps per unit:
Recv: echo:  M92 X80.00 Y80.40 Z400.00 E93.00
Recv: echo:; Max feedrates (units/s):
Recv: echo:  M203 X500.00 Y400.00 Z5.00 E25.00
Recv: echo:; Max Acceleration (units/s2):
Recv: echo:  M201 X500.00 Y600.00 Z100.00 E5000.00
Recv: echo:; Acceleration (units/s2) (P<print-accel> R<retract-accel> T<travel-accel>):
Recv: echo:  M204 P510.00 R520.00 T530.00
Recv: echo:; Advanced (B<min_segment_time_us> S<min_feedrate> T<min_travel_feedrate> J<junc_dev>):
Recv: echo:  M205 B20000.00 S0.00 T0.00 J0.08
Recv: echo:; Retract (S<length> F<feedrate> Z<lift>)
Recv: echo:  M207 S3.00 W13.00 F2700.00 Z0.00
Recv: echo:; Recover (S<length> F<feedrate>)
Recv: echo:  M208 S0.10 W0.00 F480.00
Recv: echo:; Input Shaping:
Recv: echo:  M593 X F40.50 D0.15
Recv: echo:  M593 Y F31.00 D0.10
Recv: echo:  M593 Z F21.00 D0.20
Recv: echo:; Linear Advance:
Recv: echo:  M900 T0 K0.05
Recv: echo:  M900 T1 K0.80
Recv: ok
"""


@pytest.fixture(autouse=True)
def data_dir(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STILLPATH_DATA_DIR", str(tmp_path / "data"))


@pytest.fixture
def make(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Return a function that makes `mine` of a text: its exit code, stdout and stderr."""

    def made(text: str, *more: str) -> tuple[int, str, str]:
        file = tmp_path / "m503.txt"
        file.write_text(text)
        words = ["--name", "mine", "--travel", "235x235x250", *more]
        code = run(["machines", "from-m503", str(file), *words])
        return code, *capsys.readouterr()

    return made


def stored(capsys: pytest.CaptureFixture[str]):
    assert run(["machines", "show", "mine"]) == 0
    return read_machine(capsys.readouterr().out.encode(), "mine")


@pytest.mark.parametrize(
    "line", ["echo:  M970 X1 Y0", "FIRMWARE_NAME:Prusa-Firmware-Buddy 6.2.4+8909 (Github)"]
)
def test_a_buddy_is_none_of_marlins_releases(make, capsys, line: str) -> None:
    """Prusa's printers answer M503 as others do, and were taken for one that takes a stream."""
    code, out, _ = make(f"{line}\n{M503}")
    assert (code, stored(capsys).firmware.variant) == (0, "prusa")
    assert "variant=2.1" not in out
    assert "use method advise" in out


MK4 = """\
echo:  G21    ; Units in mm (mm)

echo:Filament settings: Disabled
echo:  M200 D1.75
echo:  M200 D0
echo:Steps per unit:
echo: M92 X100.00 Y100.00 Z400.00 E380.00
echo:Maximum feedrates (units/s):
echo:  M203 X300.00 Y300.00 Z40.00 E100.00
echo:Maximum Acceleration (units/s2):
echo:  M201 X4000.00 Y4000.00 Z200.00 E2500.00
echo:Acceleration (units/s2): P<print_accel> R<retract_accel> T<travel_accel>
echo:  M204 P1250.00 R800.00 T1250.00
echo:Advanced: B<min_segment_time_us> S<min_feedrate> T<min_travel_feedrate> X<max_x_jerk>
echo:  M205 B20000.00 S0.00 T0.00 X8.00 Y8.00 Z2.00 E5.00
echo:Unified Bed Leveling:
echo:  M420 S0 Z0.00
echo:Filament load/unload lengths:
echo:  M603 L80.00 U80.00
ok
"""
"""Of Buddy 5.2, and of printers without phase stepping (MINI, MK3.5) until today."""

MK3 = """\
echo:Steps per unit:
echo:  M92 X100.00 Y100.00 Z400.00 E280.00
echo:UStep resolution:
echo: M350 X16 Y16 Z16 E32
echo:Maximum feedrates - normal (mm/s):
echo:  M203 X200.00 Y200.00 Z12.00 E120.00
echo:Maximum feedrates - stealth (mm/s):
echo:  M203 X100.00 Y100.00 Z12.00 E120.00
echo:Maximum acceleration - normal (mm/s2):
echo:  M201 X1250 Y1250 Z500 E5000
echo:Maximum acceleration - stealth (mm/s2):
echo:  M201 X960 Y960 Z500 E5000
echo:Acceleration: P=print, R=retract, T=travel
echo:  M204 P1250.00 R1250.00 T1250.00
echo:Advanced variables: S=Min feedrate (mm/s), T=Min travel feedrate (mm/s)
echo:  M205 S0.00 T0.00 B20000 X8.00 Y8.00 Z0.40 E4.50
echo:Arc Settings: P:Max length(mm) S:Min length (mm) N:Corrections R:Min segments F:Segments/sec.
echo:  M214 P1.00 S0.50 N25 R20 F0
"""


def test_a_buddy_without_phase_stepping_is_none_of_marlins_releases(make, capsys) -> None:
    """Its answer has the headings of Marlin before 2.0.5, and was taken for 2.0's."""
    code, out, _ = make(MK4)
    firmware = stored(capsys).firmware
    assert (code, firmware.variant, firmware.block_buffer_size) == (0, "prusa", 32)
    assert firmware.shaper is None  # it has one, and does not say which
    assert "HWLIMIT_NORMAL_MAX_ACCELERATION" in out


@pytest.mark.parametrize(
    "text",
    [
        "FIRMWARE_NAME:Marlin 2.0.3 (GitHub)\n" + MK4,
        MK4.replace("ok\n", "echo:  M145 S0 H180 B70 F0\n"),
        MK4.replace("X8.00", "J0.02 X8.00"),
        MK4.replace("Unified", "; Unified"),
        MK4.replace("Unified", "Mesh"),
    ],
)
def test_marlin_before_2_0_5_is_no_buddy(make, capsys, text: str) -> None:
    assert make(text)[0] == 0
    assert stored(capsys).firmware.variant == "2.0"


@pytest.mark.parametrize(
    "text",
    [
        MK3,
        # 1.1.9 and 1.1.8, as on Creality's and Artillery's printers of 2018 to 2020.
        MK4.replace("Advanced: B<", "Advanced: Q<").replace("M205 B20000.00", "M205 Q20000"),
        MK4.replace("Advanced: B<", "Advanced: S<").replace("B20000.00 S0.00", "S0.00 B20000"),
    ],
)
def test_marlin_1_runs_on_an_8_bit_board(make, capsys, text: str) -> None:
    """A stream for a 32-bit board was written for it."""
    code, out, _ = make(text)
    firmware = stored(capsys).firmware
    assert (code, firmware.board, firmware.variant) == (0, "avr", "2.1")
    assert "board=32bit" not in out
    assert "can be simulated, not compensated: an 8-bit board" in out
    assert make(text, "--name", "other", "--set", "board=32bit")[1].count("compensated") == 0


def test_marlin_1_0_has_other_words(make, capsys) -> None:
    """Such an answer was said to be incomplete, and to be sent again."""
    text = MK3.replace("P1250.00 R1250.00 T1250.00", "S1250.00 T1500.00").replace(" Y8.00", "")
    assert make(text)[0] == 0
    planner = stored(capsys).firmware.planner
    assert (planner.accel_mm_s2, planner.travel_accel_mm_s2) == (1250.0, 1250.0)
    assert (planner.retract_accel_mm_s2, planner.jerk_mm_s.y) == (1500.0, 8.0)


def test_an_mk3_has_the_limits_of_its_normal_mode(make, capsys) -> None:
    make(MK3)
    planner = stored(capsys).firmware.planner
    assert (planner.max_feedrate_mm_s.x, planner.max_accel_mm_s2.y) == (200.0, 1250.0)


def test_an_mk3_says_how_it_cuts_arcs(make, capsys) -> None:
    """With the 72 pieces a circle that Marlin makes, a circle of 2 mm took a third less."""
    make(MK3)
    firmware = stored(capsys).firmware
    assert (firmware.arc_resolution_mm, firmware.min_arc_segment_mm) == (1.0, 0.5)
    assert firmware.min_circle_segments == 20
    assert make(MK3.replace("P1.00 S0.50 N25 R20", "P1.00 S0.00 N25 R0"), "--name", "other")[0] == 0


def test_axes_that_begin_beside_the_bed(make, capsys) -> None:
    """Start codes of Creality's printers draw a line at X-2.1 there."""
    assert make(M503, "--travel=-4:220x-17:227x250")[0] == 0
    travel = stored(capsys).travel
    assert [(travel[a].min_mm, travel[a].max_mm) for a in ("x", "y", "z")] == [
        (-4.0, 220.0),
        (-17.0, 227.0),
        (0.0, 250.0),
    ]


def test_what_other_tools_have_is_told(make) -> None:
    """The document has one value of each; what a stream restores is that."""
    _, out, _ = make(M503)
    assert "other tools differ: M900 T1 K0.8; " in out
    same = M503.replace("K0.80", "K0.05").replace("Recv: ok", "Recv: M203 T1 E25.00\nRecv: ok")
    _, out, _ = make(same, "--name", "same")
    assert "other tools" not in out
    _, out, _ = make(same.replace("T1 E25", "T1 E45"), "--name", "faster")
    assert "other tools differ: M203 T1 E45; " in out


@pytest.mark.parametrize(
    "text",
    [
        M503.replace("Advanced (B", "Advanced: B").replace("J<junc_dev>):", "J<junc_dev>"),
        "Recv: FIRMWARE_NAME:Marlin 2.0.9.3 (Jan 27 2022 12:07:46) SOURCE_CODE_URL:..\n" + M503,
    ],
)
def test_marlin_2_0_is_noticed(make, capsys, text: str) -> None:
    """Its first steps are slower than 2.1's: a file for the wrong one is executed late."""
    code, out, _ = make(text)
    assert (code, stored(capsys).firmware.variant) == (0, "2.0")
    assert "variant=2.1" not in out
    _, out, _ = make(text, "--name", "other", "--set", "variant=2.1")
    assert "variant" not in out
    newer = "FIRMWARE_NAME:Marlin 2.1.2.5 (Nov 18 2024)\n" + M503
    _, out, _ = make(newer, "--name", "newer")
    assert "variant=2.1" in out


def test_what_m503_says_is_in_the_machine(make, capsys) -> None:
    code, out, err = make(
        M503, "--set", "min_steps_per_segment=1", "--set", "variant=2.0", "--fy", "29"
    )
    assert (code, err) == (0, "")
    assert "mine: revision 1" in out
    assumed = next(line for line in out.splitlines() if "assumed" in line)
    assert "block_buffer_size=16, s_curve=false, step_smoothing_hz=0;" in assumed
    assert "min_steps_per_segment" not in assumed

    machine = stored(capsys)
    firmware = machine.firmware
    assert (firmware.kind, firmware.variant) == ("marlin", "2.0")
    assert firmware.min_steps_per_segment == 1
    assert firmware.steps_per_mm.y == 80.4
    assert firmware.planner.max_feedrate_mm_s.y == 400
    assert firmware.planner.max_accel_mm_s2.y == 600
    limits = firmware.planner
    assert (limits.accel_mm_s2, limits.retract_accel_mm_s2) == (510, 520)
    assert (limits.travel_accel_mm_s2, limits.junction_deviation_mm) == (530, 0.08)
    assert firmware.junction == "deviation"
    assert (firmware.shaper.freq_x_hz, firmware.shaper.damping_y) == (40.5, 0.1)
    assert (firmware.linear_advance, firmware.linear_advance_k_s) == (True, 0.05)
    assert (firmware.retraction.retract_speed_mm_s, firmware.retraction.unretract_speed_mm_s) == (
        45,
        8,
    )
    assert machine.travel["z"].max_mm == 250
    nominal = [machine.axes[axis].nominal.modes[0].f_hz for axis in ("x", "y")]
    assert nominal == [40.5, 29]


def test_what_is_not_built_in_is_not_there(make, capsys) -> None:
    kept = [
        line for line in M503.splitlines() if not any(c in line for c in ("M207", "M593", "M900"))
    ]
    text = "\n".join(kept).replace("J0.08", "X10.00 Y9.00 Z0.30 E5.00")
    assert make(text)[0] == 0
    firmware = stored(capsys).firmware
    assert firmware.junction == "classic_jerk"
    assert firmware.planner.jerk_mm_s.y == 9
    assert (firmware.linear_advance, firmware.retraction) == (False, None)
    assert (firmware.shaper.freq_x_hz, firmware.shaper.freq_y_hz) == (0, 0)


@pytest.mark.parametrize(
    ("lines", "on", "version"),
    [
        (["M493 S1 A37.00 B38.00 D0 F0.00 H0.00 P0 K0.00"], True, 1),
        (["M493 S1 D0 H1", "M493 X C8 A37.00 F0.00 I0.10", "M493 Y C8 A38.00 I0.10"], True, 2),
        (["M493 S0 D0 H1", "M493 X C0 A37.00 I0.10", "M493 Y C0 A38.00 I0.10"], False, 2),
        ([], False, 2),
    ],
)
def test_fixed_time_motion_of_both_versions(
    make, capsys, lines: list[str], on: bool, version: int
) -> None:
    said = "".join(f"Recv: echo:  {line}\n" for line in lines)
    assert make(M503.replace("Recv: ok", f"{said}Recv: ok"))[0] == 0
    firmware = stored(capsys).firmware
    assert (firmware.ft_motion, firmware.ft_motion_version) == (on, version)


@pytest.mark.parametrize(
    ("text", "more", "words"),
    [
        ("[printer]\nkinematics: corexy\n", (), ("m503.txt", "M203", "save all of")),
        (M503.replace("M92 X80.00", "M92"), (), ("M92 X",)),
        (M503.replace("G21", "G20"), (), ("inches", "G21")),
        # As Marlin 2.1 prints it for a delta, and Snapmaker's for the J1.
        (M503 + "echo:  M665 L215 R105.2 H330 S200\n", (), ("M665", "delta", "as sliced")),
        (M503.replace("M593 X F", "M593 X P4 F"), (), ("M593 X P", "J1", "as sliced")),
        # RepRapFirmware's answer is its config.g.
        (
            "M92 X80 Y80 Z400 E420:420\nM566 X600 Y600 Z60 E300:300 P1\nM201 X400 Y400 Z25 E300\n",
            (),
            ("M566", "RepRapFirmware", "set-firmware"),
        ),
        (M503, ("--travel", "235"), ("--travel", "235x235x250")),
        (M503, ("--travel", "0:1:235x235x250"), ("--travel", "-4:220")),
        (M503, ("--set", "s_curve"), ("FIELD=VALUE",)),
        (M503, ("--set", "s_curv=true"), ("s_curv",)),
        (M503, ("--kinematics", "delta"), ("kinematics", "delta")),
    ],
)
def test_what_is_wrong_is_one_line(make, text: str, more: tuple[str, ...], words) -> None:
    code, out, err = make(text, *more)
    assert (code, out, err.count("\n")) == (2, "", 1)
    for word in words:
        assert word in err


def test_an_own_machine_takes_a_later_answer_and_keeps_what_that_does_not_say(
    make, capsys, tmp_path: Path
) -> None:
    make(M503, "--set", "min_steps_per_segment=1", "--set", "variant=2.0")
    file = tmp_path / "later.txt"
    file.write_text(M503.replace("P510.00", "P900.00").replace("M593 Y F31.00 D0.10", ""))
    assert run(["machines", "set-firmware", "mine", str(file)]) == 0
    assert capsys.readouterr().out.startswith("mine: revision 2")
    firmware = stored(capsys).firmware
    assert (firmware.variant, firmware.min_steps_per_segment) == ("2.0", 1)
    assert (firmware.planner.accel_mm_s2, firmware.planner.travel_accel_mm_s2) == (900, 530)
    assert (firmware.shaper.freq_x_hz, firmware.shaper.freq_y_hz) == (40.5, 0)
    assert run(["machines", "diff", "mine", "1", "2"]) == 0
    assert "firmware.planner.accel_mm_s2: 510 -> 900" in capsys.readouterr().out


def test_what_m503_rounds_stays_exact(make, capsys, tmp_path: Path) -> None:
    """J0.013 and K0.045 are printed as J0.01 and K0.05."""
    exact = ("--set", "planner.junction_deviation_mm=0.013", "--set", "linear_advance_k_s=0.045")
    text = M503.replace("J0.08", "J0.01")
    out = make(text, *exact)[1]
    note = next(line for line in out.splitlines() if line.startswith("rounded by M503"))
    assert "shaper.damping_x=0.15" in note
    assert "linear_advance_k_s" not in note
    file = tmp_path / "later.txt"
    file.write_text(text.replace("P510.00", "P900.00"))
    assert run(["machines", "set-firmware", "mine", str(file)]) == 0
    capsys.readouterr()
    firmware = stored(capsys).firmware
    assert firmware.planner.accel_mm_s2 == 900
    assert firmware.planner.junction_deviation_mm == 0.013
    assert firmware.linear_advance_k_s == 0.045
    file.write_text(text.replace("J0.01", "J0.02").replace("K0.05", "K0.00"))
    assert run(["machines", "set-firmware", "mine", str(file)]) == 0
    capsys.readouterr()
    firmware = stored(capsys).firmware
    assert firmware.planner.junction_deviation_mm == 0.02
    assert firmware.linear_advance_k_s == 0.0


def test_a_machine_of_another_firmware_becomes_one_with_marlin(capsys, tmp_path: Path) -> None:
    file = tmp_path / "m503.txt"
    file.write_text(M503)
    assert run(["machines", "set-firmware", "ender3", str(file), "--as", "mine"]) == 0
    capsys.readouterr()
    firmware = stored(capsys).firmware
    assert (firmware.kind, firmware.variant, firmware.steps_per_mm.y) == ("marlin", "2.1", 80.4)
    file.write_text("echo:  M92 X80.00 Y80.00 Z400.00 E93.00\n")
    assert run(["machines", "set-firmware", "mine", str(file)]) == 2
    assert "no M203 X in it; send M503 and save all" in capsys.readouterr().err


def test_the_command_has_room_above_what_the_printer_allows(make, capsys) -> None:
    fast = M503.replace("X500.00 Y400.00", "X900.00 Y900.00").replace("P510", "P30000")
    make(fast.replace("M201 X500.00 Y600.00", "M201 X40000.00 Y40000.00"))
    command = stored(capsys).command
    assert command.velocity_mm_s > 900
    assert command.accel_mm_s2 > 30000


@pytest.mark.parametrize(
    ("room", "limits"),
    [
        (None, ("X500.00 Y600.00", "P510.00 R520.00 T530.00")),
        (1.2, ("X500.00 Y600.00", "P510.00 R520.00 T530.00")),
        # As 34 of Marlin's example configurations: travel has twice the acceleration.
        (None, ("X1000.00 Y1000.00", "P500.00 R500.00 T1000.00")),
    ],
)
def test_low_limits_leave_enough_for_the_print_s_speed(
    room, limits, make, capsys, tmp_path
) -> None:
    """Marlin's short queue brakes from no more; a machine that was made with less says why."""
    text = M503.replace("J0.08", "X8 Y8 Z0.4 E5")
    text = re.sub(r"(?<=M201 )X\S+ Y\S+", limits[0], text)
    text = re.sub(r"(?<=M204 )P\S+ R\S+ T\S+", limits[1], text)
    make(text, "--fx", "45", "--fy", "29")
    machine = stored(capsys)
    if room is not None:
        command = CommandLimits(accel_mm_s2=room * 500.0)
        machine = machine.model_copy(update={"command": command})
    ring = "G1 X80 Y60 E.8 F6000\nG1 X80 Y80 E.8\nG1 X60 Y80 E.8\nG1 X60 Y60 E.8\n"
    folder = tmp_path / "printed"
    folder.mkdir()
    text = f"G28\nM83\nG1 Z1 F600\nG1 X60 Y60 F9000\n{ring}G1 X140 Y140 F9000\nG1 X60 Y60\n{ring}"
    result, _ = compensated(text, folder, tmp_path / "cache", machine)
    reasons = [one.reason for one in result.put_back]
    assert len(reasons) == (0 if room is None else 1)
    assert all("command.accel_mm_s2 (600) is low: raise it" in reason for reason in reasons)


def test_an_axis_that_may_more_bears_more(make, capsys) -> None:
    make(M503.replace("M204 P510", "M204 P3000"))
    command = stored(capsys).command
    # M201 X500 Y600, M203 X500 Y400
    assert (command.accel_mm_s2, command.velocity_mm_s) == (1500.0, 480.0)
    assert (command.of("x").accel_mm_s2, command.of("x").velocity_mm_s) == (1500.0, 600.0)
    assert (command.of("y").accel_mm_s2, command.of("y").velocity_mm_s) == (1800.0, 480.0)


def test_corners_at_low_accelerations_do_not_add_up(make, capsys, tmp_path) -> None:
    """As 86 of Marlin's example configurations: 500 mm/s2 throughout, junction deviation.

    Each sharp corner costs up to 2 ms at the 1500 mm/s2 that follow, and most pieces of this file
    had not made up for them all at their end: they stayed as sliced.
    """
    text = re.sub(r"(?<=M201 )X\S+ Y\S+", "X500.00 Y500.00", M503)
    make(
        re.sub(r"(?<=M204 )P\S+ R\S+ T\S+", "P500.00 R500.00 T500.00", text), "--fx", 45, "--fy", 29
    )
    machine = stored(capsys)
    assert machine.command.accel_mm_s2 == 1500.0
    example = Path(__file__).parents[2] / "examples" / "ps_ender3_pauses_hept24f.gcode"
    folder = tmp_path / "printed"
    folder.mkdir()
    lines = example.read_text().splitlines(keepends=True)[:800]
    result, _ = compensated("".join(lines), folder, tmp_path / "cache", machine)
    assert result.pieces > 5
    # Until 2026-11-29 140 s; what is left is late on travels.
    assert sum(one.extruding_seconds for one in result.put_back) < 60.0
