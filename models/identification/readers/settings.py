"""Facts that measurement files lack: set by the user, or assumed from the firmware's date."""

from __future__ import annotations

import math
import re
from datetime import date
from typing import Annotated, Literal, NamedTuple

import numpy as np
from pydantic import Field, field_validator, model_validator

from stillpath.models.document import Document, NonNegative, Positive
from stillpath.models.errors import ModelError
from stillpath.models.friction import Guides
from stillpath.models.identification.readers.table_range import (
    end_of_test,
    first_band_hz,
    start_of_test,
)
from stillpath.models.identification.types import (
    AccelerationLog,
    Axis,
    Excitation,
    Measurement,
    Spectrum,
)

__all__ = [
    "NO_TEST",
    "ReadSettings",
    "date_in_name",
    "direction_of",
    "excitation_for",
    "excitation_notes",
    "tested_axis",
]

Column = str | Annotated[int, Field(ge=0)]
"""By name, or counted from 0."""

NO_TEST = (
    "RepRapFirmware has no resonance test of its own, and its log does not say what moved: type "
    "the frequencies in (machines from-config, --fx and --fy) and let verify read the log of a "
    "ring-test, or record command and acceleration together"
)
"""Note of an M956 log."""
_NEW_TEST = date(2024, 12, 1)
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
_OLD = {"accel_per_hz_mm_s": 75.0, "f_end_hz": 10000.0 / 75.0, "sweeping_accel_mm_s2": 0.0}
_BESIDE_SLOW_HZ, _SLOW_RATE_HZ, _LEAST_SLOW_S = 0.05, 20.0, 30.0
_SLOW_MM_S2, _MOVED_MM_S2 = (60.0, 180.0), 500.0
"""Slow motion without and with the slow sweep, rms: its 400 mm/s^2 are 360 in the first harmonic.
Below the last value in all, the sensor did not move with the test and tells nothing."""
_SLOW_BAND_HZ, _SLOW_IN_TABLE_MM_S2 = (1.0, 4.0), (110.0, 150.0)
_LEAST_SLOW = 0.5
"""The same in a table, where the window leaves 228 mm/s^2 of the slow sweep, 1.5 times the power of
the test itself from 8 to 15 Hz. Without it up to 92 mm/s^2 and 0.21 times (45 real tables); more of
a test with a large accel_per_hz."""
_LONGER_S = (-0.05, 0.5)
"""By how much a log is longer than its test; Shake&Tune's by some tenths of a second. The default
test of before 2024-12 lasts 128.3 s, that of since and Kalico's 130 s."""
_DIAGONAL = re.compile(r"-?\d+(\.\d+)?,-?\d+(\.\d+)?(,-?\d+(\.\d+)?)?")
_DAY = re.compile(r"\d{4}-\d\d-\d\d")
_DATE = re.compile(r"(?<!\d)(20\d\d)[-_]?(\d\d)[-_]?(\d\d)(?!\d)")


