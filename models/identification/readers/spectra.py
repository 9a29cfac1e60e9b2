"""Klipper's spectra: resonances_*.csv, and calibration_data_*.csv with the shapers' columns."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from stillpath.models.arrays import Array
from stillpath.models.errors import ModelError
from stillpath.models.identification.readers.checks import check_alive, check_long, check_rising
from stillpath.models.identification.readers.interpolated import at_bins
from stillpath.models.identification.readers.settings import ReadSettings
from stillpath.models.identification.readers.tables import Table
from stillpath.models.identification.types import Spectrum

__all__ = ["GAINS_TEXT", "MOST_BINS", "is_gains", "is_spectrum", "read_spectrum"]

MOST_BINS = 2500
"""Klipper writes some 130, up to 200 Hz, but every 0.2 Hz of several data sets: 2250 where max_freq
is 300; work and memory grow with their square."""
_LEAST_BINS = 16
GAINS_TEXT = (
    "Prusa's M958 and M959 print gains of single frequencies (with K in the form of Klipper's "
    "tables), which are not read: type the frequencies in that M959 names (machines from-m503, "
    "--fx and --fy)"
)
_GAINS_HEADERS = ("freq,psd_x,psd_y,psd_z,psd_xyz,mzv", "X_gain Y_gain Z_gain")
_MOST_TERMINAL_LINES = 10_000
_PER_HZ, _SHAPERS = "accel_per_hz", "shapers:"
_SHAPER = re.compile(r"\w+\([\d./]+\)|(smooth_)?(zvd?|mzv|ei|[23]hump_ei|zvd_ei|si)")
_MIN_FREQ_HZ = 5.0
"""MIN_FREQ of klippy/extras/shaper_calibrate.py."""


def is_spectrum(table: Table) -> bool:
    """Whether the first column is Klipper's `freq`."""
    return table.names[:1] == ("freq",)


def is_gains(table: Table) -> bool:
    """Whether it is what M958 and M959 print, alone or in what a terminal showed.

    Format: Prusa-Firmware-Buddy lib/Marlin/Marlin/src/gcode/calibrate/M958.cpp, 5.0 to 6.2: with K,
    a column is named that the rows lack.
    """
    if table.first_line.strip() == _GAINS_HEADERS[0]:
        return bool(table.rows) and len(table.split(table.rows[0])) < len(table.names)
    lines = (table.first_line, *table.rows[:_MOST_TERMINAL_LINES])
    return any(line.rstrip().endswith(_GAINS_HEADERS) for line in lines)


def read_spectrum(table: Table, axis: str | None, settings: ReadSettings) -> Spectrum:
    """Read power spectral densities by the names of their columns.

    Either psd_x, psd_y, psd_z, psd_xyz, or one column per data set (klippy/extras/
    shaper_calibrate.py since 2024-12); Kalico adds accel_per_hz. Columns of shapers, in any
    of the three ways of writing them, say that the values were normalised, which is undone;
    so does the name calibration_data.

    Raises
    ------
    ModelError
        If there is no density, one is negative, or the tested axis has none.
    """
    table = _with_shapers_counted(table)
    names, shapers = _densities(table)
    check_long(table, _LEAST_BINS, "frequencies", MOST_BINS)
    has_per_hz = _PER_HZ in table.names
    values = table.numbers(["freq", *names, *([_PER_HZ] if has_per_hz else [])])
    f_hz, psd = values[:, 0], values[:, 1 : 1 + len(names)]
    check_rising(f_hz, table, "freq")
    if f_hz[0] < 0:
        raise table.at(0, f"freq {f_hz[0]:g} is negative")
    below = np.argwhere(psd < 0)
    if len(below):
        row, column = below[0]
        raise table.at(int(row), f"{names[column]} is negative: {psd[row, column]:g}")
    f_hz, psd = at_bins(_unrounded(f_hz, table), psd)
    notes = list(table.notes)
    if shapers or "calibration_data" in table.source:
        f_hz, psd = _undone(f_hz, psd, smooth=any(s.startswith("smooth_") for s in shapers))
        why = "" if shapers else ", which the file's name tells, not its columns"
        notes.append(f"Klipper's normalisation by frequency is undone{why}")
    by_name = {n.removeprefix("psd_"): psd[:, i] for i, n in enumerate(names)}
    notes += _check_densities(by_name, table, axis, settings)
    return Spectrum(
        f_hz=f_hz,
        psd=by_name,
        axis=axis,
        source=table.source,
        accel_per_hz_mm_s=_one_value(values[:, -1], table) if has_per_hz else None,
        notes=tuple(notes),
    )


