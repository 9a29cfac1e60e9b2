"""Exports for Klipper's extra that are not what they should be, and what is said of them."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

from stillpath.applications.live.export import export_digest

__all__ = ["HOSTILE"]


def _unsigned(change: Callable[[dict[str, Any]], None]) -> Callable[[dict[str, Any]], str]:
    """Change an export and leave its digest as it was."""

    def made(given: dict[str, Any]) -> str:
        change(given)
        return json.dumps(given)

    return made


def _signed(change: Callable[[dict[str, Any]], None]) -> Callable[[dict[str, Any]], str]:
    """Change an export and sign it anew."""

    def made(given: dict[str, Any]) -> str:
        change(given)
        given["digest"] = export_digest(given)
        return json.dumps(given)

    return made


def _taps(change: Callable[[list[float]], Any]) -> Callable[[dict[str, Any]], None]:
    return lambda given: change(given["axes"]["x"]["taps"])


HOSTILE: dict[str, tuple[Callable[[dict[str, Any]], str], str]] = {
    "truncated": (lambda g: json.dumps(g)[:-200], "is not a whole export"),
    "empty": (lambda g: "", "is not a whole export"),
    "a list": (lambda g: "[1]", "is not an export for this version"),
    "nested": (lambda g: "[" * 90_000, "is not a whole export"),
    "too large": (lambda g: json.dumps(g) + " " * 300_000, "larger than any export"),
    "changed": (_unsigned(_taps(lambda t: t.__setitem__(3, 0.2))), "its digest differs"),
    "foreign": (_signed(lambda g: g.update(schema="serval/1")), "is not an export for"),
    "kinematics": (_signed(lambda g: g.update(kinematics="corexy")), "the export is for corexy"),
    "delta": (_signed(lambda g: g.update(kinematics="delta")), "the export is for delta"),
    "limits": (
        _signed(lambda g: g["limits"].update(max_accel_mm_s2=50_000.0)),
        "max_accel is 5000 in printer.cfg and 50000 in the export",
    ),
    "NaN": (
        lambda g: json.dumps(g).replace('"taps": [', '"taps": [NaN, ', 1),
        "the export holds NaN",
    ),
    "infinite": (
        lambda g: json.dumps(g).replace('"taps": [', '"taps": [1e999, ', 1),
        "not JSON compliant",
    ),
    "moves": (_signed(_taps(lambda t: t.__setitem__(80, t[80] + 0.01))), "do not sum to 1"),
    "late": (_signed(_taps(lambda t: t.reverse() or t.insert(0, t.pop()))), "in time"),
    "words": (_signed(_taps(lambda t: t.__setitem__(0, "1"))), "tap is not a number"),
    "no taps": (_signed(lambda g: g["axes"].pop("y")), "is not a whole export"),
    "wild": (
        _signed(_taps(lambda t: (t.__setitem__(0, t[0] + 49), t.__setitem__(160, t[160] - 49)))),
        "",
    ),
}
