"""Write the layers of a print: tiles in layers.bin, and their index layers.json.

The format is described in docs/layers.md.
"""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO

import numpy as np

from stillpath.gcode.slicers.features import feature_title
from stillpath.pipeline.files import replacing
from stillpath.pipeline.measuring.layers import ERROR_UM, UNKNOWN, LayerTile

__all__ = ["INDEX_NAME", "TILES_NAME", "LayerWriter", "round_scale", "written_layers"]

INDEX_NAME, TILES_NAME = "layers.json", "layers.bin"
_VERSION = 1
_UNNAMED = 255
_SCALE_QUANTILE = 0.99


@contextlib.contextmanager
def written_layers(folder: Path, channels: Sequence[str]) -> Iterator[LayerWriter]:
    """Yield a writer of layers; both files are put in place when the block succeeds.

    Parameters
    ----------
    folder : Path
        Made if it does not exist.

    Raises
    ------
    OSError
        The folder or disk refuses them.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with (
        replacing(folder / TILES_NAME) as tiles_path,
        replacing(folder / INDEX_NAME) as index_path,
        tiles_path.open("wb") as tiles,
        index_path.open("w", encoding="utf-8", newline="\n") as index,
    ):
        yield LayerWriter(tiles, index, channels)


class LayerWriter:
    """Write tiles one by one.

    Parameters
    ----------
    tiles, index : files
        Binary, and text.
    """

    def __init__(self, tiles: IO[bytes], index: IO[str], channels: Sequence[str]) -> None:
        self._tiles, self._index, self._channels = tiles, index, list(channels)
        self._offset = 0
        self._written = 0
        self._seen = np.zeros(UNKNOWN, dtype=np.int64)
        self._all = np.array([np.inf, np.inf, -np.inf, -np.inf])
        self._printed = self._all.copy()
        head = {"version": _VERSION, "channels": self._channels}
        index.write(_compact(head)[:-1] + ',"layers":[')

    def add(self, tile: LayerTile) -> None:
        """Write a tile."""
        data = _packed(tile)
        entry = {
            "n": tile.layer,
            "name": f"{tile.layer}" if tile.layer >= 0 else "before the first layer",
            "z_mm": tile.z_mm,
            "offset": self._offset,
            "bytes": len(data),
            "points": len(tile),
            "rms_um": dict(zip(self._channels, tile.rms_um.round(2).tolist(), strict=True)),
            "max_um": dict(zip(self._channels, tile.max_um.round(2).tolist(), strict=True)),
            "seconds": round(tile.seconds, 3),
        }
        self._index.write(",\n" * (self._written > 0) + _compact(entry))
        self._tiles.write(data)
        self._offset += len(data)
        self._written += 1
        on = tile.on > 0
        found = np.bincount(tile.error[0][on & (tile.error[0] != UNKNOWN)])
        self._seen[: len(found)] += found
        _widen(self._all, tile, np.ones(len(tile), dtype=bool))
        if tile.layer >= 0:
            _widen(self._printed, tile, on)

    def anew(self) -> LayerWriter:
        """Discard what was written and return a fresh writer."""
        for file in (self._tiles, self._index):
            file.seek(0)
            file.truncate()
        return LayerWriter(self._tiles, self._index, self._channels)

    def finish(self, features: Sequence[str]) -> None:
        """Write the figures known only at the end of the print.

        Parameters
        ----------
        features : sequence of str
            Names, indexed by the feature numbers in tiles.
        """
        bounds = self._printed if np.all(np.isfinite(self._printed)) else self._all
        known = bounds.round(3).tolist() if np.all(np.isfinite(bounds)) else [0.0] * 4
        tail = {
            "features": [feature_title(name) for name in features[:_UNNAMED]],
            "scale_um": round_scale(ERROR_UM * self._top()),
            "bounds_mm": known,
        }
        self._index.write("]," + _compact(tail)[1:] + "\n")

    def _top(self) -> int:
        """Return an error that few points exceed, for the colour scale."""
        total = np.cumsum(self._seen)
        return int(np.searchsorted(total, _SCALE_QUANTILE * total[-1])) if total[-1] else 0


def round_scale(top_um: float) -> float:
    """Return the top of a colour scale: a round number not below this one; 1 for nothing."""
    if not top_um > 0.0:
        return 1.0
    step = 10.0 ** math.floor(math.log10(top_um))
    top = next(f for f in (1, 1.5, 2, 3, 4, 5, 6, 8, 10) if f * step >= top_um * (1 - 1e-9)) * step
    return float(f"{top:.6g}")


def _packed(tile: LayerTile) -> bytes:
    unnamed = (tile.feature < 0) | (tile.feature >= _UNNAMED)
    columns = (
        tile.x_mm.astype("<f4"),
        tile.y_mm.astype("<f4"),
        tile.line.astype("<u4"),
        *tile.error.astype("<u2"),
        np.where(unnamed, _UNNAMED, tile.feature).astype("u1"),
        tile.on,
    )
    return b"".join(
        data + bytes(-len(data) % 4) for data in (column.tobytes() for column in columns)
    )


def _widen(bounds: np.ndarray, tile: LayerTile, use: np.ndarray) -> None:
    if use.any():
        x, y = tile.x_mm[use], tile.y_mm[use]
        bounds[:2] = np.minimum(bounds[:2], (x.min(), y.min()))
        bounds[2:] = np.maximum(bounds[2:], (x.max(), y.max()))


def _compact(value: object) -> str:
    return json.dumps(value, separators=(",", ":"), allow_nan=False)
