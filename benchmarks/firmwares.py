"""Marlin and RepRapFirmware: is the written file executed as commanded, and what is it worth?

The four printers with another firmware, at several steps per mm. First table: written pieces read
back against their command at 10 kHz (`emission.py`); 99 % of the samples while extruding must lie
within the tolerance and one step. Second table: the whole written file judged on the continuous
plants (`quality.py`), both it and the best-tuned shaper under the firmware's own planner and steps;
the contour error averaged over the members must stay below the shaper's.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from pathlib import Path

from emission import watched
from inputs import find_input, plain_copy, shared_folder
from quality import FILES, MACHINES, Row, Task, judged

from stillpath.models.firmware import Marlin, RepRapFirmware
from stillpath.models.firmware.marlin import MarlinPlanner, PerAxis, PerAxisLimit
from stillpath.models.firmware.reprapfirmware import Drive, RepRapExtruder
from stillpath.models.machine import Machine
from stillpath.models.store import load_machine
from stillpath.pipeline.files import default_cache_dir
from stillpath.pipeline.options import Options

_LEAST_WITHIN = 0.99


def machine_with(
    name: str,
    firmware: str,
    steps_per_mm: float,
    advance_k_s: float = 0.0,
    min_steps: int = 1,
) -> Machine:
    """Return a printer with another firmware, under the limits of golden/klipper/README.md."""
    machine = load_machine(name)
    speed, accel, z_speed, z_accel = 500.0, 5000.0, 20.0, 200.0
    common = {
        "home_mm": (0.0, 0.0, 0.0),
        "harmless_macros": ("_ON_LAYER_CHANGE",),
        "retraction": machine.firmware.retraction,
    }
    if firmware == "marlin":
        other: Marlin | RepRapFirmware = Marlin(
            steps_per_mm=PerAxis(x=steps_per_mm, y=steps_per_mm, z=400.0, e=400.0),
            planner=MarlinPlanner(
                max_feedrate_mm_s=PerAxis(x=speed, y=speed, z=z_speed, e=100.0),
                max_accel_mm_s2=PerAxis(x=accel, y=accel, z=z_accel, e=accel),
                accel_mm_s2=accel,
                retract_accel_mm_s2=accel,
                travel_accel_mm_s2=accel,
                jerk_mm_s=PerAxisLimit(x=8.0, y=8.0, z=0.4, e=5.0),
                junction_deviation_mm=0.013,
            ),
            min_steps_per_segment=min_steps,
            linear_advance=True if advance_k_s > 0.0 else None,
            linear_advance_k_s=advance_k_s,
            **common,
        )
    else:
        axis = Drive(
            steps_per_mm=steps_per_mm, max_speed_mm_s=speed, max_accel_mm_s2=accel, jerk_mm_s=8.0
        )
        other = RepRapFirmware(
            x=axis,
            y=axis,
            z=Drive(
                steps_per_mm=800.0, max_speed_mm_s=z_speed, max_accel_mm_s2=z_accel, jerk_mm_s=1.0
            ),
            extruder=RepRapExtruder(max_speed_mm_s=100.0, max_accel_mm_s2=accel, jerk_mm_s=5.0),
            **common,
        )
    advance = f"-k{1e3 * advance_k_s:.0f}" if advance_k_s else ""
    least = f"-least{min_steps}" if min_steps > 1 else ""
    changes = {"name": f"{name}-{firmware}-{steps_per_mm:.0f}{advance}{least}", "firmware": other}
    return Machine.model_validate({**machine.model_dump(), **_dumped(changes)})


def _dumped(changes: dict[str, object]) -> dict[str, object]:
    return {
        key: value.model_dump() if isinstance(value, Marlin | RepRapFirmware) else value
        for key, value in changes.items()
    }


def without_macros(source: Path, folder: Path) -> Path:
    """Return a copy without Klipper's object macros, whose lines other firmwares do not take."""
    target = folder / f"{source.stem}.gcode"
    lines = source.read_bytes().splitlines(keepends=True)
    target.write_bytes(b"".join(x for x in lines if not x.startswith(b"EXCLUDE_OBJECT")))
    return target


