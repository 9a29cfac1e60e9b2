"""Some minutes of fuzzing with a seed of its own every day: damaged files, and files of a grammar.

As `fuzz.py` on each kind of firmware in turn. A failure is shown with the seed; with `--seed` it
comes again.

    python benchmarks/fuzz_today.py --seconds 110 [--seed 20261124] [--save DIR]
"""

from __future__ import annotations

import argparse
import datetime
import random
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.fuzz import attempt
from tests.fuzz.checks import walk
from tests.fuzz.grammar import written
from tests.fuzz.machines import machine_of
from tests.fuzz.mutations import excerpts

_ROOT = Path(__file__).parents[1]
_WARM = b"G28\nG90\nM83\nG1 X50 Y50 F6000\nG1 X90 E1\nG2 X90 Y50 I5 E1\nG1 Y90 E1\n"
_KINDS = ("klipper", "marlin", "reprapfirmware")
_METHODS = ("shaper:mzv", "none", "shaper:ei")


def main() -> int:
    arguments = _arguments()
    print(f"seed {arguments.seed}")
    dice = random.Random(arguments.seed)
    machines = {kind: machine_of(kind) for kind in _KINDS}
    failures: set[str] = set()
    slowest = (0.0, 0)
    good = put_back = number = 0
    with tempfile.TemporaryDirectory() as name:
        cache = Path(name) / "cache"
        for machine in machines.values():
            with tempfile.TemporaryDirectory() as folder:  # compiles
                walk(_WARM, machine, Path(folder), _METHODS[0], cache)
        until = time.monotonic() + arguments.seconds
        for number, data in enumerate(_files(dice)):
            if time.monotonic() > until:
                break
            turn, which = divmod(number, len(_KINDS))
            kind, method = _KINDS[which], _METHODS[turn % len(_METHODS)]
            began = time.process_time()
            what, outcome = attempt(data, machines[kind], method, cache)
            slowest = max(slowest, (time.process_time() - began, number))
            if outcome is not None:
                good += outcome.written is not None
                put_back += outcome.put_back
            elif what not in failures:
                failures.add(what)
                print(f"\nFAILURE in file {number}, {kind}, {method}: {what}", flush=True)
                if arguments.save:
                    arguments.save.mkdir(parents=True, exist_ok=True)
                    path = arguments.save / f"{kind}-{arguments.seed}-{number}.gcode"
                    path.write_bytes(data)
    print(
        f"{number} files, {good} written, {put_back} pieces put back, slowest {slowest[0]:.1f} s "
        f"CPU (file {slowest[1]}), {len(failures)} kinds of failures"
    )
    return 1 if failures else 0


def _files(dice: random.Random) -> Iterator[bytes]:
    texts = [path.read_bytes() for path in sorted((_ROOT / "examples").glob("*.gcode"))]
    damaged = excerpts(texts, 1 << 40, dice)
    for data in damaged:
        yield data
        yield written(dice, dice.choice((20, 60, 200)))


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    today = int(f"{datetime.datetime.now(datetime.UTC):%Y%m%d}")
    parser.add_argument("--seconds", type=float, default=110.0)
    parser.add_argument("--seed", type=int, default=today, help="by default the date")
    parser.add_argument("--save", type=Path)
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
