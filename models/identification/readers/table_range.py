"""What a resonance table tells of the range of its test: where it began, and where it ended."""

from __future__ import annotations

import math
from datetime import date

import numpy as np
from numpy.typing import NDArray

from stillpath.models.arrays import Array
from stillpath.models.identification.types import Spectrum
from stillpath.models.notes import WarningNote

__all__ = ["end_of_test", "first_band_hz", "start_of_test"]

_TELLS_RANGE = date(2024, 2, 17)
"""Since then a table ends at 1.5 max_freq (klippy/extras/resonance_tester.py), before at 200 Hz."""
_USUAL_START_HZ, _FIRST_HZ, _BAND_HZ = 5.0, 8.0, 7.0
_LOWEST_HZ, _BESIDE_SLOW_HZ, _HIGHEST_HZ, _RISE = (3.0, 8.0), (5.5, 14.0), 60.0, 80.0
"""Frequencies: the lowest that are compared, and the lowest beginning that is looked for, without
and with a slow sweep. The density over f^2 rises by 600 where a vendor's test begins, at 10 or 20
Hz; within the same few Hz towards a resonance by 4 (45 real tables), and between a heavy frame's
antiresonance and modes above by up to 50 (400 virtual ones)."""
_SLOW_HZ, _SLOW_SHARES = (2.0, 4.0), (1.3, 0.85)
_SLOW_CORNER = 1e4
"""Where the slow sweep tells its corners ((mm/s^2)^2 Hz, 60 000 for 400 mm/s^2; without it below
2000), and how well: what is more, and less, than they."""
_LEAST_END_HZ, _END_DIFFERS_HZ = 40.0, 8.0
_BESIDE_HZ, _FALL = 15.0, 100.0
"""A test's third harmonic has 1/243 of the density of its fundamental; no resonance falls by 100
within so few Hz."""
_EARLY_HZ, _EARLY_FALL = 12.0, 20.0
"""Up to 123 Hz the densities of 45 real tables fall by less, and those of 16 virtual tests to 133
Hz; each of 48 that ended at 90, 100 or 120 Hz is found."""


def start_of_test(spectrum: Spectrum) -> tuple[float | None, tuple[str, ...]]:
    """Return min_freq if the table tells that it is above 5 Hz, and a note that says so.

    Of vendors' printer.cfg, some have 20. What lies below looked like an axis that stands still.
    """
    f_hz, density = spectrum.f_hz, _density(spectrum)
    # The corners of the slow sweep have a density of 1/f^2.
    slow, squared = _within(f_hz, _SLOW_HZ), np.maximum(f_hz, 1.0) ** 2
    corner = float(np.max(density[slow] * squared[slow], initial=0.0))
    below_hz, first_hz = _BESIDE_SLOW_HZ if corner > _SLOW_CORNER else _LOWEST_HZ
    # Not over f^2 throughout: below the test there is noise, which has no slope.
    scale = np.maximum(squared, _FIRST_HZ**2)
    least, most = (
        np.maximum(density - share * corner / squared, 0.0) / scale for share in _SLOW_SHARES
    )
    full, start_hz = 0.0, None
    for edge_hz in f_hz[_within(f_hz, (first_hz, _HIGHEST_HZ))]:
        below = most[_within(f_hz, (below_hz, edge_hz - 3.0))]
        above = least[_within(f_hz, (edge_hz + 1.5, edge_hz + 7.0))]
        if len(below) < 2 or len(above) < 2:
            continue
        if above.min() > max(full, _RISE * below.max()):
            full = float(above.min())
            start_hz = _crossing(f_hz, least, 0.5 * full, edge_hz - 3.0)
    if start_hz is None:
        return None, ()
    whole = 5.0 * round(start_hz / 5.0)
    start_hz = whole if abs(whole - start_hz) <= 2.0 else float(round(start_hz))
    told = WarningNote(
        f"the density rises at {start_hz:g} Hz as where a test begins, so min_freq is "
        f"taken to be {start_hz:g}; give min_freq if it was another"
    )
    return start_hz, (told,)


def first_band_hz(start_hz: float | None) -> tuple[float, float]:
    """Return where a test from `start_hz` (default: 5 Hz) tells how strong it was."""
    low_hz = max(_FIRST_HZ, 1.0 + (start_hz or _USUAL_START_HZ))
    return low_hz, low_hz + _BAND_HZ


