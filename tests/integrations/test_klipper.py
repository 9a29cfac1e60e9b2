"""The macros for Klipper: what reaches the firmware, and in which order.

On an imitation, quickly and in many orders; on Klipper's own host: `test_real_macros`.
"""

from __future__ import annotations

import copy
import re
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stillpath.gcode.firmware.klipper.adapter import KlipperAdapter
from stillpath.gcode.firmware.klipper.stream_commands import IN_STREAM_MARK_MM_S
from stillpath.models.store import load_machine
from tests.integrations.klipper import SETTINGS, CommandError, ConfigError, Klipper, macros_of

FOLDER = Path(__file__).resolve().parents[2] / "integrations" / "klipper"
OURS = FOLDER / "stillpath.cfg"
M600 = FOLDER / "stillpath-m600.cfg"

USERS = """
[gcode_macro PAUSE]
rename_existing: PAUSE_BASE
gcode:
  PAUSE_BASE
  G91
  G1 Z5 F900   # my own lift
[gcode_macro RESUME]
rename_existing: RESUME_BASE
gcode:
  RESUME_BASE {rawparams}
[gcode_macro CANCEL_PRINT]
rename_existing: CANCEL_PRINT_BASE
gcode:
  G1 X0 Y0 F9000
  CANCEL_PRINT_BASE
"""
FIRST_FLOOR = """
[gcode_macro FIRST_FLOOR_PAUSE]
gcode:
  PAUSE_BASE
  G1 X5 Y5 F30000
[gcode_macro FIRST_FLOOR_RESUME]
gcode:
  G1 E3 F2100
  RESUME_BASE {get_params}
"""
"""Of Creality's printers, in short: they call what PAUSE and RESUME rename."""
CHANGES = """
[gcode_macro M600]
gcode:
  PAUSE
  G1 E-50 F1000
"""
OWN = "SET_VELOCITY_LIMIT VELOCITY=300.0 ACCEL=5000.0 SQUARE_CORNER_VELOCITY=5.0 "
OWN_LIMITS = OWN + "MINIMUM_CRUISE_RATIO=0.5"
OWN_SHAPER = (
    'SET_INPUT_SHAPER SHAPER_FREQ_X=57.8 SHAPER_FREQ_Y=45.2 SHAPER_TYPE_X="mzv" SHAPER_TYPE_Y="ei" '
    "DAMPING_RATIO_X=0.1 DAMPING_RATIO_Y=0.05"
)


def in_stretch(*files: Path | str, **more) -> Klipper:
    """A printer in the middle of a compensated stretch, by our encoder's own lines."""
    printer = Klipper(macros_of(*files), **more)
    machine = load_machine("voron-v24-250")
    firmware = KlipperAdapter(machine, machine.firmware)
    stream_commands = firmware.stream_commands()
    printer.run(stream_commands.limits(firmware.stream_limits(firmware.initial_limits())).decode())
    printer.run(stream_commands.shaper_off.decode())
    assert printer.toolhead["max_accel"] == 20_000
    printer.state = "printing"
    printer.sent.clear()
    return printer


def limits(printer: Klipper) -> tuple:
    return tuple(printer.toolhead.values()), printer.shaper["shaper_freq_x"]


def test_ones_own_macros_move_under_ones_own_limits():
    printer = in_stretch(USERS, OURS)
    before = limits(printer)
    printer.run("PAUSE")
    assert printer.sent == [OWN_LIMITS, OWN_SHAPER, "PAUSE", "G91", "G1 Z5 F900"]
    printer.run("SET_VELOCITY_LIMIT ACCEL=9000")  # somebody plays while it is paused
    printer.sent.clear()
    printer.run("RESUME")
    assert printer.sent[:3] == [OWN_LIMITS, OWN_SHAPER, "RESUME"]
    assert limits(printer) == before
    printer.sent.clear()
    printer.run("CANCEL_PRINT")
    assert printer.sent == [OWN_LIMITS, OWN_SHAPER, "G1 X0 Y0 F9000", "CANCEL_PRINT"]
    printer.run("RESUME")
    assert limits(printer)[0] == (300.0, 5000.0, 5.0, 0.5)  # nothing of the cancelled print


