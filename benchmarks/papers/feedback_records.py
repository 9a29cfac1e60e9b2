"""What the feedback scripts of this folder share: rows, each with its verdict."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

Verdict = Literal[
    "within its tolerance", "MISS", "as derived", "fitted", "not reproduced", "print error", "shown"
]
"""Of a published number: within its tolerance or not, a free number was fitted to it, it does not
come out, or it is printed wrongly. Of others: equal to what follows by other means, or only shown.
"""


@dataclass(frozen=True, slots=True)
class Row:
    """One line: `published` is what the paper prints, and None if it prints nothing."""

    quantity: str
    published: str | None
    ours: str
    verdict: Verdict
    remark: str = ""


def checked(
    quantity: str,
    paper: float,
    ours: float,
    tolerance: float,
    remark: str = "",
    unit: str = "",
    digits: str = ".4g",
) -> Row:
    """A published number against ours."""
    verdict: Verdict = "within its tolerance" if abs(ours - paper) <= tolerance else "MISS"
    said, found = (f"{value:{digits}} {unit}".strip() for value in (paper, ours))
    return Row(quantity, said, found, verdict, _joined(f"within {tolerance:g}", remark))


def derived(
    quantity: str,
    expected: float,
    ours: float,
    tolerance: float,
    remark: str = "",
    unit: str = "",
    digits: str = ".4g",
) -> Row:
    """A number that the paper does not print, against what it must be by other means."""
    verdict: Verdict = "as derived" if abs(ours - expected) <= tolerance else "MISS"
    wanted, found = (f"{value:{digits}} {unit}".strip() for value in (expected, ours))
    return Row(quantity, None, found, verdict, _joined(f"{wanted} within {tolerance:g}", remark))


def stated(quantity: str, published: str, ours: str, holds: bool, remark: str = "") -> Row:
    """What the paper says without a number of its own, or with "about", and whether it holds."""
    return Row(quantity, published, ours, "within its tolerance" if holds else "MISS", remark)


def shown(
    quantity: str, published: str | None, ours: str, remark: str = "", verdict: Verdict = "shown"
) -> Row:
    """A row without a tolerance, and why."""
    return Row(quantity, published, ours, verdict, remark)


def rate(run: Callable[[], object], samples: int) -> str:
    """Million samples per second of wall time, the best of three runs after a first."""
    run()
    took = []
    for _ in range(3):
        start = time.perf_counter()
        run()
        took.append(time.perf_counter() - start)
    return f"{samples / min(took) / 1e6:.1f} million samples/s"


def _joined(*parts: str) -> str:
    return "; ".join(part for part in parts if part)
