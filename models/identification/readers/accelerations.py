"""Raw accelerations: Klipper's CSV, and what M956 of RepRapFirmware writes."""

from __future__ import annotations

import re

import numpy as np

from stillpath.models.arrays import Array
from stillpath.models.errors import ModelError
from stillpath.models.identification.readers.checks import (
    check_alive,
    check_long,
    check_range,
    check_steady,
    sensor_axes,
)
from stillpath.models.identification.readers.lost_samples import restored
from stillpath.models.identification.readers.settings import ReadSettings
from stillpath.models.identification.readers.spikes import sound_samples
from stillpath.models.identification.readers.tables import MOST_ROWS, Table
from stillpath.models.identification.types import AccelerationLog

__all__ = ["is_klipper_log", "is_m956", "read_klipper_log", "read_m956"]

_UNITS = {"mm/s^2": 1.0, "m/s^2": 1000.0, "g": 9806.65}
_OWN_UNIT = "mm/s^2"
_GRAVITY = (0.8, 1.2)
_LARGEST_G = 40.0
"""No accelerometer of a printer measures more; a test moves it by more than so many mm/s^2."""
_LEAST_SAMPLES = 64
_BRIDGED_S = 0.01
"""A message of the sensor's board, which nobody sends again, has 8 or 10 samples."""
_KLIPPER = ("accel_x", "accel_y", "accel_z")
_TRAILER = re.compile(r"rate\s+([\d.]+)\s*,?\s*overflows\s+(\d+)", re.IGNORECASE)
_OVERFLOWS = re.compile(r"overflows\W{0,4}(\d+)", re.IGNORECASE)


def is_klipper_log(table: Table) -> bool:
    """Whether the columns are those of ACCELEROMETER_MEASURE and OUTPUT=raw_data."""
    return table.names[:1] == ("time",) and any(n.startswith("accel_") for n in table.names)


def is_m956(table: Table) -> bool:
    """Whether the columns are those of M956."""
    return table.names[:1] == ("sample",) and 1 < len(table.names) <= 4


def read_klipper_log(table: Table, axis: str | None, settings: ReadSettings) -> AccelerationLog:
    """Read `#time,accel_x,accel_y,accel_z` in s and mm/s^2, or what gravity says to be the unit.

    Format: klippy/extras/adxl345.py, 2026-08; newer forks put a line `##` with the sensor's
    statistics before it.

    Raises
    ------
    ModelError
        For a column that is missing or dead, samples lost by the sensor, gaps in time, many
        garbled samples.
    """
    for comment in table.comments:
        lost = _OVERFLOWS.search(comment)
        if lost and int(lost[1]) > 0:
            raise _overflowed(table, int(lost[1]))
    check_long(table, _LEAST_SAMPLES, "samples", MOST_ROWS)
    values = table.numbers(("time", *_KLIPPER))
    bridged = check_steady(values[:, 0], table, _BRIDGED_S)
    time_s, told = restored(values[:, 0])
    unit = settings.acceleration_unit or _unit(values[:, 1:])
    accel = values[:, 1:] * _UNITS[unit]
    sound, garbled = sound_samples(time_s, accel, table.source)
    time_s, accel = time_s[sound], accel[sound]
    columns = dict(zip("xyz", accel.T, strict=True))
    notes = [*table.notes, *bridged, *told, *garbled, *_notes(columns, table, axis, settings)]
    if unit != (settings.acceleration_unit or _OWN_UNIT):
        notes.append(f"gravity in it is that of accelerations in {unit}, so they were taken to be")
    return AccelerationLog(time_s, accel, axis, table.source, tuple(notes))


def read_m956(table: Table, axis: str | None, settings: ReadSettings) -> AccelerationLog:
    """Read `Sample,X,Y,Z` in g with the last line `Rate <Hz>, overflows <n>`.

    Format: RepRapFirmware src/Accelerometers/Accelerometers.cpp, 3.4 to 3.6. Time is the
    sample's number over the rate; axes that were not asked for are NaN.

    Raises
    ------
    ModelError
        If samples were lost, the recording failed, or the last line is missing.
    """
    rate_hz = _rate_hz(table)
    table = table.without_last("")
    check_long(table, _LEAST_SAMPLES, "samples", MOST_ROWS)
    extra = [n for n in table.names[1:] if n not in "xyz"]
    if extra:
        raise ModelError(f"{table.source}: column {extra[0]!r} is not one of X, Y, Z")
    values = table.numbers(table.names)
    check_steady(values[:, 0] / rate_hz, table)
    accel = np.full((len(values), 3), np.nan)
    for i, name in enumerate(table.names[1:], start=1):
        accel[:, "xyz".index(name)] = values[:, i] * _UNITS[settings.acceleration_unit or "g"]
    columns = dict(zip("xyz", accel.T, strict=True))
    notes = _notes(columns, table, axis, settings)
    time_s = values[:, 0] / rate_hz
    return AccelerationLog(time_s, accel, axis, table.source, notes, may_hold_test=False)


def _unit(values: Array) -> str:
    """Return the unit of accelerations, shape (n, 3), by the gravity in them."""
    gravity = float(np.linalg.norm(np.median(values, axis=0)))
    for unit in ("g", "m/s^2"):
        one_g = _UNITS["g"] / _UNITS[unit]
        is_one = _GRAVITY[0] <= gravity / one_g <= _GRAVITY[1]
        if is_one and float(np.abs(values).max()) <= _LARGEST_G * one_g:
            return unit
    return _OWN_UNIT


def _notes(
    columns: dict[str, Array], table: Table, axis: str | None, settings: ReadSettings
) -> tuple[str, ...]:
    """Check what the sensor measured."""
    along = sensor_axes(settings.axis or axis, settings.sensor_axis)
    alive = check_alive(columns, table, axis, settings.sensor_axis)
    # A sensor may be mounted turned: the column that moved most is what counts.
    moved = max(columns, key=lambda name: float(np.nan_to_num(np.var(columns[name]))))
    return *alive, *check_range(columns, table.source, (*along, moved))


def _rate_hz(table: Table) -> float:
    last = table.rows[-1] if table.rows else ""
    found = _TRAILER.match(last.strip())
    if found is None:
        if last[:1].isalpha():
            raise ModelError(
                f"{table.source}, line {table.lines[-1]}: the firmware says {last.strip()!r:.80}; "
                "record again"
            )
        raise ModelError(
            f"{table.source}: the last line `Rate <Hz>, overflows <n>` is missing, so the "
            "sampling rate is unknown: the file is cut off, record again"
        )
    if int(found[2]) > 0:
        raise _overflowed(table, int(found[2]))
    try:
        rate_hz = float(found[1])
    except ValueError:
        rate_hz = 0.0
    if not 10.0 <= rate_hz <= 1e6:
        raise table.at(-1, f"sampling rate {found[1]} Hz is not between 10 Hz and 1 MHz")
    return rate_hz


def _overflowed(table: Table, count: int) -> ModelError:
    return ModelError(
        f"{table.source}: the sensor overflowed {count} times, so samples are lost at unknown "
        "places (0 are allowed); record again with a lower rate or a faster bus"
    )