def test_a_smoother_is_switched_by_its_own_frequency():
    """Kalico's listen to no SHAPER_FREQ, and its printer.cfg says none."""
    kalico = copy.deepcopy(SETTINGS)
    kalico["input_shaper"] = {
        f"{name}_{axis}": value
        for axis, f_hz in (("x", 57.8), ("y", 45.2))
        for name, value in (("shaper_type", "smooth_mzv"), ("smoother_freq", f_hz))
    }
    printer = in_stretch(OURS, settings=kalico)
    for command, expected in (("", (0.0, 0.0)), ("PAUSE", (57.8, 45.2)), ("RESUME", (0.0, 0.0))):
        printer.run(command)
        assert tuple(printer.shaper[f"smoother_freq_{axis}"] for axis in "xy") == expected
    printer.run("CANCEL_PRINT")
    printer.state = "standby"
    printer.run("STILLPATH_CHECK")
    assert printer.shaper["smoother_freq_x"] == 57.8


def test_resume_without_a_pause_brings_nothing_back():
    printer = in_stretch(USERS, OURS)
    printer.run("PAUSE")
    printer.is_paused = False  # CLEAR_PAUSE, as start macros send it; then another print
    printer.run("RESUME")
    assert limits(printer) == ((300.0, 5000.0, 5.0, 0.5), 57.8)


@pytest.mark.parametrize("corner_mm_s", [0.0, 5.0, 7.0710678, 14.14213562, 20 / 3])
def test_a_pause_among_the_files_own_moves_of_a_stretch(corner_mm_s: float):
    """There the file's limits are in force, marked, and the shaper is off."""
    printer = Klipper(macros_of(OURS))
    machine = load_machine("voron-v24-250")
    firmware = KlipperAdapter(machine, machine.firmware)
    stream_commands = firmware.stream_commands()
    own = replace(firmware.initial_limits(), square_corner_velocity_mm_s=corner_mm_s)
    printer.run(stream_commands.limits(stream_commands.in_stream(own)).decode())
    printer.run(stream_commands.shaper_off.decode())
    before = limits(printer)
    printer.run("PAUSE")
    assert printer.shaper["shaper_freq_x"] == 57.8
    printer.run("RESUME")
    assert limits(printer) == before
    assert printer.shaper["shaper_freq_x"] == 0.0


@pytest.mark.parametrize("file_position", [None, 4711])
def test_a_change_of_filament_in_mid_stretch(file_position: int | None):
    extra = {} if file_position is None else {"virtual_sdcard": {"file_position": file_position}}
    printer = in_stretch(USERS, CHANGES, OURS, M600, extra=extra)
    before = limits(printer)
    printer.run("M600 X10")
    assert printer.sent[:3] == [OWN_LIMITS, OWN_SHAPER, OWN_LIMITS]
    assert printer.sent[-1] == "G1 E-50 F1000"
    assert limits(printer)[0] == (300.0, 5000.0, 5.0, 0.5)
    printer.run("RESUME")
    assert limits(printer) == before


@pytest.mark.parametrize("place", [{"virtual_sdcard": {"file_position": 100}}, {}])
def test_a_change_of_filament_that_broke_spoils_no_later_pause(place: dict):
    """Of a file on the printer's card, or sent line by line, as OctoPrint does."""
    fails = "[gcode_macro M600]\ngcode:\n  { action_raise_error('no filament') }\n"
    printer = in_stretch(fails, OURS, M600, extra=place)
    with pytest.raises(CommandError):
        printer.run("M600")
    printer.run("SET_VELOCITY_LIMIT ACCEL=1234")
    printer.run("PAUSE")
    printer.run("RESUME")
    assert printer.toolhead["max_accel"] == 1234


