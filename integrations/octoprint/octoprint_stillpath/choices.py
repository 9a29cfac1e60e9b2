"""What is asked of Stillpath: from the settings and the name of a file."""

from __future__ import annotations

import mmap
import re
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Any

from .client import Failure

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path

__all__ = [
    "DEFAULTS",
    "MARK",
    "METHODS",
    "ROBUST",
    "is_result",
    "is_stamped",
    "is_taken",
    "machine_for",
    "options_of",
    "result_name",
    "timeout_of",
]

METHODS = (
    ("fbf", "fbf: the path kept in spite of vibration"),
    ("advise", "advise: geometry untouched, firmware shaper and accelerations chosen"),
    ("zpetc", "zpetc"),
    ("zmetc", "zmetc"),
    ("ebzpetc", "ebzpetc"),
    ("npz-ignore", "npz-ignore"),
    ("ts", "ts"),
    ("shaper:zv", "shaper: zv"),
    ("shaper:mzv", "shaper: mzv"),
    ("shaper:ei", "shaper: ei"),
    ("shaper:2hump_ei", "shaper: 2hump_ei"),
    ("shaper:3hump_ei", "shaper: 3hump_ei"),
)
ROBUST = (
    ("auto", "automatic: what the measurement bears"),
    ("off", "the nominal plant"),
    ("ensemble", "the set of plants"),
    ("minimax", "the worst of the set"),
)
DEFAULTS: dict[str, Any] = {
    "where": "server",
    "server": "http://127.0.0.1:8000",
    "key": "",
    "command": "stillpath",
    "machines": [],
    "machine": "",
    "method": "fbf",
    "robust": "auto",
    "tolerance_um": 2.0,
    "budget_um": "",
    "times": "new",
    "automatic": True,
    "print_after": False,
    "timeout_s": 60.0,
}
MARK = ".sp"
"""Stands before the suffix of what was made."""

_SUFFIXES = (".gcode", ".gco", ".g", ".bgcode")
# As the service looks for it: at the beginning of a comment.
_STAMP = re.compile(
    rb"[^;\n]*(?:; ?stillpath(?:| advise|, held back):|; Processed by stillpath +\S)"
)


def is_taken(name: str) -> bool:
    """Return whether a file is of a kind that can be compensated, by its name."""
    return name.lower().endswith(_SUFFIXES)


def is_result(name: str) -> bool:
    """Return whether a name is one that `result_name` gives."""
    return is_taken(name) and name.rpartition(".")[0].lower().endswith(MARK)


def result_name(name: str) -> str:
    """Return the name of what is made of a file: ``part.sp.gcode`` of ``part.gcode``.

    The suffix stays, so that files that differ in it only do not meet.
    """
    stem, dot, suffix = name.rpartition(".")
    return f"{stem}{MARK}{dot}{suffix}"


def is_stamped(path: Path) -> bool:
    """Return whether G-code says that Stillpath made it; in a packed file it cannot be seen."""
    with path.open("rb") as file:
        if not path.stat().st_size:
            return False
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as text:
            at = text.find(b"stillpath")
            while at >= 0:
                begin = text.rfind(b"\n", 0, at) + 1
                if _STAMP.match(text[begin : at + 100]):
                    return True
                at = text.find(b"stillpath", at + 1)
    return False


def machine_for(profile: str, rows: Iterable[Mapping[str, Any]], otherwise: str = "") -> str:
    """Return the machine of a printer profile, or an empty text.

    Parameters
    ----------
    profile : str
        Name of the printer profile.
    rows : iterable of dict
        Each with `profile`, in which ``*`` stands for anything, and `machine`. An exact name
        counts more than one with ``*``; then the first counts.
    otherwise : str
        Machine of all other profiles.
    """
    pairs = [
        (str(row.get("profile") or "").strip(), str(row.get("machine") or "").strip())
        for row in rows
        if isinstance(row, dict)
    ]
    pairs = [pair for pair in pairs if all(pair)]
    for name, machine in pairs:
        if name == profile:
            return machine
    for name, machine in pairs:
        if fnmatchcase(profile, name):
            return machine
    return otherwise.strip()


def options_of(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of a job; what is empty is left to Stillpath.

    Raises
    ------
    Failure
        If a number is none. Limits are Stillpath's to know.
    """
    options: dict[str, Any] = {}
    for name in ("method", "times"):
        if str(settings.get(name) or "").strip():
            options[name] = str(settings[name]).strip()
    if options.get("method") == "fbf" and settings.get("robust"):
        options["robust"] = settings["robust"]
    for name, title in (("tolerance_um", "Tolerance"), ("budget_um", "Budget")):
        value = str("" if settings.get(name) is None else settings[name]).strip()
        if value:
            options[name] = _number(value, title)
    return options


def timeout_of(settings: Mapping[str, Any]) -> float:
    """Return for how long a silent server is waited for [s]."""
    value = _number(str(settings.get("timeout_s") or DEFAULTS["timeout_s"]), "Patience")
    if not 1 <= value <= 86_400:
        raise Failure(f"the setting Patience is {value:g} s; it must be 1 to 86400")
    return value


def _number(text: str, title: str) -> float:
    try:
        return float(text.replace(",", "."))
    except ValueError:
        raise Failure(f"the setting {title} is {text!r}, which is not a number") from None
