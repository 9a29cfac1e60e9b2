"""A ring test: fast moves that stop dead, as planned and compensated, and a rest after each.

Nothing is printed or heated. While an axis rests the other one creeps: motion continues as after a
corner of a print, so that compensation can act after the stop as it does there. All rests have
different durations, so that axes and stops cannot be confused in a log.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import numpy as np

from stillpath.applications.machines.envelope import derived_envelope
from stillpath.applications.proof.drive import AXES, Axis, RingingMode, ringing_mode
from stillpath.applications.proof.halves import ProofPrint, Ringing, write_proof
from stillpath.applications.proof.recorders import RingSettings, recorder_for
from stillpath.gcode.firmware.registry import adapter
from stillpath.models.confirmation import plants_digest
from stillpath.models.errors import ModelError
from stillpath.models.firmware import Klipper
from stillpath.models.machine import Machine
from stillpath.pipeline.progress import ProgressCallback
from stillpath.pipeline.result import Result

__all__ = [
    "AXES",
    "PARTS",
    "REST",
    "ROUNDS",
    "TITLE",
    "Axis",
    "RingTest",
    "plants_line",
    "region",
    "write_ring_test",
]

REST = " rest"
PARTS = ("quiet", "off", "off" + REST, "on", "on" + REST)
TITLE = "Ring test for "
"""Beginning of the file's first line."""
_SPEEDS_MM_S = (60.0, 100.0, 150.0)
_NEAR = 0.15
"""Relative change allowed to these speeds, to avoid cancellation between both ends of braking."""
ROUNDS = 2
_REST_S = (0.6, 1.0)
_QUIET_S = 2.0
_CREEP_MM_S = 3.0
"""Below the corner speed that firmwares allow without braking."""
_GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)
_CRUISE = 2.5
"""Length of a move in units of v^2 / a: Klipper lowers the acceleration of those below 2."""
_SHORTEST_MM, _MARGIN_MM, _HEIGHT_MM = 20.0, 10.0, 20.0
_TRAVEL_MM_S = 100.0


