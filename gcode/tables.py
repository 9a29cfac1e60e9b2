"""Make, enlarge and restart the tables that the rows of an interpreted file refer to.

They hold limits, modes and heights of layers, and the remembered effects of lines. Kernels fill
them (`_table_kernels`), and stop where one is full.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stillpath.gcode import _slots as at
from stillpath.gcode._table_kernels import Tables, intern_row
from stillpath.gcode.dialect import Dialect

__all__ = ["MOST_MEMOS", "are_large", "begun_anew", "grown", "new_tables"]

MOST_MEMOS = 4096
"""Lines whose effect is remembered. There are twice as many places, so that one is found soon."""
_FIRST_ROWS = 256
_MOST_ROWS = 4096
"""Size of a table above which it is cleared as soon as its rows are no longer needed."""
_LAYERS = 1024


def new_tables(limits: int, dialect: Dialect) -> Tables:
    """Return empty tables; a row of limits has `limits` numbers."""
    return Tables(
        *_new_table(limits, _FIRST_ROWS),
        *_new_table(at.MODAL_SIZE, _FIRST_ROWS),
        np.zeros(2 * MOST_MEMOS, np.int64),
        np.zeros(2 * MOST_MEMOS, np.int64),
        np.full((MOST_MEMOS, limits), np.nan),
        np.full((MOST_MEMOS, 2), -1, np.int32),
        dialect.table("G"),
        dialect.table("M"),
        np.full(_LAYERS, np.nan),
    )


def grown(tables: Tables, i: NDArray[np.int64]) -> Tables:
    """Return the tables, those twice as large that are full by the numbers `i` of the state."""
    if i[at.I_N_MODAL] + 2 > len(tables.modal):
        rows, index = _twice(tables.modal, int(i[at.I_N_MODAL]))
        tables = tables._replace(modal=rows, modal_index=index)
    if i[at.I_N_LIMITS] + 2 > len(tables.limits):
        rows, index = _twice(tables.limits, int(i[at.I_N_LIMITS]))
        tables = tables._replace(limits=rows, limits_index=index)
    if i[at.I_LAYER] + 2 > len(tables.layer_z):
        more = np.full(len(tables.layer_z), np.nan)
        tables = tables._replace(layer_z=np.concatenate([tables.layer_z, more]))
    return tables


def are_large(i: NDArray[np.int64]) -> bool:
    """Return whether modes or limits have so many rows that tables should be begun anew."""
    return int(max(i[at.I_N_MODAL], i[at.I_N_LIMITS])) > _MOST_ROWS


def begun_anew(tables: Tables, i: NDArray[np.int64]) -> Tables:
    """Return tables whose only modes and limits, rows 0, are those in force; `i` then says so."""
    modal, modal_index = _with_row(tables.modal[i[at.I_MODAL_ID]])
    limits, limits_index = _with_row(tables.limits[i[at.I_LIMITS_ID]])
    i[at.I_N_MODAL] = i[at.I_N_LIMITS] = 1
    i[at.I_MODAL_ID] = i[at.I_LIMITS_ID] = 0
    tables.memo_after[:] = -1
    return tables._replace(
        modal=modal, modal_index=modal_index, limits=limits, limits_index=limits_index
    )


def _new_table(columns: int, rows: int) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Return a table of floats, and the hash index by which its rows are found."""
    return np.zeros((rows, columns)), np.full(4 * rows, -1, np.int32)


def _with_row(row: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    rows, index = _new_table(len(row), _FIRST_ROWS)
    rows[0] = row
    intern_row(rows, index, 0)
    return rows, index


def _twice(rows: NDArray[np.float64], count: int) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Return a table of twice the size with the first `count` rows."""
    larger, index = _new_table(rows.shape[1], 2 * len(rows))
    for number in range(count):
        larger[number] = rows[number]
        intern_row(larger, index, number)
    return larger, index
