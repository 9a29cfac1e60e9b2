"""A common vocabulary for the kinds of extruded lines of all slicers.

Source: `ExtrusionRole.cpp` of PrusaSlicer 2.9 and SuperSlicer 2.5, `ExtrusionEntity.cpp` of
OrcaSlicer 2.3 and BambuStudio 2.3; the output of Cura 5, ideaMaker, KISSlicer 2, Simplify3D and
Kiri:Moto.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum

__all__ = ["Feature", "feature_name", "feature_of", "feature_title"]


class Feature(Enum):
    """What is printed; the value is what reports call it."""

    OUTER_WALL = "outer wall"
    INNER_WALL = "inner wall"
    OVERHANG_WALL = "overhang wall"
    THIN_WALL = "thin wall"
    SPARSE_INFILL = "sparse infill"
    SOLID_INFILL = "solid infill"
    TOP_SURFACE = "top surface"
    BOTTOM_SURFACE = "bottom surface"
    SKIN = "top or bottom surface"
    BRIDGE = "bridge"
    INTERNAL_BRIDGE = "internal bridge"
    GAP_FILL = "gap fill"
    IRONING = "ironing"
    SKIRT = "skirt or brim"
    RAFT = "raft"
    SUPPORT = "support"
    SUPPORT_INTERFACE = "support interface"
    PRIME_TOWER = "prime tower"
    TRAVEL = "travel"
    CUSTOM = "custom G-code"


_NAMES: dict[Feature, tuple[str, ...]] = {
    Feature.OUTER_WALL: (
        "external perimeter",
        "outer wall",
        "wall-outer",
        "outer perimeter",
        # KISSlicer's perimeter is the outermost loop.
        "perimeter path",
    ),
    Feature.INNER_WALL: (
        "perimeter",
        "internal perimeter",
        "inner wall",
        "wall-inner",
        "inner perimeter",
        "loop path",
    ),
    Feature.OVERHANG_WALL: ("overhang perimeter", "overhang wall"),
    Feature.THIN_WALL: ("thin wall", "internal single extrusion"),
    Feature.SPARSE_INFILL: (
        "internal infill",
        "sparse infill",
        "fill",
        "infill",
        "sparse infill path",
        "stacked sparse infill path",
    ),
    Feature.SOLID_INFILL: (
        "solid infill",
        "internal solid infill",
        "floating vertical shell",
        "solid-fill",
        "solid layer",
        "solid fill",
        "solid path",
    ),
    Feature.TOP_SURFACE: ("top solid infill", "top surface"),
    Feature.BOTTOM_SURFACE: ("bottom surface",),
    Feature.SKIN: ("skin", "crown path"),
    Feature.BRIDGE: ("bridge infill", "bridge"),
    Feature.INTERNAL_BRIDGE: ("internal bridge infill", "internal bridge"),
    Feature.GAP_FILL: ("gap fill", "gap infill", "gap-fill", "thin fill"),
    Feature.IRONING: ("ironing",),
    Feature.SKIRT: ("skirt", "brim", "skirt/brim", "skirt path"),
    Feature.RAFT: ("raft", "raft path"),
    Feature.SUPPORT: (
        "support material",
        "support",
        "support transition",
        "support (may stack) path",
        "ooze shield",
    ),
    Feature.SUPPORT_INTERFACE: (
        "support material interface",
        "support interface",
        "support-interface",
        "support ironing",
        "support interface path",
        "dense support",
    ),
    Feature.PRIME_TOWER: (
        "wipe tower",
        "prime tower",
        "prime-tower",
        "prime pillar",
        "pillar path",
        "prime pillar path",
        "flush",
    ),
    Feature.TRAVEL: ("travel/ironing path", "destring/wipe/jump path"),
    Feature.CUSTOM: ("custom",),
}
_FEATURES = {name: feature for feature, names in _NAMES.items() for name in names}


def feature_of(name: str) -> Feature | None:
    """Return which feature a slicer's name means, or None where it is not known."""
    return _FEATURES.get(name.strip().lower())


def feature_name(number: int, names: Sequence[str]) -> str:
    """Return the slicer's name of a feature by its number, which is -1 where it is not known."""
    return names[number] if number >= 0 else "unnamed"


def feature_title(name: str) -> str:
    """Return the common name of a feature, with the slicer's own where it is another."""
    feature = feature_of(name)
    if feature is None or name.lower() == feature.value:
        return name if feature is None else feature.value
    return f"{feature.value} ({name})"
