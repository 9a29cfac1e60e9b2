"""A ringing tower: bands of rising acceleration, each half as planned and half compensated."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from stillpath.applications.proof.drive import Axis, Drive, bands, ringing_mode
from stillpath.applications.proof.halves import (
    AS_PLANNED,
    COMPENSATED,
    Halves,
    ProofPrint,
    Ringing,
    write_proof,
)
from stillpath.applications.proof.program import PrintSettings, Program
from stillpath.models.errors import ModelError
from stillpath.models.machine import Machine
from stillpath.pipeline.progress import ProgressCallback
from stillpath.pipeline.result import Result

__all__ = ["Tower", "TowerBand", "tower_program", "write_tower"]

Point = tuple[float, float]

_RUN_MM, _WALL_MM = 25.0, 30.0
_BAND_MM = 5.0
_RIB_MM = 0.25
"""Protrusion of the first layer of a band."""
_FEWEST, _MOST = 2, 12


@dataclass(frozen=True, slots=True)
class TowerBand:
    """A band of the tower, from the bed up."""

    bottom_mm: float
    top_mm: float
    accel_mm_s2: float
    speed_mm_s: float
    before: Ringing
    after: Ringing


@dataclass(frozen=True, slots=True)
class Tower:
    """The tower that was written, and its legend in numbers."""

    written: ProofPrint
    bands: list[TowerBand]


def tower_program(
    machine: Machine, axis: Axis, settings: PrintSettings, count: int
) -> tuple[Program, list[Drive]]:
    """Return the tower before its right half is compensated, and the drives of its bands.

    Raises
    ------
    ModelError
        As of `write_tower`.
    """
    if axis not in ("x", "y"):
        raise ModelError(f"axis {axis!r} is not x or y")
    if not _FEWEST <= count <= _MOST:
        raise ModelError(f"{count} bands: the tower has {_FEWEST} to {_MOST}")
    width, depth = (_RUN_MM, _WALL_MM) if axis == "x" else (_WALL_MM, _RUN_MM)
    halves = Halves(machine, settings, width, depth, "tower")
    program = halves.program
    drives = bands(machine, axis, settings.max_flow_mm3_s / program.section_mm2, _RUN_MM, count)
    base = halves.begin()
    layers = round(_BAND_MM / program.layer_mm)
    for k, chosen in enumerate(drives):
        program.limit_accel(chosen.accel_mm_s2)
        for number in range(k * layers + 1, (k + 1) * layers + 1):
            program.layer(base + number * program.layer_mm)
            if number <= 2:
                halves.words(chosen.accel_mm_s2)
            rib = _RIB_MM if k and number == k * layers + 1 else 0.0
            halves.both([_box(width, depth, rib)], chosen.speed_mm_s, _band(k))
    program.finish()
    return program, drives


def write_tower(
    machine: Machine,
    axis: Axis,
    target: Path,
    settings: PrintSettings | None = None,
    *,
    count: int = 6,
    cache_dir: Path | None = None,
    progress: ProgressCallback | None = None,
) -> Tower:
    """Write the tower for one axis.

    Parameters
    ----------
    axis : "x" or "y"
        Axis to show: ringing of X is on the outer side walls, of Y on the front walls.
    count : int
        Number of bands, 2 to 12.
    machine, target, settings, cache_dir, progress
        As of `applications.proof.coupon.write_coupon`.

    Raises
    ------
    ModelError
        The axis or number of bands is invalid, the travel is too small, or nothing rings.
    DesignError, GcodeError
        As of `pipeline.compensate.compensate_file`.
    """
    program, drives = tower_program(machine, axis, settings or PrintSettings(), count)
    found: list[TowerBand] = []

    def legend(ringing: dict[str, Ringing], result: Result) -> list[str]:
        height = round(_BAND_MM / program.layer_mm) * program.layer_mm
        bottom = 2 * program.layer_mm
        for k, chosen in enumerate(drives):
            before, after = (ringing[_band(k) + half] for half in (AS_PLANNED, COMPENSATED))
            low, high = bottom + k * height, bottom + (k + 1) * height
            found.append(TowerBand(low, high, chosen.accel_mm_s2, chosen.speed_mm_s, before, after))
        return _legend(machine, axis, found, result)

    written = write_proof(program, machine, target, legend, cache_dir=cache_dir, progress=progress)
    return Tower(written, found)


def _legend(machine: Machine, axis: Axis, found: list[TowerBand], result: Result) -> list[str]:
    mode = ringing_mode(machine.axes[axis].nominal)
    where = "the outer side walls" if axis == "x" else "the front walls"
    return [
        f"Ringing tower for {machine.title}, axis {axis.upper()} (model {machine.revision})",
        "Left half (OFF) as planned, right half (ON) compensated. A rib begins each band.",
        f"{axis.upper()} rings at {mode.f_hz:.1f} Hz; read it on {where}, from the corner on.",
        "band, height mm, mm/s2, mm/s, um rms (largest) as planned -> compensated:",
        *(
            f"  {k}: {b.bottom_mm:.1f}-{b.top_mm:.1f}, {b.accel_mm_s2:g}, {b.speed_mm_s:g}, "
            f"{b.before.rms_um:.1f} ({b.before.largest_um:.0f}) -> "
            f"{b.after.rms_um:.1f} ({b.after.largest_um:.0f})"
            for k, b in enumerate(found, 1)
        ),
        f"Print time {result.time_s / 60:.1f} min without heating and homing.",
    ]


def _band(k: int) -> str:
    return f"band {k + 1} "


def _box(width: float, depth: float, out: float) -> list[Point]:
    """Return a closed outline that begins in the middle of the back wall."""
    corners = [(-out, depth + out), (-out, -out), (width + out, -out), (width + out, depth + out)]
    return [(0.5 * width, depth + out), *corners, (0.5 * width, depth + out)]
