"""How fast G-code is read: bytes to moves, and bytes to planned moves, on one core.

Run: python benchmarks/interpreting.py [FILE ...] [--megabytes 64] [--machine ender3]

Every file is read over and over as one long file in pieces of a quarter of a megabyte, as the
pipeline reads it and with its settings of the allocator, the best of three runs counts, and times
are CPU times. For comparison: counting newlines, and `gcodeparser` from PyPI (MIT; install it to
see it), on the file once. Each row is a process of its own, so that the largest memory is the
row's.
"""

from __future__ import annotations

import argparse
import gzip
import json
import resource
import subprocess
import sys
import time
from pathlib import Path

from inputs import shared_folder

from stillpath.gcode.firmware.registry import adapter
from stillpath.gcode.interpreter import Interpreter
from stillpath.models.store import load_machine
from stillpath.service.environment import prepare_environment

PIECE = 1 << 18
ROUNDS = 3
FILES = ("ps_mk3s_gyroid_medium", "ps_voron_klipper_ringing", "cura_ender3_gear24")
ROWS = ("newline scan", "lexing + interpreting", "+ planning", "gcodeparser")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", nargs="*", type=Path)
    parser.add_argument("--megabytes", type=float, default=64.0, help="length to read")
    parser.add_argument("--machine", default="ender3")
    parser.add_argument("--row", choices=ROWS, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.row:
        prepare_environment()
        data = _text(arguments.files[0])
        print(json.dumps(_measure(arguments.row, data, arguments.megabytes, arguments.machine)))
        return
    shared = shared_folder()
    if not arguments.files and shared is None:
        sys.exit("no shared data: name files, or set STILLPATH_SHARED")
    files = arguments.files or [shared / "corpus" / "own" / f"{name}.gcode.gz" for name in FILES]
    for path in files:
        print(f"\n{path.name}")
        print(f"{'':24}{'MB/s':>8}{'M lines/s':>11}{'M moves/s':>11}{'peak MB':>9}")
        for row in ROWS:
            command = [sys.executable, __file__, str(path), "--row", row]
            command += ["--megabytes", str(arguments.megabytes), "--machine", arguments.machine]
            done = subprocess.run(command, capture_output=True, text=True, check=True)
            found = json.loads(done.stdout)
            if not found:
                print(f"{row:24}  not installed")
                continue
            seconds = found["seconds"]
            moves = found["moves"] / seconds / 1e6
            print(
                f"{row:24}{found['bytes'] / seconds / 1e6:8.0f}"
                f"{found['lines'] / seconds / 1e6:11.2f}"
                + (f"{moves:11.2f}" if moves else " " * 11)
                + f"{found['peak_mb']:9.0f}"
            )


def _text(path: Path) -> bytes:
    data = path.read_bytes()
    return gzip.decompress(data) if path.suffix == ".gz" else data


def _measure(row: str, data: bytes, megabytes: float, machine: str) -> dict[str, float]:
    """Return seconds, bytes, lines, moves and the largest memory; nothing if it cannot run."""
    repeats = max(1, round(megabytes * 1e6 / len(data)))
    if row == "gcodeparser":
        repeats = 1
        try:
            from gcodeparser import GcodeParser  # type: ignore[import-untyped,import-not-found]
        except ImportError:
            return {}
    best, moves = float("inf"), 0
    for _ in range(1 if row == "gcodeparser" else ROUNDS):
        start = time.process_time()
        if row == "newline scan":
            for _ in range(repeats):
                data.count(b"\n")
        elif row == "gcodeparser":
            moves = sum(line.command in (("G", 0), ("G", 1)) for line in _parsed(GcodeParser, data))
        else:
            moves = _interpret(data, repeats, machine, planning=row == "+ planning")
        best = min(best, time.process_time() - start)
    return {
        "seconds": best,
        "bytes": float(len(data) * repeats),
        "lines": float(data.count(b"\n") * repeats),
        "moves": float(moves),
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
    }


def _parsed(parser: type, data: bytes) -> list:  # type: ignore[type-arg]
    return list(parser(data.decode("utf-8", "replace"), include_comments=False).lines)


def _interpret(data: bytes, repeats: int, machine_name: str, *, planning: bool) -> int:
    machine = load_machine(machine_name)
    interpreter = Interpreter(machine, strict_bounds=False)
    planner = adapter(machine).planner()
    moves = 0
    for _ in range(repeats):
        for first in range(0, len(data), PIECE):
            for block in interpreter.push(data[first : first + PIECE]):
                moves += len(block.moves)
                if planning:
                    planner.push(block)
    for block in interpreter.flush():
        moves += len(block.moves)
    return moves


if __name__ == "__main__":
    main()
