"""The file for the Klipper extra: filter, limits and predictions of a machine."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from stillpath.compensation.defaults import DT_S
from stillpath.models.firmware import Klipper
from stillpath.models.machine import Machine
from stillpath.pipeline.error_range import ErrorRange
from stillpath.pipeline.files import default_cache_dir, replacing
from stillpath.pipeline.live_design import LiveDesign, cached_live_design
from stillpath.version import __version__

__all__ = [
    "SCHEMA",
    "export_digest",
    "export_document",
    "export_text",
    "write_export",
]

SCHEMA = "stillpath-klipper/1"
_DIGITS = 12


def write_export(machine: Machine, target: Path, cache_dir: Path | None = None) -> dict[str, Any]:
    """Design the filter of a machine, write it whole or not at all, and return it.

    Raises
    ------
    DesignError
        If there is no print-time compensation for the machine.
    """
    design = cached_live_design(machine, cache_dir or default_cache_dir())
    document = export_document(machine, design)
    with replacing(target) as temporary:
        temporary.write_text(export_text(document), encoding="utf-8")
    return document


def export_text(document: dict[str, Any]) -> str:
    """Return an export as it is written."""
    return json.dumps(document, indent=1, sort_keys=True, allow_nan=False) + "\n"


def export_document(machine: Machine, design: LiveDesign) -> dict[str, Any]:
    """Return the export of a design, with its digest."""
    firmware = machine.firmware
    assert isinstance(firmware, Klipper)
    limits = firmware.planner
    document: dict[str, Any] = {
        "schema": SCHEMA,
        "made_by": f"stillpath {__version__}",
        "machine": machine.name,
        "machine_revision": machine.revision,
        "kinematics": machine.kinematics,
        "sample_s": DT_S,
        "limits": {
            "max_velocity_mm_s": limits.max_velocity_mm_s,
            "max_accel_mm_s2": limits.max_accel_mm_s2,
        },
        "command": machine.command.model_dump(
            include={"velocity_mm_s", "accel_mm_s2", "motors"}, exclude_none=True
        ),
        "axes": {
            axis: {
                "taps": [round(float(tap), _DIGITS) for tap in design.taps[k]],
                "share": design.shares[k],
                "accel_gain": round(design.accel_gain(k), 4),
            }
            for k, axis in enumerate(("x", "y"))
        },
        "predictions": {
            "of": "contour error while extruding on the reference motion, um rms; predictions",
            "channels": {name: _channel(known) for name, known in design.ranges.items()},
            "against_shaper": {"mean": _um(design.mean), "worst": _um(design.worst)},
            "shaper": design.shaper.label,
            "bandwidth_hz": design.corner_hz,
            "peak_accel_mm_s2": round(design.peak_accel_mm_s2),
        },
    }
    return {**document, "digest": export_digest(document)}


def export_digest(document: dict[str, Any]) -> str:
    """Return the SHA-256 of an export without its digest, as canonical JSON."""
    rest = {name: value for name, value in document.items() if name != "digest"}
    text = json.dumps(rest, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def _channel(known: ErrorRange) -> dict[str, float]:
    least_um, most_um = known.around_um(known.reference_um)
    return {"nominal": _um(known.reference_um), "least": _um(least_um), "most": _um(most_um)}


def _um(value: float) -> float:
    return round(value, 3)
