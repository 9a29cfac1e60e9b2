"""The golden plans: what Klipper queued for the open corpus against our planner, column by column.

Largest difference of every column over the recorded moves (mm, mm/s, mm/s2, s), and of the time of
the whole file.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from inputs import shared_folder
from numpy.typing import NDArray
from readback import read_motion

from stillpath.gcode.types import Phases
from stillpath.models.machine import Machine
from stillpath.models.store import load_machine

GOLDEN = Path(__file__).parents[1] / "examples" / "machines" / "klipper-golden.json"
_COLUMNS = "t accel_t cruise_t decel_t start_x start_y start_z r_x r_y r_z start_v cruise_v accel"
_OTHER_LIMITS = {
    "max_accel_mm_s2": 10_000.0,
    "square_corner_velocity_mm_s": 8.0,
    "minimum_cruise_ratio": 0.0,
}
_FIRST_PRINT_TIME_S = 0.25
_LIMIT = 1e-6


def machine_for(name: str) -> Machine:
    """Return the machine of an archive; `__a10000_scv8_mcr0` says other limits."""
    machine = load_machine(GOLDEN)
    if "__" not in name:
        return machine
    planner = machine.firmware.planner.model_copy(update=_OTHER_LIMITS)
    firmware = machine.firmware.model_copy(update={"planner": planner})
    return machine.model_copy(update={"firmware": firmware})


def tables(plan: Phases) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lay a plan out as the archives do: moves of X Y Z, moves of the extruder."""
    t_s = plan.t_s + _FIRST_PRINT_TIME_S
    times = np.column_stack((t_s, plan.accel_s, plan.cruise_s, plan.decel_s))
    speeds = np.column_stack((plan.start_mm_s, plan.cruise_mm_s, plan.accel_mm_s2))
    xyz = np.column_stack((times, plan.start_mm[:, :3], plan.direction[:, :3], speeds))
    ratio = plan.direction[:, 3]
    advance = (ratio > 0.0) & np.any(plan.direction[:, :2] != 0.0, axis=1)
    zero, one = np.zeros_like(ratio), np.ones_like(ratio)
    signed = speeds * ratio[:, None]
    e = np.column_stack((times, plan.start_mm[:, 3], zero, zero, one, advance, zero, signed))
    return xyz[np.any(plan.direction[:, :3] != 0.0, axis=1)], e[ratio != 0.0]


def main() -> None:
    parser = argparse.ArgumentParser(description="Our planner against Klipper's recorded plans.")
    parser.add_argument("--shared", type=Path, help="default: $STILLPATH_SHARED or ../shared")
    shared = shared_folder(parser.parse_args().shared)
    if shared is None:
        sys.exit("no shared data: set STILLPATH_SHARED or give --shared")
    good = True
    for path in sorted((shared / "golden" / "klipper").glob("*.npz")):
        golden = np.load(path)
        source = shared / "corpus" / "own" / f"{path.stem.split('__')[0]}.gcode.gz"
        motion = read_motion(source, machine_for(path.stem))
        total = abs(float(motion.phases.end_s[-1]) - float(golden["total_time_s"]))
        worst, same = total, True
        print(f"{path.stem}: total time off by {total:.1e} s")
        for kind, table in zip(("xyz", "e"), tables(motion.phases), strict=True):
            recorded = golden[kind]
            same &= len(table) == int(golden[f"n_{kind}"])
            gap = np.max(np.abs(table[: len(recorded)] - recorded), axis=0)
            worst = max(worst, float(gap.max()))
            print(f"  {kind:4}{len(table):7} moves (Klipper {int(golden[f'n_{kind}'])}):", end="")
            names = _COLUMNS.split()
            print("".join(f" {n} {g:.0e}" for n, g in zip(names, gap, strict=True) if g > 1e-12))
        good &= same and worst <= _LIMIT
        print(f"  {'PASS' if same and worst <= _LIMIT else 'MISS'}, worst {worst:.1e}")
    sys.exit(0 if good else 1)


if __name__ == "__main__":
    main()