def _with_shapers_counted(table: Table) -> Table:
    """Return the table with as many columns of shapers as its rows have.

    Klipper does not quote the commas in names such as mzv(n=6,t=1.0) (shaper_calibrate.py since
    2026-04).
    """
    if _SHAPERS not in table.names or not table.rows:
        return table
    at = table.names.index(_SHAPERS) + 1
    count = max(0, len(table.split(table.rows[0])) - at)
    return replace(table, names=(*table.names[:at], *table.names[at:][:count]))


def _densities(table: Table) -> tuple[list[str], list[str]]:
    """Return the names of the densities' columns, and of the shapers' columns."""
    names = list(table.names[1:])
    shapers: list[str] = []
    if _SHAPERS in names:
        at = names.index(_SHAPERS)
        names, shapers = names[:at], names[at:]
    shapers += [n for n in names if _SHAPER.fullmatch(n)]
    names = [n for n in names if n != _PER_HZ and not _SHAPER.fullmatch(n)]
    if not names or "" in names or len(set(names)) < len(names):
        raise ModelError(
            f"{table.source}: after freq there must be psd_x, psd_y, psd_z, psd_xyz, or a column "
            f"of its own name for each data set; there are: {', '.join(table.names):.300}"
        )
    return names, shapers


def _unrounded(f_hz: Array, table: Table) -> Array:
    """Return the uniform grid k df that was rounded to one decimal, if it is one.

    Every bin bounds df; the middle of what all allow is some 1e-4 Hz near, where a rounded
    bin is up to 0.05 Hz off.
    """
    first = (table.split(row)[0].strip().partition(".")[2] for row in table.rows)
    half = 0.5 * 10.0 ** -max(len(text) for text in first) + 1e-9
    k = np.round(f_hz * (len(f_hz) - 1) / (f_hz[-1] - f_hz[0]))
    if half < 1e-3 or np.any(np.diff(k) != 1):
        return f_hz
    used = k > 0
    least = float(((f_hz[used] - half) / k[used]).max())
    most = float(((f_hz[used] + half) / k[used]).min())
    return k * (0.5 * (least + most)) if least <= most else f_hz


def _undone(f_hz: Array, psd: Array, *, smooth: bool) -> tuple[Array, Array]:
    """Undo the division by f + 0.1 and the suppression of low frequencies.

    Below twice MIN_FREQ, exp(1 - (10/(f+0.1))^2); before 2024-12, zero below MIN_FREQ;
    in Kalico (told by its smooth shapers), tanh(f/10) everywhere.
    """
    low = f_hz < 2 * _MIN_FREQ_HZ
    cut = (f_hz > 1.0) & (f_hz < _MIN_FREQ_HZ - 0.1)
    if smooth:
        kept = np.tanh(0.5 / _MIN_FREQ_HZ * f_hz)
    elif cut.any() and not psd[cut].any():
        kept = (f_hz >= _MIN_FREQ_HZ).astype(float)
    else:
        kept = np.exp(np.where(low, 1.0 - (2 * _MIN_FREQ_HZ / (f_hz + 0.1)) ** 2, 0.0))
    # Below some 1 Hz nothing is left of the values.
    used = kept > 1e-60
    return f_hz[used], psd[used] * ((f_hz[used] + 0.1) / kept[used])[:, None]


def _check_densities(
    by_name: dict[str, Array], table: Table, axis: str | None, settings: ReadSettings
) -> tuple[str, ...]:
    sensor = {name: psd for name, psd in by_name.items() if name in ("x", "y", "z")}
    if sensor:
        return check_alive(sensor, table, axis, settings.sensor_axis)
    dead = next((name for name, psd in by_name.items() if np.ptp(psd) == 0.0), None)
    if dead is not None:
        raise ModelError(f"{table.source}: column {dead!r} is constant; measure it again")
    return ()


def _one_value(column: Array, table: Table) -> float:
    if np.ptp(column) > 0 or column[0] <= 0:
        raise ModelError(
            f"{table.source}: {_PER_HZ} must be positive and the same in every line; "
            f"it runs from {column.min():g} to {column.max():g}"
        )
    return float(column[0])