def read_back(
    source: Path, machine: Machine, steps: float, tolerance_um: float, cache: Path
) -> str:
    """Return a row of the first table."""
    with tempfile.TemporaryDirectory(prefix="stillpath-firmwares-") as folder:
        job, result = watched(source, Path(folder) / "out.gcode", machine, tolerance_um, cache)
    apart = job.xy_extruding
    limit = tolerance_um + 1e3 / steps
    within = apart.within(limit)
    hours = result.compensated_s / 3600.0
    put_back = result.put_back_extruding_share
    good = within >= _LEAST_WITHIN and put_back <= 0.01
    return (
        f"{source.stem[:25]:26}{machine.name[:28]:29}{tolerance_um:4g} {limit:6.2f} "
        f"{100 * within:7.3f}% {result.emission_rms_um:6.2f} {apart.quantile(0.99):6.2f} "
        f"{apart.max:7.2f} {job.along.quantile(0.99):6.2f} {job.across.quantile(0.99):6.2f} "
        f"{job.filament.max:6.1f} {1e3 * job.late_s / hours:+8.3f} {job.end_mm:8.1e} "
        f"{result.segments_per_s:5.0f} {len(result.put_back):3d}/{100 * put_back:.2f}%  "
        f"{'PASS' if good else 'MISS'} (max at line {apart.line})"
    )


def quality_row(row: Row) -> str:
    """Return a row of the second table."""
    good = row.members_ratio < 1.0 and row.put_back_percent <= 1.0
    return (
        f"{row.file[:25]:26}{row.machine[:28]:29}{row.tolerance_um:4g} "
        f"{row.none_rms:6.1f} {row.shaper_rms:6.2f} {row.ours_rms:6.2f} {row.ratio:6.3f} "
        f"{row.members_rms:6.2f} {row.members_ratio:6.3f} {row.time_percent:+7.3f} "
        f"{row.put_back_percent:5.2f}%  {'PASS' if good else 'MISS'} ({row.shaper})"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description="Other firmwares, read back and judged.")
    parser.add_argument("files", nargs="*", default=list(FILES), help="paths, or corpus names")
    parser.add_argument("--firmware", choices=("marlin", "reprapfirmware"), required=True)
    parser.add_argument("--machines", nargs="+", default=list(MACHINES))
    parser.add_argument("--steps-per-mm", nargs="+", type=float, default=[80.0, 160.0])
    parser.add_argument("--advance-k-s", type=float, default=0.0, help="Marlin's M900 K")
    parser.add_argument(
        "--min-steps", nargs="+", type=int, default=[1], help="Marlin's MIN_STEPS_PER_SEGMENT"
    )
    parser.add_argument("--tolerance-um", nargs="+", type=float, default=[5.0])
    parser.add_argument("--tables", choices=("readback", "quality", "both"), default="both")
    parser.add_argument("--shared", type=Path, help="default: $STILLPATH_SHARED or ../shared")
    parser.add_argument("--cache", type=Path, default=default_cache_dir() / "benchmarks")
    given = parser.parse_args()
    shared = shared_folder(given.shared)
    missed = 0
    with tempfile.TemporaryDirectory(prefix="stillpath-firmwares-") as folder:
        plain, own = Path(folder) / "plain", Path(folder) / "own"
        plain.mkdir()
        own.mkdir()
        sources = [
            without_macros(plain_copy(find_input(name, shared), plain), own) for name in given.files
        ]
        cases = [
            (
                source,
                machine_with(name, given.firmware, steps, given.advance_k_s, least),
                steps,
                tolerance_um,
            )
            for source in sources
            for name in given.machines
            for steps in given.steps_per_mm
            for least in given.min_steps
            for tolerance_um in given.tolerance_um
        ]
        if given.tables != "quality":
            print("executed against commanded while extruding, um: share within tolerance + step,")
            print("rms, 99 %, max; 99 % along and across; E um; late ms per hour; end mm")
            # One printer shows what the firmware does with a stream.
            for case in cases:
                if case[1].name.startswith(f"{given.machines[0]}-"):
                    line = read_back(*case, given.cache)
                    missed += "MISS" in line
                    print(line, flush=True)
        if given.tables != "readback":
            print("\ncontour error, um rms: as sliced, best-tuned shaper, ours, ours / shaper;")
            print("members: ours, ours / shaper; time %; put back")
            for source, machine, _steps, tolerance_um in cases:
                document = Path(folder) / f"{machine.name}.json"
                document.write_text(json.dumps(machine.model_dump(mode="json")))
                task = Task(source, str(document), (tolerance_um,), Options(), given.cache)
                for row in judged(task):
                    line = quality_row(row)
                    missed += "MISS" in line
                    print(line, flush=True)
    print(f"{missed} missed")
    sys.exit(1 if missed else 0)


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    main()
