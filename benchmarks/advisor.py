"""Advice on whole files: what it predicts, and that it can be taken out again.

For every file: removing the lines with the mark gives the input; no feature exceeds its bound
where an acceleration would help; and without a budget (the first run of each file) the print takes
no longer than the original at no larger an error. `MISS` stands where it is not so.

    python benchmarks/advisor.py [NAME ...] [--machines ender3 voron-v24-250] [--budgets 0 25]
        [--lines N] [--firmware examples/firmware/marlin.json [--facts '{"inch_mode": true}']]

Names are parts of names of the corpus, or paths; without any the whole corpus and the examples are
taken. A budget of 0 stands for none.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path

from gcode.errors import GcodeError
from models.machine import Machine
from models.store import load_machine
from service.pipeline.advising.inserting import MARK
from service.pipeline.files import default_cache_dir
from service.pipeline.options import Options
from service.pipeline.result import Result
from service.pipeline.road import compensate_file
from service.pipeline.yardstick import cached_shaper
from tests.e2e.round_trip import corpus_files, corpus_folder, excerpt, made_to_fit, text_of

ROOT = Path(__file__).resolve().parent.parent
_EXAMPLES = ("cura_ender3_gear24.gcode", "ps_ender3_pauses_hept24f.gcode")
_LONGER = 1.0005
"""Rests of a shaper that changes are no misses."""


def main() -> int:
    arguments = _arguments()
    missed = 0
    head = f"{'file':40} {'machine':15} {'um':>4} {'lines':>6} {'print s':>8} {'advised':>8}"
    print(f"{head} {'before':>7} {'after':>7} {'walls':>6} {'CPU s':>6}  outcome")
    with tempfile.TemporaryDirectory() as name:
        for path in _files(arguments.names):
            data = text_of(path)
            if arguments.lines:
                data = excerpt(data, arguments.lines, arguments.lines // 5)
            for machine in arguments.machines:
                made = _machine(machine, arguments)
                for budget_um in arguments.budgets:
                    missed += _advised(path.name, data, made, budget_um, Path(name))
    return 1 if missed else 0


def _advised(name: str, data: bytes, machine: Machine, budget_um: float, folder: Path) -> bool:
    source, target = folder / "in.gcode", folder / "out.gcode"
    source.write_bytes(data)
    target.unlink(missing_ok=True)
    fitted = _known(made_to_fit(machine, data), folder)
    options = Options(method="advise", budget_um=budget_um or None)
    row, began = f"{name[:40]:40} {machine.name:15} {budget_um:4.0f}", time.process_time()
    try:
        result = compensate_file(source, target, fitted, options, cache_dir=folder)
    except GcodeError as error:
        print(f"{row}  refused: {str(error)[:90]}", flush=True)
        return False
    cpu_s = time.process_time() - began
    restored = b"".join(x for x in target.read_bytes().splitlines(keepends=True) if MARK not in x)
    wrong = [] if restored == data else ["removal does not give the input"]
    wrong += _worse(result, budget_um)
    assert result.advice is not None
    before, after, _ = (channel.extruding.contour_rms_um for channel in result.channels)
    walls = [f.after_um for f in result.advice.features if f.bound_um is not None]
    print(
        f"{row} {result.advice.lines:6} {result.original_time_s:8.1f} {result.time_s:8.1f} "
        f"{before:7.2f} {after:7.2f} {max(walls, default=0.0):6.2f} {cpu_s:6.1f}  "
        f"{'MISS ' + '; '.join(wrong) if wrong else 'kept'}",
        flush=True,
    )
    return bool(wrong)


def _worse(result: Result, budget_um: float) -> list[str]:
    assert result.advice is not None
    wrong = []
    for f in result.advice.features:
        if f.within_bound:
            continue
        # What is not seen is never made slower than the file has it.
        raised = f.accel_mm_s2 is not None and not f.exact
        beyond_reach = any("would do" in x and x.startswith(f.name) for x in result.warnings)
        if raised or (f.exact and not beyond_reach):
            wrong.append(f"{f.name}: {f.after_um:.1f} um of {f.bound_um:.1f}")
    if not budget_um:
        before, after, _ = (channel.extruding.contour_rms_um for channel in result.channels)
        if result.time_s > result.original_time_s * _LONGER:
            wrong.append(f"{result.time_s - result.original_time_s:.1f} s longer")
        if after > before * 1.001:
            wrong.append("a larger error")
    return wrong


def _files(names: list[str]) -> list[Path]:
    own = [ROOT / "examples" / name for name in _EXAMPLES]
    every = own + [corpus_folder() / name for name in corpus_files()]
    if not names:
        return every
    paths = [Path(name) for name in names if Path(name).is_file()]
    words = [name for name in names if not Path(name).is_file()]
    return paths + [p for p in every if any(word in p.name for word in words)]


def _machine(name: str, arguments: argparse.Namespace) -> Machine:
    """Return a machine with another firmware, or with a nozzle for files of other printers."""
    document = load_machine(name).model_dump(mode="json")
    if arguments.firmware:
        document["firmware"] = json.loads(arguments.firmware.read_text())
    else:
        document["firmware"]["extruder"]["max_extrude_cross_section_mm2"] = 10.0
    document["firmware"] |= json.loads(arguments.facts)
    return Machine.model_validate(document)


def _known(machine: Machine, folder: Path) -> Machine:
    """Spare a machine whose plants are those of another the tuning of its yardstick."""
    plain = load_machine(machine.name)
    cached_shaper(plain, default_cache_dir())
    for path in default_cache_dir().glob(f"shaper-{plain.revision}-*"):
        copied = folder / path.name.replace(plain.revision, machine.revision)
        copied.write_bytes(path.read_bytes())
    return machine


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="parts of names, or paths")
    parser.add_argument("--machines", nargs="+", default=["ender3", "voron-v24-250"])
    parser.add_argument("--budgets", nargs="+", type=float, default=[0.0, 25.0])
    parser.add_argument("--firmware", type=Path, help="JSON of another firmware's section")
    parser.add_argument("--facts", default="{}", help="JSON of what is different in it")
    parser.add_argument("--lines", type=int, help="only so many lines of each file's start")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
