"""The method and basis of a job that names none, and the sampling time of all jobs.

They have their own module because the command line shows them before it imports numerical code.
"""

from __future__ import annotations

from typing import Final

__all__ = ["DEFAULT_BASIS", "DEFAULT_METHOD", "DT_S"]

DEFAULT_METHOD: Final = "fbf"
DEFAULT_BASIS: Final = "ce-opt"  # control-effort-optimal (compensation/basis.py)
DT_S: Final = 1e-3
"""Sampling time of paths and commands: finer changes contour errors by hundredths of a um."""
