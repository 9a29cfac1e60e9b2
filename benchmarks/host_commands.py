"""Where the printer is when a line asks the host something in motion (M105, M117, ...).

Such a line stands where its moment comes, and there the printer is at the command, which leads the
file's path so that the nozzle is on it. For every such line in a stream of the written file this
tells how far the written place is from the file's, and at that moment the command and the nozzle of
the machine's model from the path. The first is the second and part of a segment, if the reason
holds; and the nozzle is on the path.

    python benchmarks/host_commands.py [FILE] [--firmware marlin] [--budget-um 100]
"""

from __future__ import annotations

import argparse
import re
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np

from stillpath.models.machine import Machine
from stillpath.pipeline.compensate import compensate_file
from stillpath.pipeline.last_check import _reader_kernels as at
from stillpath.pipeline.last_check.reader import Reader, code_of
from stillpath.pipeline.last_check.rules import rules_of
from stillpath.pipeline.measuring.tracing import Trace
from stillpath.pipeline.options import Options
from tests.fuzz.machines import KINDS, machine_of

_ASKS = re.compile(rb"(?:M105|M117|M73|M106|M107|M104|M140)(?!\d)")
_NEAR = 400
"""Samples around a move among which its end is looked for."""


def main() -> int:
    arguments = _arguments()
    machine = machine_of(arguments.firmware)
    options = Options(robust="ensemble", budget_um=arguments.budget_um)
    parts: list[Trace] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        source, target = folder / "in.gcode", folder / "out.gcode"
        source.write_bytes(arguments.file.read_bytes() if arguments.file else _zigzag())
        result = compensate_file(source, target, machine, options, trace=parts.append)
        file = [(n, code, place) for n, code, place, _ in _places(source.read_bytes(), machine)]
        written = [(place, on) for _, _, place, on in _places(target.read_bytes(), machine)]
    after = [channel.name for channel in result.channels].index("after")
    path, command, nozzle = (
        np.concatenate(columns, axis=1)
        for columns in zip(
            *((p.path_mm, p.executed_mm, p.simulated_mm[after]) for p in parts), strict=True
        )
    )
    line = np.concatenate([p.line for p in parts])
    print(
        "| line | written place to file's | command to path | nozzle to path |\n|---|---|---|---|"
    )
    table = []
    for (number, code, asked), (place, on) in zip(file, written, strict=True):
        behind = np.flatnonzero(line > number)
        if not on or len(behind) == 0:
            continue
        first = max(int(behind[0]) - _NEAR, 0)
        near = slice(first, int(behind[0]) + _NEAR)
        k = first + int(np.argmin(np.hypot(*(path[:, near] - asked[:, None]))))
        gaps = (place - asked, command[:, k] - path[:, k], nozzle[:, k] - path[:, k])
        table.append([1e3 * float(np.hypot(*gap)) for gap in gaps])
        cells = " | ".join(f"{gap:.0f} um" for gap in table[-1])
        print(f"| {number} {code.decode('utf-8', 'replace')} | {cells} |")
    largest = " | ".join(f"{gap:.0f} um" for gap in np.max(table, axis=0, initial=0.0))
    print(f"| largest of {len(table)} | {largest} |")
    return 0


def _places(data: bytes, machine: Machine) -> list[tuple[int, bytes, np.ndarray, bool]]:
    """Number, code and place of each line that asks something, and whether it is in a stream."""
    reader, on, found = Reader(rules_of(machine.firmware)), False, []
    for number, line in enumerate(data.split(b"\n"), 1):
        if line.startswith(b"; stillpath: stream o"):
            on = line.startswith(b"; stillpath: stream on")
        if code := code_of(line):
            reader.carry_out(code)
            if _ASKS.match(code):
                found.append((number, code, reader.state[[at.X, at.Y]], on))
    return found


def _zigzag() -> bytes:
    """Return a print whose corners of 30 to 150 degrees each have an M105."""
    lines = ["G28", "G90", "M83", "G1 X60 Y60 Z0.2 F6000"]
    place = np.array([60.0, 60.0])
    for k in range(24):
        turn = np.deg2rad((-1) ** k * (15 + 2.5 * k))
        place = place + 8.0 * np.array([np.cos(turn), np.sin(turn)]) * (1 if k % 12 < 6 else -1)
        lines += [f"G1 X{place[0]:.3f} Y{place[1]:.3f} E0.26 F{3000 + 200 * k}", "M105"]
    return ("\n".join([*lines, "M400"]) + "\n").encode()


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", type=Path, nargs="?", help="by default a zigzag")
    parser.add_argument("--firmware", choices=KINDS, default="klipper")
    parser.add_argument("--budget-um", type=float)
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
