"""Compiles what a firmware's tests need: `python -m tests.warm marlin`.

`.ci/run` does so before processes begin that would else compile the same beside each other.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from stillpath.pipeline.compensate import compensate_file
from stillpath.pipeline.options import Options
from tests.fuzz.machines import machine_of

EXAMPLE = Path(__file__).parents[1] / "examples" / "ps_ender3_pauses_hept24f.gcode"


def main(kind: str) -> None:
    lines = EXAMPLE.read_bytes().splitlines(keepends=True)[:300]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "in.gcode").write_bytes(b"".join(lines))
        compensate_file(
            folder / "in.gcode",
            folder / "out.gcode",
            machine_of(kind),
            Options(robust="off"),
            cache_dir=folder,
        )


if __name__ == "__main__":
    main(sys.argv[1])