class ReadSettings(Document):
    """What a file leaves open; None means: as the file, its name or the firmware's date says.

    Attributes
    ----------
    axis : str, optional
        Tested axis: "x", "y", "z", or a direction like "1.000,1.000".
    accel_per_hz_mm_s, f_start_hz, f_end_hz, hz_per_s : float, optional
        Of the firmware's [resonance_tester].
    sweeping_accel_mm_s2, sweeping_period_s : float, optional
        The slow square wave of newer versions; acceleration 0 for none.
    firmware_date : date, optional
        Of the Klipper version that made the file.
    sensor_axis : str, optional
        Axis of the sensor that lies along the tested axis, if it is mounted turned.
    sensor_turned : bool
        The sensor was mounted differently for X and for Y.
    frame_firm : bool
        The frame stands firm (bolted down, heavy): what the sensor feels is what prints. Otherwise
        a weak mode far below the strongest may be the frame on its feet, which an accelerometer
        feels and the nozzle over the bed does not.
    guides : str, optional
        What the axes run on: "wheels" (or bushings on rods) or "rails", for the friction that is
        assumed where none can be measured. None: rails, which rub least.
    time_column, command_column, measured_column, axis_column : str or int, optional
        Columns of a recorded drive, by name or counted from 0.
    acceleration_unit, magnitude_unit : str, optional
        Where a file is not in its format's own unit.
    sampling_s : float, optional
        Of a discrete model whose file does not say.
    repair_rounding : bool
        Move the coefficients of a discrete model within the rounding of their printed
        decimals so that the DC gain is 1.
    dc_gain : float, optional
        The DC gain that the model may have: the steps per mm are off by this factor.
    """

    axis: str | None = None
    accel_per_hz_mm_s: Positive | None = None
    f_start_hz: Positive | None = None
    f_end_hz: Positive | None = None
    hz_per_s: Positive | None = None
    sweeping_accel_mm_s2: NonNegative | None = None
    sweeping_period_s: Positive | None = None
    firmware_date: date | None = None
    sensor_axis: Literal["x", "y", "z"] | None = None
    sensor_turned: bool = False
    frame_firm: bool = False
    guides: Guides | None = None
    time_column: Column | None = None
    command_column: Column | None = None
    measured_column: Column | None = None
    axis_column: Column | None = None
    acceleration_unit: Literal["mm/s^2", "m/s^2", "g"] | None = None
    magnitude_unit: Literal["abs", "dB"] | None = None
    sampling_s: Positive | None = None
    repair_rounding: bool = False
    dc_gain: Positive | None = None

    @field_validator("firmware_date", mode="before")
    @classmethod
    def _day(cls, day: object) -> object:
        if isinstance(day, str) and not _DAY.fullmatch(day):
            raise ModelError("a date is written YYYY-MM-DD")
        return day

    @field_validator("axis")
    @classmethod
    def _known_axis(cls, axis: str | None) -> str | None:
        if axis is not None:
            direction_of(axis, allow_z=True)
        return axis

    @model_validator(mode="after")
    def _consistent(self) -> ReadSettings:
        low, high = self.f_start_hz, self.f_end_hz
        if low is not None and high is not None and low >= high:
            raise ModelError(f"min_freq {low:g} must be below max_freq {high:g}")
        if self.repair_rounding and self.dc_gain is not None:
            raise ModelError("repair_rounding makes the DC gain 1; leave out dc_gain")
        return self


def direction_of(axis: str, *, allow_z: bool = False) -> tuple[float, float]:
    """Return the unit vector (x, y) of "x", "y" or a direction like "1.000,-1.000".

    Raises
    ------
    ModelError
        If the text is no axis, or (without `allow_z`) the axis is not in the plane.
    """
    text = axis.strip().lower()
    named = {"x": (1.0, 0.0), "y": (0.0, 1.0)}
    if text in named:
        return named[text]
    if text == "z" and allow_z:
        return 0.0, 0.0
    if _DIAGONAL.fullmatch(text):
        x, y, *rest = (float(part) for part in text.split(","))
        size = math.hypot(x, y)
        if size > 0 and not any(rest):
            return x / size, y / size
    remedy = "give x, y, or components like 1.000,1.000"
    if text == "z":
        remedy = "only X and Y are compensated, so leave out tests along Z"
    raise ModelError(f"axis {axis!r} is not a direction of the plane; {remedy}")


def tested_axis(measurement: Measurement, settings: ReadSettings) -> Axis:
    """Return the axis of the machine that a measurement is of.

    Raises
    ------
    ModelError
        If nothing says it, the test moved both axes at once, or there was none.
    """
    if NO_TEST in measurement.notes:
        raise ModelError(f"{measurement.source}: {NO_TEST}")
    text = settings.axis or measurement.axis
    if text is None:
        raise ModelError(
            f"{measurement.source}: neither the file nor its name says which axis it is of; "
            "give the axis, x or y, or rename the file (resonances_x_1.csv)"
        )
    try:
        x, y = direction_of(text)
    except ModelError as error:
        raise ModelError(f"{measurement.source}: {error}") from None
    if min(abs(x), abs(y)) > 1e-6:
        raise ModelError(
            f"{measurement.source}: measured along {text}, which moves both axes at once; identify "
            "X and Y from tests along X and along Y"
        )
    return "x" if abs(x) > abs(y) else "y"


def excitation_for(
    measurement: AccelerationLog | Spectrum, settings: ReadSettings | None = None
) -> Excitation:
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
    return _resolved(measurement, settings or ReadSettings()).excitation


