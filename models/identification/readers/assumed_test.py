"""The resonance test that made a file: as stated, as the file shows, or as was usual in its day."""

from __future__ import annotations

import re
from datetime import date
from typing import NamedTuple

from stillpath.models.errors import ModelError
from stillpath.models.identification.readers.settings import ReadSettings, direction_of
from stillpath.models.identification.readers.slow_sweep import log_sweeps, table_sweeps
from stillpath.models.identification.readers.table_range import end_of_test, start_of_test
from stillpath.models.identification.types import AccelerationLog, Excitation, Spectrum

__all__ = ["AssumedTest", "assumed_test", "date_in_name"]

_NEW_TEST = date(2024, 12, 1)
_NEW = Excitation(direction=(1.0, 0.0))
"""Defaults since then."""
_OLD = {"accel_per_hz_mm_s": 75.0, "f_end_hz": 10000.0 / 75.0, "sweeping_accel_mm_s2": 0.0}
"""Those of before that differ."""
_PER_HZ = "accel_per_hz"
_KLIPPER = {
    "accel_per_hz_mm_s": _PER_HZ,
    "f_start_hz": "min_freq",
    "f_end_hz": "max_freq",
    "hz_per_s": "hz_per_sec",
    "sweeping_accel_mm_s2": "sweeping_accel",
    "sweeping_period_s": "sweeping_period",
}
"""What users call them: options of [resonance_tester]."""
_LONGER_S = (-0.05, 0.5)
"""By how much a log is longer than its test; Shake&Tune's by some tenths of a second. The default
test of before 2024-12 lasts 128.3 s, that of since and Kalico's 130 s."""
_DATE = re.compile(r"(?<!\d)(20\d\d)[-_]?(\d\d)[-_]?(\d\d)(?!\d)")


class AssumedTest(NamedTuple):
    """The test that made a file, and notes on what was assumed of it for lack of information."""

    excitation: Excitation
    notes: tuple[str, ...]


def assumed_test(
    measurement: AccelerationLog | Spectrum, settings: ReadSettings | None = None
) -> AssumedTest:
    """Return the firmware's resonance test: the settings first, then the file, then defaults.

    Defaults of klippy/extras/resonance_tester.py: before 2024-12 from 5 to 133.33 Hz with
    75 mm/s and without the slow square wave; since then from 5 to 135 Hz with 60 mm/s,
    400 mm/s^2 and 1.2 s. Always 1 Hz/s. A file tells which by its slow motion, whatever its
    date: many printers have an older Klipper than the day, and Kalico has no slow square wave.

    Raises
    ------
    ModelError
        If the tested axis is not stated, or does not lie in the plane.
    """
    settings = settings or ReadSettings()
    axis = settings.axis or measurement.axis
    if axis is None:
        raise ModelError(
            f"{measurement.source}: neither the file nor its name says which axis was tested; "
            "give the axis"
        )
    direction = direction_of(axis)
    made = settings.firmware_date or date_in_name(measurement.source)
    known, notes = _known(measurement, settings, made)
    defaults, era = _defaults(measurement, settings, made, known["f_start_hz"])
    values = {name: defaults[name] if one is None else one for name, one in known.items()}
    if values["f_start_hz"] >= values["f_end_hz"]:
        raise ModelError(
            f"{measurement.source}: the test would run from {values['f_start_hz']:g} to "
            f"{values['f_end_hz']:g} Hz; give both min_freq and max_freq"
        )
    idle = {"sweeping_period_s"} if values["sweeping_accel_mm_s2"] == 0 else set()
    assumed = [
        f"{_KLIPPER[name]} {values[name]:g}"
        for name, one in known.items()
        if one is None and name not in idle
    ]
    if assumed:
        notes.append(f"assumed {', '.join(assumed)}: the defaults of Klipper {era}")
    return AssumedTest(Excitation(direction, out_and_back=False, **values), tuple(notes))


def date_in_name(name: str) -> date | None:
    """Return the date in a file name such as resonances_x_20211217_070942.csv, if it has one."""
    for found in _DATE.finditer(name):
        try:
            return date(*(int(part) for part in found.groups()))
        except ValueError:
            continue
    return None


