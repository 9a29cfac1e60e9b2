"""Tune the firmware's best shaper for every built-in machine, and keep what is found.

    python benchmarks/reference_shapers.py [--write]

Prints machine, digest of its plants and limits, shaper and error, and whether
`pipeline/measuring/reference_shapers.json` says the same; exits with 1 if it does not. With
`--write` the file is made anew: after a change of a built-in machine, of the reference motion or of
what the best shaper is.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict
from pathlib import Path

from stillpath.models.reference_motion import reference_motion_of
from stillpath.models.store import builtin_machines, load_machine
from stillpath.pipeline.files import replacing
from stillpath.pipeline.measuring import reference_shaper

FILE = Path(reference_shaper.__file__).with_name("reference_shapers.json")
DT_S = 1e-3


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--write", action="store_true")
    given = parser.parse_args()
    known = json.loads(FILE.read_text())["machines"] if FILE.exists() else {}
    found = {}
    for name in builtin_machines():
        machine = load_machine(name)
        motion, extruding = reference_motion_of(machine, DT_S)
        best = reference_shaper.tune_shaper(machine, motion, DT_S, extruding)
        digest = reference_shaper.tuning_digest(machine)
        found[name] = {"digest": digest, "shaper": asdict(best)}
        verdict = "" if known.get(name) == found[name] else "MISS"
        print(
            f"{name:20} {digest} {best.label:28} {best.contour_rms_um:8.3f} um {verdict}",
            flush=True,
        )
    if given.write:
        with replacing(FILE) as temporary:
            document = {"version": reference_shaper._VERSION, "machines": found}
            temporary.write_text(json.dumps(document, indent=1) + "\n")
        return 0
    return 0 if known == found else 1


if __name__ == "__main__":
    sys.exit(main())
