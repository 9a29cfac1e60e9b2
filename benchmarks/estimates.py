"""Planned times against the slicers' own estimates, over the corpus.

By the slicer's rules: `gcode.slicers.estimator`, under the limits that stand in the file; must be
within 1 % + 1 s. Copies that ArcWelder made keep the original's estimate; their arcs are taken as
the straight moves that they were. As Marlin plans: our planner of Marlin with classic jerk under
the same limits, told and not judged: the firmware is not the estimator.
"""

from __future__ import annotations

import argparse
import gzip
import io
import sys
from dataclasses import replace
from pathlib import Path

from inputs import shared_folder

from stillpath.gcode.containers.opening import open_text
from stillpath.gcode.errors import GcodeError
from stillpath.gcode.firmware.registry import adapter
from stillpath.gcode.interpreter import Interpreter
from stillpath.gcode.slicers.estimator import estimated_s, rules_of
from stillpath.gcode.slicers.facts import SlicerFacts, read_facts
from stillpath.models.firmware.marlin import Marlin, MarlinPlanner, PerAxis, PerAxisLimit
from stillpath.models.machine import AxisTravel, Machine
from stillpath.models.store import load_machine

GOLDEN = Path(__file__).parents[1] / "examples" / "machines" / "klipper-golden.json"
_REASONS = {
    "Cura": "Cura's limits are settings of the printer and not in the file",
    "KISSlicer": "KISSlicer's limits are not in the file",
    "Snapmaker Luban": "an excerpt",
    "Slic3r": "Slic3r 1.3 estimates nothing",
    "": "no slicer's file, or it says nothing",
}


def marlin(facts: SlicerFacts) -> Machine:
    """Return a Marlin machine with the limits that stand in a file."""

    def axes(*keys: str) -> dict[str, float]:
        return {
            a: next(v for k in keys if (v := facts.number(f"{k}_{a}")) is not None) for a in "xyze"
        }

    accel = facts.number("machine_max_acceleration_extruding") or 1500.0
    travel = facts.number("machine_max_acceleration_travel") or accel
    planner = MarlinPlanner(
        max_feedrate_mm_s=PerAxis(**axes("machine_max_feedrate", "machine_max_speed")),
        max_accel_mm_s2=PerAxis(**axes("machine_max_acceleration")),
        accel_mm_s2=accel,
        retract_accel_mm_s2=facts.number("machine_max_acceleration_retracting") or accel,
        travel_accel_mm_s2=travel if facts.flavor == "marlin2" else accel,
        jerk_mm_s=PerAxisLimit(**axes("machine_max_jerk")),
        min_segment_time_us=0.0,
    )
    firmware = Marlin(planner=planner, junction="classic_jerk", slowdown=False)
    wide = {axis: AxisTravel(min_mm=-5000, max_mm=5000) for axis in ("x", "y", "z")}
    machine = load_machine(GOLDEN)
    return machine.model_copy(update={"firmware": firmware, "travel": wide})


def planned_s(text: bytes, machine: Machine) -> float:
    reader, planner = Interpreter(machine, strict_bounds=False), adapter(machine).planner()
    for block in reader.blocks(io.BytesIO(text)):
        planner.push(block)
    planner.flush()
    return float(planner.time_s)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("files", nargs="*", type=Path, help="default: the corpus")
    parser.add_argument("--shared", type=Path, help="default: $STILLPATH_SHARED or ../shared")
    given = parser.parse_args()
    shared = shared_folder(given.shared)
    if not given.files and shared is None:
        sys.exit("no shared data: name files, set STILLPATH_SHARED or give --shared")
    files = given.files or sorted((shared / "corpus").glob("*/*.*gcode*"))
    print(f"{'file':36}{'slicer':20}{'says, s':>9}{'its rules':>18}{'as Marlin':>18}")
    good = True
    for path in files:
        good &= judged(path)
    sys.exit(0 if good else 1)


def judged(path: Path) -> bool:
    text, facts = opened(path)
    file = io.BytesIO(text)
    name = path.name.removesuffix(".gz").removesuffix(".gcode")[:34]
    says = facts.estimate_s
    slicer = f"{facts.slicer} {facts.version}"[:18]
    print(f"{name:36}{slicer:20}{says or float('nan'):9.0f}", end="", flush=True)
    rules = rules_of(facts)
    if says is None or rules is None:
        print(f"   {_REASONS.get(facts.slicer, 'it says no time')}")
        return True
    welded = b"ArcWelder" in text
    if welded:
        rules = replace(rules, arcs="pieces")
    estimate = estimated_s(file, facts, rules)
    if estimate is None:
        print("   the limits are not in the file")
        return True
    close = abs(estimate - says) <= 0.01 * says + 1.0
    verdict = ("PASS" if close else "MISS") + (", an ArcWelder copy" if welded else "")
    print(f"{shown(estimate, says)}{shown(marlin_s(text, facts), says)}  {verdict}")
    return close


def opened(path: Path) -> tuple[bytes, SlicerFacts]:
    if path.suffix == ".gz":
        text = gzip.decompress(path.read_bytes())
        return text, read_facts(io.BytesIO(text))
    with open_text(path) as container:
        return container.text.read(), container.facts()


def marlin_s(text: bytes, facts: SlicerFacts) -> float | None:
    try:
        return planned_s(text, marlin(facts))
    except GcodeError:
        return None


def shown(seconds: float | None, says: float) -> str:
    if seconds is None:
        return f"{'not its G-code':>18}"
    return f"{seconds:9.1f} {100 * (seconds / says - 1):+6.2f} %"


if __name__ == "__main__":
    main()
