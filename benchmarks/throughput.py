"""How fast the pipeline is and how much memory it takes, compilation apart.

Fresh processes: one on a short file, which fills numba's cache, Python's bytecode and the cached
shaper; some on the file, of which the fastest counts; one on the file made ten times as long (its
layers repeated). `--mb 180` makes it as long as it takes for that many megabytes, of a file with
short moves (cura_ender3_gear24) some 42 h of print, and a tenth of that, to see whether time grows
with the length and no faster. All
times are CPU seconds of the whole job, reading, design, read-back, measurement and the HTML report
included.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from inputs import find_input, plain_copy, shared_folder

from stillpath.models.store import load_machine
from stillpath.pipeline.compensate import compensate_file
from stillpath.pipeline.files import default_cache_dir
from stillpath.pipeline.options import Options
from stillpath.reports import write_report
from stillpath.service.environment import prepare_environment

_ROOT = Path(__file__).resolve().parent.parent
_FILE, _SPARE = "ps_voron_klipper_ringing", _ROOT / "examples" / "cura_ender3_gear24.gcode"
_SHORT = _ROOT / "examples" / "ps_ender3_pauses_hept24f.gcode"
_LAYER = re.compile(rb"^;\s*(LAYER_CHANGE|LAYER:|layer num|CHANGE_LAYER)", re.I | re.M)
_FILAMENT = re.compile(rb"^(?:G92|G0|G1)\b[^;\n]*\bE([-+.\d]+)", re.M)


def child(source: Path, machine_name: str, options: Options, cache: Path) -> None:
    """Run one job and print its figures as JSON."""
    prepare_environment()
    started_s = time.process_time()
    machine = load_machine(machine_name)
    with tempfile.TemporaryDirectory(prefix="stillpath-throughput-") as folder:
        target = Path(folder) / "out.gcode"
        result = compensate_file(source, target, machine, options, cache_dir=cache)
        reported_s = time.process_time()
        write_report(result, Path(folder))
        ended_s = time.process_time()
        report_mb = sum(file.stat().st_size for file in Path(folder).glob("report*")) / 1e6
    figures = {
        "print_s": result.original_time_s,
        "cpu_s": ended_s - started_s,
        "start_s": started_s,
        "rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
        "stages": {s.stage: s.cpu_s for s in result.stages} | {"report": ended_s - reported_s},
        "put_back": len(result.put_back),
        "megabytes": result.written_bytes / 1e6,
        "report_mb": report_mb,
    }
    print(json.dumps(figures))


def longer(source: Path, target: Path, times: int) -> None:
    """Write the file with the part from its first to its last layer change repeated."""
    text = source.read_bytes()
    marks = [match.start() for match in _LAYER.finditer(text)]
    if len(marks) < 2:
        sys.exit(f"{source}: no layer marks, so it cannot be made longer")
    head, body, end = text[: marks[0]], text[marks[0] : marks[-1]], text[marks[-1] :]
    filament = _FILAMENT.findall(head)
    back = b"G92 E" + (filament[-1] if filament else b"0") + b"\n"
    with target.open("wb") as out:
        out.write(head)
        for _ in range(times):
            out.write(body)
            out.write(back)
        out.write(b"G92 E" + (_FILAMENT.findall(body) or [b"0"])[-1] + b"\n")
        out.write(end)


def fastest(source: Path, given: argparse.Namespace, runs: int) -> dict[str, object]:
    """Run a job some times; return the figures of the fastest."""
    found = [run(source, given) for _ in range(runs)]
    return min(found, key=lambda figures: float(str(figures["cpu_s"])))


def run(source: Path, given: argparse.Namespace) -> dict[str, object]:
    """Run a job in a process of its own, on one core."""
    command = [
        *(sys.executable, str(Path(__file__).resolve()), "--child", str(source)),
        *("--machine", given.machine, "--tolerance-um", str(given.tolerance_um)),
        *("--robust", given.robust, "--cache", str(given.cache)),
    ]
    environment = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"} | dict(os.environ)
    # An installed product has its bytecode.
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    environment.setdefault("PYTHONPYCACHEPREFIX", str(given.cache / "bytecode"))
    done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, check=False)
    if done.returncode:
        sys.exit(f"the job on {source} failed")
    figures: dict[str, object] = json.loads(done.stdout)
    return figures


def show(title: str, figures: dict[str, object]) -> float:
    """Print the figures of one job; return print seconds per CPU second."""
    print_s, cpu_s = float(str(figures["print_s"])), float(str(figures["cpu_s"]))
    print(f"\n{title}: {print_s:.0f} s of print, {float(str(figures['megabytes'])):.1f} MB written")
    print(f"  {cpu_s:.2f} CPU s (start of the process, {figures['start_s']:.2f} s, apart):")
    print(
        f"  {print_s / cpu_s:.0f} print seconds per CPU second; pieces put back: "
        f"{figures['put_back']}; peak RSS {figures['rss_mb']:.0f} MB; report "
        f"{figures['report_mb']:.1f} MB"
    )
    stages = figures["stages"]
    assert isinstance(stages, dict)
    known = sum(stages.values())
    for name, seconds in {**stages, "other": cpu_s - known}.items():
        print(f"    {name:14}{seconds:8.2f} s {100 * seconds / cpu_s:5.1f} %")
    return print_s / cpu_s


def _cost(short: dict[str, object], long: dict[str, object]) -> float:
    """CPU seconds for each further second of print."""
    cpu_s, print_s = (float(str(long[k])) - float(str(short[k])) for k in ("cpu_s", "print_s"))
    return cpu_s / print_s


def main() -> None:
    # Caches of one core are not another's.
    with contextlib.suppress(AttributeError, OSError):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    parser = argparse.ArgumentParser(description="Speed and memory of the pipeline.")
    parser.add_argument("file", nargs="?", help=f"path, or corpus name (default {_FILE})")
    parser.add_argument("--machine", default="ender3")
    parser.add_argument("--tolerance-um", type=float, default=2.0)
    parser.add_argument("--robust", default="auto", help="auto, off, ensemble or minimax")
    parser.add_argument("--times", type=int, default=10, help="length of the long file; 1: none")
    parser.add_argument("--mb", type=float, help="length of the long file in MB, instead of times")
    parser.add_argument("--runs", type=int, default=1, help="of the file itself")
    parser.add_argument("--shared", type=Path, help="default: $STILLPATH_SHARED or ../shared")
    parser.add_argument("--cache", type=Path, default=default_cache_dir() / "benchmarks")
    parser.add_argument("--child", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.child:
        options = Options(tolerance_um=given.tolerance_um, robust=given.robust)
        child(given.child, given.machine, options, given.cache)
        return
    shared = shared_folder(given.shared)
    name = given.file or (_FILE if shared else str(_SPARE))
    with tempfile.TemporaryDirectory(prefix="stillpath-throughput-") as folder:
        source = plain_copy(find_input(name, shared), Path(folder))
        run(_SHORT, given)
        once = fastest(source, given, given.runs)
        rate = show(f"{source.stem} on {given.machine}, {given.tolerance_um:g} um", once)
        rss = float(str(once["rss_mb"]))
        checks = {f"{rate:.0f} >= 2000 per CPU s": rate >= 2000, "RSS <= 400 MB": rss <= 400}
        long = Path(folder) / "long.gcode"
        times = given.times
        if given.mb:
            longer(source, long, 10)
            tenth = round(1e6 * given.mb / long.stat().st_size)
            longer(source, long, 10 * tenth)
            times = round(10 * tenth * 1e6 * given.mb / long.stat().st_size)
            longer(source, long, times // 10)
            part = run(long, given)
            show(f"{times // 10} times its layers", part)
        if times > 1:
            longer(source, long, times)
            many = run(long, given)
            content = long.read_bytes()
            lines = content.count(b"\n") / 1e6
            show(
                f"{times} times its layers, {len(content) / 1e6:.0f} MB, {lines:.1f} M lines", many
            )
            peak = float(str(many["rss_mb"]))
            checks[f"{peak - rss:+.1f} MB for {times} times the length <= 40 MB"] = peak - rss <= 40
            checks[f"{peak:.0f} MB <= 500 MB"] = peak <= 500
        if given.mb:
            # What a job costs before its first line is taken off.
            growth = _cost(part, many) / _cost(once, part)
            checks[f"CPU s per print s, {growth:.2f} times that of a tenth, <= 1.1"] = growth <= 1.1
    print()
    for text, good in checks.items():
        print(f"{'PASS' if good else 'MISS'}  {text}")


if __name__ == "__main__":
    main()
