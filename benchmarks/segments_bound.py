"""How far the segments of a stream are from the fewest that could follow the command.

A straight segment of constant speed stays within the tolerance of all samples that it passes. The
longest such segment from each place on, free to begin anywhere, is found by linear programming;
segments that must also begin where the last one ended cannot be fewer. Beside that bound: what the
encoder wrote for the same seconds.

    python benchmarks/segments_bound.py cura_ender3_gear24
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from inputs import find_input, plain_copy, shared_folder
from scipy.optimize import linprog

from stillpath.gcode._segment_kernels import path_directions
from stillpath.gcode.segments import (
    ACROSS_SHARE,
    ALONG_SHARE,
    ErrorFilter,
    Segments,
    fit_segments,
)
from stillpath.gcode.timeline import Timeline
from stillpath.models.arrays import Array
from stillpath.models.store import load_machine
from stillpath.pipeline import piece_compensator
from stillpath.pipeline.compensate import compensate_file
from stillpath.pipeline.options import Options

_MACHINES = ("ender3", "voron-v0", "voron-v24-250", "annex-k3")
_STRETCHES, _SECONDS = 12, 1.0
_SHORTEST_S = 0.3


@dataclass(frozen=True, slots=True, eq=False)
class Stretch:
    """A part of a command, shape (2, n), its path's directions, and the segments written for it.

    `tolerance_mm` is that along the path and that across it.
    """

    command_mm: Array
    along: Array
    tolerance_mm: Array
    dt_s: float
    written: int


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", nargs="?", default="cura_ender3_gear24")
    parser.add_argument("--machines", nargs="+", default=list(_MACHINES))
    parser.add_argument("--shared", type=Path, help="default: $STILLPATH_SHARED or ../shared")
    given = parser.parse_args()
    print(f"{'machine':16}{'tolerance, um':>18}{'written/s':>11}{'least/s':>9}{'ratio':>7}")
    with tempfile.TemporaryDirectory(prefix="stillpath-segments-") as folder:
        file = plain_copy(find_input(given.file, shared_folder(given.shared)), Path(folder))
        for machine in given.machines:
            some = drawn(list(stretches(file, machine, Path(folder) / "out.gcode")))
            seconds = sum(one.command_mm.shape[1] * one.dt_s for one in some)
            written = sum(one.written for one in some) / seconds
            least = sum(fewest(one) for one in some) / seconds
            along_mm, across_mm = some[0].tolerance_mm
            tolerance = f"{1e3 * along_mm:.2f} / {1e3 * across_mm:.2f}"
            print(f"{machine:16}{tolerance:>18}{written:11.0f}{least:9.0f}{written / least:7.2f}")


def stretches(file: Path, machine: str, target: Path) -> Iterator[Stretch]:
    """Compensate a file and return the beginnings of its longer stretches."""
    found: list[Stretch] = []

    def recorded(
        timeline: Timeline,
        command_mm: Array,
        tolerance_mm: float,
        error_filter: ErrorFilter,
        **others: Any,
    ) -> Segments:
        fitted = fit_segments(timeline, command_mm, tolerance_mm, error_filter, **others)
        used = error_filter.share * tolerance_mm * np.array([ALONG_SHARE, ACROSS_SHARE])
        found.extend(_beginnings(timeline, command_mm[:2], fitted, used))
        return fitted

    with patch.object(piece_compensator, "fit_segments", recorded):
        compensate_file(file, target, load_machine(machine), Options(), cache_dir=target.parent)
    yield from found


def _beginnings(
    timeline: Timeline, command_mm: Array, fitted: Segments, tolerance_mm: Array
) -> Iterator[Stretch]:
    along = np.empty_like(command_mm)
    path_directions(timeline.position_mm[:2], along)
    for i, group in enumerate(timeline.groups):
        start_s, end_s = timeline.start_s[i], timeline.end_s[i]
        if group.rest or end_s - start_s < _SHORTEST_S:
            continue
        end_s = min(end_s, start_s + _SECONDS)
        first, last = round(start_s / timeline.dt_s), round(end_s / timeline.dt_s)
        written = np.count_nonzero((fitted.group == i) & (fitted.end_s <= end_s))
        part = slice(first, last + 1)
        yield Stretch(
            command_mm[:, part].copy(), along[:, part], tolerance_mm, timeline.dt_s, int(written)
        )


def fewest(stretch: Stretch) -> int:
    """Return the fewest segments, each free to begin anywhere within the tolerance."""
    samples = stretch.command_mm.shape[1]
    begin = count = 0
    length = 8
    while begin < samples - 1:
        # Doubled until one fails, then halved in between: a longer one fails as well.
        low, high = 1, max(2, length)
        while begin + high < samples and _straight(stretch, begin, begin + high):
            low, high = high, 2 * high
        high = min(high, samples - begin)
        while high - low > 1:
            middle = (low + high) // 2
            if _straight(stretch, begin, begin + middle):
                low = middle
            else:
                high = middle
        begin, count, length = begin + low, count + 1, low
    return count


def _straight(stretch: Stretch, first: int, last: int) -> bool:
    """Whether one segment stays within the tolerance of samples first to last."""
    part = slice(first, last + 1)
    # In um from the first sample, for the solver's tolerances.
    command = 1e3 * (stretch.command_mm[:, part] - stretch.command_mm[:, [first]])
    along = stretch.along[:, part]
    k = np.arange(command.shape[1], dtype=float)
    rows, limits = [], []
    for direction, tolerance_um in zip(
        (along, np.stack([-along[1], along[0]])), 1e3 * stretch.tolerance_mm, strict=True
    ):
        row = np.stack([direction[0], direction[0] * k, direction[1], direction[1] * k], axis=1)
        at = np.sum(direction * command, axis=0)
        rows += [row, -row]
        limits += [tolerance_um + at, tolerance_um - at]
    found = linprog(np.zeros(4), np.vstack(rows), np.concatenate(limits), bounds=[(None, None)] * 4)
    return bool(found.status == 0)


def drawn(found: list[Stretch]) -> list[Stretch]:
    """Draw some, always the same."""
    chosen = np.random.default_rng(0).choice(len(found), min(_STRETCHES, len(found)), False)
    return [found[i] for i in sorted(chosen)]


if __name__ == "__main__":
    main()
