"""Recorded drives: a command and the measured motion, in columns of any name."""

from __future__ import annotations

import numpy as np

from stillpath.models.errors import ModelError
from stillpath.models.identification.readers.checks import check_long, check_range, check_steady
from stillpath.models.identification.readers.settings import ReadSettings
from stillpath.models.identification.readers.tables import MOST_ROWS, Table
from stillpath.models.identification.types import DrivenLog

__all__ = ["is_drive", "read_drives"]

_LEAST_SAMPLES = 64
_MOST_AXES = 16
_COLUMNS = ("time_s", "cmd_acc", "meas_acc")


def is_drive(table: Table, settings: ReadSettings) -> bool:
    """Whether the settings name the columns, or the table has those of a swept sine."""
    told = (settings.time_column, settings.command_column, settings.measured_column)
    return None not in told or len(set(_COLUMNS) & set(table.names)) >= 2


def read_drives(table: Table, axis: str | None, settings: ReadSettings) -> tuple[DrivenLog, ...]:
    """Read `time_s, cmd_acc, meas_acc [, axis]`, or the columns that the settings name.

    One log for each value of the axis column, in the order in which they come.

    Raises
    ------
    ModelError
        For a column that is missing or dead, gaps in time, and a sensor whose range ended.
    """
    columns = (
        _chosen(settings.time_column, _COLUMNS[0]),
        _chosen(settings.command_column, _COLUMNS[1]),
        _chosen(settings.measured_column, _COLUMNS[2]),
    )
    values = table.numbers(columns)
    axis_column = settings.axis_column
    if axis_column is None and "axis" in table.names:
        axis_column = "axis"
    if axis_column is None:
        return (_log(table, np.arange(len(values)), values, axis),)
    axes = [text.lower() for text in table.texts(axis_column)]
    if len(set(axes)) > _MOST_AXES:
        raise ModelError(
            f"{table.source}: column {axis_column!r} has {len(set(axes))} values, at most "
            f"{_MOST_AXES} axes are read; choose another axis_column"
        )
    listed = np.array(axes)
    return tuple(
        _log(table, np.flatnonzero(listed == name), values, name) for name in dict.fromkeys(axes)
    )


def _log(table: Table, chosen: np.ndarray, values: np.ndarray, axis: str | None) -> DrivenLog:
    part = table.picked(chosen)
    time_s, command, measured = values[chosen].T
    check_long(
        part, _LEAST_SAMPLES, "samples" if axis is None else f"samples of axis {axis}", MOST_ROWS
    )
    check_steady(time_s, part)
    for name, column in (("command", command), ("measured", measured)):
        if np.ptp(column) == 0.0:
            raise ModelError(
                f"{table.source}: the {name} column is constant ({column[0]:g})"
                f"{f' for axis {axis}' if axis else ''}; choose another column, or record again"
            )
    if np.array_equal(command, measured):
        raise ModelError(
            f"{table.source}: command and measurement are the same numbers"
            f"{f' for axis {axis}' if axis else ''}: choose the column of what followed"
        )
    notes = check_range({"measurement": measured}, table.source, ("measurement",))
    return DrivenLog(time_s, command, measured, axis, table.source, (*table.notes, *notes))


def _chosen(column: str | int | None, usual: str) -> str | int:
    return usual if column is None else column
