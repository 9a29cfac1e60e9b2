"""The one place where the version is written."""

from __future__ import annotations

import hashlib
import os
from functools import lru_cache
from pathlib import Path

__all__ = ["__version__", "build"]

__version__ = "0.1.0"

_COMPUTING = (
    "applications",
    "compensation",
    "gcode",
    "models",
    "pipeline",
    "reports",
    "simulation",
)
"""Layers that results depend on."""


@lru_cache(maxsize=1)
def build() -> str:
    """Return the version, with a digest of the code that computes: ``0.1.0+5f2c8e0e1a2b``.

    Equal builds give equal results. The version alone does not say so: a checkout that is updated
    keeps it until the next release.

    Notes
    -----
    The code is read once, so a process that outlives an update is to ask when it starts.
    """
    digest = hashlib.sha256()
    package = Path(__file__).parent
    for layer in _COMPUTING:
        for folder, folders, names in os.walk(package / layer):
            folders.sort()
            for name in sorted(names):
                if name.endswith(".py"):
                    path = Path(folder, name)
                    content = path.read_bytes()
                    place = path.relative_to(package).as_posix()
                    digest.update(f"{place}\0{len(content)}\0".encode() + content)
    return f"{__version__}+{digest.hexdigest()[:12]}"
