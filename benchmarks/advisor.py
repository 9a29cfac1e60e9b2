"""Advice on whole files: what it predicts, and that it can be taken out again.

For every file: removing the lines with the mark gives the input; no feature exceeds its bound
where an acceleration would help; and without a budget (the first run of each file) the print takes
no longer than the original at no larger an error. `MISS` stands where it is not so.

    python benchmarks/advisor.py [NAME ...] [--machines ender3 voron-v24-250] [--budgets 0 25]
        [--lines N] [--log FILE]
        [--firmware examples/firmware/marlin.json [--facts '{"inch_mode": true}']]

Names are parts of names of the corpus, or paths; without any the whole corpus and the examples are
taken, small files first. A budget of 0 stands for none. With a log what is in it is not run again.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from stillpath.gcode.errors import GcodeError
from stillpath.models.machine import Machine
from stillpath.models.store import load_machine
from stillpath.pipeline.advising.inserting import MARK
from stillpath.pipeline.compensate import compensate_file
from stillpath.pipeline.files import default_cache_dir
from stillpath.pipeline.measuring.reference_shaper import cached_shaper
from stillpath.pipeline.options import Options
from stillpath.pipeline.result import Result
from tests.e2e.round_trip import corpus_files, corpus_folder, excerpt, made_to_fit, text_of

ROOT = Path(__file__).resolve().parent.parent
_EXAMPLES = ("cura_ender3_gear24.gcode", "ps_ender3_pauses_hept24f.gcode")
_COLUMNS = (
    *("file", "machine", "budget, um", "lines", "before, s", "after, s"),
    *("before, um", "after, um", "walls, um", "CPU, s", "outcome"),
)
_HEAD = f"\n| {' | '.join(_COLUMNS)} |\n{'|---' * len(_COLUMNS)}|"
_LONGER = 1.0005
"""Rests of a shaper that changes are no misses."""
_SHORT_S = 1.0
"""What may stand in a last line without an end, after which nothing could be set back."""


def main() -> int:
    arguments = _arguments()
    log: Path | None = arguments.log
    known = log.read_text().splitlines() if log and log.exists() else []
    rows = []
    print(_HEAD)
    with tempfile.TemporaryDirectory() as name:
        for path in _files(arguments.names):
            data = text_of(path)
            if arguments.lines:
                data = excerpt(data, arguments.lines, arguments.lines // 5)
            for machine in arguments.machines:
                made = _machine(machine, arguments)
                for budget_um in arguments.budgets:
                    key = _key(path.name, made, budget_um)
                    row = next((x for x in known if x.startswith(key)), "")
                    row = row or key + _advised(data, made, budget_um, Path(name))
                    print(row, flush=True)
                    rows.append(row)
                    if log and row not in known:
                        with log.open("a") as file:
                            file.write(row + "\n")
    return 1 if any("MISS" in row for row in rows) else 0


def _key(name: str, machine: Machine, budget_um: float) -> str:
    return f"| {name.removesuffix('.gz')} | {machine.name} | {budget_um or 'none'} | "


def _advised(data: bytes, machine: Machine, budget_um: float, folder: Path) -> str:
    source, target = folder / "in.gcode", folder / "out.gcode"
    source.write_bytes(data)
    target.unlink(missing_ok=True)
    fitted = _known(made_to_fit(machine, data), folder)
    options = Options(method="advise", budget_um=budget_um or None)
    began = time.process_time()
    try:
        result = compensate_file(source, target, fitted, options, cache_dir=folder)
    except GcodeError as error:
        return f" | | | | | | | refused: {str(error)[:90]} |"
    cpu_s = time.process_time() - began
    restored = b"".join(x for x in target.read_bytes().splitlines(keepends=True) if MARK not in x)
    outcome = _outcome(result, budget_um, ends=data.endswith(b"\n"))
    if restored != data:
        outcome = f"MISS removal does not give the input; {outcome}"
    assert result.advice is not None
    before, after, _ = (channel.extruding.contour_rms_um for channel in result.channels)
    walls = [f.after_um for f in result.advice.features if f.bound_um is not None and f.exact]
    return (
        f"{result.advice.lines} | {result.original_time_s:.1f} | {result.time_s:.1f} | "
        f"{before:.2f} | {after:.2f} | {_figure(max(walls, default=None))} | {cpu_s:.1f} | "
        f"{outcome} |"
    )


def _outcome(result: Result, budget_um: float, *, ends: bool) -> str:
    assert result.advice is not None
    wrong: list[str] = []
    beyond: list[str] = []
    for f in result.advice.features:
        if f.within_bound:
            continue
        figure = f"{f.name} {f.after_um:.1f} of {f.bound_um:.1f} um"
        if f.exact and any("would do" in x for x in _about(f.name, result)):
            beyond.append(f"out of reach: {figure}")
        elif not f.exact and f.accel_mm_s2 is None:
            beyond.append(f"no slower than sliced: {figure}")
        elif not ends and f.after_s < _SHORT_S:
            beyond.append(f"in a last line without an end: {figure}")
        else:
            wrong.append(figure)
    if not budget_um:
        before, after, _ = (channel.extruding.contour_rms_um for channel in result.channels)
        if result.time_s > result.original_time_s * _LONGER:
            wrong.append(f"{result.time_s - result.original_time_s:.1f} s longer")
        if after > before * 1.001:
            wrong.append("a larger error")
    return "; ".join([f"MISS {x}" for x in wrong] + beyond) or "kept"


def _figure(um: float | None) -> str:
    return "-" if um is None else f"{um:.2f}"


def _about(name: str, result: Result) -> list[str]:
    return [x for x in result.warnings if x.startswith(f"{name}: ")]


def _files(names: list[str]) -> list[Path]:
    every = [corpus_folder() / name for name in corpus_files()]
    known = {path.name.removesuffix(".gz") for path in every}
    every += [ROOT / "examples" / name for name in _EXAMPLES if name not in known]
    every.sort(key=lambda path: (path.stat().st_size, path.name))
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
    """Spare a machine whose plants are those of another the tuning of its reference shaper."""
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
    parser.add_argument("--log", type=Path, help="rows are added; those in it are not run again")
    parser.add_argument("--lines", type=int, help="only so many lines of each file's start")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
