"""Comments with which slicers mark layers, features and objects, and users sections to keep.

Source: the output of PrusaSlicer, SuperSlicer, OrcaSlicer, BambuStudio, Creality Print, Cura,
ideaMaker, KISSlicer, Simplify3D and Kiri:Moto, 2021 to 2026. Objects that the firmware knows (M486,
EXCLUDE_OBJECT, M624) are commands, and the interpreter's. What features mean: `features`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import Enum

__all__ = ["Mark", "MarkKind", "read_mark"]


class MarkKind(Enum):
    """What a comment marks."""

    LAYER = "layer"
    Z = "z"
    HEIGHT = "height"
    """Height of the extruded line."""
    WIDTH = "width"
    """Width of the extruded line."""
    FEATURE = "feature"
    OBJECT = "object"
    WIPE_START = "wipe start"
    WIPE_END = "wipe end"
    COLOR_CHANGE = "colour change"
    PAUSE = "pause"
    CUSTOM = "custom"
    """What follows, somebody typed into the slicer."""
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
        Name of the feature or object in the slicer's own words (empty: none from here on); Z,
        height or width in mm; for a layer its Z, where the mark says it; else empty.
    """

    kind: MarkKind
    text: str = ""

    @property
    def value_mm(self) -> float | None:
        """The text as a number of mm, or None."""
        try:
            return float(self.text)
        except ValueError:
            return None


_NUMBER = r"(?P<text>-?\d*\.?\d+)"
_PATTERNS: tuple[tuple[re.Pattern[str], MarkKind], ...] = tuple(
    (re.compile(pattern), kind)
    for pattern, kind in (
        # Typed by users, so read leniently: a missed one would let protected moves be changed.
        (r";\s*(?i:stillpath[ _]off)\b", MarkKind.OFF),
        (r";\s*(?i:stillpath[ _]on)\b", MarkKind.ON),
        (r"; ?stillpath(?:| advise|, held back):|; Processed by stillpath ", MarkKind.STAMP),
        (r";LAYER_CHANGE\s*$", MarkKind.LAYER),  # PrusaSlicer, SuperSlicer, Orca, Creality
        (r"; CHANGE_LAYER\s*$", MarkKind.LAYER),  # Bambu
        (r";LAYER:-?\d+", MarkKind.LAYER),  # Cura, ideaMaker
        (rf"; BEGIN_LAYER_OBJECT z={_NUMBER}", MarkKind.LAYER),  # KISSlicer
        (rf"; layer \d+, Z = {_NUMBER}", MarkKind.LAYER),  # Simplify3D
        (rf";; --- layer \d+ \([\d.]+ @ {_NUMBER}", MarkKind.LAYER),  # Kiri:Moto
        (r";; --- layer \d+", MarkKind.LAYER),
        (rf";Z:{_NUMBER}", MarkKind.Z),
        (rf"; Z_HEIGHT: ?{_NUMBER}", MarkKind.Z),
        (rf"(?:;HEIGHT|; LAYER_HEIGHT): ?{_NUMBER}\s*$", MarkKind.HEIGHT),
        (rf"(?:;WIDTH|; LINE_WIDTH): ?{_NUMBER}\s*$", MarkKind.WIDTH),
        (r";TYPE:(?P<text>.*)$", MarkKind.FEATURE),
        (r"; FEATURE: ?(?P<text>.*)$", MarkKind.FEATURE),
        (r"; '(?P<text>[^']+ Path)'", MarkKind.FEATURE),  # KISSlicer
        (r"; feature (?P<text>.*)$", MarkKind.FEATURE),  # Kiri:Moto, Simplify3D
        (r"; printing object (?P<text>.*)$", MarkKind.OBJECT),
        (r"; stop printing object", MarkKind.OBJECT),
        # Simplify3D has one process for each object, if they are to be excluded one by one.
        (r"; process (?P<text>\S.*)$", MarkKind.OBJECT),
        (r";MESH:NONMESH\s*$", MarkKind.OBJECT),
        (r";MESH:(?P<text>.*)$", MarkKind.OBJECT),
        (r";PRINTING:(?P<text>.*)$", MarkKind.OBJECT),  # ideaMaker
        (r"; OBJECT_ID: ?(?P<text>.*)$", MarkKind.OBJECT),  # Bambu
        (r"; ?WIPE_START\s*$", MarkKind.WIPE_START),
        (r"; ?WIPE_END\s*$", MarkKind.WIPE_END),
        (r"; ?COLOR_CHANGE\b", MarkKind.COLOR_CHANGE),
        (r"; ?PAUSE_PRINT(?:ING)?\s*$", MarkKind.PAUSE),
        (r"; ?CUSTOM_GCODE\s*$", MarkKind.CUSTOM),
    )
)


def read_mark(comment: str) -> Mark | None:
    """Return what a comment (from its semicolon on) marks, or None."""
    comment = comment.rstrip()
    for pattern, kind in _PATTERNS:
        match = pattern.match(comment)
        if match is not None:
            return Mark(kind, (match.groupdict().get("text") or "").strip())
    return None