def end_of_test(
    spectrum: Spectrum, made: date | None, default_hz: float, start_hz: float | None = None
) -> tuple[float | None, tuple[str, ...]]:
    """Return max_freq if the table tells that it is not the default, and a note that says so."""
    tells_range = made is None or made >= _TELLS_RANGE
    end_hz = _end_of_range(spectrum, default_hz) if tells_range else None
    if end_hz is not None:
        told = (
            f"the table reaches {spectrum.f_hz[-1]:g} Hz, 1.5 max_freq: so max_freq is "
            f"{end_hz:g}; give it if the table was cut"
        )
        return end_hz, (told,)
    end_hz = _early_end(spectrum, default_hz, first_band_hz(start_hz))
    if end_hz is None:
        return None, ()
    told = WarningNote(
        f"the density falls at {end_hz:g} Hz as where a test ends, so max_freq is taken "
        f"to be {end_hz:g}; give max_freq if it was another"
    )
    return end_hz, (told,)


def _early_end(
    spectrum: Spectrum, default_hz: float, first_hz: tuple[float, float]
) -> float | None:
    """Return where a test ended long before the default, if the density shows it.

    Tables of a Klipper before 2024-02, and of vendors' to this day, reach 200 Hz whatever max_freq
    was. Taken for a resonance's flank, the end makes a mode beside it that the printer lacks.
    """
    f_hz = spectrum.f_hz
    density = _density(spectrum) / np.maximum(f_hz, 1.0) ** 2

    def part(low_hz: float, high_hz: float) -> Array:
        return np.asarray(density[(f_hz >= low_hz) & (f_hz <= high_hz)])

    level, best = part(*first_hz), (0.0, 0.0)
    for end in f_hz[(f_hz >= _LEAST_END_HZ) & (f_hz <= default_hz - _EARLY_HZ)]:
        before, left = part(end - 6.0, end - 1.0), part(end - 20.0, end - 6.0)
        beyond, floor = part(end + 3.0, default_hz - 5.0), part(end + 3.0, end + 12.0)
        if min(map(len, (level, before, left, beyond, floor))) < 2 or not floor.min() > 0.0:
            continue
        # A resonance rises as steeply as it falls, its flank goes on falling, and above a zero an
        # axis moves again; above the end of a test only harmonics are left.
        is_edge = before.min() < 10.0 * np.median(left) and floor.max() < 6.0 * floor.min()
        if is_edge and beyond.max() < 0.5 * np.median(level):
            best = max(best, (float(before.min() / beyond.max()), float(end)))
    fall, end_hz = best
    if fall < _EARLY_FALL:
        return None
    whole = 5.0 * round(end_hz / 5.0)
    return whole if abs(whole - end_hz) <= 2.0 else end_hz - 1.0


def _end_of_range(spectrum: Spectrum, default_hz: float) -> float | None:
    """Return max_freq if the table tells that it is not the default, nor that of before.

    Since 2024-02 tables end at the last bin up to 1.5 max_freq.
    """
    bin_hz = float(spectrum.f_hz[-1] - spectrum.f_hz[-2])
    least = float(spectrum.f_hz[-1]) / 1.5
    if least < _LEAST_END_HZ or abs(least - default_hz) < _END_DIFFERS_HZ:
        return None
    if _falls(spectrum, default_hz):
        return None
    whole = 5.0 * math.ceil(least / 5.0 - 1e-9)
    return whole if whole < least + bin_hz / 1.5 else least


def _falls(spectrum: Spectrum, end_hz: float) -> bool:
    """Return whether the density falls as at the end of a test, where only harmonics go on."""
    density = _density(spectrum)
    away = spectrum.f_hz - end_hz
    inside, outside = (away >= -_BESIDE_HZ) & (away <= 0.0), (away >= 5.0) & (away <= _BESIDE_HZ)
    if not inside.any() or not outside.any():
        return False
    return bool(np.median(density[inside]) > _FALL * np.median(density[outside]))


def _crossing(f_hz: Array, level: Array, value: float, from_hz: float) -> float:
    """Return where the level first rises to a value: half of it is where a test begins."""
    at = int(np.argmax((f_hz >= from_hz) & (level >= value)))
    between = slice(max(at - 1, 0), at + 1)
    return float(np.interp(value, level[between], f_hz[between]))


def _density(spectrum: Spectrum) -> Array:
    return np.asarray(np.sum(list(spectrum.psd.values()), axis=0), np.float64)


def _within(f_hz: Array, band_hz: tuple[float, float]) -> NDArray[np.bool_]:
    return np.asarray((f_hz >= band_hz[0]) & (f_hz <= band_hz[1]))
