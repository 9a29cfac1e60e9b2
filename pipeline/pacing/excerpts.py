"""Take excerpts of some seconds of every class of moves from all over a file.

Memory is bounded: each class keeps a limited number of excerpts. When there are more, every second
one is dropped, and from then on only every second one is taken. The same file gives the same
excerpts.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from stillpath.gcode.dialect import Dialect
from stillpath.gcode.interpreter import Interpreter
from stillpath.gcode.pacing import AS_SLICED, FirstLayer, move_classes
from stillpath.gcode.pieces import Piece, VerbatimPart
from stillpath.gcode.splitter import Splitter, excerpt
from stillpath.gcode.types import Moves, Phases
from stillpath.models.machine import Machine
from stillpath.models.schedule import OperatingPoint
from stillpath.pipeline.operating_point import Operation

__all__ = ["Excerpt", "FileExcerpts", "take_excerpts"]

_LASTS_S = 4.0
_TOTAL_S = 120.0
_FEWEST, _MOST = 3, 12
_SPREAD = 0.6180339887498949
"""Golden ratio: spreads excerpts within pieces without aliasing with the file."""


@dataclass(frozen=True, slots=True)
class Excerpt:
    """Some moves of a file and their operating point."""

    piece: Piece
    classes: NDArray[np.int32]
    point: OperatingPoint


@dataclass(frozen=True, slots=True)
class FileExcerpts:
    """Excerpts of a file."""

    excerpts: list[Excerpt]
    first_layer: FirstLayer


@dataclass(slots=True)
class _Places:
    """Excerpts of one class."""

    stride: int = 1
    seen: int = 0
    kept: list[tuple[int, int, int, Excerpt]] = field(default_factory=list)

    @property
    def due(self) -> bool:
        return self.seen % self.stride == 0

    def add(self, where: tuple[int, int, int], taken: Excerpt) -> None:
        self.kept.append((*where, taken))
        if len(self.kept) > 2 * _MOST:
            self.kept = self.kept[::2]
            self.stride *= 2

    def some(self, count: int) -> list[tuple[int, int, int, Excerpt]]:
        if len(self.kept) <= count:
            return self.kept
        return [self.kept[i] for i in np.linspace(0, len(self.kept) - 1, count).round().astype(int)]


def take_excerpts(
    source: BinaryIO,
    machine: Machine,
    dialect: Dialect,
    progress: Callable[[float], None] | None = None,
) -> FileExcerpts:
    """Read a file to its end and take excerpts of all moves whose pace may change.

    Parameters
    ----------
    source : BinaryIO
        At its beginning.
    progress : callable, optional
        Receives the bytes read so far.
    """
    operation = Operation(machine)
    places: dict[tuple[int, int], _Places] = {}
    first_layer = FirstLayer(-1)
    for number, item in enumerate(_items(source, machine, dialect, progress)):
        first_layer = _seen(first_layer, item.moves)
        point = operation.at(item.moves)
        operation.passed(item.moves)
        if isinstance(item, Piece):
            _take(item, number, point, places, machine, first_layer)
    # Whether and how the file marks its layers is unknown before the second layer begins.
    wanted = [one for (below, _), one in sorted(places.items()) if below == first_layer.below]
    each = int(np.clip(_TOTAL_S / _LASTS_S / max(len(wanted), 1), _FEWEST, _MOST))
    chosen = {entry[:3]: entry[3] for one in wanted for entry in one.some(each)}
    return FileExcerpts([_above(chosen[key], first_layer) for key in sorted(chosen)], first_layer)


def _items(
    source: BinaryIO, machine: Machine, dialect: Dialect, progress: Callable[[float], None] | None
) -> Iterator[Piece | VerbatimPart]:
    reader, splitter = Interpreter(machine, dialect=dialect), Splitter(machine)
    for block in reader.blocks(source):
        yield from splitter.push(block)
        if progress is not None:
            progress(float(source.tell()))
    yield from splitter.flush()


def _seen(known: FirstLayer, moves: Moves) -> FirstLayer:
    """Return what is known about the first layer after these moves."""
    below = max(known.below, min(int(np.max(moves.layer, initial=-1)), 1))
    # What is printed before the first mark, such as a purge line, counts only where there is none.
    z_mm = -np.inf if known.below < 0 <= below else known.z_mm
    prints = moves.prints & (moves.layer >= min(below, 0))
    if np.isfinite(z_mm) or not np.any(prints):
        return FirstLayer(below, z_mm)
    return FirstLayer(below, float(moves.end_mm[np.argmax(prints), 2]))


def _take(
    piece: Piece,
    number: int,
    point: OperatingPoint,
    places: dict[tuple[int, int], _Places],
    machine: Machine,
    first_layer: FirstLayer,
) -> None:
    """Take the excerpts of a piece that are due."""
    classes = move_classes(piece.moves, first_layer)
    for one in np.unique(classes[classes != AS_SLICED]).tolist():
        place = places.setdefault((first_layer.below, one), _Places())
        if place.due:
            rows = np.flatnonzero(classes == one)
            row = int(rows[int(len(rows) * (place.seen * _SPREAD % 1.0))])
            first, last = _around(piece.phases, row)
            part = excerpt(piece, first, last, machine)
            if len(part.phases) == len(part.moves):
                place.add((number, first, last), Excerpt(part, classes[first:last], point))
        place.seen += 1


def _around(phases: Phases, row: int) -> tuple[int, int]:
    """Return rows [first, last) around one, from rest to rest if there are rests nearby."""
    xy, begin_s, end_s = phases.moves_xy, phases.t_s, phases.end_s
    starts = np.flatnonzero(xy & np.append(True, ~xy[:-1]))
    ends = np.flatnonzero(xy & np.append(~xy[1:], True))
    first = int(starts[np.searchsorted(starts, row, "right") - 1])
    if begin_s[first] < begin_s[row] - 0.5 * _LASTS_S:
        first = int(np.searchsorted(begin_s, begin_s[row] - 0.25 * _LASTS_S))
        first += int(np.argmax(xy[first:]))
    last = max(int(np.searchsorted(end_s, begin_s[first] + _LASTS_S, "right")) - 1, row)
    rest = int(np.searchsorted(ends, last, "right")) - 1
    if rest >= 0 and ends[rest] >= row and end_s[ends[rest]] > begin_s[first] + 0.5 * _LASTS_S:
        return first, int(ends[rest]) + 1
    while not xy[last]:
        last -= 1
    return first, last + 1


def _above(taken: Excerpt, first_layer: FirstLayer) -> Excerpt:
    classes = move_classes(taken.piece.moves, first_layer)
    return Excerpt(taken.piece, classes, taken.point)
