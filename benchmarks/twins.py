"""Files for the built-in machines, printed by plants that explain the same measurement.

A resonance table tells no phase. `golden/twins.json` of the shared folder holds, for each of four
printers, two plants that somebody else made to fit the same measured magnitude; the machines that
are shipped have not seen them. Each file is compensated for the machine as shipped, the written
file is planned by the firmware's rules, and the twin answers that motion at 10 kHz. Beside it:
nothing, and the shaper tuned by brute force on the twin itself, which nobody has.

Goals: every ratio to that shaper <= 1.05 and their geometric mean <= .7; to nothing <= .5.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from statistics import geometric_mean

from builtin_machines import TABLES
from inputs import find_input, one_thread_each, plain_copy, shared_folder
from quality import FILES, Task, best_shaper
from readback import Aligned, Judge, Own, Shaped, forced_stops, read_motion

from stillpath.applications.identification.run import InputFile, identify_files
from stillpath.models.identification.readers import ReadSettings
from stillpath.models.machine import Machine
from stillpath.models.plants import PlantSetSpec, RelativeModesSpec
from stillpath.models.store import load_machine
from stillpath.pipeline.compensate import compensate_file
from stillpath.pipeline.files import default_cache_dir
from stillpath.pipeline.options import Options

MACHINES = {
    "ender3": "ender3",
    "voron_v0": "voron-v0",
    "voron_v24_250": "voron-v24-250",
    "annex_k3": "annex-k3",
}
_WORST, _MEAN, _NOTHING = 1.05, 0.7, 0.5


@dataclass(frozen=True, slots=True)
class Row:
    """Contour rms while extruding, in um."""

    file: str
    machine: str
    twin: str
    shaper: str
    none_um: float
    shaper_um: float
    ours_um: float
    ours_max_um: float

    @property
    def to_shaper(self) -> float:
        """Ours over the shaper's."""
        return self.ours_um / self.shaper_um

    @property
    def to_none(self) -> float:
        """Ours over none."""
        return self.ours_um / self.none_um


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("files", nargs="*", default=list(FILES), help="paths, or corpus names")
    parser.add_argument("--machines", nargs="+", default=list(MACHINES), choices=list(MACHINES))
    parser.add_argument("--robust", default="auto")
    parser.add_argument(
        "--identified",
        action="store_true",
        help="machines as identify makes them of the same tables, in place of those that are "
        "shipped (which have no friction)",
    )
    parser.add_argument("--tolerance-um", type=float, default=Options().tolerance_um)
    parser.add_argument("--shared", type=Path, help="default: $STILLPATH_SHARED or ../shared")
    parser.add_argument("--cache", type=Path, default=default_cache_dir() / "benchmarks")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    given = parser.parse_args()
    shared = shared_folder(given.shared)
    if shared is None:
        sys.exit("the folder of shared data is not there; see --shared")
    one_thread_each()
    options = Options(robust=given.robust, tolerance_um=given.tolerance_um)
    machines = {name: load_machine(MACHINES[name]) for name in given.machines}
    if given.identified:
        machines = {name: from_tables(machine, shared) for name, machine in machines.items()}
    head = f"{'file':26}{'machine':15}{'twin':5}{'none':>7}{'shaper':>8}{'ours':>7}{'max':>6}"
    print(f"{head}{'/shaper':>9}{'/none':>7}  tuned shaper of the twin", flush=True)
    rows: list[Row] = []
    with tempfile.TemporaryDirectory(prefix="stillpath-twins-") as folder:
        files = [plain_copy(find_input(name, shared), Path(folder)) for name in given.files]
        with ProcessPoolExecutor(given.jobs, mp_context=get_context("spawn")) as pool:
            waiting = [
                pool.submit(
                    judged, file, machine, twins_of(machine, name, shared), options, given.cache
                )
                for file in files
                for name, machine in machines.items()
            ]
            for done in waiting:
                rows += done.result()
                for row in rows[-2:]:
                    print(
                        f"{row.file[:25]:26}{row.machine:15}{row.twin:5}{row.none_um:7.2f}"
                        f"{row.shaper_um:8.2f}{row.ours_um:7.2f}{row.ours_max_um:6.0f}"
                        f"{row.to_shaper:9.2f}{row.to_none:7.2f}  {row.shaper}",
                        flush=True,
                    )
    worst = max(row.to_shaper for row in rows)
    mean = geometric_mean(row.to_shaper for row in rows)
    nothing = max(row.to_none for row in rows)
    missed = 0
    for what, value, limit in (
        ("worst ratio to the shaper", worst, _WORST),
        ("geometric mean of the ratios", mean, _MEAN),
        ("worst ratio to nothing", nothing, _NOTHING),
    ):
        missed += value > limit
        print(f"{'PASS' if value <= limit else 'MISS'} {what} {value:.3f} <= {limit:g}")
    return 1 if missed else 0


def twins_of(shipped: Machine, name: str, shared: Path) -> dict[str, Machine]:
    """Return the machine with the plants of its twins a and b."""
    twins = json.loads((shared / "golden" / "twins.json").read_text())[name]
    found = {}
    for twin in ("a", "b"):
        axes = {
            axis: PlantSetSpec(nominal=RelativeModesSpec.model_validate({"modes": one["modes"]}))
            for axis, one in twins[twin].items()
        }
        found[twin] = shipped.model_copy(update={"axes": axes, "name": f"{shipped.name}-{twin}"})
    return found


def from_tables(shipped: Machine, shared: Path) -> Machine:
    """Return the machine that `identify` makes of the tables that the shipped one was made of."""
    paths = [shared / "measurements" / table for table in TABLES[shipped.name]]
    files = [InputFile(path.name, path.read_bytes()) for path in paths]
    return identify_files(files, shipped, ReadSettings()).machine


def judged(
    file: Path, shipped: Machine, truths: Mapping[str, Machine], options: Options, cache: Path
) -> list[Row]:
    """Compensate a file for a machine and let its twins print it."""
    own = read_motion(file, shipped)
    with tempfile.TemporaryDirectory(prefix="stillpath-twins-") as folder:
        target = Path(folder) / "out.gcode"
        compensate_file(file, target, shipped, options, cache_dir=cache)
        written = read_motion(target, shipped)
    original = read_motion(file, shipped, forced_stops(own, written))
    rows = []
    for twin, truth in truths.items():
        best = best_shaper(Task(file, truth.name, (), options, cache), truth, own)
        none, shaped, ours = (Judge(truth, members=False) for _ in range(3))
        for section in Own.sections(own):
            none.add(section)
        for shaped_section in Shaped.through(own, best.pulses):
            shaped.add(shaped_section)
        for part in Aligned(original, written).sections(original, written):
            ours.add(part)
        rows.append(
            Row(
                file.stem,
                shipped.name,
                twin,
                best.label,
                1e3 * none.contour.rms,
                1e3 * shaped.contour.rms,
                1e3 * ours.contour.rms,
                1e3 * ours.contour.max,
            )
        )
    return rows


if __name__ == "__main__":
    sys.exit(main())
