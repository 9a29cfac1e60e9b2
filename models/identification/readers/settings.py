"""Facts that measurement files lack, as the user states them, and the axis a file is of."""

from __future__ import annotations

import math
import re
from datetime import date
from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from stillpath.models.document import Document, NonNegative, Positive
from stillpath.models.errors import ModelError
from stillpath.models.friction import Guides
from stillpath.models.identification.types import AccelerationLog, Axis, Measurement, StopsLog

__all__ = ["ReadSettings", "direction_of", "tested_axis"]

Column = str | Annotated[int, Field(ge=0)]
"""By name, or counted from 0."""

_NO_TEST = (
    "RepRapFirmware has no resonance test of its own, and its log does not say what moved: log a "
    "ring-test, and give its G-code together with the logs, or record command and acceleration "
    "together"
)
_DIAGONAL = re.compile(r"-?\d+(\.\d+)?,-?\d+(\.\d+)?(,-?\d+(\.\d+)?)?")
_DAY = re.compile(r"\d{4}-\d\d-\d\d")


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
    if isinstance(measurement, AccelerationLog) and not measurement.may_hold_test:
        raise ModelError(f"{measurement.source}: {_NO_TEST}")
    text = measurement.axis
    if not isinstance(measurement, StopsLog):
        text = settings.axis or text
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
