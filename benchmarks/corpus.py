"""The corpus there and back: whole files, compensated, against a reader that shares nothing.

Every line that is no move must be there, in order and unchanged but for the documented ones;
filament by tool, last place and modes must be the file's, and no place outside of the machine.

    python benchmarks/corpus.py [NAME ...] [--machine ender3] [--method fbf]
        [--firmware examples/firmware/marlin.json [--facts '{"steps_per_mm": ...}']] [--lines N]
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from stillpath.gcode.errors import GcodeError
from stillpath.models.machine import Machine
from stillpath.models.store import load_machine
from stillpath.pipeline.compensate import compensate_file
from stillpath.pipeline.options import Options
from tests.e2e.round_trip import corpus_files, corpus_folder, excerpt, flaws, made_to_fit, text_of


def main() -> int:
    arguments = _arguments()
    machine = load_machine(arguments.machine)
    document = machine.model_dump(mode="json")
    if arguments.firmware:
        document["firmware"] = json.loads(arguments.firmware.read_text())
    elif "extruder" in document["firmware"]:
        document["firmware"]["extruder"]["max_extrude_cross_section_mm2"] = 10.0
    document["firmware"] |= json.loads(arguments.facts)
    machine = Machine.model_validate(document)
    names = [n for n in corpus_files() if not arguments.names or _named(n, arguments.names)]
    if not names:
        sys.exit("no shared data (set STILLPATH_SHARED), or no file of that name in it")
    print(f"{machine.name}, {machine.firmware.kind}, method {arguments.method}")
    print(f"{'file':44} {'pieces':>6} {'back':>5} {'print s':>8} {'CPU s':>6}  outcome")
    missed = 0
    with tempfile.TemporaryDirectory() as name:
        source, target = Path(name) / "in.gcode", Path(name) / "out.gcode"
        for one in names:
            data = text_of(corpus_folder() / one)
            if arguments.lines:
                data = excerpt(data, arguments.lines, arguments.lines // 5)
            source.write_bytes(data)
            fitted, began = made_to_fit(machine, data), time.process_time()
            try:
                result = compensate_file(source, target, fitted, Options(method=arguments.method))
            except GcodeError as error:
                print(f"{one:44} {'':28}  refused: {str(error)[:110]}", flush=True)
                continue
            cpu_s = time.process_time() - began
            written = target.read_bytes()
            wrong = flaws(data, written, fitted)
            if arguments.method == "none" and written != data:
                wrong.append("bytes differ")
            missed += bool(wrong)
            print(
                f"{one:44} {result.pieces:6} {len(result.put_back):5} {result.time_s:8.0f} "
                f"{cpu_s:6.1f}  {'MISS ' + '; '.join(wrong[:3]) if wrong else 'same'}",
                flush=True,
            )
    return 1 if missed else 0


def _named(name: str, wanted: list[str]) -> bool:
    return any(word in name for word in wanted)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="parts of names")
    parser.add_argument("--machine", default="ender3")
    parser.add_argument("--method", default="fbf")
    parser.add_argument("--firmware", type=Path, help="JSON of another firmware's section")
    parser.add_argument("--facts", default="{}", help="JSON of what is different in it")
    parser.add_argument("--lines", type=int, help="only so many lines of each file's start")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
