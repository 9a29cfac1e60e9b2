"""Finding the slicers that tests run, if they are there.

`PRUSA_SLICER` and `CURA_ENGINE` name the programs, `CURA_DEFINITIONS` the folder of
`fdmprinter.def.json`; else they are looked for on the PATH and where Debian puts them.
`get-slicers` beside this file unpacks Debian's.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

__all__ = ["NOT_HERE", "box", "cura_definitions", "cura_engine", "prusa_slicer"]

NOT_HERE = "slicer not here"


def prusa_slicer() -> str:
    """Return the program, or skip the test."""
    return _program("PRUSA_SLICER", "prusa-slicer")


def cura_engine() -> str:
    """Return the program, or skip the test."""
    return _program("CURA_ENGINE", "CuraEngine")


def cura_definitions() -> Path:
    """Return the folder of Cura's definitions of printers, or skip the test."""
    folder = Path(os.environ.get("CURA_DEFINITIONS", "/usr/share/cura/resources/definitions"))
    if not (folder / "fdmprinter.def.json").is_file():
        pytest.skip(f"{NOT_HERE}: CURA_DEFINITIONS, or Debian's package cura")
    return folder


def box(path: Path, x: float, y: float, z: float) -> Path:
    """Write a box as STL and return its path."""
    corners = [(i * x, j * y, k * z) for k in (0, 1) for j in (0, 1) for i in (0, 1)]
    faces = ["0462", "1375", "0154", "2673", "0231", "4576"]  # counter-clockwise from outside
    lines = ["solid box"]
    for face in faces:
        a, b, c, d = (corners[int(corner)] for corner in face)
        for triangle in ((a, b, c), (a, c, d)):
            lines += ["facet normal 0 0 0", "outer loop"]
            lines += ["vertex {} {} {}".format(*corner) for corner in triangle]
            lines += ["endloop", "endfacet"]
    path.write_text("\n".join([*lines, "endsolid box", ""]))
    return path


def _program(variable: str, name: str) -> str:
    found = os.environ.get(variable) or shutil.which(name)
    if not found:
        pytest.skip(f"{NOT_HERE}: {variable}, or {name} on the PATH")
    return found
