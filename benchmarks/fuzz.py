"""Damaged print files through interpreter, planner and encoder: nothing but refusals may come out.

Each excerpt of the corpus is damaged, read and planned; then, without the lines that were refused,
it goes through the whole pipeline, and every line of what is written must find the machine in the
state that it found it in before. Failures are made small and saved.

    python benchmarks/fuzz.py --bytes 10_000_000 --seed 1 [--machine ender3] [--method shaper:mzv]
        [--firmware examples/firmware/marlin.json [--facts '{"variant": "prusa"}']]
        [--files GLOB ...] [--save DIR] [--bounds-check]

``--bounds-check`` compiles the kernels with checks of every index (slow, in a cache of their own).
"""

from __future__ import annotations

import argparse
import gzip
import json
import os
import random
import resource
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from pathlib import Path

if "--bounds-check" in sys.argv:
    os.environ["NUMBA_BOUNDSCHECK"] = "1"
    os.environ["NUMBA_CACHE_DIR"] = str(Path(tempfile.gettempdir()) / "stillpath-bounds-numba")

sys.path.insert(0, str(Path(__file__).parents[1]))

from stillpath.models.machine import Machine
from stillpath.models.store import load_machine
from tests.fuzz.checks import roomy, walk
from tests.fuzz.mutations import excerpts

_ROOT = Path(__file__).parents[1]
_ALARM_S = 120
_WARM = b"G28\nG90\nM83\nG1 X50 Y50 F6000\nG1 X90 E1\nG2 X90 Y50 I5 E1\nG1 Y90 E1\n"


def main() -> int:
    arguments = _arguments()
    machine = load_machine(arguments.machine)
    if arguments.firmware:
        section = json.loads(arguments.firmware.read_text()) | json.loads(arguments.facts)
        document = machine.model_dump(mode="json") | {"firmware": section}
        machine = Machine.model_validate(document)
    if not arguments.own_travel:
        machine = roomy(machine)
    files = [_text(path) for path in _paths(arguments.files)]
    dice = random.Random(arguments.seed)
    methods = arguments.method.split(",")
    total = good = lines = put_back = 0
    slowest = (0.0, 0)
    refusals: Counter[str] = Counter()
    failures: dict[str, bytes] = {}
    began = time.process_time()
    with tempfile.TemporaryDirectory() as name:
        cache = Path(name) / "cache"
        with tempfile.TemporaryDirectory() as folder:  # compiles
            for method in methods:
                walk(_WARM, machine, Path(folder), method, cache)
        for number, data in enumerate(excerpts(files, arguments.bytes, dice)):
            method = methods[number % len(methods)]
            cpu = time.process_time()
            what, outcome = attempt(data, machine, method, cache)
            slowest = max(slowest, (time.process_time() - cpu, number))
            total += len(data)
            if outcome is not None:
                good += outcome.written is not None
                lines += outcome.text.count(b"\n")
                put_back += outcome.put_back
                refusals.update(_kind(str(error)) for error in outcome.refusals)
            elif what not in failures:
                print(f"\nFAILURE in excerpt {number}: {what}", flush=True)
                hangs = what.startswith("TimeoutError")  # hours to make it smaller
                failures[what] = data if hangs else smaller(data, what, machine, method, cache)
                print(failures[what].decode("latin-1")[-1500:], flush=True)
                if arguments.save:
                    arguments.save.mkdir(parents=True, exist_ok=True)
                    path = (
                        arguments.save / f"{machine.firmware.kind}-{arguments.seed}-{number}.gcode"
                    )
                    path.write_bytes(failures[what])
    seconds = time.process_time() - began
    print(f"{total:_} bytes in {number + 1} excerpts, seed {arguments.seed}, {machine.name}")
    rss_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(
        f"{good} written ({lines} lines, {put_back} pieces put back), {seconds:.0f} s CPU, "
        f"slowest excerpt {slowest[1]}: {slowest[0]:.1f} s; peak RSS {rss_mb:.0f} MB"
    )
    for message, count in refusals.most_common():
        print(f"{count:7} refused: {message}")
    print(f"{len(failures)} kinds of failures" + (" MISS" if failures else ""))
    return 1 if failures else 0


def attempt(data: bytes, machine: Machine, method: str, cache: Path):
    """Return what failed (by kind and place) and the outcome, one of them None."""

    def hang(*_: object) -> None:
        raise TimeoutError(f"more than {_ALARM_S} s of CPU time")

    signal.signal(signal.SIGPROF, hang)
    signal.setitimer(signal.ITIMER_PROF, _ALARM_S)
    try:
        with tempfile.TemporaryDirectory() as folder:
            return None, walk(data, machine, Path(folder), method, cache)
    except Exception as error:
        frames = traceback.extract_tb(error.__traceback__)
        places = [f"{Path(f.filename).name}:{f.lineno}" for f in frames[-3:]]
        where = " < ".join(places[::-1])
        return f"{type(error).__name__}: {_kind(str(error))[:160]} at {where}", None
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)


def smaller(data: bytes, what: str, machine: Machine, method: str, cache: Path) -> bytes:
    """Take out lines as long as the same thing fails at the same place."""
    lines = data.split(b"\n")
    step, tries = max(len(lines) // 2, 1), 0
    place = what.rsplit(" at ", 1)[1]
    while step and tries < 400:
        at = 0
        while at < len(lines) and tries < 400:
            rest = lines[:at] + lines[at + step :]
            tries += 1
            found = attempt(b"\n".join(rest), machine, method, cache)[0]
            if found is not None and found.rsplit(" at ", 1)[1] == place:
                lines = rest
            else:
                at += step
        step //= 2
    return b"\n".join(lines)


def _kind(message: str) -> str:
    """Return a message without its numbers and quotations."""
    message = message.split(": ", 1)[1] if message.startswith("line ") else message
    out, quoted = [], False
    for c in message.split(" ('")[0].split(' ("')[0]:
        quoted ^= c in "'\""
        if not quoted:
            out.append("0" if c.isdigit() else c)
    text = "".join(out)
    while "00" in text:
        text = text.replace("00", "0")
    return text[:110]


def _paths(patterns: list[str]) -> list[Path]:
    shared = Path(os.environ.get("STILLPATH_SHARED", _ROOT.parent / "shared")) / "corpus"
    found = [p for pattern in patterns for p in sorted(Path().glob(pattern))]
    if not found and shared.is_dir():
        found = sorted(p for p in shared.glob("*/*") if p.suffix == ".gz")
    return found or sorted((_ROOT / "examples").glob("*.gcode"))


def _text(path: Path) -> bytes:
    data = path.read_bytes()
    return gzip.decompress(data) if path.suffix == ".gz" else data


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--bytes", type=int, default=10_000_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--machine", default="ender3")
    parser.add_argument("--firmware", type=Path, help="JSON of another firmware's section")
    parser.add_argument("--facts", default="{}", help="JSON of what is different in it")
    parser.add_argument("--method", default="shaper:mzv", help="or several, taken in turn")
    parser.add_argument("--files", nargs="*", default=[])
    parser.add_argument("--save", type=Path)
    parser.add_argument("--own-travel", action="store_true", help="do not widen the machine")
    parser.add_argument("--bounds-check", action="store_true")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
