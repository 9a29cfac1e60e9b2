"""Search for lost steps: stream-like motions at rising limits, and the console's replies.

Each level homes X and Y, moves as streams do (starts, stops and corners, along both axes and both
motors of a CoreXY) and homes again. If the host's step counters then differ by a full step from
their first values, a motor has lost steps.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from stillpath.gcode.firmware.klipper.limits import KlipperLimits
from stillpath.gcode.firmware.klipper.stream_commands import KlipperStreamCommands
from stillpath.models.errors import ModelError
from stillpath.models.firmware import Klipper
from stillpath.models.machine import CommandLimits, Machine

__all__ = ["Level", "borne", "envelope", "levels_of", "motor_test"]

_RISE, _MOST_LEVELS = 1.25, 16
_STROKES, _CORNERS = 8, 60
_LONGEST_MM, _SHARE = 120.0, 0.6
_LEG_MM, _TURN_RAD = 2.0, math.radians(30.0)
_SMALL_CORNER = math.sqrt(8.0 * (math.sqrt(2.0) - 1.0))
"""Step of velocity around a small angle, relative to the speed through a square corner."""
_HEIGHT_MM = 20.0
_DIRECTIONS = (
    (1.0, 0.0),
    (0.0, 1.0),
    (math.sqrt(0.5), math.sqrt(0.5)),
    (math.sqrt(0.5), -math.sqrt(0.5)),
)
_LEVEL = re.compile(r"^; level (\d+): accel ([\d.]+) mm/s2, step ([\d.]+) mm/s$", re.MULTILINE)
_START = "Starting SD card print (position 0)"
"""In klippy.log at the start of a file; where it is resumed, the position is another."""
_OVER = "the search is over"
_TOLD = r"level \d+: accel [\d.]+ mm/s2, step [\d.]+ mm/s"
_ENTRY = re.compile(rf"mcu: stepper_.*|(?<!M118 )(?<!; )(?:{_TOLD}|{_OVER})")
"""Answers to GET_POSITION and what M118 says, but not the file's own lines."""
_COUNTED = re.compile(r"stepper_([xy]\d*):(-?\d+)")
"""A stepper and its counter; an axis may have several."""


@dataclass(frozen=True)
class Level:
    """Limits tried on the motors."""

    accel_mm_s2: float
    speed_step_mm_s: float


def motor_test(machine: Machine, most_accel_mm_s2: float) -> str:
    """Return the G-code of a search up to an acceleration.

    Raises
    ------
    ModelError
        For another firmware than Klipper, whose counters the search reads; for a machine that
        allows more already.
    """
    firmware = machine.firmware
    if not isinstance(firmware, Klipper):
        raise ModelError(
            f"{machine.name} runs {firmware.kind}: the search reads Klipper's step counters; say "
            "what the motors bear in `command` of the machine's document"
        )
    levels = _levels(firmware, most_accel_mm_s2)
    stream_commands = KlipperStreamCommands(firmware)
    middle = [0.5 * (machine.travel[a].min_mm + machine.travel[a].max_mm) for a in ("x", "y")]
    room_mm = min(machine.travel[a].max_mm - machine.travel[a].min_mm for a in ("x", "y"))
    home = ["G28 X Y", "M400", "GET_POSITION"]
    place = f"G1 X{middle[0]:.3f} Y{middle[1]:.3f} F6000"
    lines = ["; STILLPATH_OFF", "; a search for lost steps: nothing is heated, nothing printed"]
    lines += ["G28", "G90", "M83", f"G1 Z{_HEIGHT_MM:g} F600", *home]
    # A shaper would reduce the load of a stream on the motors.
    lines += stream_commands.shaper_off.decode().splitlines()
    for number, level in enumerate(levels, 1):
        text = _told(number, level)
        lines += [
            f"; {text}",
            f"M118 {text}",
            place,
            stream_commands.limits(_limits(firmware, level)).decode().strip(),
        ]
        for direction in _DIRECTIONS:
            lines += _strokes(
                middle, direction, min(_LONGEST_MM, _SHARE * room_mm), level, firmware
            )
            lines += _corners(middle, direction, level)
        lines += [stream_commands.limits(_own(firmware)).decode().strip(), *home]
    shaper = stream_commands.shaper_on
    over = "; the shaper stays off until FIRMWARE_RESTART" if shaper is None else shaper.decode()
    return "\n".join([*lines, *over.splitlines(), f"M118 {_OVER}", ""])


def levels_of(text: str) -> list[Level]:
    """Return the levels of a file that `motor_test` wrote.

    Raises
    ------
    ModelError
        If it holds none.
    """
    found = [Level(float(accel), float(step)) for _, accel, step in _LEVEL.findall(text)]
    if not found:
        raise ModelError("the file has no levels; it must be what `stillpath motor-test` wrote")
    return found


def borne(levels: list[Level], console: str, full_step: int) -> int:
    """Return how many levels the motors passed, from the console's replies.

    Parameters
    ----------
    console : str
        The console's text or klippy.log; of several runs in it the last counts.
    full_step : int
        Microsteps of a full step, of X and Y.

    Raises
    ------
    ModelError
        The text is not that of one whole run of this search on one printer.
    """
    counts = [dict(_COUNTED.findall(answer)) for answer in _answers(levels, console)]
    if len(counts) != len(levels) + 1:
        raise ModelError(
            f"the console holds {len(counts)} answers to GET_POSITION, the search asks for "
            f"{len(levels) + 1}: run the whole file, then hand in the console's text of this run "
            "alone, or klippy.log"
        )
    first, *later = counts
    for passed, one in enumerate(later):
        if one.keys() != first.keys():
            raise ModelError(
                f"answer {passed + 2} to GET_POSITION lists other steppers of X and Y than the "
                f"first ({', '.join(one)}; {', '.join(first)}): hand in the text of one run alone"
            )
        if any(abs(int(one[name]) - int(at)) >= full_step for name, at in first.items()):
            return passed
    return len(levels)


