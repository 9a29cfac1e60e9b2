"""Identify the built-in machines from the tables that their owners published.

    python benchmarks/builtin_machines.py [--write]

Prints, axis by axis, what the fit leaves, its modes and its members, and whether the machine that
is shipped says the same; exits with 1 if one does not. With `--write` the documents are made anew:
`benchmarks/reference_shapers.py --write` goes after it.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from inputs import shared_folder

from stillpath.applications.identification.run import InputFile, identify_files
from stillpath.models.identification.readers import ReadSettings
from stillpath.models.machine import Machine
from stillpath.models.store import load_machine

LIBRARY = Path(__file__).resolve().parent.parent / "models" / "library"
TABLES = {
    "ender3": (
        "bassco_ender3/resonances_x_20210821_152037.csv",
        "bassco_ender3/resonances_y_20210630_223910.csv",
        "bassco_ender3/resonances_y_20210630_230110.csv",
    ),
    "voron-v0": (
        "bassco_v0/resonances_x_20220703_144605.csv",
        "bassco_v0/resonances_y_20220703_143119.csv",
    ),
    "voron-v24-250": (
        "richardjm_voron24_250/resonances_x_20220430_191517.csv",
        "richardjm_voron24_250/resonances_x_20220430_192532.csv",
        "richardjm_voron24_250/resonances_x_20220430_193805.csv",
        "richardjm_voron24_250/resonances_y_20220430_191733.csv",
        "richardjm_voron24_250/resonances_y_20220430_192750.csv",
        "richardjm_voron24_250/resonances_y_20220430_194022.csv",
    ),
    "annex-k3": (
        "nielsvz_annexK3/resonances_x_20220522_092825.csv",
        "nielsvz_annexK3/resonances_y_20220522_093052.csv",
    ),
}
_SOURCE = (
    "identified from resonance tables that its owner published (magnitude only: the phase was not "
    "measured; slow motion is taken to have no delay): {}"
)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("machines", nargs="*", help="default: all of them")
    parser.add_argument("--write", action="store_true")
    parser.add_argument("--shared", type=Path, help="default: $STILLPATH_SHARED or ../shared")
    given = parser.parse_args()
    shared = shared_folder(given.shared)
    if shared is None:
        sys.exit("the folder of shared measurements is not there; see --shared")
    same = True
    for name, tables in TABLES.items():
        if given.machines and name not in given.machines:
            continue
        shipped = load_machine(name)
        made = identified(shipped, [shared / "measurements" / table for table in tables])
        same &= made.revision == shipped.revision
        print(f"  {'as shipped' if made.revision == shipped.revision else 'DIFFERS from shipped'}")
        if given.write:
            document = json.dumps(made.model_dump(mode="json", exclude_none=True), indent=1)
            (LIBRARY / f"{name}.json").write_text(document + "\n")
    return 0 if same or given.write else 1


def identified(base: Machine, tables: list[Path]) -> Machine:
    """Return the machine with the axes that the tables say."""
    files = [InputFile(path.name, path.read_bytes()) for path in tables]
    found = identify_files(files, base, ReadSettings())
    for axis, plants in sorted(found.machine.axes.items()):
        about = plants.provenance
        assert about is not None
        modes = ", ".join(f"{m.f_hz:.1f} Hz/{m.zeta:.3f}" for m in about.modes)
        count = len(plants.weighted_members())
        print(f"{base.name} {axis}: {about.residual:.2f} dB, {count} members, {modes}", flush=True)
    source = _SOURCE.format(", ".join(path.name for path in tables))
    # Figures of the documentation, and files that users have, are of guides that do not rub.
    document = {**found.machine.without_friction().model_dump(), "source": source}
    return Machine.model_validate(document)


if __name__ == "__main__":
    sys.exit(main())
