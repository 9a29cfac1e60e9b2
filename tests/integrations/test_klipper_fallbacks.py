"""When the extra cannot do its work: in Klipper's own host, what its motors do then.

Whatever happens, Klipper runs on, no motor jumps, and at every stand the motors are where Klipper's
own would be.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stillpath.applications.live.export import export_digest
from stillpath.models.machine import Machine
from stillpath.models.store import load_machine
from tests.integrations.interrupted import asked, homed, two_objects
from tests.integrations.klipper_host import CHECKOUT, NO_KLIPPER, PYTHON, printer_cfg, steps_of
from tests.integrations.live import MORE, SECTION, Pair, both, print_with, stands, with_event

pytestmark = [pytest.mark.slow, pytest.mark.skipif(PYTHON is None, reason=NO_KLIPPER)]

MOVES, WATCHED = 96, 12
Export = Callable[[str], dict[str, Any]]

TROUBLE = """
import time
def load_config(config):
    printer, what = config.get_printer(), config.get("what")
    def ready():
        extra = printer.lookup_object("stillpath")
        if what == "slow":
            push, filter = extra.filter.push, extra.filter
            def slowly(until):
                pieces = push(until)
                end = time.perf_counter() + 0.7e-3 * len(pieces)
                while time.perf_counter() < end:
                    pass
                return pieces
            extra.filter.push = slowly
        elif what == "late":
            extend = extra.filter._extend
            extra.filter._extend = lambda size: extend(size + 500)
        elif what == "endstop":
            gcode, (rail, *_) = extra.gcode, extra.toolhead.get_kinematics().rails
            endstop = rail.get_endstops()[0][0]
            def raising(*given, **more):
                raise printer.command_error("the endstop does not answer")
            def home(gcmd):
                endstop.home_start, gcode.is_fileinput = raising, False  # which would exit
                try:
                    gcode.run_script_from_command("G28 X")
                except printer.command_error:
                    del endstop.home_start
                gcode.is_fileinput = True
            gcode.register_command("FAIL_TO_HOME", home)
    def measure(gcmd):
        extra, toolhead = printer.lookup_object("stillpath"), printer.lookup_object("toolhead")
        toolhead.manual_move([60.0], 150.0)
        gcmd.respond_info("measured: %s" % (extra.get_status(0.0)["state"],))
    if what == "measurement":
        for name in ("AXES_SHAPER_CALIBRATION", "_COMPARE_BELTS_RESPONSES"):
            printer.lookup_object("gcode").register_command(name, measure)
    def reset(gcmd):
        printer.lookup_object("toolhead").square_corner_velocity = 5.0
    if what == "Kalico":
        printer.lookup_object("gcode").register_command("RESET_VELOCITY_LIMIT", reset)
    printer.register_event_handler("klippy:ready", ready)
    return ready
"""
"""An extra of Klipper that makes trouble: computing takes .7 s for each s; the plan is taken for
known .5 s further than Klipper promises, so that moves come late; X's endstop raises once. Or it
moves the head as Shake&Tune does while it measures; or it has Kalico's RESET_VELOCITY_LIMIT."""
WATCH = """
import gc, logging, tracemalloc
def load_config(config):
    printer = config.get_printer()
    extra = printer.lookup_object("stillpath")
    def watch(gcmd):
        gc.collect()
        ours = tracemalloc.Filter(True, "*/extras/stillpath/*")
        traces = tracemalloc.take_snapshot().filter_traces([ours]).traces
        held = extra.filter
        objects = sum(map(len, (held.x, held.dx, held.allowed, held.plan.phases, held.blocked)))
        count = sum(1 for thing in gc.get_objects() if "stillpath" in type(thing).__module__)
        size = sum(trace.size for trace in traces)
        logging.info("watch: %d %d %d %d", size, len(traces), objects, count)
    printer.lookup_object("gcode").register_command("WATCH", watch)
    tracemalloc.start(1)
    return watch
"""
"""An extra of Klipper that counts what Stillpath's holds: bytes and blocks of Python's memory that
its modules asked for, samples and phases in its buffers, objects of its classes."""
SHAPER_OFF = "SET_INPUT_SHAPER SHAPER_FREQ_X=0 SHAPER_FREQ_Y=0"
SHAPER_ON = "SET_INPUT_SHAPER SHAPER_FREQ_X=40 SHAPER_FREQ_Y=35"


