"""Choose and thin layers to draw on a page, within bounded memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from stillpath.pipeline.measuring.layers import ERROR_UM, UNKNOWN, LayerTile
from stillpath.pipeline.result import LayerView

__all__ = ["LayerViews"]

_LAYERS_SHOWN = 24
_POINTS_PER_LAYER = 2500
_MOST_HELD = 4
"""Times the points that are shown, so that a layer of several tiles is thinned evenly."""


class LayerViews:
    """Keep a limited number of layers with a limited number of points.

    Parameters
    ----------
    names : sequence of str
        Channels.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._names = list(names)
        self._every = 1
        self._layers: dict[int, LayerTile] = {}

    def add(self, tile: LayerTile) -> None:
        """Add a layer, or more of one."""
        if tile.layer < 0 or tile.layer % self._every:
            return
        part = replace(tile, error=np.where(tile.error == UNKNOWN, 0, tile.error))
        known = self._layers.get(tile.layer)
        whole = part if known is None else _joined(known, part)
        self._layers[tile.layer] = _thinned(whole, _MOST_HELD * _POINTS_PER_LAYER)
        while len(self._layers) > 2 * _LAYERS_SHOWN:
            self._every *= 2
            self._layers = {k: v for k, v in self._layers.items() if k % self._every == 0}

    def views(self) -> list[LayerView]:
        """Return the layers to draw, rising."""
        numbers = sorted(self._layers)
        if len(numbers) > _LAYERS_SHOWN:
            pick = np.linspace(0, len(numbers) - 1, _LAYERS_SHOWN).round().astype(int)
            numbers = [numbers[i] for i in pick]
        return [self._view(_thinned(self._layers[k], _POINTS_PER_LAYER)) for k in numbers]

    def _view(self, tile: LayerTile) -> LayerView:
        return LayerView(
            layer=tile.layer,
            z_mm=tile.z_mm,
            x_mm=np.round(tile.x_mm.astype(float), 3).tolist(),
            y_mm=np.round(tile.y_mm.astype(float), 3).tolist(),
            extruding=(tile.on > 0).tolist(),
            line=tile.line.tolist(),
            contour_um={
                name: np.round(ERROR_UM * row, 1).tolist()
                for name, row in zip(self._names, tile.error, strict=True)
            },
        )


def _joined(first: LayerTile, second: LayerTile) -> LayerTile:
    return replace(
        first,
        x_mm=np.append(first.x_mm, second.x_mm),
        y_mm=np.append(first.y_mm, second.y_mm),
        line=np.append(first.line, second.line),
        error=np.append(first.error, second.error, axis=1),
        feature=np.append(first.feature, second.feature),
        on=np.append(first.on, second.on),
    )


def _thinned(tile: LayerTile, most: int) -> LayerTile:
    """Return a tile of at most so many points.

    Travel is not drawn, so each is one point: where extrusion begins. Stretches of extrusion are
    merged, keeping the largest of their errors. Of more lines than that, every k-th is kept.
    """
    count = len(tile)
    if count <= most:
        return tile
    run = np.concatenate([[0], np.flatnonzero(np.diff(tile.on)) + 1])
    size = np.diff(np.append(run, count))
    prints = np.repeat(tile.on[run] > 0, size)
    # A travel and the line after it belong together.
    pair = (np.arange(len(run)) + prints[0]) // 2
    every = -(-len(run) // most)
    step = count if every > 1 else -(-count // max(most - len(run), 1))
    place = np.arange(count) - np.repeat(run, size)
    first = np.flatnonzero((place == 0) | (prints & (place % step == 0)))
    last = np.append(first[1:], count) - 1
    kept = np.repeat(pair % every == 0, size)[first]
    error = np.maximum.reduceat(tile.error, first, axis=1)
    return replace(
        tile,
        x_mm=tile.x_mm[last[kept]],
        y_mm=tile.y_mm[last[kept]],
        line=tile.line[last[kept]],
        error=error[:, kept],
        feature=tile.feature[last[kept]],
        on=tile.on[last[kept]],
    )
