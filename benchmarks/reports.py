"""Do reports hold what an execution of the written file by itself shows?

Each file is compensated; the report's print time and its largest contour errors are compared with
those of the bytes that were written: interpreted, planned by the firmware's rules, sampled at
10 kHz, answered by the continuous plants (`readback.py`). As in reports, the nozzle's ringing
after the end of a line counts for the line, while it stands there.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from inputs import find_input, plain_copy, shared_folder
from numpy.typing import NDArray
from readback import DT_S, Aligned, Judge, forced_stops, read_motion

from stillpath.models.machine import Machine
from stillpath.models.store import load_machine
from stillpath.pipeline.compensate import compensate_file
from stillpath.pipeline.files import default_cache_dir
from stillpath.pipeline.options import Options

FILES = (
    "cura_ender3_gear24",
    "klipper_excludeobj_multi",
    "ps_mk3s_xyzcube",
    "real_cura4.10_objs",
    "cura_prusa_mk3_reltiveE_tris24",
    "real_kisslicer2.0.6",
    "arcwelder_mk3s_xyzcube",
    "real_superslicer2.3_arcwelder",
)
MACHINES = ("ender3", "voron-v24-250")
_MAX_SHARE, _TIME_SHARE = 0.1, 5e-4
_BEHIND_S = 0.1


class Ringing(Aligned):
    """A written file whose lines last until the nozzle no longer rings on their ends."""

    def path(self, first: int, last: int) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        reach = round(_BEHIND_S / DT_S)
        before = min(first, reach + 1)
        path, extruding = super().path(first - before, last)
        here = np.arange(path.shape[1])
        moves = np.any(np.diff(path, axis=1, prepend=path[:, :1]) != 0.0, axis=0)
        printed = np.maximum.accumulate(np.where(extruding, here, -reach - 1))
        moved = np.maximum.accumulate(np.where(moves, here, -reach - 1))
        counts = extruding | ((here - printed <= reach) & (moved <= printed + 1))
        return path[:, before:], counts[before:]


@dataclass(frozen=True, slots=True)
class Row:
    """What one case showed: report and execution; how much longer it takes than the file came."""

    max_um: tuple[float, float]
    time_s: tuple[float, float]
    longer: float
    left_alone_s: float

    @property
    def missed(self) -> bool:
        """Tell whether they differ by too much."""
        return (
            abs(self.max_um[0] - self.max_um[1]) > _MAX_SHARE * self.max_um[1]
            or abs(self.time_s[0] - self.time_s[1]) > _TIME_SHARE * self.time_s[1]
        )


def compared(file: Path, machine: Machine, options: Options) -> Row:
    """Compensate a file and compare its report with the written bytes."""
    with tempfile.TemporaryDirectory(prefix="stillpath-reports-") as folder:
        target = Path(folder) / "out.gcode"
        result = compensate_file(file, target, machine, options, cache_dir=default_cache_dir())
        written = read_motion(target, machine)
    own = read_motion(file, machine)
    original = read_motion(file, machine, forced_stops(own, written))
    judge = Judge(machine, members=False)
    for section in Ringing(original, written).sections(original, written):
        judge.add(section)
    reported = next(channel for channel in result.channels if channel.name == "after")
    return Row(
        (reported.extruding.contour_max_um, 1e3 * judge.contour.max),
        (result.time_s, written.time_s),
        written.time_s / own.time_s - 1.0,
        result.left_alone_s,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description="Reports against an independent execution.")
    parser.add_argument("--files", nargs="+", default=list(FILES), help="paths, or corpus names")
    parser.add_argument("--machines", nargs="+", default=list(MACHINES))
    parser.add_argument("--shared", type=Path, help="default: $STILLPATH_SHARED or ../shared")
    given = parser.parse_args()
    shared = shared_folder(given.shared)
    print("largest contour error, um, and print time, s: report, execution, difference in %")
    missed = 0
    with tempfile.TemporaryDirectory(prefix="stillpath-reports-") as folder:
        for name in given.files:
            file = plain_copy(find_input(name, shared), Path(folder))
            for machine in given.machines:
                row = compared(file, load_machine(machine), Options())
                missed += row.missed
                (a, b), (s, t) = row.max_um, row.time_s
                print(
                    f"{file.stem[:32]:34}{machine:15}{a:7.1f} {b:7.1f} "
                    f"{100 * (a - b) / max(b, 1e-9):6.1f}  "
                    f"{s:9.2f} {t:9.2f} {100 * (s / t - 1):8.4f} "
                    f"{100 * row.longer:+6.2f} % than as sliced, "
                    f"left alone {row.left_alone_s:.1f} s"
                    f"{'  MISS' if row.missed else ''}",
                    flush=True,
                )
    print(f"{missed} missed (10 % and .05 % allowed): {'MISS' if missed else 'PASS'}")
    sys.exit(1 if missed else 0)


if __name__ == "__main__":
    main()
