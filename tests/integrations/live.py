"""Prints with and without the extra in Klipper's own host, and what is to be compared of them."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stillpath.models.machine import Machine
from tests.integrations.klipper_host import Steps, printer_cfg, steps_of

__all__ = ["EVENTS", "Pair", "both", "print_with", "shifted", "stands"]

Array = NDArray[np.float64]

SECTION = "[stillpath]\nfile: stillpath.json"
MORE = """[force_move]
enable_force_move: True
[gcode_arcs]
resolution: 0.2
[firmware_retraction]
retract_length: 0.8
[probe]
pin: P29
z_offset: 1
speed: 5
[bed_mesh]
mesh_min: 20, 20
mesh_max: 80, 80
probe_count: 3, 3
fade_start: 0.4
fade_end: 2
[bed_mesh default]
version: 1
points:
  0.0, 0.1, 0.0
  0.1, 0.2, 0.1
  0.0, 0.1, 0.0
x_count: 3
y_count: 3
mesh_x_pps: 2
mesh_y_pps: 2
algo: lagrange
tension: 0.2
min_x: 20
max_x: 80
min_y: 20
max_y: 80
[gcode_macro T1]
gcode:
  G91
  G1 Z1 F900
  G90
  G1 X5 Y5 F18000
  G4 P200
  G1 X50 Y50 F18000
  G91
  G1 Z-1 F900
  G90
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
EVENTS = {
    "PAUSE, RESUME": "PAUSE\nG4 P1500\nRESUME",
    "CANCEL_PRINT": "CANCEL_PRINT",
    "EXCLUDE_OBJECT": "EXCLUDE_OBJECT NAME=one",
    "M220 S50": "M220 S50",
    "M220 S200": "M220 S200",
    "G28": "G28",
    "G28 X": "G28 X",
    "PROBE": "PROBE",
    "SET_GCODE_OFFSET": "SET_GCODE_OFFSET X_ADJUST=.3 Z_ADJUST=.05 MOVE=1",
    "bed mesh": "BED_MESH_PROFILE LOAD=default",
    "retraction": "G10\nG11",
    "arc": "G17\nG2 X60 Y60 I5 J5 F9000",
    "tool change": "T1",
    "FORCE_MOVE": "FORCE_MOVE STEPPER=stepper_x DISTANCE=2 VELOCITY=20 ACCEL=500",
    "STEPPER_BUZZ": "STEPPER_BUZZ STEPPER=stepper_y",
    "SET_KINEMATIC_POSITION": "SET_KINEMATIC_POSITION X=40 Y=40",
    "off": "STILLPATH ENABLE=0",
    "off and on": "STILLPATH ENABLE=0\nSTILLPATH ENABLE=1",
    "higher limits": "SET_VELOCITY_LIMIT ACCEL=60000 VELOCITY=900",
    "host stalls": "G4 P2500",
}
"""What happens in the middle of lines that are fast."""


@dataclass(frozen=True)
class Pair:
    """A print as Klipper makes it, and with the extra; and what the host said."""

    plain: Steps
    live: Steps
    log: str


def print_with(
    text: str,
    machine: Machine,
    export: dict[str, object],
    place: Path,
    klipper: Path,
    more: str = "",
) -> Steps:
    """Print with the extra."""
    (place / "stillpath.json").write_text(json.dumps(export), encoding="utf-8")
    return steps_of(text, printer_cfg(machine, SECTION, more), place, klipper)


def both(
    text: str,
    machine: Machine,
    export: dict[str, object],
    place: Path,
    klipper: Path,
    more: str = MORE,
) -> Pair:
    """Print without and with the extra."""
    plain = "\n".join(line for line in text.split("\n") if not line.startswith("STILLPATH"))
    first = steps_of(plain, printer_cfg(machine, more), place, klipper)
    text = text + "SET_KINEMATIC_POSITION\nSTILLPATH_STATUS\n"  # the first of them makes all steps
    second = print_with(text, machine, export, place, klipper, more)
    return Pair(first, second, (place / "klippy.log").read_text())


def stands(steps: Steps, least_s: float = 0.6) -> list[tuple[float, ...]]:
    """Return where both motors stood for so long, one after the other."""
    times = np.sort(np.concatenate(steps.time_s))
    ends = np.flatnonzero(np.diff(times) > least_s)
    at = [*(times[ends] + least_s / 2), times[-1] + 1.0]
    found: list[tuple[float, ...]] = []
    for t in at:
        k = [int(np.searchsorted(s, t)) - 1 for s in steps.time_s]
        place = tuple(
            float(p[i]) if i >= 0 else 0.0 for p, i in zip(steps.place_mm, k, strict=True)
        )
        if not found or found[-1] != place:
            found.append(place)
    return found


def shifted(found: Array, late: float, count: int) -> Array:
    """Return a motion (2, n) so many samples earlier, (2, count)."""
    at = np.arange(count) + late
    return np.stack([np.interp(at, np.arange(len(row)), row) for row in found])
