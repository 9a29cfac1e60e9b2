"""Reads layers.json and layers.bin as docs/layers.md says, and nothing of the service."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np


@dataclass(frozen=True)
class ReadTile:
    entry: dict[str, Any]
    x: np.ndarray
    y: np.ndarray
    line: np.ndarray
    error: dict[str, np.ndarray]
    feature: np.ndarray
    on: np.ndarray


def read_tiles(folder: Path) -> tuple[dict[str, Any], list[ReadTile]]:
    index = json.loads((folder / "layers.json").read_text())
    data = (folder / "layers.bin").read_bytes()
    tiles, end = [], 0
    for entry in index["layers"]:
        assert entry["offset"] == end
        end += entry["bytes"]
        at, columns = entry["offset"], []
        types = ["<f4", "<f4", "<u4", *["<u2"] * len(index["channels"]), "u1", "u1"]
        for kind in types:
            column = np.frombuffer(data, kind, entry["points"], at)
            at += -(-column.nbytes // 4) * 4
            columns.append(column)
        assert at == end
        error = dict(zip(index["channels"], columns[3:-2], strict=True))
        tiles.append(ReadTile(entry, *columns[:3], error, *columns[-2:]))
    assert end == len(data)
    return index, tiles
