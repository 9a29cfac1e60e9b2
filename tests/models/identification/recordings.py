"""Files of simulated resonance tests, whole and broken, for the tests of identification."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from stillpath.applications.identification.run import InputFile
from stillpath.models.identification.conditions import Condition
from stillpath.models.identification.synthetic import (
    ADXL345,
    Sensor,
    simulate_log,
    simulate_spectrum,
    write_raw_data,
)
from stillpath.models.identification.types import AccelerationLog, Excitation, Spectrum
from stillpath.models.plants import PairsSpec, PlantSpec, PolePair, frequency_response
from tests.models.identification.klipper_files import write_resonances

__all__ = [
    "BROKEN",
    "LEGACY",
    "QUICK",
    "QUICK_OPTIONS",
    "QUICK_QUERY",
    "QUICK_SETTINGS",
    "SWEEPING",
    "TAZ",
    "along",
    "broken",
    "late_by_less",
    "one_mode",
    "quick_log",
    "quick_raw",
    "raw_file",
    "spectrum_file",
    "table",
]

SWEEPING = Excitation((1.0, 0.0))
LEGACY = Excitation((1.0, 0.0), 5.0, 10_000 / 75, 75.0, 1.0, 0.0, out_and_back=True)
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


def late_by_less(log: AccelerationLog, plant: PairsSpec, share: float) -> AccelerationLog:
    """Return the log of an axis whose phase is only a share of its plant's, as under friction."""
    accel = np.array(log.accel_mm_s2)
    f_hz = np.fft.rfftfreq(len(accel), float(np.median(np.diff(log.time_s))))
    turned = np.exp(1j * (share - 1) * np.angle(frequency_response(plant, f_hz)))
    spectra = turned[:, None] * np.fft.rfft(accel, axis=0)
    return replace(log, accel_mm_s2=np.fft.irfft(spectra, len(accel), axis=0))


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


def broken(what: str) -> list[InputFile]:
    """Files that `what` of `BROKEN` is wrong with."""
    whole = quick_raw("x")
    rows = table(whole)
    made: dict[str, Callable[[], list[InputFile]]] = {
        "same axis twice": lambda: [whole, raw_file(replace(quick_log("x", seed=3), axis="y"))],
        "sensor elsewhere": lambda: [quick_raw("x", sensor=replace(QUICK_SENSOR, gain=0.02))],
        "sensor at rest": lambda: [quick_raw("x", sensor=replace(QUICK_SENSOR, gain=0.0))],
        "dead column": lambda: _of(rows[:1] + [_constant(row) for row in rows[1:]]),
        "gap": lambda: _of(rows[:4000] + rows[4010:]),
        "overflow of M956": lambda: _of(_m956(quick_log("x")), "accelerations_x.csv"),
        "overflow of Klipper": lambda: _of([b"## overflows: 7\n", *rows]),
        "accel_per_hz": lambda: [quick_raw("x", test=replace(QUICK, accel_per_hz_mm_s=75.0))],
        "empty": lambda: _of([]),
        "cut off": lambda: _of(rows[:8000]),
        "other sweep": lambda: [quick_raw("x", test=replace(QUICK, hz_per_s=1.0, f_end_hz=35.0))],
        "two tests": lambda: [raw_file(_two_tests())],
        "of nothing known": lambda: _of([b"a,b\n", b"1,2\n", b"3,4\n"]),
    }
    return made[what]()


BROKEN = {
    "same axis twice": ["same axis was measured twice", "measure the other"],
    "sensor elsewhere": ["0.02 times as much", "measure at the part"],
    "sensor at rest": ["does not move with the tested axis", "measure at the part"],
    "dead column": ["x is dead", "check the sensor"],
    "gap": ["line 4001: gap in time", "10 samples are missing", "Measure again"],
    "overflow of M956": ["overflowed 3 times", "record again"],
    "overflow of Klipper": ["overflowed 7 times", "record again"],
    "accel_per_hz": ["1.25 times as much", "looks like accel_per_hz = 74.", "printer.cfg"],
    "empty": ["the file is empty"],
    "cut off": ["the log ends", "before the end of the test", "record the whole test"],
    "other sweep": ["the test is not in the log", "check min_freq, max_freq, hz_per_sec"],
    "two tests": ["more than one test", "give a log of one test"],
    "of nothing known": ["not a known format", "'a,b'"],
}
"""What is wrong with files, and words of the message that each must get."""


def _of(rows: list[bytes], name: str = "raw_data_x_20260101_120000.csv") -> list[InputFile]:
    return [InputFile(name, b"".join(rows))]


def _constant(row: bytes) -> bytes:
    time, _, *rest = row.split(b",")
    return b",".join([time, b"12.500000", *rest])


def _m956(log: AccelerationLog) -> list[bytes]:
    rows = [
        "{},{:.3f},{:.3f},{:.3f}\n".format(i, *a).encode()
        for i, a in enumerate(log.accel_mm_s2 / 9806.65)
    ]
    return [b"Sample,X,Y,Z\n", *rows, b"Rate 500, overflows 3\n"]


def _two_tests() -> AccelerationLog:
    """One after the other, without a gap."""
    first = quick_log("x", seed=1, tail_s=2.0)
    second = quick_log("x", seed=2, start_s=float(first.time_s[-1]) + 0.502)
    rows = [
        np.concatenate(pair)
        for pair in ((first.time_s, second.time_s), (first.accel_mm_s2, second.accel_mm_s2))
    ]
    return AccelerationLog(rows[0], rows[1], "x")
