"""G-code with which each firmware logs its accelerometer during a ring test."""

from __future__ import annotations

import hashlib
import math
import re
from dataclasses import dataclass

from stillpath.models.errors import ModelError
from stillpath.models.machine import Machine

__all__ = ["Recorder", "RingSettings", "recorder_for"]

_RATES_HZ = (1300.0, 1700.0)
"""Sampling rates of the accelerometers that RepRapFirmware supports, with a margin."""
_MOST_SAMPLES = 65535
"""S of M956 holds 16 bits (RepRapFirmware src/Accelerometers/Accelerometers.cpp, 3.4 to 3.6)."""
_CHIPS = {
    "klipper": (
        re.compile(r"""[^\s;#*="']+"""),
        "CHIP of ACCELEROMETER_MEASURE is one word: of a section [adxl345 head] it is head",
    ),
    "reprapfirmware": (
        re.compile(r"\d+(\.\d+)?"),
        "P of M956 is a number, such as 0 or 121.0",
    ),
}
"""Names of a sensor that the firmware takes; the file would stop at others, homed and logging."""


@dataclass(frozen=True, slots=True)
class RingSettings:
    """Settings that are not in the machine's model.

    Attributes
    ----------
    chip_x, chip_y : str, optional
        The sensor that moves with X, and with Y if that is another one: CHIP of
        ACCELEROMETER_MEASURE, P of M956. None: the firmware's default; the same for Y as for X.
    start_gcode : str, optional
        Instead of the line that homes.
    accel_mm_s2 : float, optional
        Acceleration of the stops, instead of the firmware's for X and Y.
    """

    chip_x: str | None = None
    chip_y: str | None = None
    start_gcode: str | None = None
    accel_mm_s2: float | None = None


class Recorder:
    """Lines around a ring test; the base class, for firmware without a sensor, has none.

    Parameters
    ----------
    name : str
        Begins the names of the logs, or ends them. It is the test's own, so that logs of another
        one are not taken for this one's.
    """

    def __init__(self, settings: RingSettings, name: str) -> None:
        self._name = name
        self._chips = (settings.chip_x, settings.chip_y or settings.chip_x)

    @property
    def instruction(self) -> tuple[str, ...]:
        """Instructions to the user for the first lines of the file."""
        return (
            "This firmware logs no accelerations: fix a sensor with a logger of its own to the",
            "part that moves, at 1000 samples per second or more, and let it log from before the",
            "file until after it, as `#time,accel_x,accel_y,accel_z` in s and mm/s2.",
        )

    def first(self) -> tuple[str, ...]:
        """Lines before the first round, at rest."""
        return ()

    def before(self, number: int, seconds: float) -> tuple[str, ...]:  # noqa: ARG002
        """Lines before a round, counted from 1, that takes `seconds`."""
        return ()

    def after(self, seconds: float) -> tuple[str, ...]:  # noqa: ARG002
        """Lines after a round that took `seconds`."""
        return ()

    def last(self) -> tuple[str, ...]:
        """Lines after the last round, at rest."""
        return ()


def recorder_for(machine: Machine, settings: RingSettings) -> Recorder:
    """Return the recorder of a machine's firmware.

    Raises
    ------
    ModelError
        The firmware does not take a sensor's name.
    """
    kind = machine.firmware.kind
    for chip in filter(None, (settings.chip_x, settings.chip_y)):
        if kind in _CHIPS and not _CHIPS[kind][0].fullmatch(chip):
            raise ModelError(f"the sensor {chip!r:.80} (--chip, --chip-y): {_CHIPS[kind][1]}")
    kinds: dict[str, type[Recorder]] = {"klipper": _Klipper, "reprapfirmware": _RepRap}
    plain = machine.model_copy(update={"confirmations": {}})
    digest = hashlib.sha256(f"{plain.revision} {settings}".encode()).hexdigest()[:6]
    return kinds.get(kind, Recorder)(settings, f"ring-{digest}")


class _Klipper(Recorder):
    """One log of every sensor over the whole file."""

    @property
    def instruction(self) -> tuple[str, ...]:
        """Say where the logs are, and how to end one that a cancelled test has begun."""
        words = " and ".join(f"`{line}`" for line in self.first())
        return (
            f"Klipper writes the log, or one per sensor, to /tmp/*-{self._name}.csv. Give what was",
            "logged to `stillpath verify THIS-FILE LOG...`. A test that was cancelled leaves its",
            f"log running, and the next one would end it: send {words}",
            "once before, and again unless the console says that a file is written.",
        )

    def first(self) -> tuple[str, ...]:
        """Start every sensor."""
        return self._each("")

    def last(self) -> tuple[str, ...]:
        """Stop every sensor; each writes its file."""
        return self._each(f" NAME={self._name}")

    def _each(self, more: str) -> tuple[str, ...]:
        chips = dict.fromkeys(self._chips)
        return tuple(
            "ACCELEROMETER_MEASURE" + (f" CHIP={chip}" if chip else "") + more for chip in chips
        )


class _RepRap(Recorder):
    """One log per round, as the number of samples is limited."""

    @property
    def instruction(self) -> tuple[str, ...]:
        """Say where the logs are."""
        return (
            f"The logs are {self._name}-*.csv in 0:/sys/accelerometer. Give all of them to",
            "`stillpath verify THIS-FILE LOG...`.",
        )

    def before(self, number: int, seconds: float) -> tuple[str, ...]:
        """Stand still and start."""
        chips = list(dict.fromkeys(chip or "0" for chip in self._chips))
        names = [
            f"{self._name}-{number}" + (f"-{chip}" if len(chips) > 1 else "") for chip in chips
        ]
        return (
            "M400",
            *(
                f'M956 P{chip} S{_samples(seconds)} A0 F"{name}.csv"'
                for chip, name in zip(chips, names, strict=True)
            ),
        )

    def after(self, seconds: float) -> tuple[str, ...]:
        """Wait until a slow sensor has all its samples: M956 refuses to start before."""
        left_s = _samples(seconds) / _RATES_HZ[0] - seconds
        return ("M400", f"G4 P{1e3 * max(left_s, 1.0):.0f}")


def _samples(seconds: float) -> int:
    return min(math.ceil(_RATES_HZ[1] * seconds), _MOST_SAMPLES)
