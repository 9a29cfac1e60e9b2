"""The most that a speed budget can save: every class at the machine's limits, whatever errs.

The speeds at which plastic is laid stay, so most files are bound by them and not by vibration.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
from inputs import find_input, plain_copy, shared_folder

from stillpath.gcode.errors import GcodeError
from stillpath.gcode.interpreter import Interpreter
from stillpath.gcode.pacing import AS_SLICED, FirstLayer, Pace, move_classes, paced
from stillpath.gcode.pieces import Piece
from stillpath.gcode.splitter import Splitter
from stillpath.models.machine import Machine
from stillpath.models.store import load_machine

FILES = (
    "cura_ender3_gear24",
    "klipper_excludeobj_multi",
    "ps_voron_klipper_ringing",
    "arcwelder_ender3_gear24_absE",
    "ps_ender3_gear24_absE",
    "cura_prusa_mk3_reltiveE_tris24",
    "ps_mk3s_gyroid_medium",
    "real_bambustudio1.10_k1max",
    "arcwelder_mk3s_xyzcube",
    "ps_mk3s_xyzcube",
    "real_superslicer2.3_arcwelder",
    "cura_um2_ultigcode_hept24f",
    "ps_ender3_pauses_hept24f",
    "real_prusaslicer2.3.3_thumb",
    "real_kisslicer2.0.6",
    "ps_jubilee_rrf_toolchange",
    "real_cura4.10_objs",
    "real_orcaslicer2.3.0b2",
    "ps_mk3s_vase",
)
_READ_BYTES = 1 << 20
_TOP = Pace(1e3, 1e3)


def least_s(file: Path, machine: Machine) -> tuple[float, float]:
    """Return how long the pieces of a file last as sliced, and at the machine's limits.

    The first layer is what lies below the second, as slicers mark them.
    """
    reader, splitter = Interpreter(machine), Splitter(machine)
    sliced_s = quick_s = 0.0
    with file.open("rb") as source:
        while True:
            data = source.read(_READ_BYTES)
            items = [
                item
                for block in (reader.push(data) if data else reader.flush())
                for item in splitter.push(block)
            ]
            for item in items if data else [*items, *splitter.flush()]:
                if not isinstance(item, Piece):
                    continue
                classes = move_classes(item.moves, FirstLayer(1))
                raised = {one: _TOP for one in np.unique(classes).tolist() if one != AS_SLICED}
                sliced_s += item.phases.duration_s
                quick_s += paced(item, classes, raised, machine).phases.duration_s
            if not data:
                return sliced_s, quick_s


def main() -> None:
    parser = argparse.ArgumentParser(description="The most that a speed budget can save.")
    parser.add_argument("--files", nargs="+", default=list(FILES), help="paths, or corpus names")
    parser.add_argument("--machine", default="ender3")
    parser.add_argument("--shared", type=Path, help="default: $STILLPATH_SHARED or ../shared")
    given = parser.parse_args()
    machine, shared = load_machine(given.machine), shared_folder(given.shared)
    with tempfile.TemporaryDirectory(prefix="stillpath-bound-") as folder:
        for name in given.files:
            file = plain_copy(find_input(name, shared), Path(folder))
            try:
                sliced_s, quick_s = least_s(file, machine)
            except GcodeError as error:
                print(f"{name:34} refused: {error}", flush=True)
                continue
            saved = 1.0 - quick_s / sliced_s
            print(f"{name:34}{sliced_s:9.1f} s {quick_s:9.1f} s {100 * saved:6.1f} %", flush=True)


if __name__ == "__main__":
    main()
