"""Machines of every firmware, with room for files of other printers."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

from stillpath.models.machine import Machine
from stillpath.models.store import load_machine
from tests.fuzz.checks import roomy

__all__ = ["KINDS", "machine_of"]

_SECTIONS = Path(__file__).parents[2] / "examples" / "firmware"
KINDS = ("klipper", "marlin", "prusa", "bambu", "reprapfirmware")


@cache
def machine_of(kind: str, base: str = "ender3") -> Machine:
    """Return a machine whose firmware is of that kind or Marlin's variant, without its guards."""
    document = load_machine(base).model_dump(mode="json")
    if kind == "klipper":
        # Prusa's purge lines are beyond Klipper's default, excerpts beyond every bound.
        document["firmware"]["extruder"]["max_extrude_cross_section_mm2"] = 1e6
        document["firmware"]["extruder"]["max_extrude_only_distance_mm"] = 1e6
    else:
        variant = {} if kind in ("marlin", "reprapfirmware") else {"variant": kind}
        name = "marlin" if variant else kind
        document["firmware"] = json.loads((_SECTIONS / f"{name}.json").read_text()) | variant
    return roomy(Machine.model_validate(document))