class RingTest:
    """Writes a ring test, which only moves.

    Raises
    ------
    ModelError
        The travel is too small, or an axis does not ring.

    Attributes
    ----------
    speeds_mm_s : dict
        By axis, in the order of the file.
    accel_mm_s2 : dict
        By axis.
    recorder : Recorder
    """

    def __init__(self, machine: Machine, settings: RingSettings) -> None:
        self._own_limits = adapter(machine).initial_limits()
        self.machine = machine = _driven(machine, settings.accel_mm_s2)
        self._machine, self._settings = machine, settings
        self._firmware_adapter = adapter(machine)
        self._stream_commands = self._firmware_adapter.stream_commands()
        firmware = machine.firmware
        self._allowed = {axis: firmware.allowance(axis) for axis in AXES}
        self._z_mm_s = min(10.0, firmware.fastest_z_mm_s)
        self._travel_mm_s = min(_TRAVEL_MM_S, firmware.fastest_mm_s)
        self._middle = {
            a: 0.5 * (machine.travel[a].min_mm + machine.travel[a].max_mm) for a in ("x", "y", "z")
        }
        self.accel_mm_s2 = {axis: one.accel_mm_s2 for axis, one in self._allowed.items()}
        self.speeds_mm_s: dict[Axis, tuple[float, ...]] = {
            axis: self._speeds(ringing_mode(machine.axes[axis].nominal), axis) for axis in AXES
        }
        self.recorder = recorder_for(machine, settings)
        self._rests = _rests()
        self._at_mm: dict[Axis, float] = {}
        self._out: list[str] = []
        self._write()

    def text(self) -> str:
        """Return all lines."""
        return "\n".join(self._out) + "\n"

    def _write(self) -> None:
        start = self._settings.start_gcode
        self._add(*(["G28"] if start is None else start.splitlines()))
        self._add("; STILLPATH_OFF", "G90", "M83", "M220 S100")
        # Both halves are predicted and measured without the firmware's shaper.
        self._limit(self._stream_commands.shaper_off)
        largest = self._machine.firmware.largest_accel_mm_s2
        self._limit(self._stream_commands.acceleration(largest))
        if self._settings.accel_mm_s2 is not None:
            raised = self._firmware_adapter.initial_limits()
            self._limit(self._stream_commands.axis_accelerations(raised))
        travel = self._machine.travel["z"]
        height_mm = min(max(travel.min_mm, 0.0) + _HEIGHT_MM, self._middle["z"])
        self._add(f"G1 Z{height_mm:.3f} F{60 * self._z_mm_s:.0f}")
        self._centre()
        self._add(*self.recorder.first())
        for number in range(1, ROUNDS + 1):
            begins = len(self._out)
            seconds = 0.0
            for axis in AXES:
                self._add(f";TYPE:{region(axis, 'quiet')}")
                self._creep(axis, _QUIET_S)
                seconds += _QUIET_S
            seconds += self._stops("off")
            self._add("; STILLPATH_ON")
            seconds += self._stops("on")
            self._add("; STILLPATH_OFF", ";TYPE:end")
            self._out[begins:begins] = self.recorder.before(number, seconds)
            self._centre()
            self._add(*self.recorder.after(seconds))
        self._add(*self.recorder.last())
        if self._settings.accel_mm_s2 is not None:
            self._limit(self._stream_commands.axis_accelerations(self._own_limits))
        self._limit(self._stream_commands.acceleration_back(self._own_limits))
        self._limit(self._stream_commands.shaper_on or b"")

    def _stops(self, half: Literal["off", "on"]) -> float:
        """Move each axis back and forth at every speed; return the approximate duration.

        X and Y alternate, so that a wrong clock rate can be told from a delay of one axis.
        """
        seconds = 0.0
        for k in range(len(_SPEEDS_MM_S)):
            for axis in AXES:
                speed = self.speeds_mm_s[axis][k]
                length_mm = self._length_mm(axis, speed)
                for side in (1.0, -1.0):
                    place = self._middle[axis] + side * 0.5 * length_mm
                    rest_s = next(self._rests)
                    self._add(f";TYPE:{region(axis, half)}")
                    self._at_mm[axis] = place
                    self._add(f"G1 {axis.upper()}{place:.3f} F{60 * speed:.0f}")
                    self._add(f";TYPE:{region(axis, half + REST)}")
                    self._creep(axis, side * rest_s)
                    seconds += length_mm / speed + speed / self.accel_mm_s2[axis] + rest_s
        return seconds

    def _creep(self, axis: Axis, seconds: float) -> None:
        """Let the other axis creep, backwards for negative times."""
        other: Axis = "y" if axis == "x" else "x"
        self._at_mm[other] += _CREEP_MM_S * seconds
        place = self._at_mm[other]
        self._add(f"G1 {other.upper()}{place:.3f} F{60 * _CREEP_MM_S:.0f}")

    def _speeds(self, mode: RingingMode, axis: Axis) -> tuple[float, ...]:
        """Return speeds near those wanted, within the limits, at which the axis rings most."""
        travel = self._machine.travel[axis]
        room_mm = travel.max_mm - travel.min_mm - 2 * _MARGIN_MM
        allowed_mm_s, accel_mm_s2 = self._allowed[axis][:2]
        fastest = min(allowed_mm_s, math.sqrt(max(room_mm, 0.0) * accel_mm_s2 / _CRUISE))
        if room_mm < _SHORTEST_MM or fastest < 0.5 * _SPEEDS_MM_S[0]:
            raise ModelError(
                f"the ring test moves {axis} by {_SHORTEST_MM:g} mm at least, at "
                f"{0.5 * _SPEEDS_MM_S[0]:g} mm/s: its travel of {room_mm:.0f} mm (with a margin) "
                f"allows {fastest:.0f} mm/s; correct the machine's travel or its limits"
            )
        out = []
        for wanted in _SPEEDS_MM_S:
            tried = np.linspace(1.0 - _NEAR, 1.0 + _NEAR, 13) * wanted
            tried = np.minimum(tried, fastest)
            rings = [mode.ringing_um(v, accel_mm_s2) for v in tried]
            out.append(round(float(tried[int(np.argmax(rings))]), 1))
        return tuple(out)

    def _length_mm(self, axis: Axis, speed_mm_s: float) -> float:
        return max(_CRUISE * speed_mm_s**2 / self.accel_mm_s2[axis], _SHORTEST_MM)

    def _centre(self) -> None:
        x, y = self._middle["x"], self._middle["y"]
        self._at_mm = {"x": x, "y": y}
        self._add(f"G1 X{x:.3f} Y{y:.3f} F{60 * self._travel_mm_s:.0f}")
        self._add(f"G4 P{1e3 * _REST_S[0]:.0f}")

    def _limit(self, lines: bytes) -> None:
        self._add(*lines.decode().splitlines())

    def _add(self, *lines: str) -> None:
        self._out.extend(lines)


