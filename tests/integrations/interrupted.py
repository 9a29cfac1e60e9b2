"""Written files that are interrupted in the middle of streams, for Klipper's own host."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stillpath.models.machine import Machine
from tests.integrations.klipper_host import Steps, printer_cfg, steps_of

__all__ = [
    "EVENTS",
    "ONCE",
    "SAMPLE_S",
    "Asked",
    "asked",
    "disturbed",
    "homed",
    "run",
    "two_objects",
]

MACROS = (Path(__file__).resolve().parents[2] / "integrations/klipper/stillpath.cfg").read_text()
USERS = """
[gcode_macro PAUSE]
rename_existing: PAUSE_BASE
gcode:
  PAUSE_BASE
  G1 X5 Y5 F18000
[gcode_macro CANCEL_PRINT]
rename_existing: CANCEL_PRINT_BASE
gcode:
  G1 X5 Y5 F18000
  CANCEL_PRINT_BASE
"""
SAMPLE_S = 5e-5
_MEAN = 4
"""Samples over which speed is a mean: single steps come in fits and starts."""

EVENTS = {
    "nothing": "",
    "PAUSE, RESUME": "PAUSE\nG4 P300\nRESUME",
    "babystep": "SET_GCODE_OFFSET Z_ADJUST=.05 MOVE=1",
    "host stalls": "G4 P2500",
    "M220 S200": "M220 S200",
    "M220 S50": "M220 S50",
    "EXCLUDE_OBJECT": "EXCLUDE_OBJECT NAME=one",
    "CANCEL_PRINT": "CANCEL_PRINT",
    "started at a layer": "",
}
ONCE = ("EXCLUDE_OBJECT", "CANCEL_PRINT", "started at a layer")
"""What cannot happen twice in a print."""


@dataclass(frozen=True)
class Asked:
    """What a print asked of the motors: largest changes of velocity within 1 and 10 ms, mm/s."""

    step_mm_s: float
    ramp_mm_s: float


def two_objects(layers: int = 2) -> str:
    """A small print of two objects, with fast travels and retractions inside them."""
    lines = ["G28", "G90", "M83", "G1 Z.2 F900"]
    lines += [f"EXCLUDE_OBJECT_DEFINE NAME={name}" for name in ("one", "two")]
    for z in (0.4 + 0.2 * layer for layer in range(layers)):
        for name, x in (("one", 20), ("two", 75)):
            lines += [f";LAYER at {z:.1f}", f"EXCLUDE_OBJECT_START NAME={name}", "G1 E-.8 F2100"]
            lines += [f"G1 Z{z + 0.4:.1f} F900", f"G1 X{x} Y30 F18000", f"G1 Z{z:.1f} F900"]
            lines += ["G1 E.8 F2100"]
            for k in range(8):
                lines += [f"G1 X{x + 40 * (1 - k % 2)} Y{30 + 2 * k} E1.2 F9000"]
                lines += [f"G1 Y{32 + 2 * k} E.06"]
            lines += ["G1 E-.8 F2100", f"G1 X{x + 40} Y80 F24000", "G1 E.8 F2100"]
            lines += [f"G1 X{x} Y80 E1.2 F4800", f"G1 X{x + 20} Y40 E1.3"]
            lines += [f"EXCLUDE_OBJECT_END NAME={name}"]
    return "\n".join(lines) + "\n"


def homed(machine: Machine) -> Machine:
    """The machine, homed where the host's endstops are."""
    firmware = machine.firmware.model_copy(update={"home_mm": (0.0, 0.0, 0.0)})
    return machine.model_copy(update={"firmware": firmware})


def disturbed(text: str, event: str, times: int) -> list[str]:
    """The files that come of a file when something happens at so many lines of its streams.

    One file with all of them, or one for each where it can happen only once. The fastest line is
    among them.
    """
    if event == "nothing":
        return [text]
    lines, speeds = text.split("\n"), _stream_lines(text)
    places = list(speeds)
    chosen = {places[int(k)] for k in np.linspace(3, len(places) - 3, times - 1)}
    chosen.add(max(places, key=speeds.__getitem__))
    if event == "started at a layer":
        head = lines[
            : next(k for k, line in enumerate(lines) if line.startswith("EXCLUDE_OBJECT_D"))
        ]
        return ["\n".join([*head, *lines[k:]]) for k in sorted(chosen)]
    script = EVENTS[event].split("\n")
    if event == "CANCEL_PRINT":
        return ["\n".join([*lines[: k + 1], *script, ""]) for k in sorted(chosen)]
    if event in ONCE:
        return ["\n".join([*lines[: k + 1], *script, *lines[k + 1 :]]) for k in sorted(chosen)]
    whole: list[str] = []
    for k, line in enumerate(lines):
        whole += [line, *(script if k in chosen else ())]
    return ["\n".join(whole)]


def asked(steps: Steps, machine: Machine) -> Asked:
    """Measure what steps ask of X and Y."""
    place = steps.sampled(SAMPLE_S, machine.kinematics == "corexy")
    velocity = (place[:, _MEAN:] - place[:, :-_MEAN]) / (_MEAN * SAMPLE_S)
    return Asked(_change(velocity, 1e-3), _change(velocity, 10e-3))


def run(text: str, machine: Machine, folder: Path) -> Steps:
    """Let the host run a file with our macros behind somebody's own."""
    return steps_of(text, printer_cfg(machine, USERS, MACROS), folder)


def _stream_lines(text: str) -> dict[int, float]:
    """Numbers of the moves inside streams, and their F."""
    found, inside, feed = {}, False, 0.0
    for number, line in enumerate(text.split("\n")):
        if "; stillpath: stream " in line:
            inside = line.endswith("on")
        elif inside and line.startswith("G1") and ("X" in line or "Y" in line):
            feed = float(line.rpartition("F")[2]) if "F" in line else feed
            found[number] = feed
    return found


def _change(velocity: NDArray[np.float64], within_s: float) -> float:
    reach = round(within_s / SAMPLE_S)
    return float(np.hypot(*(velocity[:, reach:] - velocity[:, :-reach])).max())
