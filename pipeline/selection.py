"""Select the sections worth compensating: visible ones, and the motion before them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from stillpath.gcode.dividing import divided, sections
from stillpath.gcode.pieces import LeftOut, Piece, VerbatimPart
from stillpath.gcode.slicers.features import Feature, feature_of
from stillpath.models.machine import Machine
from stillpath.models.runs import runs
from stillpath.pipeline.options import Options, Where
from stillpath.pipeline.result import GroupFigures

__all__ = ["Selection", "TooLarge", "smaller"]

_WALLS = frozenset({Feature.OUTER_WALL, Feature.OVERHANG_WALL, Feature.THIN_WALL})
_VISIBLE = _WALLS | {Feature.TOP_SURFACE, Feature.SKIN, Feature.IRONING, Feature.BOTTOM_SURFACE}
_CHOSEN = {"visible": _VISIBLE, "walls": _WALLS}
_TOLERANCES_UM = (8.0, 12.0, 16.0)
"""Tried in turn where a file is too large; larger ones cost as much as leaving out surfaces."""
_WORTH_S = 0.5
"""Shorter stretches are not worth the lines that end a stream and begin the next one."""


class TooLarge(Exception):
    """The file being written exceeds `Options.max_mb`."""


def smaller(options: Options) -> Options | None:
    """Return options that write a smaller file, or None where there are none.

    What costs least is given up first (docs/benchmarks.md, "Compensated where it shows"): hidden
    features, then accuracy, then surfaces.
    """
    if options.where == "all":
        return options.model_copy(update={"where": "visible"})
    for tolerance_um in _TOLERANCES_UM:
        if tolerance_um > options.tolerance_um:
            return options.model_copy(update={"tolerance_um": tolerance_um})
    return options.model_copy(update={"where": "walls"}) if options.where == "visible" else None


class Selection:
    """Leave sections with invisible features as sliced.

    A section (`gcode.dividing`) is compensated as a whole if it prints any selected feature, or one
    that the slicer does not name. Travel right before it is compensated too, as its vibration
    would last into the wall.

    Parameters
    ----------
    where : {"all", "visible", "walls"}
        `walls`: outer, overhanging and thin walls. `visible`: those, and surfaces at the top and
        at the bottom.
    """

    def __init__(self, where: Where, machine: Machine) -> None:
        self._machine = machine
        self._features = _CHOSEN.get(where)
        self._counts: dict[int, bool] = {-1: True}
        """Whether a feature is selected, by its number."""

    def divide(
        self, item: Piece | VerbatimPart, names: Sequence[str]
    ) -> Iterator[Piece | VerbatimPart | LeftOut]:
        """Split a piece into compensated and left-out sections; other items pass through.

        Parameters
        ----------
        names : sequence of str
            The slicer's names, indexed by feature number.
        """
        if self._features is None or not isinstance(item, Piece):
            yield item
        else:
            yield from divided(item, self._wanted(item, names), self._machine)

    def rms_um(self, features: Sequence[GroupFigures]) -> dict[str, float]:
        """Return the rms contour error of what is compensated, by channel."""
        ours = [one for one in features if self._named(one.name)]
        total_s = sum(one.seconds for one in ours)
        names = ours[0].contour_rms_um if ours else ()
        return {
            name: float(
                np.sqrt(sum(g.seconds * g.contour_rms_um[name] ** 2 for g in ours) / total_s)
            )
            for name in names
            if total_s > 0.0
        }

    def _wanted(self, piece: Piece, names: Sequence[str]) -> NDArray[np.bool_]:
        """Mark the sections of a piece that are compensated."""
        feeds, feature = piece.phases.prints, piece.moves.feature
        counts = np.array([self._shows(int(k), names) for k in feature])
        rows = sections(piece)
        prints = np.array([np.any(feeds[a:b]) for a, b in rows])
        wanted = np.array([np.any((feeds & counts)[a:b]) for a, b in rows])
        for k in range(len(rows) - 2, -1, -1):
            wanted[k] |= wanted[k + 1] and not prints[k]
        start_s = piece.phases.t_s - piece.phases.t_s[0]
        for first, last in runs(~wanted):
            begin_s = float(start_s[rows[first][0]])
            end = rows[last - 1][1]
            end_s = float(start_s[end]) if end < len(start_s) else piece.phases.duration_s
            if end_s - begin_s < _WORTH_S:
                wanted[first:last] = True
        return wanted

    def _shows(self, number: int, names: Sequence[str]) -> bool:
        if number not in self._counts:
            self._counts[number] = self._named(names[number])
        return self._counts[number]

    def _named(self, name: str) -> bool:
        feature = feature_of(name)
        return self._features is None or feature is None or feature in self._features