_MACROS = macros_of(USERS, CHANGES, OURS, M600)
_OWN_MOVES = ("G1 Z5 F900", "G1 E-50 F1000", "G1 X0 Y0 F9000")
_COMMANDS = ("PAUSE", "RESUME", "M600", "CANCEL_PRINT", "stretch", "end of stretch", "file")


@settings(max_examples=40)
@given(st.lists(st.sampled_from(_COMMANDS), max_size=12))
def test_ones_own_moves_never_run_under_raised_limits(commands: list[str]):
    """And what a pause found is in force again when the print goes on."""
    printer = Klipper(_MACROS, extra={"virtual_sdcard": {"file_position": 0}})
    lines = {
        "stretch": (
            "SET_VELOCITY_LIMIT ACCEL=20000 SQUARE_CORNER_VELOCITY="
            f"{14.83 + IN_STREAM_MARK_MM_S:.10g}\nSET_INPUT_SHAPER SHAPER_FREQ_X=0"
        ),
        "end of stretch": (
            "SET_VELOCITY_LIMIT ACCEL=2000 SQUARE_CORNER_VELOCITY=5\n"
            "SET_INPUT_SHAPER SHAPER_FREQ_X=57.8"
        ),
        "file": "SET_VELOCITY_LIMIT ACCEL=2500",
    }
    found = limits(printer)
    for command in commands:
        if command in lines:
            if printer.is_paused:
                continue  # the file does not go on
            printer.extra["virtual_sdcard"]["file_position"] += 100
        was_paused = printer.is_paused
        before = limits(printer)
        printer.sent.clear()
        printer.run(lines.get(command, command))
        if not was_paused:
            found = before
        for place, line in enumerate(printer.sent):
            if line in _OWN_MOVES:
                limit = [each for each in printer.sent[:place] if "ACCEL=" in each][-1:]
                assert limit == [OWN_LIMITS] or (was_paused and not limit)
        if command == "RESUME" and was_paused:
            assert limits(printer) == found
        if printer.is_paused:
            assert limits(printer) == ((300.0, 5000.0, 5.0, 0.5), 57.8)


def test_the_second_file_needs_a_macro():
    with pytest.raises(ConfigError, match="M600"):
        Klipper(macros_of(OURS, M600))


@pytest.mark.parametrize(
    ("stated", "restored"),
    [
        ({"max_accel_to_decel": 2500.0}, "ACCEL_TO_DECEL=2500.0"),
        # For some days after its change the default of minimum_cruise_ratio was not among settings.
        ({}, "MINIMUM_CRUISE_RATIO=0.5"),
    ],
)
def test_a_klipper_from_before_april_2024(stated: dict, restored: str):
    settings = {"printer": dict(SETTINGS["printer"]), "input_shaper": SETTINGS["input_shaper"]}
    del settings["printer"]["minimum_cruise_ratio"]
    settings["printer"] |= stated
    printer = in_stretch(OURS, settings=settings)
    before = limits(printer)
    printer.run("PAUSE")
    assert printer.sent[0] == OWN + restored
    printer.run("RESUME")
    assert limits(printer) == before


def test_a_printer_without_a_shaper():
    settings = {"printer": SETTINGS["printer"]}
    printer = Klipper(macros_of(USERS, OURS), settings=settings)
    printer.run("PAUSE")
    printer.run("RESUME")
    printer.run("STILLPATH_CHECK")
    assert not [line for line in printer.sent if "SHAPER" in line]
    assert printer.told == ["Stillpath: PAUSE, RESUME and CANCEL_PRINT restore the limits first"]


