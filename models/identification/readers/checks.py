"""Checks of every recording: rising time without gaps, and columns that are alive."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from stillpath.models.arrays import Array
from stillpath.models.errors import ModelError
from stillpath.models.identification.readers.tables import Table
from stillpath.models.notes import WarningNote

__all__ = [
    "RangeEnded",
    "check_alive",
    "check_long",
    "check_range",
    "check_rising",
    "check_steady",
    "sensor_axes",
]

_RATES_HZ = (10.0, 1e6)
_LONGEST_S = 3600.0
_NEXT, _FINE, _OFTEN = 0.02, 3, 20
"""Saturation: the share of the range beside an extreme that is examined, the sensor steps that it
must contain, and the most samples that may lie at the extreme."""
_MOST_STOPPED = 0.005
"""Share of the samples at an extreme up to which a recording is used, with a warning."""
_GAP_SAMPLES, _MOST_MISSING = 2.5, 0.01
"""Two periods are one lost sample, which is accepted; half a period allows for jitter. Of a log of
3200 Hz, 0.7 % may be missing by tens without any effect (by hand, a virtual bed slinger)."""


def check_long(table: Table, least: int, what: str, most: int | None = None) -> None:
    """Raise ModelError if the table has fewer than `least` rows, or more than `most`."""
    if most is not None and len(table.rows) > most:
        raise ModelError(
            f"{table.source}: {len(table.rows)} {what}, at most {most} are read; give the file as "
            "it was written, or fewer"
        )
    if len(table.rows) < least:
        raise ModelError(
            f"{table.source}: {len(table.rows)} {what}, at least {least} are needed; "
            "record the whole test"
        )


def check_rising(values: Array, table: Table, name: str) -> None:
    """Raise ModelError at the first value that is not above the one before it."""
    falls = np.flatnonzero(np.diff(values) <= 0)
    if len(falls):
        i = int(falls[0]) + 1
        raise table.at(
            i,
            f"{name} {values[i]:.9g} does not rise (before it: {values[i - 1]:.9g}); "
            "lines are doubled or out of order, export the file again",
        )


def check_steady(time_s: Array, table: Table, bridged_s: float = 0.0) -> tuple[str, ...]:
    """Return a note on gaps of more than two samples that the record can do without.

    Parameters
    ----------
    bridged_s : float
        Longest such gap.

    Raises
    ------
    ModelError
        For a time not in s, a recording of hours, a longer gap, or gaps of over 1 % of the record.
    """
    check_rising(time_s, table, "time")
    steps = np.diff(time_s)
    period = float(np.median(steps))
    if not _RATES_HZ[0] <= 1.0 / period <= _RATES_HZ[1]:
        raise ModelError(
            f"{table.source}: the samples are {period:.4g} s apart by its time, which is not "
            f"between {1 / _RATES_HZ[1]:g} and {1 / _RATES_HZ[0]:g} s: time must be in seconds"
        )
    lasted_s = float(time_s[-1] - time_s[0])
    if lasted_s > _LONGEST_S:
        raise ModelError(
            f"{table.source}: it lasts {lasted_s:.0f} s, at most {_LONGEST_S:.0f} s are read; a "
            "resonance test takes some minutes: cut the file to it"
        )
    gaps = np.flatnonzero(steps > _GAP_SAMPLES * period)
    if len(gaps) == 0:
        return ()
    missing = np.round(steps[gaps] / period - 1.0)
    most = max(1, int(bridged_s / period))
    share = float(missing.sum()) / len(time_s)
    if missing.max() <= most and share <= _MOST_MISSING:
        count = f"{missing.sum():.0f} samples ({share:.2%}) are missing in {len(gaps)} gaps"
        return (f"{count} (messages of the sensor's board were lost): so few do not matter",)
    i = int(gaps[np.argmax(missing > most)])
    more = f" ({len(gaps)} gaps in all, {share:.2%} of the samples)" if len(gaps) > 1 else ""
    rest = f" in a place, and {_MOST_MISSING:.0%} in all" if bridged_s else ""
    raise table.at(
        i + 1,
        f"gap in time{more}: {steps[i] * 1e3:.4g} ms after {time_s[i]:.6f} s, "
        f"{steps[i] / period - 1:.0f} samples are missing; at most {most} may be{rest}. Measure "
        "again with less load on the host, or a lower rate of the sensor",
    )


def check_alive(
    columns: dict[str, Array], table: Table, axis: str | None, sensor_axis: str | None
) -> tuple[str, ...]:
    """Refuse a recording whose column of interest is constant; note any other such column.

    Parameters
    ----------
    columns : dict
        By sensor axis; columns of NaN were not recorded.
    axis : str, optional
        Tested axis, or direction like "1.000,1.000".
    sensor_axis : str, optional
        Column along the tested axis; default: that of the same name.

    Raises
    ------
    ModelError
        If no column moves, or the one along the tested axis does not or was not recorded.
    """
    recorded = {name: v for name, v in columns.items() if not np.isnan(v).any()}
    dead = {name: float(v[0]) for name, v in recorded.items() if np.ptp(v) == 0.0}
    if len(dead) == len(recorded):
        raise ModelError(
            f"{table.source}: every column of the sensor is constant "
            f"({_listed(dead)}): it did not measure; check its wiring and measure again"
        )
    for name in sensor_axes(axis, sensor_axis):
        if name in columns and name not in recorded:
            raise ModelError(
                f"{table.source}: the sensor's {name} was not recorded, but axis {axis} was "
                "tested; record all axes, or give sensor_axis if the sensor is mounted turned"
            )
        if name in dead:
            raise ModelError(
                f"{table.source}: the sensor's {name} is dead (constant {dead[name]:g}) while axis "
                f"{axis} was tested; check the sensor, or give sensor_axis if it is mounted turned"
            )
    return (f"the sensor's {_listed(dead)} is constant",) if dead else ()


class RangeEnded(WarningNote):
    """A warning that the sensor's range ended, so that the phase of its log may tell nothing."""

    __slots__ = ()


