"""Where processes that a test starts find the program, and the tests: in this checkout."""

from __future__ import annotations

import os
from pathlib import Path

__all__ = ["PYTHONPATH"]

_ROOT = Path(__file__).resolve().parents[1]
PYTHONPATH = os.pathsep.join((str(_ROOT / "src"), str(_ROOT)))
"""With the folder of the program: what is installed may be another checkout."""