def excitation_notes(
    measurement: AccelerationLog | Spectrum, settings: ReadSettings | None = None
) -> tuple[str, ...]:
    """Return notes on what `excitation_for` assumed for lack of information."""
    return _resolved(measurement, settings or ReadSettings()).notes


def date_in_name(name: str) -> date | None:
    """Return the date in a file name such as resonances_x_20211217_070942.csv, if it has one."""
    for found in _DATE.finditer(name):
        try:
            return date(*(int(part) for part in found.groups()))
        except ValueError:
            continue
    return None


class _Resolved(NamedTuple):
    excitation: Excitation
    notes: tuple[str, ...]


def _resolved(measurement: AccelerationLog | Spectrum, settings: ReadSettings) -> _Resolved:
    axis = settings.axis or measurement.axis
    if axis is None:
        raise ModelError(
            f"{measurement.source}: neither the file nor its name says which axis was tested; "
            "give the axis"
        )
    made = settings.firmware_date or date_in_name(measurement.source)
    defaults = Excitation(direction=direction_of(axis))
    found: list[str] = []
    start_hz = settings.f_start_hz
    if isinstance(measurement, Spectrum) and start_hz is None:
        start_hz, why = start_of_test(measurement)
        found += why
    by_file = _contradicts(measurement, settings, made, start_hz)
    old = _is_old(made) is not by_file
    given = {
        "accel_per_hz_mm_s": settings.accel_per_hz_mm_s,
        "f_start_hz": start_hz,
        "f_end_hz": settings.f_end_hz,
        "hz_per_s": settings.hz_per_s,
        "sweeping_accel_mm_s2": settings.sweeping_accel_mm_s2,
        "sweeping_period_s": settings.sweeping_period_s,
    }
    written = measurement.accel_per_hz_mm_s if isinstance(measurement, Spectrum) else None
    if written is not None:
        # Kalico writes that of printer.cfg, also where the command gave another (2026-07).
        stated = given["accel_per_hz_mm_s"] = given["accel_per_hz_mm_s"] or written
        if stated != written:
            found.append(f"{_PER_HZ} {stated:g} was stated, {written:g} in the file does not count")
    if isinstance(measurement, Spectrum) and settings.f_end_hz is None:
        given["f_end_hz"], why = end_of_test(measurement, made, defaults.f_end_hz, start_hz)
        found += why
    usual_of_old = _OLD
    if old and settings.f_end_hz is None and _lasts_as_new(measurement, settings):
        usual_of_old = _OLD | {"f_end_hz": defaults.f_end_hz}
    values: dict[str, float] = {}
    assumed: list[str] = []
    for name, value in given.items():
        if value is not None:
            values[name] = value
            continue
        values[name] = (usual_of_old if old else {}).get(name, getattr(defaults, name))
        idle = name == "sweeping_period_s" and values["sweeping_accel_mm_s2"] == 0
        if not idle:
            assumed.append(f"{_KLIPPER[name]} {values[name]:g}")
    if values["f_start_hz"] >= values["f_end_hz"]:
        raise ModelError(
            f"{measurement.source}: the test would run from {values['f_start_hz']:g} to "
            f"{values['f_end_hz']:g} Hz; give both min_freq and max_freq"
        )
    excitation = Excitation(defaults.direction, out_and_back=False, **values)
    if assumed:
        era = _era(made, settings, shows=_kind(measurement) if by_file else "")
        if usual_of_old is not _OLD:
            era += "; the log is 130 s long, as Kalico's test is to 135 Hz"
        found.append(f"assumed {', '.join(assumed)}: the defaults of Klipper {era}")
    return _Resolved(excitation, tuple(found))


def _is_old(made: date | None) -> bool:
    return made is not None and made < _NEW_TEST


def _contradicts(
    measurement: AccelerationLog | Spectrum,
    settings: ReadSettings,
    made: date | None,
    start_hz: float | None,
) -> bool:
    """Return whether a file shows another test than that of its day."""
    if settings.sweeping_accel_mm_s2 is not None:
        return False
    if isinstance(measurement, Spectrum):
        return _table_sweeps(measurement, start_hz) is _is_old(made)
    period_s = settings.sweeping_period_s or Excitation((1.0, 0.0)).sweeping_period_s
    return _sweeps(measurement, period_s) is _is_old(made)


