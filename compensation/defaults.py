"""The method and basis of a job that names none.

They have their own module because the command line shows them before it imports numerical code.
"""

from __future__ import annotations

from typing import Final

__all__ = ["DEFAULT_BASIS", "DEFAULT_METHOD"]

DEFAULT_METHOD: Final = "fbf"
DEFAULT_BASIS: Final = "ce-opt"  # control-effort-optimal (compensation/basis.py)
