"""The macros for Klipper in Klipper's own host: which accelerations parking moves are made with.

The moves are those that the host appends to its queue; the shaper is its own.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from stillpath.models.firmware.klipper import FirmwareShaper
from stillpath.models.machine import Machine
from stillpath.models.store import load_machine
from stillpath.pipeline.compensate import compensate_file
from stillpath.pipeline.options import Options
from tests.integrations.interrupted import disturbed, homed, two_objects
from tests.integrations.klipper_host import NO_KLIPPER, PYTHON, printer_cfg, steps_of
from tests.integrations.klipper_moves import Array, recorded

pytestmark = [pytest.mark.slow, pytest.mark.skipif(PYTHON is None, reason=NO_KLIPPER)]

FOLDER = Path(__file__).resolve().parents[2] / "integrations" / "klipper"
OURS = (FOLDER / "stillpath.cfg").read_text()
OUR_M600 = (FOLDER / "stillpath-m600.cfg").read_text()
PARKING = "G1 X5 Y5 F18000"
USERS = f"""
[gcode_macro PAUSE]
rename_existing: PAUSE_BASE
gcode:
  PAUSE_BASE
  {PARKING}
[gcode_macro RESUME]
rename_existing: RESUME_BASE
gcode:
  G1 X10 Y5 F18000
  RESUME_BASE
[gcode_macro CANCEL_PRINT]
rename_existing: CANCEL_PRINT_BASE
gcode:
  {PARKING}
  CANCEL_PRINT_BASE
"""
PAUSES = "\n[gcode_macro M600]\ngcode:\n  PAUSE\n  G1 X12 Y5 F18000\n"
GOES_ON = f"""
[gcode_macro M600]
gcode:
  SAVE_GCODE_STATE NAME=change
  G90
  {PARKING}
  RESTORE_GCODE_STATE NAME=change MOVE=1 MOVE_SPEED=100
"""
SCRIPTS = {
    "PAUSE": (USERS + OURS, "PAUSE\nRESUME"),
    "without macros of one's own": (OURS, f"PAUSE\n{PARKING}\nRESUME"),
    "CANCEL_PRINT": (USERS + OURS, "CANCEL_PRINT"),
    "M600 pauses": (USERS + PAUSES + OURS + OUR_M600, "M600\nRESUME"),
    "M600 goes on": (USERS + GOES_ON + OURS + OUR_M600, "M600"),
}
SPEED, ACCEL = 11, 12
"""Columns of the host's record."""


@dataclass(frozen=True)
class Print:
    """A written file, how the host plans it, and what it is told of its shaper."""

    machine: Machine
    text: str
    moves: Array

    @property
    def own_mm_s2(self) -> float:
        """Of printer.cfg."""
        firmware = self.machine.firmware
        assert firmware.kind == "klipper"
        return firmware.planner.max_accel_mm_s2

    @property
    def of_streams_mm_s2(self) -> float:
        return self.machine.command.accel_mm_s2


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Print:
    """Nothing happens."""
    folder = tmp_path_factory.mktemp("plain")
    machine = homed(load_machine("voron-v24-250"))
    shaper = FirmwareShaper(type_x="mzv", freq_x_hz=57.8, type_y="ei", freq_y_hz=45.2)
    firmware = machine.firmware.model_copy(update={"shaper": shaper})
    machine = machine.model_copy(update={"firmware": firmware})
    (folder / "in.gcode").write_text(two_objects(1))
    made = folder / "out.gcode"
    compensate_file(folder / "in.gcode", made, machine, Options(robust="off"))
    text = made.read_text()
    moves, _ = planned(text, machine, USERS + OURS, folder)
    found = Print(machine, text, moves)
    assert found.of_streams_mm_s2 > 2 * found.own_mm_s2
    return found


def planned(text: str, machine: Machine, macros: str, place: Path) -> tuple[Array, list[str]]:
    """What the host plans of a file, and what it tells of its shaper."""
    steps_of(text, printer_cfg(machine, macros, shaper=True), place)
    log = (place / "klippy.log").read_text().partition("Configured MCU")[2]
    return recorded(place).head, re.findall(r"shaper_type_x:\S+ shaper_freq_x:(\S+)", log)


def interrupted(text: str, script: str) -> str:
    """The file with a script in the middle of a stream, at its fastest line among others."""
    if script == "CANCEL_PRINT":
        return max(disturbed(text, "CANCEL_PRINT", 3), key=len)
    lines = disturbed(text, "babystep", 3)[0].split("\n")
    return "\n".join(script if line.startswith("SET_GCODE_OFFSET") else line for line in lines)


