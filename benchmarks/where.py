"""Compensated where it shows: what `--where` saves, and what it costs on what is seen.

Errors are predictions of the machine's nominal plant, of the written file. Print time is against
the file as sliced.
"""

from __future__ import annotations

import argparse
import math
import os
import tempfile
from itertools import product
from pathlib import Path

from inputs import find_input, plain_copy, shared_folder

from stillpath.models.machine import Machine
from stillpath.models.store import load_machine
from stillpath.pipeline.compensate import compensate_file
from stillpath.pipeline.options import Options, Where
from stillpath.pipeline.result import Result
from stillpath.pipeline.selection import Selection

FILES = (
    "cura_ender3_gear24",
    "klipper_excludeobj_multi",
    "ps_ender3_gear24_absE",
    "ps_mk3s_xyzcube",
    "ps_voron_klipper_ringing",
    "real_bambustudio1.10_k1max",
    "real_cura4.10_objs",
    "real_kisslicer2.0.6",
)
MACHINES = ("ender3", "voron-v0", "voron-v24-250")
CHOICES: tuple[Where, ...] = ("all", "visible", "walls")


def row(name: str, options: Options, machine: Machine, result: Result) -> str:
    """Return a line of the table: the errors are those of what `visible` compensates."""
    rms_um = Selection("visible", machine).rms_um(result.features)
    before, after = rms_um.get("before", math.nan), rms_um.get("after", math.nan)
    hours = result.time_s / 3600.0
    cpu_s = sum(stage.cpu_s for stage in result.stages)
    return (
        f"{name[:25]:26}{machine.name[:13]:14}{options.where:8}"
        f"{options.tolerance_um:5g}"
        f"{result.written_bytes / result.original_bytes:8.2f}"
        f"{1e-6 * result.written_bytes / hours:8.1f}"
        f"{100.0 * (result.time_s / result.original_time_s - 1.0):+8.3f}"
        f"{before:8.2f}{after:8.2f}{len(result.put_back):9d}{result.time_s / cpu_s:9.0f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description="What --where saves and costs.")
    parser.add_argument("files", nargs="*", default=list(FILES), help="paths, or corpus names")
    parser.add_argument("--machines", nargs="+", default=list(MACHINES), help="names or .json")
    parser.add_argument("--shared", type=Path, help="default: $STILLPATH_SHARED or ../shared")
    parser.add_argument("--where", nargs="+", choices=CHOICES, default=list(CHOICES))
    parser.add_argument("--tolerance-um", nargs="+", type=float, default=[Options().tolerance_um])
    given = parser.parse_args()
    print(
        "um: tolerance; size: times the original; time: % beside the original; visible features: "
        "contour error as sliced and written, rms um; print seconds per CPU second"
    )
    print(
        f"{'file':26}{'machine':14}{'where':8}{'um':>5}{'size':>8}{'MB/h':>8}{'time':>8}"
        f"{'sliced':>8}{'written':>8}{'put back':>9}{'s/CPU s':>9}"
    )
    shared = shared_folder(given.shared)
    with tempfile.TemporaryDirectory(prefix="stillpath-where-") as folder:
        target = Path(folder) / "out.gcode"
        for name in given.files:
            source = plain_copy(find_input(name, shared), Path(folder))
            for machine in map(load_machine, given.machines):
                for where, tolerance_um in product(given.where, given.tolerance_um):
                    options = Options(where=where, tolerance_um=tolerance_um)
                    result = compensate_file(source, target, machine, options)
                    print(row(source.stem, options, machine, result), flush=True)


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    main()
