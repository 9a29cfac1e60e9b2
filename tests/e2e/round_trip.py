"""A file and its compensated twin, held against each other line by line and in sum."""

from __future__ import annotations

import gzip
import os
import re
from pathlib import Path

import numpy as np

from stillpath.gcode.containers.opening import open_text
from stillpath.gcode.firmware.registry import adapter
from stillpath.models.machine import AxisTravel, Machine
from tests.gcode.plain_reader import is_motion, read
from tests.gcode.states import timeless

__all__ = ["corpus_files", "corpus_folder", "excerpt", "flaws", "made_to_fit", "text_of"]

_HELD = b"; stillpath, held back: "
_OURS = re.compile(
    rb"; stillpath|; Processed by stillpath|SET_VELOCITY_LIMIT VEL|SET_INPUT_SHAPER "
    rb"|G9[01]$|M8[23]$"
    rb"|G4 P0 ; stand still|M400(?: ; stand still)?$|G1(?: F[\d.]+)?$|G92 E[-\d.]+$"
    rb"|M20[1345] |M566 |M593 |M572 |M900 "
)
"""Lines that a stream may add: limits, modes, the firmware's shaper, a stand-still or a fence, a
feedrate, what E is counted from."""
_FILAMENT_MM = 1e-4


def corpus_folder() -> Path:
    """Return where the corpus lies; beside the checkout, if nothing else is said."""
    shared = os.environ.get("STILLPATH_SHARED", Path(__file__).parents[3] / "shared")
    return Path(shared) / "corpus"


def corpus_files() -> list[str]:
    """Return the names of the corpus' files; none if it is not there."""
    folder = corpus_folder()
    files = (p for p in sorted(folder.glob("*/*.*")) if p.suffix != ".md")
    return [str(p.relative_to(folder)) for p in files]


def text_of(path: Path) -> bytes:
    """Return the G-code of a file, whatever it is packed in."""
    if path.suffix == ".gz":
        return gzip.decompress(path.read_bytes())
    with open_text(path) as container:
        return container.text.read()


def excerpt(data: bytes, head: int = 1500, tail: int = 300) -> bytes:
    """Return the first and the last lines of a file, its odd end included."""
    lines = data.splitlines(keepends=True)
    return data if len(lines) <= head + tail else b"".join(lines[:head] + lines[-tail:])


def made_to_fit(machine: Machine, data: bytes) -> Machine:
    """Return the machine with no more travel than the file needs, rounded up to centimetres."""
    reading = read(data, machine.firmware.kind)
    travel = {}
    for k, axis in enumerate(("x", "y", "z")):
        low, high = min(reading.low_mm[k], 0.0), max(reading.high_mm[k], 0.0)
        # Few sizes, so that the shaper is tuned for few machines; arcs reach beyond their ends.
        size = 400.0 if max(-low, high) <= 390.0 else 10_000.0
        travel[axis] = AxisTravel(min_mm=-size, max_mm=size)
    return machine.model_copy(update={"travel": travel})


def flaws(data: bytes, written: bytes, machine: Machine) -> list[str]:
    """Say what is not as it was, beside what the documents say."""
    before, after = (read(text, machine.firmware.kind) for text in (data, written))
    step_mm = np.array(adapter(machine).step_mm)
    found = _line_flaws(data, written)
    for tool in {*before.extruded_mm, *after.extruded_mm}:
        gap = after.extruded_mm[tool] - before.extruded_mm[tool]
        if abs(gap) > _FILAMENT_MM:
            found.append(f"tool {tool} feeds {gap:+.6f} mm more")
    if before.modes() != after.modes():
        found.append(f"ends with {after.modes()}, not {before.modes()}")
    if b"RESTORE_GCODE_STATE" in data:
        return found  # the plain reader does not know where that leads
    gap = np.abs(np.subtract(after.position_mm, before.position_mm))
    if np.any(gap > 1e-5 + step_mm[:3]):
        found.append(f"ends at {after.position_mm}, not {before.position_mm}")
    if abs(after.feed_mm_min - before.feed_mm_min) > 1e-3:
        found.append(f"ends with F{after.feed_mm_min}, not F{before.feed_mm_min}")
    for k, axis in enumerate("xyz"):
        travel = machine.travel[axis]  # type: ignore[index]
        if after.moves and after.low_mm[k] < travel.min_mm - 1e-6:
            found.append(f"{axis} goes down to {after.low_mm[k]}")
        if after.moves and after.high_mm[k] > travel.max_mm + 1e-6:
            found.append(f"{axis} goes up to {after.high_mm[k]}")
    return found


def _line_flaws(data: bytes, written: bytes) -> list[str]:
    """Look for every line that is no move in the written file, in order; the rest must be ours."""
    wanted = [x for x in data.splitlines() if not is_motion(x)]
    present = [x for x in written.splitlines() if not is_motion(x)]
    found, at = [], 0
    for line in wanted:
        behind = at
        while behind < len(present) and not _is_same(line, present[behind]):
            behind += 1
        if behind == len(present):
            found.append(f"{line!r} is missing")
            continue
        found += [f"{x!r} is new" for x in present[at:behind] if not _OURS.match(x)]
        at = behind + 1
    found += [f"{x!r} is new" for x in present[at:] if not _OURS.match(x)]
    return found[:10]


def _is_same(line: bytes, other: bytes) -> bool:
    return other in (line, _HELD + line) or timeless(line) == timeless(other)