@pytest.fixture(scope="session")
def troubled(klipper_live: Path) -> Path:
    (klipper_live / "klippy/extras/trouble.py").write_text(TROUBLE)
    return klipper_live


def check(prints: Pair, machine: Machine) -> None:
    """No shutdown, no step lost, nothing that the motors do not bear or Klipper did not ask for."""
    assert "Traceback" not in prints.log
    assert "shutdown" not in prints.log
    assert stands(prints.live) == stands(prints.plain)
    bears, plain, live = machine.command, asked(prints.plain, machine), asked(prints.live, machine)
    assert live.step_mm_s <= max(bears.speed_step_mm_s, 1.05 * plain.step_mm_s)
    assert live.ramp_mm_s <= max(10e-3 * bears.accel_mm_s2, 1.05 * plain.ramp_mm_s)


@pytest.mark.parametrize(
    ("what", "said", "name"),
    [
        ("slow", "this computer is too slow", "ender3"),
        ("late", "a move came later", "voron-v24-250"),
    ],
)
def test_it_passes_the_plan_through_where_it_falls_behind(
    what: str, said: str, name: str, troubled: Path, export: Export, tmp_path: Path
) -> None:
    if what == "late" and CHECKOUT is not None:
        pytest.skip("without a board, Klipper of 2026 makes steps when it knows all moves")
    machine = homed(load_machine(name))
    more = f"[trouble]\nwhat: {what}\n"
    text = with_event("G4 P100").replace("G90\n", "G90\nSTILLPATH_STATUS\n", 1)
    prints = troubled_pair(text, machine, export(name), tmp_path, troubled, more)
    assert f"stillpath: passing through: {said}" in prints.log
    assert f"stillpath: passing for {name}: {said}" in prints.log
    # Switched on again, it says nothing of what is over.
    assert f"stillpath: on for {name}; limited" in prints.log.rpartition("passing for")[2]
    check(prints, machine)


def test_an_endstop_that_raises_does_not_leave_it_off(
    troubled: Path, export: Export, tmp_path: Path
) -> None:
    machine = homed(load_machine("ender3"))
    text = "G28\nFAIL_TO_HOME\nFAIL_TO_HOME\nSTILLPATH_STATUS\nG28\nG90\nG1 X50 Y20 F9000\n"
    more = "[trouble]\nwhat: endstop\n"
    print_with(f"{text}STILLPATH_STATUS\n", machine, export("ender3"), tmp_path, troubled, more)
    log = (tmp_path / "klippy.log").read_text()
    assert log.count("the endstop does not answer") == 2
    assert "Traceback" not in log
    assert re.findall(r"stillpath: (\w+) for ender3", log) == ["on", "on"]


def test_it_stands_aside_while_shaketune_measures(
    troubled: Path, export: Export, tmp_path: Path
) -> None:
    machine = homed(load_machine("ender3"))
    text = "G28\nAXES_SHAPER_CALIBRATION\n_COMPARE_BELTS_RESPONSES\nSTILLPATH_STATUS\n"
    more = "[trouble]\nwhat: measurement\n"
    print_with(text, machine, export("ender3"), tmp_path, troubled, more)
    log = (tmp_path / "klippy.log").read_text()
    assert re.findall(r"measured: (\w+)", log) == ["off", "off"]
    assert "stillpath: on for ender3" in log