def envelope(machine: Machine, level: Level, margin: float) -> CommandLimits:
    """Return the machine's limits for motors that passed a level."""
    changed: dict[str, object] = {
        "accel_mm_s2": round(margin * level.accel_mm_s2),
        "speed_step_mm_s": round(margin * level.speed_step_mm_s, 1),
    }
    if machine.command.motors is not None:
        # Strokes along diagonals need this of one motor of a CoreXY.
        accel = round(math.sqrt(2.0) * margin * level.accel_mm_s2)
        changed["motors"] = machine.command.motors.model_copy(update={"accel_mm_s2": accel})
    return machine.command.model_copy(update=changed)


def _told(number: int, level: Level) -> str:
    accel, step = level.accel_mm_s2, level.speed_step_mm_s
    return f"level {number}: accel {accel:.0f} mm/s2, step {step:.1f} mm/s"


def _answers(levels: list[Level], console: str) -> list[str]:
    """Return the answers of the last run, which begins with one before the first level."""
    runs: list[list[str]] = [_ENTRY.findall(run) for run in console.split(_START)]
    entries = next((run for run in reversed(runs) if run), [])
    begins = [k for k, entry in enumerate(entries) if entry.startswith("level 1:")]
    if begins:  # klippy.log has no lines of M118, nor has a printer without [respond]
        entries = entries[max(begins[-1] - 1, 0) :]
        if _OVER not in entries:
            raise ModelError(
                f"the console's last search has no end (no {_OVER!r}): run the whole file, then "
                "hand in the console's text, oldest line first"
            )
        entries = entries[: entries.index(_OVER)]
    said = [entry for entry in entries if entry.startswith("level")]
    if said and said != [_told(number, level) for number, level in enumerate(levels, 1)]:
        raise ModelError(
            f"the console's search has other levels ({said[-1]!r} is its last) than the file: hand "
            "in the text of a run of this file"
        )
    return [entry for entry in entries if entry.startswith("mcu")]


def _levels(firmware: Klipper, most_accel_mm_s2: float) -> list[Level]:
    own = firmware.largest_accel_mm_s2
    largest = own * _RISE ** (_MOST_LEVELS - 1)
    if not most_accel_mm_s2 <= largest:
        raise ModelError(
            f"an acceleration of {most_accel_mm_s2:g} mm/s2 is beyond {_MOST_LEVELS} levels from "
            f"the printer's {own:g} mm/s2 on: search up to {largest:.0f} at most, then raise "
            "max_accel and search on"
        )
    if most_accel_mm_s2 <= own:
        raise ModelError(
            f"the printer allows a file {own:g} mm/s2 already: search up to more than that"
        )
    step = _SMALL_CORNER * max(firmware.corner_mm_s, 5.0)
    count = math.ceil(math.log(most_accel_mm_s2 / own) / math.log(_RISE) - 1e-9)
    rise = (most_accel_mm_s2 / own) ** (1.0 / count)
    return [Level(round(own * rise**k), round(step * rise**k, 1)) for k in range(count + 1)]


def _limits(firmware: Klipper, level: Level) -> KlipperLimits:
    corner = level.speed_step_mm_s / _SMALL_CORNER
    return KlipperLimits(firmware.fastest_mm_s, level.accel_mm_s2, corner, 0.0)


def _own(firmware: Klipper) -> KlipperLimits:
    planner = firmware.planner
    return KlipperLimits(
        planner.max_velocity_mm_s,
        planner.max_accel_mm_s2,
        planner.square_corner_velocity_mm_s,
        planner.minimum_cruise_ratio,
        planner.max_accel_to_decel_mm_s2 or 0.0,
    )


def _strokes(
    middle: list[float],
    direction: tuple[float, float],
    length_mm: float,
    level: Level,
    firmware: Klipper,
) -> list[str]:
    """Move back and forth at the top speed of each length; the shortest only start and stop."""
    lines = []
    for share in (1.0, 0.25, 0.05):
        far_mm = share * length_mm
        speed = min(firmware.fastest_mm_s, math.sqrt(0.8 * level.accel_mm_s2 * far_mm))
        ends = (-0.5 * far_mm, 0.5 * far_mm)
        lines += [_move(middle, direction, ends[k % 2], 0.0, speed) for k in range(_STROKES)]
    return lines


def _corners(middle: list[float], direction: tuple[float, float], level: Level) -> list[str]:
    """Write a zigzag whose corners step velocity by the level's step."""
    speed = 1.5 * level.speed_step_mm_s / (2.0 * math.sin(0.5 * _TURN_RAD))
    rise_mm = _LEG_MM * math.sin(0.5 * _TURN_RAD)
    along_mm, lines = _LEG_MM * math.cos(0.5 * _TURN_RAD), []
    there = 10
    for k in range(_CORNERS):
        way = k % (2 * there)
        far = way if way <= there else 2 * there - way
        lines.append(_move(middle, direction, far * along_mm, rise_mm * (k % 2), speed))
    return lines


def _move(
    middle: list[float],
    direction: tuple[float, float],
    far_mm: float,
    aside_mm: float,
    speed: float,
) -> str:
    x = middle[0] + far_mm * direction[0] - aside_mm * direction[1]
    y = middle[1] + far_mm * direction[1] + aside_mm * direction[0]
    return f"G1 X{x:.3f} Y{y:.3f} F{60.0 * speed:.0f}"
