"""Fuzzing with a seed of its own every day: damaged excerpts, layers, and files of a grammar.

As `fuzz.py` on each kind of firmware in turn, for some minutes or for a number of files. A failure
is shown with the seed; with `--seed` it comes again. What fails: anything but a refusal, lines or
states that differ, pieces reverted for an error of our own, more CPU than 15 s for one file. Prints
are at most 3 h long (`M203 X1` makes days of a few lines).

    python benchmarks/fuzz_today.py --seconds 110 [--seed 20261124] [--save DIR]
    python benchmarks/fuzz_today.py --files 20000 --firmware klipper

With `--files` they are short, so that many fit into an hour.
"""

from __future__ import annotations

import argparse
import datetime
import itertools
import random
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.fuzz import attempt
from tests.fuzz.checks import walk
from tests.fuzz.grammar import written
from tests.fuzz.layers import layered
from tests.fuzz.machines import machine_of
from tests.fuzz.mutations import excerpts

_ROOT = Path(__file__).parents[1]
_WARM = b"G28\nG90\nM83\nG1 X50 Y50 F6000\nG1 X90 E1\nG2 X90 Y50 I5 E1\nG1 Y90 E1\n"
_KINDS = ("klipper", "marlin", "reprapfirmware")
_METHODS = ("shaper:mzv", "none", "shaper:ei")
_MOST_CPU_S = 15.0
"""For a print of some minutes: Marlin and RepRapFirmware choose a vertex every few milliseconds."""
_TOLD_EVERY = 1000


def main() -> int:
    arguments = _arguments()
    kinds = arguments.firmware or list(_KINDS)
    print(f"seed {arguments.seed}, {', '.join(kinds)}", flush=True)
    dice = random.Random(arguments.seed)
    machines = {kind: machine_of(kind) for kind in kinds}
    failures: dict[str, int] = {}
    spent_s: list[float] = []
    good = put_back = 0
    with tempfile.TemporaryDirectory() as name:
        cache = Path(name) / "cache"
        for machine, method in itertools.product(machines.values(), _METHODS):
            with tempfile.TemporaryDirectory() as folder:  # compiles
                walk(_WARM, machine, Path(folder), method, cache)
        until = time.monotonic() + arguments.seconds
        for number, data in enumerate(_files(dice, short=arguments.files is not None)):
            if number == arguments.files or time.monotonic() > until:
                break
            turn, which = divmod(number, len(kinds))
            kind, method = kinds[which], _METHODS[turn % len(_METHODS)]
            began = time.process_time()
            what, outcome = attempt(data, machines[kind], method, cache)
            spent_s.append(time.process_time() - began)
            if outcome is not None:
                spent_s[-1] = outcome.cpu_s
                good += outcome.written is not None
                put_back += outcome.put_back
                if outcome.cpu_s > _MOST_CPU_S:
                    what = f"SLOW: more than {_MOST_CPU_S:g} s of CPU"
            if what is not None:
                failures[what] = failures.get(what, 0) + 1
                if failures[what] == 1:
                    print(f"\nFAILURE in file {number}, {kind}, {method}: {what}", flush=True)
                    _save(arguments.save, f"{kind}-{arguments.seed}-{number}.gcode", data)
            if len(spent_s) % _TOLD_EVERY == 0:
                print(f"{len(spent_s)} files, {sum(spent_s):.0f} s CPU", flush=True)
    print(
        f"{len(spent_s)} files of {', '.join(kinds)}: {good} written, {put_back} pieces put back, "
        f"{sum(spent_s):.0f} s CPU (mean {statistics.fmean(spent_s):.3f}, most "
        f"{max(spent_s):.2f} s in file {spent_s.index(max(spent_s))}), "
        f"{len(failures)} kinds of failures in {sum(failures.values())} files"
    )
    return 1 if failures else 0


def _files(dice: random.Random, *, short: bool) -> Iterator[bytes]:
    texts = [path.read_bytes() for path in sorted((_ROOT / "examples").glob("*.gcode"))]
    damaged = excerpts(texts, 1 << 40, dice, size=1500 if short else 20_000)
    lengths = (8, 16, 30) if short else (20, 60, 200)
    for data in damaged:
        yield data
        yield layered(dice)
        # No multiple of three in all: the firmwares take turns.
        for _ in range(3 if short else 2):
            yield written(dice, dice.choice(lengths))


def _save(folder: Path | None, name: str, data: bytes) -> None:
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    today = int(f"{datetime.datetime.now(datetime.UTC):%Y%m%d}")
    parser.add_argument("--seconds", type=float, default=None)
    parser.add_argument("--files", type=int, help="how many; they are short then")
    parser.add_argument("--firmware", action="append", choices=_KINDS, help="by default all")
    parser.add_argument("--seed", type=int, default=today, help="by default the date")
    parser.add_argument("--save", type=Path)
    arguments = parser.parse_args()
    if arguments.seconds is None:
        arguments.seconds = 110.0 if arguments.files is None else float("inf")
    return arguments


if __name__ == "__main__":
    sys.exit(main())
