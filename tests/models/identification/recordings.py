"""Files of simulated resonance tests, whole and broken, for the tests of identification."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from models.identification.conditions import Condition
from models.identification.synthetic import (
    ADXL345,
    Sensor,
    simulate_log,
    simulate_spectrum,
    write_raw_data,
    write_resonances,
)
from models.identification.types import AccelerationLog, Excitation, Spectrum
from models.plants import PairsSpec, PlantSpec, PolePair
from service.identification.run import InputFile

__all__ = [
    "LEGACY",
    "QUICK",
    "QUICK_OPTIONS",
    "QUICK_QUERY",
    "QUICK_SETTINGS",
    "SWEEPING",
    "TAZ",
    "along",
    "broken",
    "one_mode",
    "quick_log",
    "quick_raw",
    "raw_file",
    "spectrum_file",
    "table",
]

SWEEPING = Excitation((1.0, 0.0))
LEGACY = Excitation((1.0, 0.0), 5.0, 10_000 / 75, 75.0, 1.0, 0.0, 0.0)
# Half a minute at 500 Hz: little, and still enough for one mode.
QUICK = Excitation((1.0, 0.0), 5.0, 65.0, 60.0, 2.0, 0.0)
QUICK_SENSOR = Sensor(rate_hz=500.0, noise_mm_s2=20.0)
QUICK_SETTINGS = {"f_end_hz": 65.0, "hz_per_s": 2.0, "sweeping_accel_mm_s2": 0.0}
QUICK_QUERY = {"max_freq": 65, "hz_per_sec": 2, "sweeping_accel": 0}
QUICK_OPTIONS = ["--max-freq", "65", "--hz-per-sec", "2", "--sweeping-accel", "0"]
TAZ = (
    '{"num": [0.0874, -0.3415, 0.5118, -0.3481, 0.09063], '
    '"den": [1.0, -4.54, 8.283, -7.583, 3.479, -0.639], "dt": 0.001}'
)
"""As printed in the dissertation: an integrator, by rounding."""


def one_mode(f_hz: float, zeta: float) -> PairsSpec:
    return PairsSpec(poles=(PolePair(f_hz=f_hz, zeta=zeta),))


def along(axis: str, test: Excitation = QUICK) -> Excitation:
    return replace(test, direction={"x": (1.0, 0.0), "y": (0.0, 1.0)}[axis])


def quick_log(
    axis: str = "x", plant: PlantSpec | None = None, *, seed: int = 0, **options: Any
) -> AccelerationLog:
    """A short test of one mode (X 42 Hz/.06, Y 35 Hz/.08)."""
    test = along(axis, options.pop("test", QUICK))
    truth: dict[str, PlantSpec] = {"x": one_mode(42.0, 0.06), "y": one_mode(35.0, 0.08)} | (
        {axis: plant} if plant else {}
    )
    options = {"sensor": QUICK_SENSOR, "rng": np.random.default_rng(seed)} | options
    return simulate_log(truth, test, **options)


def quick_raw(
    axis: str = "x", plant: PlantSpec | None = None, *, condition: str = "", **options: Any
) -> InputFile:
    """The file of `quick_log`."""
    name = options.pop("name", "20260101_120000")
    return raw_file(quick_log(axis, plant, **options), name, condition)


def raw_file(log: AccelerationLog, name: str = "20260101_120000", condition: str = "") -> InputFile:
    return _written(lambda folder: write_raw_data(log, folder, name), condition)


def spectrum_file(
    plant: PlantSpec,
    test: Excitation = SWEEPING,
    *,
    name: str = "20260101_120000",
    write: Callable[[Spectrum, Path, str], Path] = write_resonances,
    sensor: Sensor = ADXL345,
    seed: int = 0,
    condition: str = "",
) -> InputFile:
    rng = np.random.default_rng(seed)
    spectrum = simulate_spectrum({"x": plant, "y": plant}, test, sensor=sensor, rng=rng)
    return _written(lambda folder: write(spectrum, folder, name), condition)


def table(file: InputFile) -> list[bytes]:
    """The lines of a file, to be broken."""
    return file.content.splitlines(keepends=True)


def _written(write: Callable[[Path], Path], condition: str) -> InputFile:
    with tempfile.TemporaryDirectory() as folder:
        path = write(Path(folder))
        return InputFile(path.name, path.read_bytes(), Condition.parse(condition))


def broken() -> dict[str, tuple[list[InputFile], list[str]]]:
    """Files by what is wrong with them, with words of the message they must get."""
    whole = quick_raw("x")
    rows = table(whole)

    def of(lines: list[bytes], name: str = whole.name) -> list[InputFile]:
        return [InputFile(name, b"".join(lines))]

    def column(value: bytes) -> list[bytes]:
        parts = [row.split(b",") for row in rows[1:]]
        return [rows[0], *(b",".join([p[0], value, *p[2:]]) for p in parts)]

    moved = quick_log("x", seed=1)
    two = quick_log("x", seed=2, start_s=float(moved.time_s[-1]) + 1.002)
    # Between the two nothing is missing: the first one's rest is made as long as the pause.
    gap = np.arange(moved.time_s[-1] + 0.002, two.time_s[0] - 0.001, 0.002)
    rest = np.tile(moved.accel_mm_s2[-1], (len(gap), 1))
    twice = AccelerationLog(
        np.concatenate([moved.time_s, gap, two.time_s]),
        np.concatenate([moved.accel_mm_s2, rest, two.accel_mm_s2]),
        "x",
    )
    m956 = [b"Sample,X,Y,Z\n"]
    for i, a in enumerate(moved.accel_mm_s2 / 9806.65):
        m956.append(f"{i},{a[0]:.3f},{a[1]:.3f},{a[2]:.3f}\n".encode())
    m956.append(b"Rate 500, overflows 3\n")
    same = [whole, raw_file(replace(quick_log("x", seed=3), axis="y"))]
    other = quick_log("x", sensor=Sensor(rate_hz=500.0, noise_mm_s2=20.0, gain=0.02))
    return {
        "other axis measured": (same, ["same axis was measured twice", "measure the other"]),
        "sensor elsewhere": ([raw_file(other)], ["does not move with", "measure at the part"]),
        "dead column": (of(column(b"12.500000")), ["x is dead", "check the sensor"]),
        "gap": (of(rows[:4000] + rows[4010:]), ["gap in time", "line 4001", "Measure again"]),
        "overflow": (of(m956, "accel_x.csv"), ["overflowed 3 times", "record again"]),
        "overflow of klipper": (
            of([b"## overflows: 7\n", *rows]),
            ["overflowed 7 times", "record again"],
        ),
        "accel_per_hz": (
            [quick_raw("x", test=replace(QUICK, accel_per_hz_mm_s=75.0))],
            ["1.25 times", "accel_per_hz = 75", "printer.cfg"],
        ),
        "empty": (of([]), ["empty"]),
        "truncated": (of(rows[:8000]), ["ends", "record the whole"]),
        "other sweep": (
            [quick_raw("x", test=replace(QUICK, hz_per_s=1.0, f_end_hz=35.0))],
            ["the test is not in the log", "hz_per_sec"],
        ),
        "two tests": ([raw_file(twice)], ["more than one test", "give a log of one test"]),
    }