def test_kalicos_reset_of_the_limits_ends_a_compensated_stretch(
    troubled: Path, export: Export, tmp_path: Path
) -> None:
    machine = homed(load_machine("ender3"))
    move = "G1 X{} Y60 F9000\n"
    text = "G28\nG90\nSET_VELOCITY_LIMIT SQUARE_CORNER_VELOCITY=14.8300005\n" + move.format(60)
    text += "SET_KINEMATIC_POSITION\nSTILLPATH_STATUS\nRESET_VELOCITY_LIMIT\n" + move.format(20)
    more = MORE + "[trouble]\nwhat: Kalico\n"
    text += "SET_KINEMATIC_POSITION\nSTILLPATH_STATUS\n"
    print_with(text, machine, export("ender3"), tmp_path, troubled, more)
    log = (tmp_path / "klippy.log").read_text()
    stretch_s, behind_s = map(float, re.findall(r"limited ([\d.]+) s", log))
    assert stretch_s > 0.2
    assert behind_s < stretch_s + 0.2


def troubled_pair(
    text: str, machine: Machine, given: dict[str, Any], place: Path, host: Path, more: str
) -> Pair:
    """Print without the extra, and with it and something that troubles it."""
    plain = "\n".join(line for line in text.split("\n") if not line.startswith("STILLPATH"))
    first = steps_of(plain, printer_cfg(machine, MORE), place, host)
    text += "SET_KINEMATIC_POSITION\nSTILLPATH_STATUS\nSTILLPATH ENABLE=1\n"
    second = print_with(text, machine, given, place, host, MORE + more)
    return Pair(first, second, (place / "klippy.log").read_text())


@pytest.mark.parametrize(
    ("field", "name", "share"),
    [("accel_mm_s2", "ender3", 1.2), ("velocity_mm_s", "voron-v24-250", 0.3)],
)
def test_limits_below_the_files_own(
    field: str, name: str, share: float, klipper_live: Path, export: Export, tmp_path: Path
) -> None:
    machine, given = homed(load_machine(name)), export(name)
    own = {"accel_mm_s2": given["limits"]["max_accel_mm_s2"], "velocity_mm_s": 150.0}
    given["command"][field] = share * own[field]
    given["digest"] = export_digest(given)
    prints = both(with_event("G4 P100"), machine, given, tmp_path, klipper_live)
    assert f"stillpath: on for {name}" in prints.log
    check(prints, machine)
    # Nothing is added to what the plan asks for already.
    plain, live = asked(prints.plain, machine), asked(prints.live, machine)
    if field == "accel_mm_s2":
        most = max(share, 1.0) * own[field]
        assert live.ramp_mm_s <= max(1.05 * plain.ramp_mm_s, 10e-3 * np.sqrt(2.0) * most)


def test_other_kinematics_are_refused(klipper_live: Path, export: Export, tmp_path: Path) -> None:
    machine = homed(load_machine("ender3"))
    (tmp_path / "stillpath.json").write_text(json.dumps(export("ender3")))
    config = printer_cfg(machine).replace("kinematics: cartesian", "kinematics: hybrid_corexy")
    text = "G28\nG90\nG1 X20 Y30 F9000\n"
    plain = steps_of(text, config, tmp_path, klipper_live)
    live = steps_of(f"{text}STILLPATH_STATUS\n", f"{config}{SECTION}\n", tmp_path, klipper_live)
    log = (tmp_path / "klippy.log").read_text()
    assert "the export is for cartesian, this printer's kinematics are" in log
    assert "stillpath: refused" in log
    assert "Traceback" not in log
    for ours, theirs in zip(live.place_mm, plain.place_mm, strict=True):
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.skipif(CHECKOUT is None, reason="the [input_shaper] of the package does not start")
@pytest.mark.parametrize(
    ("event", "starts_on"),
    [(SHAPER_ON, False), (SHAPER_OFF, True), (f"{SHAPER_ON}\nG4 P200\n{SHAPER_OFF}", False)],
)
def test_beside_klippers_own_shaper(
    event: str, starts_on: bool, klipper_live: Path, export: Export, tmp_path: Path
) -> None:
    machine = homed(load_machine("ender3"))
    section = "[input_shaper]\nshaper_type: mzv\n"
    section += "shaper_freq_x: 40\nshaper_freq_y: 35\n" if starts_on else ""
    macro = "[gcode_macro SET_INPUT_SHAPER]\ngcode:\n  M400\n"
    config = printer_cfg(machine, MORE)
    assert macro in config
    config = config.replace(macro, section)
    (tmp_path / "stillpath.json").write_text(json.dumps(export("ender3")))
    text = with_event(event)
    plain = steps_of(text, config, tmp_path, klipper_live)
    text += "SET_KINEMATIC_POSITION\nSTILLPATH_STATUS\n"
    live = steps_of(text, f"{config}{SECTION}\n", tmp_path, klipper_live)
    log = (tmp_path / "klippy.log").read_text()
    if starts_on or event == SHAPER_ON:
        assert "stillpath: off: input_shaper is active: SET_INPUT_SHAPER SHAPER_FREQ_X=0" in log
    assert ("off" if event == SHAPER_ON else "on") + " for ender3" in log
    check(Pair(plain, live, log), machine)


