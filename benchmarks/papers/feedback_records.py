"""What the feedback scripts of this folder share: rows with a tolerance and a verdict."""

from __future__ import annotations

import time
from collections.abc import Callable

Row = tuple[str, str, str, str]
"""Quantity, the paper's value, ours, tolerance with verdict and reason."""


def checked(
    quantity: str,
    paper: float,
    ours: float,
    tolerance: float,
    reason: str = "",
    unit: str = "",
    digits: str = ".4g",
) -> Row:
    """A row whose verdict is whether both values lie within the tolerance."""
    verdict = "yes" if abs(ours - paper) <= tolerance else "NO"
    return (
        quantity,
        f"{paper:{digits}} {unit}".strip(),
        f"{ours:{digits}} {unit}".strip(),
        f"within {tolerance:g}: {verdict}" + (f"; {reason}" if reason else ""),
    )


def shown(quantity: str, paper: str, ours: str, reason: str) -> Row:
    """A row that cannot be judged, with the reason."""
    return quantity, paper, ours, reason


def rate(run: Callable[[], object], samples: int) -> str:
    """Million samples per second of wall time, the best of three runs after a first."""
    run()
    took = []
    for _ in range(3):
        start = time.perf_counter()
        run()
        took.append(time.perf_counter() - start)
    return f"{samples / min(took) / 1e6:.1f} million samples/s"