def check_range(
    columns: dict[str, Array], source: str = "", along: Sequence[str] = ()
) -> tuple[str, ...]:
    """Return a `RangeEnded` if a sensor's readings stop at a value that they reach often.

    An extreme is rare: where more samples lie on it than in the next part of the range, the
    sensor's own range ended there.

    Parameters
    ----------
    along : sequence of str
        Columns that a machine is identified from.

    Raises
    ------
    ModelError
        If one of these often lies there, again and again: no test would tell its damping.
    """
    found: list[str] = []
    for name, values in columns.items():
        for side in (1.0, -1.0):
            up = side * values
            top = float(up.max())
            below = up[(up < top) & (up > top - _NEXT * float(np.ptp(up)))]
            there = up == top
            often = int(np.count_nonzero(there))
            if often <= max(_OFTEN, 2 * len(below)) or len(np.unique(below)) < _FINE:
                continue
            unit = " mm/s^2" if name in "xyz" else ""
            text = (
                f"the sensor's {name} stops at {side * top:.6g}{unit}, {often} samples lie "
                "there: its range ended, and damping comes out too large; test with a lower "
                "accel_per_hz, or set a larger range"
            )
            # Something that came to rest at its extreme lies there once, for long.
            times = np.count_nonzero(there[1:] & ~there[:-1])
            if name in along and often > _MOST_STOPPED * len(up) and times > _OFTEN:
                raise ModelError(f"{source}: {text}")
            found.append(RangeEnded(text))
    return tuple(found[:1])


def sensor_axes(axis: str | None, sensor_axis: str | None) -> tuple[str, ...]:
    """Return the sensor's columns that take part in a test of an axis, or of a direction."""
    if sensor_axis is not None:
        return (sensor_axis,)
    if axis is None:
        return ()
    if "," not in axis:
        return (axis,)
    parts = [float(part) for part in axis.split(",")]
    return tuple(name for name, part in zip("xyz", parts, strict=False) if part)


def _listed(dead: dict[str, float]) -> str:
    return ", ".join(f"{name} = {value:g}" for name, value in dead.items())
