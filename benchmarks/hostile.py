"""Files made to be slow or large, at a size and at twice that size: CPU time and memory.

Each file goes through the whole pipeline in a process of its own that may not take more memory than
``--limit-mb`` or more processor time than ``--limit-s``; one that only waits is killed after
``--wall-s``. What is told is the CPU time of the second size over the first (2 is linear) and the
peak of resident memory. MISS marks what is more than linear, too large, or ends in anything but a
result or a `GcodeError`.

    python benchmarks/hostile.py [NAME ...] [--scale .1] [--methods none,fbf] [--machine ender3]
        [--firmware marlin]

The full sizes of `tests.fuzz.hostile` are the second ones of ``--scale .5``.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import multiprocessing
import resource
import sys
import tempfile
import time
from multiprocessing.connection import Connection
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from stillpath.gcode.errors import GcodeError
from stillpath.models.machine import Machine
from stillpath.models.store import load_machine
from stillpath.pipeline.compensate import compensate_file
from stillpath.pipeline.options import Options
from tests.fuzz.hostile import HOSTILE, pieces
from tests.fuzz.machines import KINDS, machine_of

_EXAMPLE = Path(__file__).parents[1] / "examples" / "ps_ender3_pauses_hept24f.gcode"
_NOISE_S = 1.0
_MOST_RATIO = 2.8
_MOST_RSS_MB = 600.0


def main() -> int:
    arguments = _arguments()
    machine = load_machine(arguments.machine)
    if arguments.firmware:
        machine = machine_of(arguments.firmware, arguments.machine)
    methods = arguments.methods.split(",")
    missed = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        warm = folder / "in.gcode"
        warm.write_bytes(b"".join(_EXAMPLE.read_bytes().splitlines(keepends=True)[:400]))
        for method in methods:
            compensate_file(warm, folder / "out.gcode", machine, Options(method=method))
        print(f"{'file':30} method {'size':>10} {'CPU s':>7} {'2n/n':>5} {'RSS MB':>7}  outcome")
        for case in arguments.names or list(HOSTILE):
            size = max(int(HOSTILE[case][1] * arguments.scale), 1)
            for method in methods:
                small, large = (
                    measured(case, n, method, machine, arguments, folder) for n in (size, 2 * size)
                )
                missed += told(case, method, size, small, large)
    return 1 if missed else 0


def measured(
    case: str, size: int, method: str, machine: Machine, options: argparse.Namespace, folder: Path
) -> dict:
    source = folder / "in.gcode"
    with source.open("wb") as file:
        for part in pieces(case, size):
            file.write(part)
    context = multiprocessing.get_context("fork")  # everything is compiled and loaded already
    here, there = context.Pipe(duplex=False)
    process = context.Process(target=child, args=(there, source, method, machine, options))
    process.start()
    there.close()
    dead = f"DIED OR > {options.limit_s} s"
    answer = None
    if here.poll(options.wall_s):
        with contextlib.suppress(EOFError):
            answer = json.loads(here.recv())
    else:
        dead = f"HUNG: killed after {options.wall_s} s"
        process.kill()
    process.join()
    here.close()
    return answer or {"outcome": dead, "cpu_s": float("nan"), "rss_mb": 0.0}


def child(
    there: Connection, source: Path, method: str, machine: Machine, options: argparse.Namespace
) -> None:
    most = int(options.limit_mb * 1e6)
    resource.setrlimit(resource.RLIMIT_DATA, (most, most))
    resource.setrlimit(resource.RLIMIT_CPU, (options.limit_s, options.limit_s + 5))
    began = time.process_time()
    try:
        result = compensate_file(source, source.with_name("o"), machine, Options(method=method))
        outcome = f"ok, {len(result.put_back)} of {result.pieces} put back"
    except GcodeError as error:
        outcome = f"GcodeError: {error}"
    except Exception as error:
        outcome = f"FAULT {type(error).__name__}: {error}"
    told = {
        "outcome": outcome,
        "cpu_s": time.process_time() - began,
        "rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }
    there.send(json.dumps(told))


def told(name: str, method: str, size: int, small: dict, large: dict) -> bool:
    ratio = large["cpu_s"] / max(small["cpu_s"], 1e-9)
    bad = []
    if not all(what["outcome"].startswith(("ok", "GcodeError")) for what in (small, large)):
        bad.append("fault")
    if large["cpu_s"] > _NOISE_S and ratio > _MOST_RATIO:
        bad.append("more than linear")
    if large["rss_mb"] > _MOST_RSS_MB:
        bad.append("memory")
    word = "MISS " + ", ".join(bad) if bad else ""
    print(
        f"{name:30} {method:6} {2 * size:10} {large['cpu_s']:7.2f} {ratio:5.2f} "
        f"{large['rss_mb']:7.0f}  {large['outcome'][:100]} {word}",
        flush=True,
    )
    return bool(bad)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*")
    parser.add_argument("--scale", type=float, default=1.0)
    parser.add_argument("--methods", default="none,fbf")
    parser.add_argument("--machine", default="ender3")
    parser.add_argument("--firmware", choices=KINDS, help="another than the machine's own")
    parser.add_argument("--limit-mb", type=float, default=3000.0)
    parser.add_argument("--limit-s", type=int, default=600, help="of processor time")
    parser.add_argument("--wall-s", type=int, default=3600, help="for a process that only waits")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