def _known(
    measurement: AccelerationLog | Spectrum, settings: ReadSettings, made: date | None
) -> tuple[dict[str, float | None], list[str]]:
    """Return what is stated of the test, or else shown by its table, and notes on the latter."""
    known: dict[str, float | None] = {name: getattr(settings, name) for name in _KLIPPER}
    notes: list[str] = []
    if not isinstance(measurement, Spectrum):
        return known, notes
    if settings.f_start_hz is None:
        known["f_start_hz"], why = start_of_test(measurement)
        notes += why
    stated, written = settings.accel_per_hz_mm_s, measurement.accel_per_hz_mm_s
    if stated is None:
        known["accel_per_hz_mm_s"] = written
    elif written is not None and written != stated:
        # Kalico writes that of printer.cfg, also where the command gave another (2026-07).
        notes.append(f"{_PER_HZ} {stated:g} was stated, {written:g} in the file does not count")
    if settings.f_end_hz is None:
        start_hz = known["f_start_hz"]
        known["f_end_hz"], why = end_of_test(measurement, made, _NEW.f_end_hz, start_hz)
        notes += why
    return known, notes


def _defaults(
    measurement: AccelerationLog | Spectrum,
    settings: ReadSettings,
    made: date | None,
    start_hz: float | None,
) -> tuple[dict[str, float], str]:
    """Return the defaults of the Klipper that made a file, and of which time it is and why."""
    old_by_date = made is not None and made < _NEW_TEST
    sweeps = _sweeps(measurement, settings, start_hz)
    old = old_by_date if sweeps is None else not sweeps
    defaults = {name: getattr(_NEW, name) for name in _KLIPPER} | (_OLD if old else {})
    if old is old_by_date:
        era = _era_by_date(made, settings)
    else:
        era = _era_by_file(made, settings, measurement, old=old)
    if old and settings.f_end_hz is None and _lasts_as_new(measurement, settings):
        defaults["f_end_hz"] = _NEW.f_end_hz
        era += "; the log is 130 s long, as Kalico's test is to 135 Hz"
    return defaults, era


def _sweeps(
    measurement: AccelerationLog | Spectrum, settings: ReadSettings, start_hz: float | None
) -> bool | None:
    """Return whether a file shows the slow sweep; None if it does not tell or need not."""
    if settings.sweeping_accel_mm_s2 is not None:
        return None
    if isinstance(measurement, Spectrum):
        return table_sweeps(measurement, start_hz)
    return log_sweeps(measurement, settings.sweeping_period_s or _NEW.sweeping_period_s)


def _lasts_as_new(measurement: AccelerationLog | Spectrum, settings: ReadSettings) -> bool:
    """Return whether a log is as long as the test of since 2024-12.

    Kalico's has no slow sweep, nor has Klipper's with sweeping_period 0 (printer.cfg).
    """
    stated = (settings.f_start_hz, settings.hz_per_s)
    if isinstance(measurement, Spectrum) or any(one is not None for one in stated):
        return False
    test_s = (_NEW.f_end_hz - _NEW.f_start_hz) / _NEW.hz_per_s
    lasted_s = float(measurement.time_s[-1] - measurement.time_s[0])
    return _LONGER_S[0] <= lasted_s - test_s <= _LONGER_S[1]


def _era_by_date(made: date | None, settings: ReadSettings) -> str:
    """Say of which time the defaults are where the file does not contradict its date."""
    if made is None:
        return (
            "since 2024-12, because no date is known (give firmware_date if the firmware is older)"
        )
    era = "before 2024-12" if made < _NEW_TEST else "since 2024-12"
    return f"{era} by {_told_by(settings)}, {made.isoformat()}"


def _era_by_file(
    made: date | None,
    settings: ReadSettings,
    measurement: AccelerationLog | Spectrum,
    *,
    old: bool,
) -> str:
    """Say of which time the defaults are where the file shows another than its date, if any."""
    kind = "table" if isinstance(measurement, Spectrum) else "log"
    era, a = ("before 2024-12", "no") if old else ("since 2024-12", "a")
    shown = f"{era}, because the {kind} shows {a} slow sweep"
    return shown if made is None else f"{shown}, whatever {_told_by(settings)}, {made}, says"


def _told_by(settings: ReadSettings) -> str:
    return "firmware_date" if settings.firmware_date else "the date in the file's name"
