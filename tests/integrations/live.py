"""Prints with and without the extra in Klipper's own host, and what is to be compared of them."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillpath.compensation.live_filter import LiveFilter
from stillpath.models.machine import Machine
from tests.integrations.interrupted import two_objects
from tests.integrations.klipper_host import MICROSTEPS, STEP_MM, Steps, printer_cfg, steps_of
from tests.integrations.klipper_moves import HostMoves, recorded

__all__ = [
    "EVENTS",
    "FILES",
    "FINE",
    "Pair",
    "both",
    "curves",
    "later",
    "off_steps",
    "predicted",
    "print_begins",
    "print_with",
    "shifted",
    "stands",
    "with_event",
]

Array = NDArray[np.float64]

GEAR = Path(__file__).resolve().parents[2] / "examples" / "cura_ender3_gear24.gcode"
FINE, _FAR_MM, _HOMED_S = 4, 1e4, 2.5
"""`FINE`: samples of a plan to one of the filter."""
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


def curves() -> str:
    """Circles as slicers write them, at several speeds, and short zigzags."""
    lines = ["G28", "G90", "M83", "G1 Z.3 F900"]
    for radius, feed in ((3, 3000), (12, 9000), (25, 15000)):
        for k in range(73):
            a = 2 * np.pi * k / 72
            x, y = 60 + radius * np.cos(a), 60 + radius * np.sin(a)
            lines.append(f"G1 X{x:.3f} Y{y:.3f} E.03 F{feed}")
        lines += ["G1 E-.8 F2100", "G1 Z.6", "G1 X40 Y40 F18000", "G1 Z.3", "G1 E.8"]
        lines += [f"G1 X{40 + 0.4 * k:.1f} Y{40 + 4 * (k % 2)} E.1 F{feed}" for k in range(40)]
    return "\n".join(lines) + "\n"


FILES: dict[str, Callable[[], str]] = {
    "two objects": two_objects,
    "curves": curves,
    "gear": lambda: GEAR.read_text().partition(";LAYER:1")[0],
}


@dataclass(frozen=True)
class Pair:
    """A print as Klipper makes it, and with the extra; what the host said, and its plan."""

    plain: Steps
    live: Steps
    log: str
    plan: HostMoves | None = None

    def planned(self) -> tuple[Array, Array]:
        """The plan from shortly before the print on: times, and places of X and Y, (2, n).

        `FINE` samples are one of the filter.
        """
        first = (round(print_begins(self.plain.time_s) * 1e3) - 500) * FINE
        ends_s = max(float(t[-1]) for t in self.plain.time_s)
        assert self.plan is not None
        at_s = np.arange(first, round(ends_s * 1e3 * FINE) + 50 * FINE) * 1e-3 / FINE
        return at_s, self.plan.head_at(at_s)


def print_with(
    text: str,
    machine: Machine,
    export: dict[str, object],
    place: Path,
    klipper: Path,
    more: str = "",
    microsteps: int | None = None,
) -> Steps:
    """Print with the extra; `microsteps` of X and Y, if not as fine as `STEP_MM`."""
    (place / "stillpath.json").write_text(json.dumps(export), encoding="utf-8")
    config = printer_cfg(machine, SECTION, more)
    if microsteps is not None:
        config = config.replace(f"microsteps: {MICROSTEPS}\n", f"microsteps: {microsteps}\n")
    return steps_of(text, config, place, klipper)


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
    plan = recorded(place)
    text = text + "SET_KINEMATIC_POSITION\nSTILLPATH_STATUS\n"  # the first of them makes all steps
    second = print_with(text, machine, export, place, klipper, more)
    return Pair(first, second, (place / "klippy.log").read_text(), plan)


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


def with_event(script: str) -> str:
    """Two objects, with an event in fast lines and a stand behind the next one.

    `script`: one of `EVENTS`, or other lines.
    """
    event, script = script, EVENTS.get(script, script)
    lines = two_objects(layers=1).split("\n")
    fast = [k for k, line in enumerate(lines) if line.startswith("G1 X") and "F9000" in line]
    happens = script.split("\n")
    if event == "CANCEL_PRINT":
        return "\n".join([*lines[: fast[12] + 1], *happens, ""])
    for k in reversed(fast[3::9]):
        lines[k + 1 : k + 2] = [*happens, lines[k + 1], "G4 P1500"]
    return "\n".join(lines)


def print_begins(times: list[Any]) -> float:
    """When X or Y moves after the homing of Z, the only long stand."""
    t = np.sort(np.concatenate(times))
    return float(t[np.flatnonzero(np.diff(t) > _HOMED_S)[-1] + 1])


def later(prints: Pair) -> float:
    """By how much later the extruder makes its last step, which no filter touches."""
    return float(prints.live.others_s[1][-1] - prints.plain.others_s[1][-1])


def predicted(plan: Array, given: dict[str, Any]) -> Array:
    """Filter a plan whose samples are `FINE` to one of the filter."""
    taps = np.array([given["axes"][axis]["taps"] for axis in ("x", "y")])
    command = given["command"]
    far = np.array([[-_FAR_MM, _FAR_MM]] * 2)
    live = LiveFilter(taps, 1e-3, command["velocity_mm_s"], command["accel_mm_s2"], far)
    out = np.empty_like(plan)
    for phase in range(FINE):
        rows = np.pad(plan[:, phase::FINE], ((0, 0), (live.margin, live.margin)), mode="edge")
        out[:, phase::FINE] = live.command(rows)
    return out


def off_steps(prints: Pair, given: dict[str, Any], corexy: bool) -> Array:
    """By how many steps the motors stand off the filtered plan, (2, n), from the print on."""
    at_s, plan = prints.planned()
    x, y = predicted(plan, given)
    motors = np.stack((x + y, x - y) if corexy else (x, y))
    stand = prints.live.held(at_s + later(prints))
    # Steps count from where the motors stood at first, the plan from where they were homed.
    stand -= stand[:, :1] - motors[:, :1]
    return np.asarray((stand - motors) / STEP_MM)