def test_klipper_starts_again(klipper_live: Path, export: Export, tmp_path: Path) -> None:
    machine = homed(load_machine("ender3"))
    (tmp_path / "stillpath.json").write_text(json.dumps(export("ender3")))
    config = printer_cfg(machine, MORE).replace("[mcu]\n", "[mcu]\nrestart_method: command\n")
    # The host reads blocks of 4096 bytes, and what it has read is gone with it.
    before = f"{two_objects(1)}STILLPATH_STATUS\nFIRMWARE_RESTART\n"
    before += ";" * (-len(before) % 4096 - 1) + "\n"
    without = before.replace("STILLPATH", ";TILLPATH")
    plain = steps_of(f"{without}{two_objects(1)}", config, tmp_path, klipper_live)
    (tmp_path / "klippy.log").unlink()
    text = f"{before}{two_objects(1)}SET_KINEMATIC_POSITION\nSTILLPATH_STATUS\n"
    live = steps_of(text, f"{config}{SECTION}\n", tmp_path, klipper_live)
    log = (tmp_path / "klippy.log").read_text()
    assert log.count("Start printer at") == 2
    assert log.count("stillpath: on for ender3") == 2
    # What the board was sent is that of the second start alone.
    check(Pair(plain, live, log), machine)


@pytest.mark.skipif(CHECKOUT is not None, reason="without a board, its plan waits for a stand")
def test_its_memory_does_not_grow(klipper_live: Path, export: Export, tmp_path: Path) -> None:
    machine = homed(load_machine("ender3"))
    (klipper_live / "klippy/extras/watch.py").write_text(WATCH)
    lines = ["G28", "G90", "G1 X20 Y20 F12000"]
    for k in range(MOVES):
        lines.append(f"G1 X{80 - 60 * (k % 2)} Y{20 + k % 60} F12000")
        if k % WATCHED == WATCHED - 1:
            # Limits in force, moves that pass, stands: every buffer is used.
            lines += ["G4 P1500", "SET_VELOCITY_LIMIT ACCEL=60000", "G1 X50 Y50", "WATCH"]
            lines += ["SET_VELOCITY_LIMIT ACCEL=5000"]
    print_with(
        "\n".join([*lines, "M400", ""]),
        machine,
        export("ender3"),
        tmp_path,
        klipper_live,
        "[watch]\n",
    )
    log = (tmp_path / "klippy.log").read_text()
    found = np.array([row.split() for row in re.findall(r"watch: ([\d ]+)", log)], int)
    assert len(found) == MOVES // WATCHED
    first, last = found[3 : len(found) // 2], found[len(found) // 2 :]
    assert last.max(axis=0).tolist() == pytest.approx(first.max(axis=0).tolist(), rel=0.02)