def test_a_shaper_that_printer_cfg_does_not_state_is_left_alone():
    """Of two carriages: Klipper refuses frequencies in [input_shaper], [delayed_gcode] has them."""
    carriages = copy.deepcopy(SETTINGS)
    carriages["input_shaper"] = {"shaper_freq_x": 0.0, "shaper_freq_y": 0.0, "shaper_type_x": "mzv"}
    printer = Klipper(macros_of(USERS, OURS), settings=carriages)
    printer.run("SET_INPUT_SHAPER SHAPER_TYPE_X=ei SHAPER_FREQ_X=61 SHAPER_FREQ_Y=45")
    for command in ("PAUSE", "RESUME", "CANCEL_PRINT", "STILLPATH_RESTORE", "STILLPATH_CHECK"):
        printer.run(command)
        assert float(printer.shaper["shaper_freq_x"]) == 61.0, command
    assert not any("stays off" in line for line in printer.told)
    carriages["dual_carriage"] = {"axis": "x"}
    printer = in_stretch(USERS, OURS, settings=carriages)
    printer.run("CANCEL_PRINT")
    assert printer.toolhead["max_accel"] == carriages["printer"]["max_accel"]
    assert any("the shaper stays off" in line for line in printer.told)


def test_what_ones_own_macros_rename_is_still_told():
    """timelapse.cfg parks with what `gcode_macro pause` renames in the settings, in lower case."""
    told: dict[str, dict[str, str]] = {}
    for section, options in macros_of(USERS, OURS):
        told.setdefault(section.lower(), {}).update(options)
    for name in ("pause", "resume", "cancel_print"):
        assert told[f"gcode_macro {name}"]["rename_existing"] == f"{name.upper()}_BASE"


def test_check_is_content():
    printer = Klipper(macros_of(USERS, CHANGES, OURS, M600))
    printer.run("STILLPATH_CHECK STOP=1")
    assert printer.told[0].startswith("Stillpath: printer.cfg says shaper_freq_x:57.800")
    assert printer.told[-1].startswith("shaper_type_x:mzv shaper_freq_x:57.8")
    assert "restore the limits first" in printer.told[1]
    assert limits(printer) == ((300.0, 5000.0, 5.0, 0.5), 57.8)


@pytest.mark.parametrize("state", ["printing", "standby"])  # from the printer's card, by OctoPrint
def test_a_start_macro_stops_for_limits_of_a_stretch_only(state: str):
    printer = in_stretch(OURS)
    printer.state = state
    with pytest.raises(CommandError, match="limits of a compensated stretch are still in force"):
        printer.run("STILLPATH_CHECK STOP=1")
    printer.run("STILLPATH_RESTORE")
    printer.run("SET_VELOCITY_LIMIT ACCEL=1500")  # of the slicer
    printer.run("STILLPATH_CHECK STOP=1")


def test_check_shows_whether_the_shaper_goes_off():
    printer = Klipper(macros_of(OURS))
    printer.run("SET_VELOCITY_LIMIT ACCEL=9000")
    printer.run("STILLPATH_CHECK")
    [place] = [k for k, line in enumerate(printer.told) if "does not say 0.000" in line]
    assert "shaper_freq_x:0.0" in printer.told[place + 1]
    assert "shaper_freq_y:0.0" in printer.told[place + 1]
    assert printer.sent[-1] == OWN_SHAPER
    assert limits(printer)[0][1] == 9000  # told, and left to STILLPATH_RESTORE
    printer.sent.clear()
    printer.state = "printing"
    printer.run("STILLPATH_CHECK")
    assert printer.sent == []


def test_the_files_own_damping_does_not_outlive_a_pause():
    printer = in_stretch(OURS)
    printer.run("SET_INPUT_SHAPER DAMPING_RATIO_X=0.2")
    printer.run("PAUSE")
    assert printer.shaper["damping_ratio_x"] == 0.1