def added(moves: Array, plain: Array) -> Array:
    """Moves that are not of the file."""
    known = {tuple(row[4:10]) for row in plain}
    return np.array([row for row in moves if tuple(row[4:10]) not in known])


@pytest.mark.parametrize("case", SCRIPTS)
def test_parking_moves_have_printer_cfgs_acceleration(
    case: str, plain: Print, tmp_path: Path
) -> None:
    macros, script = SCRIPTS[case]
    moves, told = planned(interrupted(plain.text, script), plain.machine, macros, tmp_path)
    parking = added(moves, plain.moves)
    times = 1 if script == "CANCEL_PRINT" else 3
    assert len(parking) >= times
    assert set(parking[:, ACCEL]) == {plain.own_mm_s2}
    assert parking[:, SPEED].max() > 50.0
    if script == "CANCEL_PRINT":
        assert told == ["0.000", "57.800"]
        return
    # Behind it the stream goes on as it was.
    assert told.count("0.000") == 1 + times
    assert re.fullmatch(r"(0\.000 (57\.800 )+)+", " ".join([*told, ""]))
    last = np.flatnonzero([tuple(row) == tuple(parking[-1]) for row in moves])[-1]
    assert moves[last + 1 :, ACCEL].max() == plain.of_streams_mm_s2
    assert len(moves) - len(parking) == len(plain.moves)


def test_a_pause_where_a_stream_begins_leaves_the_shaper_off(plain: Print, tmp_path: Path) -> None:
    """Behind the line that switches it off the host waits, and a PAUSE with it."""
    off = next(
        x for x in plain.text.split("\n") if x.startswith("SET_INPUT_SHAPER SHAPER_FREQ_X=0")
    )
    before, _, behind = plain.text.partition(f"{off}\nG4 P0 ; stand still\n")
    assert behind
    text = f"{before}{off}\nG4 P0\nPAUSE\nRESUME\n{behind}"
    _, told = planned(text, plain.machine, USERS + OURS, tmp_path)
    # The file; PAUSE, RESUME twice, the last time as it was; the file.
    assert told == ["0.000", "57.800", "57.800", "0.000", "57.800"]


def test_without_our_macros_they_have_the_streams(plain: Print, tmp_path: Path) -> None:
    text = interrupted(plain.text, "PAUSE\nRESUME")
    moves, _ = planned(text, plain.machine, USERS, tmp_path)
    assert added(moves, plain.moves)[:, ACCEL].max() == plain.of_streams_mm_s2


def test_other_macros_find_what_ones_own_rename(plain: Print, tmp_path: Path) -> None:
    """As timelapse.cfg does, to park with it: one's own PAUSE would park, too."""
    asks = """
[gcode_macro ASK]
gcode:
  {% set own = printer.configfile.settings['gcode_macro pause'].rename_existing %}
  {action_respond_info('renamed: ' ~ own)}
"""
    planned("G28\nASK\n", plain.machine, USERS + OURS + asks, tmp_path)
    assert "renamed: PAUSE_BASE" in (tmp_path / "klippy.log").read_text()


def test_check_in_mid_stream_changes_no_move(plain: Print, tmp_path: Path) -> None:
    text = interrupted(plain.text, "STILLPATH_CHECK")
    moves, _ = planned(text, plain.machine, USERS + OURS, tmp_path)
    assert len(added(moves, plain.moves)) == 0
    assert moves[:, ACCEL].tolist() == plain.moves[:, ACCEL].tolist()
    log = (tmp_path / "klippy.log").read_text()
    assert re.search(r"Stillpath: max_accel is 20000, printer.cfg says \d+: STILLPATH_RESTORE", log)
    assert "Stillpath: PAUSE does not" not in log


def test_check_behind_a_print_shows_the_shaper_on_and_off(plain: Print, tmp_path: Path) -> None:
    _, told = planned(f"{plain.text}\nSTILLPATH_CHECK\n", plain.machine, USERS + OURS, tmp_path)
    assert told == ["0.000", "57.800", "57.800", "0.000", "57.800"]
    assert "restore the limits first" in (tmp_path / "klippy.log").read_text().rpartition("===")[2]


def test_a_wrapper_in_the_wrong_order_is_found(plain: Print, tmp_path: Path) -> None:
    swapped = USERS.replace("PAUSE_BASE", "PAUSE_OTHER")
    planned("G28\nSTILLPATH_CHECK\n", plain.machine, OURS + swapped, tmp_path)
    said = (tmp_path / "klippy.log").read_text().rpartition("===")[2]
    assert "Stillpath: PAUSE does not restore the limits first" in said
