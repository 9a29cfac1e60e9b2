"""Comments by which slicers mark layers, features and objects, and users what shall stay.

Source: the output of PrusaSlicer, SuperSlicer, OrcaSlicer, BambuStudio, Creality Print, Cura,
ideaMaker, KISSlicer and Kiri:Moto, 2021 to 2026.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import Enum

__all__ = ["Mark", "MarkKind", "read_mark"]


class MarkKind(Enum):
    """What a comment marks."""

    LAYER = "layer"
    HEIGHT = "height"
    FEATURE = "feature"
    OBJECT = "object"
    STAMP = "stamp"
    OFF = "off"
    """From here on moves stay as they are."""
    ON = "on"


@dataclass(frozen=True, slots=True)
class Mark:
    """A slicer's mark.

    Attributes
    ----------
    text : str
        Name of the feature or object (empty: none from here on), height in mm, else empty.
    """

    kind: MarkKind
    text: str = ""


_PATTERNS: tuple[tuple[re.Pattern[str], MarkKind], ...] = tuple(
    (re.compile(pattern), kind)
    for pattern, kind in (
        (r"; ?stillpath\b|; Processed by stillpath ", MarkKind.STAMP),
        # Typed by people: one that is missed lets moves be changed that shall not be.
        (r";\s*(?i:stillpath_off)\b", MarkKind.OFF),
        (r";\s*(?i:stillpath_on)\b", MarkKind.ON),
        (r";LAYER_CHANGE\s*$", MarkKind.LAYER),  # PrusaSlicer, SuperSlicer, Orca, Creality
        (r"; CHANGE_LAYER\s*$", MarkKind.LAYER),  # Bambu
        (r";LAYER:-?\d+", MarkKind.LAYER),  # Cura, ideaMaker
        (r"; BEGIN_LAYER_OBJECT z=(?P<z>\S+)", MarkKind.LAYER),  # KISSlicer
        (r";; --- layer \d+", MarkKind.LAYER),  # Kiri:Moto
        (r";Z:(?P<name>-?[\d.]+)", MarkKind.HEIGHT),
        (r"; Z_HEIGHT: ?(?P<name>-?[\d.]+)", MarkKind.HEIGHT),
        (r";TYPE:(?P<name>.*)$", MarkKind.FEATURE),
        (r"; FEATURE: ?(?P<name>.*)$", MarkKind.FEATURE),
        (r"; '(?P<name>[^']+)'", MarkKind.FEATURE),  # KISSlicer
        (r"; feature (?P<name>.*)$", MarkKind.FEATURE),  # Kiri:Moto
        (r"; printing object (?P<name>.*)$", MarkKind.OBJECT),
        (r"; stop printing object", MarkKind.OBJECT),
        (r";MESH:NONMESH\s*$", MarkKind.OBJECT),
        (r";MESH:(?P<name>.*)$", MarkKind.OBJECT),
        (r";PRINTING:(?P<name>.*)$", MarkKind.OBJECT),  # ideaMaker
        (r"; OBJECT_ID: ?(?P<name>.*)$", MarkKind.OBJECT),  # Bambu
    )
)


def read_mark(comment: str) -> Mark | None:
    """Return what a comment (from its semicolon on) marks, or None.

    A layer mark that names its height carries it as text.
    """
    comment = comment.rstrip()
    for pattern, kind in _PATTERNS:
        match = pattern.match(comment)
        if match is not None:
            found = match.groupdict()
            return Mark(kind, (found.get("name") or found.get("z") or "").strip())
    return None
