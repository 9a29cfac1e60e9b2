"""Limits of the motors that commands keep to, derived from what the printer sets for a file."""

from __future__ import annotations

import math
from typing import Any

from stillpath.models.firmware import Klipper
from stillpath.models.firmware.common import AxisAllowance
from stillpath.models.machine import AxisLimits, CommandLimits, Machine, MotorLimits

__all__ = ["changed_to", "derived_envelope", "envelope_warnings", "with_firmware"]

_ACCEL_ROOM, _SPEED_ROOM, _CORNERS = 1.5, 1.2, 6.0
"""Limits assumed for motors where none are stated: these multiples of the acceleration, speed and
corner speed that the printer allows a file."""
_QUEUE_ROOM, _QUEUE_MM_S2 = 3.0, 6000.0
"""Multiple of the acceleration on Marlin and RepRapFirmware, and up to where: with few short moves
in their queues they do not reach a print's speed on 1.5 times a low limit, and every piece would
stay as sliced."""
_LEAST_STEP_MM_S = 20.0
_ROUNDING = 1.001
"""Ratio up to which two limits count as equal."""


def derived_envelope(machine: Machine) -> CommandLimits:
    """Return the limits assumed for the motors, from those that the printer sets for a file.

    They are slightly higher, since a command has to lead the nozzle; the machine's `command` can
    state better values. `axes` are set if the printer has separate limits for X and Y; the motors
    of a CoreXY are assumed to follow what a file's diagonals need.
    """
    x, y = (_borne(machine, machine.firmware.allowance(axis)) for axis in ("x", "y"))
    least = {name: min(value, y[name]) for name, value in x.items()}
    if machine.kinematics == "corexy":
        # An integer, not below what a diagonal at the head's own limit needs.
        accel = math.ceil(_accel_borne(machine, machine.firmware.motor_accel_mm_s2()))
        return CommandLimits(**least, motors=MotorLimits(accel_mm_s2=accel))
    if machine.firmware.kind == "klipper":
        return CommandLimits(**least)
    more = {
        axis: AxisLimits(**{name: value for name, value in borne.items() if value > least[name]})
        for axis, borne in (("x", x), ("y", y))
        if borne != least
    }
    return CommandLimits(**least, axes=more)


def with_firmware(machine: Machine, section: dict[str, Any]) -> Machine:
    """Return a machine with another firmware section.

    Limits of the motors are derived again if they were derived, and kept if they were stated.

    Raises
    ------
    ValidationError
        If the section, or the machine with it, is invalid.
    """
    return changed_to(machine, {**machine.model_dump(mode="json"), "firmware": section})


def changed_to(machine: Machine, document: dict[str, Any]) -> Machine:
    """Return a machine as its changed document has it; limits of the motors as `with_firmware`.

    Raises
    ------
    ValidationError
        If the document is invalid.
    """
    derived = machine.command == derived_envelope(machine)
    if derived:
        del document["command"]
    changed = Machine.model_validate(document)
    return changed.model_copy(update={"command": derived_envelope(changed)}) if derived else changed


def envelope_warnings(machine: Machine) -> list[str]:
    """Return a warning if a command may exceed what the printer's own limits suggest.

    Until 2026-11 machines were made with 20 000 mm/s2 whatever the printer's limit was.
    """
    derived, stated = derived_envelope(machine), machine.command
    found: dict[str, tuple[float, float]] = {}
    for axis in ("x", "y"):
        most, asked = derived.of(axis).accel_mm_s2, stated.of(axis).accel_mm_s2
        if asked > _ROUNDING * most:
            by_axis = axis in stated.axes and stated.axes[axis].accel_mm_s2 is not None
            place = f"axes.{axis}.accel_mm_s2" if by_axis else "accel_mm_s2"
            found[place] = (asked, min(most, found.get(place, (asked, most))[1]))
    motors = [limits.motors and limits.motors.accel_mm_s2 for limits in (stated, derived)]
    if motors[0] and motors[1] and motors[0] > _ROUNDING * motors[1]:
        found["motors.accel_mm_s2"] = (motors[0], motors[1])
    return [
        f"{machine.name}: a command may ask the motors for {asked:.0f} mm/s2 (command.{place}), "
        f"more than the {most:.0f} that the printer's own limits for a file suggest: right if the "
        f"motors were tested at that acceleration; otherwise put {most:.0f} there"
        for place, (asked, most) in found.items()
    ]


def _borne(machine: Machine, allowed: AxisAllowance) -> dict[str, float]:
    # A command that cannot travel as the printer does comes late behind each travel.
    accel = max(allowed.accel_mm_s2, allowed.travel_accel_mm_s2)
    step = _CORNERS * allowed.corner_mm_s
    room = 1.0 if _capped(machine) else _SPEED_ROOM
    return {
        "velocity_mm_s": room * allowed.speed_mm_s,
        "accel_mm_s2": _accel_borne(machine, accel),
        "speed_step_mm_s": min(max(step, _LEAST_STEP_MM_S), CommandLimits().speed_step_mm_s),
    }


def _accel_borne(machine: Machine, allowed_mm_s2: float) -> float:
    usual = allowed_mm_s2 if _capped(machine) else _ACCEL_ROOM * allowed_mm_s2
    if machine.firmware.kind == "klipper":
        return usual
    return max(usual, min(_QUEUE_ROOM * allowed_mm_s2, _QUEUE_MM_S2))


def _capped(machine: Machine) -> bool:
    return isinstance(machine.firmware, Klipper) and machine.firmware.limits_capped
