"""A first print: a small box, its left half as planned, its right half compensated."""

from __future__ import annotations

import math
from pathlib import Path

from stillpath.applications.proof.drive import Drive, drive, ringing_mode
from stillpath.applications.proof.halves import (
    AS_PLANNED,
    COMPENSATED,
    Halves,
    ProofPrint,
    Ringing,
    write_proof,
)
from stillpath.applications.proof.program import PrintSettings, Program
from stillpath.models.machine import Machine
from stillpath.pipeline.progress import ProgressCallback
from stillpath.pipeline.result import Result

__all__ = ["coupon_program", "write_coupon"]

Point = tuple[float, float]

_SIDE_MM, _HEIGHT_MM = 28.0, 8.0
_TEETH, _TOOTH_MM, _TOOTH_DEPTH_MM = 8, 2.0, 1.5
_CIRCLE_MM, _CHORDS = 4.0, 48


def coupon_program(machine: Machine, settings: PrintSettings) -> tuple[Program, Drive]:
    """Return the coupon before its right half is compensated, and how its walls are printed.

    Raises
    ------
    ModelError
        The travel is too small, or the plants do not ring.
    """
    halves = Halves(machine, settings, _SIDE_MM, _SIDE_MM, "coupon")
    program = halves.program
    flow_mm_s = settings.max_flow_mm3_s / program.section_mm2
    chosen = drive(machine, flow_mm_s, _SIDE_MM)
    z = halves.begin()
    program.limit_accel(chosen.accel_mm_s2)
    layers = round(_HEIGHT_MM / program.layer_mm)
    for number in range(1, layers + 1):
        program.layer(z + number * program.layer_mm)
        if number <= 2:
            halves.words(chosen.accel_mm_s2)
        halves.both([_outline(), _circle()], chosen.speed_mm_s)
    program.finish()
    return program, chosen


def write_coupon(
    machine: Machine,
    target: Path,
    settings: PrintSettings | None = None,
    *,
    cache_dir: Path | None = None,
    progress: ProgressCallback | None = None,
) -> ProofPrint:
    """Write the coupon for a machine.

    A box and a circle of single walls in either half, with sharp corners in X and Y and a fine
    zigzag in the back wall. Speed and acceleration make the machine ring visibly
    (`applications.proof.drive`). Some seven minutes and 5 g.

    Parameters
    ----------
    target : Path
        Written whole or not at all.
    cache_dir, progress
        As of `pipeline.compensate.compensate_file`.

    Raises
    ------
    ModelError
        The travel is too small, or the plants do not ring.
    DesignError, GcodeError
        As of `pipeline.compensate.compensate_file`.
    """
    program, chosen = coupon_program(machine, settings or PrintSettings())

    def legend(ringing: dict[str, Ringing], result: Result) -> list[str]:
        return _legend(machine, chosen, ringing, result)

    return write_proof(program, machine, target, legend, cache_dir=cache_dir, progress=progress)


def _legend(
    machine: Machine, chosen: Drive, ringing: dict[str, Ringing], result: Result
) -> list[str]:
    modes = [ringing_mode(machine.axes[a].nominal) for a in ("x", "y")]
    waves = ", ".join(
        f"{axis} {mode.f_hz:.1f} Hz: a ripple every {chosen.speed_mm_s / mode.f_hz:.1f} mm"
        for axis, mode in zip("XY", modes, strict=True)
    )
    return [
        f"Coupon for {machine.title} (model {machine.revision})",
        "Left half (OFF) as planned, right half (ON) compensated.",
        f"Walls at {chosen.speed_mm_s:g} mm/s and {chosen.accel_mm_s2:g} mm/s2. {waves}",
        "X rings on the outer side walls, Y on the front walls; compare from the corner on.",
        "Predicted distance of the nozzle from the walls:",
        *(
            f"  {half}: {found.rms_um:.1f} µm rms, {found.largest_um:.0f} µm at most"
            for half, found in ((half, ringing[half]) for half in (AS_PLANNED, COMPENSATED))
        ),
        f"Print time {result.time_s / 60:.1f} min without heating and homing.",
    ]


def _outline() -> list[Point]:
    """Return the outline from the back wall: inner wall, front, outer wall, back with teeth.

    It ends on a straight line, where residual motion at the stop is not visible.
    """
    side = _SIDE_MM
    first = 0.5 * (side - _TEETH * _TOOTH_MM)
    teeth: list[Point] = [(first + _TEETH * _TOOTH_MM, side)]
    for k in reversed(range(_TEETH)):
        x = first + k * _TOOTH_MM
        teeth += [(x + 0.5 * _TOOTH_MM, side - _TOOTH_DEPTH_MM), (x, side)]
    seam = (0.5 * first, side)
    return [seam, (0.0, side), (0.0, 0.0), (side, 0.0), (side, side), *teeth, seam]


def _circle() -> list[Point]:
    middle = 0.45 * _SIDE_MM
    angles = (2 * math.pi * k / _CHORDS for k in range(_CHORDS + 1))
    return [(middle + _CIRCLE_MM * math.cos(a), middle + _CIRCLE_MM * math.sin(a)) for a in angles]