def write_ring_test(
    machine: Machine,
    target: Path,
    settings: RingSettings | None = None,
    *,
    cache_dir: Path | None = None,
    progress: ProgressCallback | None = None,
) -> ProofPrint:
    """Write the ring test for a machine, half of it compensated. Less than two minutes.

    Parameters
    ----------
    target : Path
        Written whole or not at all.
    cache_dir, progress
        As of `pipeline.compensate.compensate_file`.

    Raises
    ------
    ModelError
        The travel is too small, an axis does not ring, or not all can be compensated.
    DesignError, GcodeError
        As of `pipeline.compensate.compensate_file`.
    """
    settings = settings or RingSettings()
    program = RingTest(machine, settings)

    def legend(_: dict[str, Ringing], result: Result) -> list[str]:
        if result.put_back:
            raise ModelError(
                f"{len(result.put_back)} of the {result.pieces} parts of the ring test that should "
                f"be compensated would stay as planned ({result.put_back[0].reason}), and its logs "
                "would say nothing: see what the motors bear (`command` of the machine's document)"
            )
        stops = [
            f"{' '.join(f'{v:g}' for v in program.speeds_mm_s[a])} mm/s in {a.upper()} at "
            f"{program.accel_mm_s2[a]:g} mm/s2"
            for a in AXES
        ]
        return [
            f"{TITLE}{machine.title} (model {machine.revision})",
            f"Nothing is printed, nothing is heated: the head stops dead from {', '.join(stops)},",
            "half of the times as planned, half compensated. Do not touch machine or table.",
            *program.recorder.instruction,
            *_raised(settings.accel_mm_s2),
            ", ".join(plants_line(a, plants_digest(machine.axes[a])) for a in AXES),
            f"Time {result.time_s:.0f} s without homing.",
        ]

    driven = program.machine
    return write_proof(program, driven, target, legend, cache_dir=cache_dir, progress=progress)


def _driven(machine: Machine, accel_mm_s2: float | None) -> Machine:
    """Return the machine with this acceleration, and motors that bear as much as it needs.

    Raises
    ------
    ModelError
        The printer does not take limits above its own.
    """
    if accel_mm_s2 is None:
        return machine
    firmware, own = machine.firmware, machine.command
    if isinstance(firmware, Klipper) and firmware.limits_capped:
        most = min(firmware.allowance(axis).accel_mm_s2 for axis in AXES)
        if accel_mm_s2 > most:
            raise ModelError(
                f"the stops cannot brake with {accel_mm_s2:g} mm/s2 (--accel-mm-s2): this printer "
                f"takes no more than its own {most:g}; leave it out"
            )
    driven = machine.model_copy(update={"firmware": firmware.driven_at(accel_mm_s2)})
    needed = derived_envelope(driven)
    if own.every_way.accel_mm_s2 >= needed.every_way.accel_mm_s2:
        return driven
    kept = {name: getattr(own, name) for name in ("velocity_mm_s", "speed_step_mm_s")}
    return driven.model_copy(update={"command": needed.model_copy(update=kept)})


def _raised(accel_mm_s2: float | None) -> list[str]:
    if accel_mm_s2 is None:
        return []
    return [
        f"Accelerations are set to {accel_mm_s2:g} mm/s2 until the end: if you cancel, restart the",
        "firmware, or set them back. Motors that clack or stay behind do not bear it.",
    ]


def region(axis: Axis, part: str) -> str:
    """Return the name of a part of the file, one of `PARTS`."""
    return f"ring {axis} {part}"


def plants_line(axis: Axis, digest: str) -> str:
    """Return the plants of an axis as the file's first lines describe them."""
    return f"plants of {axis}: {digest}"


def _rests() -> Iterator[float]:
    """Yield rests, no two of which are equal."""
    low, high = _REST_S
    share = 0.0
    while True:
        share = (share + _GOLDEN) % 1.0
        yield low + (high - low) * share