def _lasts_as_new(measurement: AccelerationLog | Spectrum, settings: ReadSettings) -> bool:
    """Return whether a log is as long as the test of since 2024-12.

    Kalico's has no slow sweep, nor has Klipper's with sweeping_period 0 (printer.cfg).
    """
    stated = (settings.f_start_hz, settings.hz_per_s)
    if isinstance(measurement, Spectrum) or any(one is not None for one in stated):
        return False
    usual = Excitation((1.0, 0.0))
    test_s = (usual.f_end_hz - usual.f_start_hz) / usual.hz_per_s
    lasted_s = float(measurement.time_s[-1] - measurement.time_s[0])
    return _LONGER_S[0] <= lasted_s - test_s <= _LONGER_S[1]


def _table_sweeps(table: Spectrum, start_hz: float | None) -> bool | None:
    """Return whether a table shows the slow square wave of tests since 2024-12; None if unsure."""
    axes = [psd for name, psd in table.psd.items() if name in ("x", "y", "z")]
    densities = np.array([np.sum(axes, axis=0)] if axes else [*table.psd.values()])
    powers = densities * np.gradient(table.f_hz)

    def largest(band_hz: tuple[float, float]) -> float:
        within = (table.f_hz >= band_hz[0]) & (table.f_hz <= band_hz[1])
        return float(powers[:, within].sum(axis=1).max())

    if table.f_hz[0] > _SLOW_BAND_HZ[1]:
        # Klipper before 2024-12 cuts normalised tables at 5 Hz (shaper_calibrate.py, 16b4b6b30).
        return False
    slow = largest(_SLOW_BAND_HZ)
    least, most = np.square(_SLOW_IN_TABLE_MM_S2)
    if slow >= most and slow >= _LEAST_SLOW * largest(first_band_hz(start_hz)):
        return True
    moved = largest((0.0, math.inf)) >= _MOVED_MM_S2**2
    return False if slow <= least and moved else None


def _sweeps(log: AccelerationLog, period_s: float) -> bool | None:
    """Return whether a log shows the slow square wave of tests since 2024-12; None if unsure."""
    time_s, accel = log.time_s, log.accel_mm_s2
    accel = accel[:, ~np.isnan(accel).any(axis=0)]
    if not accel.size or time_s[-1] - time_s[0] < _LEAST_SLOW_S:
        return None
    rate_hz = len(time_s) / float(time_s[-1] - time_s[0])
    block = max(1, round(rate_hz / _SLOW_RATE_HZ))
    means = accel[: len(accel) // block * block].reshape(-1, block, accel.shape[1]).mean(axis=1)
    f_hz = np.fft.rfftfreq(len(means), block / rate_hz)
    slow = np.fft.rfft(means - means.mean(axis=0), axis=0) / len(means)
    inside = np.abs(f_hz - 1.0 / period_s) <= _BESIDE_SLOW_HZ
    slow_mm_s2 = math.sqrt(2.0 * float(np.sum(np.abs(slow[inside]) ** 2)))
    if slow_mm_s2 >= _SLOW_MM_S2[1]:
        return True
    moved_mm_s2 = math.sqrt(float(np.sum(np.var(accel, axis=0))))
    return False if slow_mm_s2 <= _SLOW_MM_S2[0] and moved_mm_s2 >= _MOVED_MM_S2 else None


def _kind(measurement: AccelerationLog | Spectrum) -> str:
    return "table" if isinstance(measurement, Spectrum) else "log"


def _era(made: date | None, settings: ReadSettings, *, shows: str) -> str:
    """Say why the defaults are those of a time; `shows`: the kind of file that says another."""
    if made is None:
        if shows:
            return f"before 2024-12, because the {shows} shows no slow sweep"
        return (
            "since 2024-12, because no date is known (give firmware_date if the firmware is older)"
        )
    old = _is_old(made)
    told = "firmware_date" if settings.firmware_date else "the date in the file's name"
    if shows:
        era, a = ("since 2024-12", "a") if old else ("before 2024-12", "no")
        return f"{era}, because the {shows} shows {a} slow sweep, whatever {told}, {made}, says"
    era = "before 2024-12" if old else "since 2024-12"
    return f"{era} by {told}, {made.isoformat()}"
