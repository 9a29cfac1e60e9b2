"""Samples of a file: what is taken, and what is known of the first layer."""

from __future__ import annotations

import io

import numpy as np
import pytest

from stillpath.gcode.pacing import AS_SLICED, FirstLayer
from stillpath.models.store import load_machine
from stillpath.pipeline.file_dialect import dialect_for
from stillpath.pipeline.pacing.excerpts import FileExcerpts, take_excerpts

MACHINE = load_machine("ender3")
PURGE = "G28\nM83\nG1 Z.3 F600\nG1 X5 Y5 F6000\nG1 Y80 E8 F1500\n"


def layer(z_mm: float, mark: str = ";LAYER_CHANGE\n") -> str:
    ring = "G1 X60 Y40 E1 F3600\nG1 X60 Y60 E1\nG1 X40 Y60 E1\nG1 X40 Y40.4 E1\n"
    return f"{mark}G1 Z{z_mm} F600\nG1 X40 Y40 F9000\n;TYPE:Perimeter\n{4 * ring}"


def taken(text: str) -> FileExcerpts:
    return take_excerpts(io.BytesIO(text.encode()), MACHINE, dialect_for(MACHINE))


def heights(excerpts: FileExcerpts) -> set[float]:
    """Heights of all moves whose pace may change."""
    found: set[float] = set()
    for one in excerpts.excerpts:
        free = one.classes != AS_SLICED
        found |= set(np.round(one.piece.moves.end_mm[free, 2], 3).tolist())
    return found


@pytest.mark.parametrize("between", ["", "G28\n"])
def test_the_first_layer_is_left_alone(between: str) -> None:
    """The purge line is higher, and belongs to no layer."""
    found = taken(PURGE + between + layer(0.2) + layer(0.4) + layer(0.6))
    assert found.first_layer == FirstLayer(1, 0.2)
    assert min(heights(found)) == 0.4


def test_a_print_of_one_layer_has_nothing_else() -> None:
    found = taken(PURGE + layer(0.2))
    assert found.first_layer == FirstLayer(0, 0.2)
    assert heights(found) == set()


def test_every_object_has_a_first_layer() -> None:
    found = taken(PURGE + 2 * (layer(0.2) + layer(0.4)))
    assert heights(found) == {0.4}


def test_without_marks_all_up_to_the_first_height_is_left_alone() -> None:
    found = taken(PURGE + "".join(layer(z_mm, mark="") for z_mm in (0.2, 0.4, 0.6)))
    assert found.first_layer == FirstLayer(-1, 0.3)
    assert min(heights(found)) == 0.4