@pytest.mark.parametrize(
    ("files", "words"),
    [
        ((OURS, USERS), r"PAUSE does not .* behind it"),
        ((USERS, CHANGES, OURS), r"M600 does not .*stillpath-m600\.cfg"),
    ],
    ids=["wrong order", "M600 left out"],
)
@pytest.mark.parametrize("shows_commands", [True, False])
def test_check_finds_wrappers_that_are_missing(files, words: str, shows_commands: bool):
    printer = Klipper(macros_of(*files), shows_commands=shows_commands)
    printer.run("STILLPATH_CHECK")
    assert re.search(words, "\n".join(printer.told))
    with pytest.raises(CommandError, match="STILLPATH_CHECK"):
        printer.run("STILLPATH_CHECK STOP=1")


@pytest.mark.parametrize("shows_commands", [True, False])
def test_check_finds_a_wrapper_that_was_cut_out(shows_commands: bool):
    text = re.sub(r"\[gcode_macro\tCancel_Print\].*?(?=\n\[)", "", OURS.read_text(), flags=re.S)
    printer = Klipper(macros_of(text), shows_commands=shows_commands)
    printer.run("STILLPATH_CHECK")
    assert [line for line in printer.told if line.startswith("Stillpath: CANCEL_PRINT does not")]


def test_check_finds_macros_that_pass_by_the_wrappers():
    printer = Klipper(macros_of(USERS, FIRST_FLOOR, OURS))
    printer.run("STILLPATH_CHECK")
    found = [line for line in printer.told if "itself" in line]
    assert [re.findall("[A-Z]+_[A-Z_]+", line) for line in found] == [
        ["FIRST_FLOOR_PAUSE", "PAUSE_BASE", "STILLPATH_RESTORE"],
        ["FIRST_FLOOR_RESUME", "RESUME_BASE", "STILLPATH_CONTINUE"],
    ]
    printer.run("STILLPATH_CHECK STOP=1")  # a print starts all the same


def test_macros_that_pass_by_the_wrappers_can_be_mended():
    pauses = FIRST_FLOOR.replace("  PAUSE", "  STILLPATH_RESTORE REMEMBER=1\n  PAUSE")
    mended = pauses.replace("{get_params}", "\n  STILLPATH_CONTINUE")
    printer = in_stretch(USERS, mended, OURS)
    before = limits(printer)
    printer.run("FIRST_FLOOR_PAUSE")
    assert printer.sent == [OWN_LIMITS, OWN_SHAPER, "PAUSE", "G1 X5 Y5 F30000"]
    printer.run("FIRST_FLOOR_RESUME")
    assert limits(printer) == before
    printer.told.clear()
    printer.run("STILLPATH_CHECK")
    assert not [line for line in printer.told if "itself" in line]


def test_a_part_of_ones_own_pause_is_no_other_macro():
    parts = (
        USERS.replace("  PAUSE_BASE\n", "  _PARK\n") + "[gcode_macro _PARK]\ngcode:\n  PAUSE_BASE\n"
    )
    printer = Klipper(macros_of(parts, OURS))
    printer.run("STILLPATH_CHECK")
    assert not [line for line in printer.told if "itself" in line]


@pytest.mark.parametrize("state", ["printing", "standby"])
def test_check_in_a_stretch_leaves_the_shaper_off(state: str):
    printer = in_stretch(OURS)
    printer.state = state  # OctoPrint's prints are not known to print_stats
    before = limits(printer)
    printer.run("STILLPATH_CHECK")
    assert limits(printer) == before
    assert before[1] == 0.0


def test_check_finds_limits_that_stayed():
    printer = in_stretch(OURS)
    printer.run("STILLPATH_CHECK")
    assert "a print runs" in printer.told[-2] or "a print runs" in printer.told[0]
    printer.state = "cancelled"
    printer.told.clear()
    printer.run("STILLPATH_CHECK")
    told = "\n".join(printer.told)
    assert re.search(r"max_accel is \d+, printer.cfg says 5000: STILLPATH_RESTORE", told)
    assert "the input shaper is off" in told
    printer.run("STILLPATH_RESTORE")
    printer.told.clear()
    printer.run("STILLPATH_CHECK STOP=1")
    assert limits(printer) == ((300.0, 5000.0, 5.0, 0.5), 57.8)
