"""Measurements of plants that are known, for tests, benchmarks and examples.

The continuous plant is computed exactly: Klipper's command is acceleration that is constant
between knots, and so is the response of every pole in closed form, at any time.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stillpath.models.arrays import Array
from stillpath.models.errors import ModelError
from stillpath.models.identification.excitation import VelocityProfile, klipper_psd, regenerate
from stillpath.models.identification.types import AccelerationLog, Excitation, Spectrum
from stillpath.models.plants import PlantSpec, continuous

__all__ = [
    "ADXL345",
    "LIS2DW",
    "Sensor",
    "acceleration_response",
    "file_axis",
    "simulate_log",
    "simulate_spectrum",
    "write_raw_data",
    "write_table",
]

_GRAVITY_MM_S2 = np.array([0.0, 0.0, 9806.65])
_STOP_MM_S2 = 3000.0
_LARGEST_CONDITION = 1e7
_IDENTITY = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@dataclass(frozen=True, slots=True)
class Sensor:
    """An accelerometer and its errors.

    Attributes
    ----------
    noise_mm_s2 : float
        Standard deviation of white noise, per sample and axis.
    lsb_mm_s2 : float
        Readings are whole multiples of it; 0: not rounded.
    rotation : 3 x 3
        From the machine's axes to the sensor's.
    delay_s : float
        Readings are this late.
    jitter_s : float
        Standard deviation of the error of each time stamp.
    """

    rate_hz: float = 3200.0
    noise_mm_s2: float = 60.0
    lsb_mm_s2: float = 37.0
    rotation: tuple[tuple[float, float, float], ...] = _IDENTITY
    delay_s: float = 0.0
    gain: float = 1.0
    jitter_s: float = 0.0


ADXL345 = Sensor()
LIS2DW = Sensor(rate_hz=1600.0, lsb_mm_s2=4.8)


def acceleration_response(plant: PlantSpec, profile: VelocityProfile, time_s: ArrayLike) -> Array:
    """Return the acceleration with which `plant` follows `profile`, exact at any times.

    y'' = G u'' with u'' constant between the knots: each pole p of the partial fractions
    d + sum of r/(s - p) is advanced by exp(p dt) from knot to knot, and from a knot to a sample.

    Raises
    ------
    ModelError
        If poles coincide, or a discrete plant has no continuous equivalent.
    """
    t = np.asarray(time_s, np.float64)
    poles, residues, through = _partial_fractions(plant)
    knots, driven = profile.time_s, np.append(profile.accelerations_mm_s2(), 0.0)
    piece = np.searchsorted(knots, t, side="right") - 1
    moving = piece >= 0
    piece = np.maximum(piece, 0)
    since = np.where(moving, t - knots[piece], 0.0)
    drive = np.where(moving, driven[piece], 0.0)
    response = through * drive
    for pole, residue in zip(poles, residues, strict=True):
        state = _states_at_knots(pole, knots, driven)[piece]
        # x(t) = -a/p + exp(p t) (x0 + a/p): rest, and a decaying distance from it.
        at_rest = -drive / pole
        response += (residue * (at_rest + np.exp(pole * since) * (state - at_rest))).real
    return np.asarray(response, np.float64)


def simulate_log(
    plants: Mapping[str, PlantSpec],
    excitation: Excitation,
    *,
    sensor: Sensor = ADXL345,
    start_s: float = 100.0,
    lead_s: float = 0.5,
    tail_s: float = 0.5,
    rng: np.random.Generator,
) -> AccelerationLog:
    """Simulate the recording of an accelerometer at the nozzle during Klipper's resonance test.

    Parameters
    ----------
    plants : mapping of "x", "y" to PlantSpec
        Those of the axes that move.
    start_s : float
        The test's true start, on the clock of the log.
    lead_s, tail_s : float
        Rest that is recorded before and after. Negative: the log begins late or ends early.

    Returns
    -------
    AccelerationLog
        With gravity.
    """
    profile = _brought_to_rest(regenerate(excitation))
    count = int((lead_s + profile.duration_s + tail_s) * sensor.rate_hz) + 1
    taken = np.arange(count) / sensor.rate_hz - lead_s + rng.uniform(0, 1 / sensor.rate_hz)
    machine = np.zeros((count, 3))
    for column, (axis, share) in enumerate(zip("xy", excitation.direction, strict=True)):
        if share != 0.0:
            followed = acceleration_response(plants[axis], profile, taken - sensor.delay_s)
            machine[:, column] = share * followed
    seen = sensor.gain * (machine + _GRAVITY_MM_S2) @ np.array(sensor.rotation).T
    seen += rng.normal(0.0, 1.0, seen.shape) * sensor.noise_mm_s2
    if sensor.lsb_mm_s2:
        seen = np.round(seen / sensor.lsb_mm_s2) * sensor.lsb_mm_s2
    stamps = start_s + taken + rng.normal(0.0, 1.0, count) * sensor.jitter_s
    return AccelerationLog(stamps, seen, _axis_name(excitation), "simulated")


def simulate_spectrum(
    plants: Mapping[str, PlantSpec],
    excitation: Excitation,
    *,
    sensor: Sensor = ADXL345,
    rng: np.random.Generator,
) -> Spectrum:
    """Return Klipper's power spectral densities of a simulated test, up to 200 Hz."""
    log = simulate_log(plants, excitation, sensor=sensor, lead_s=0.0, tail_s=0.0, rng=rng)
    f, psd = klipper_psd(log.time_s, log.accel_mm_s2)
    kept = f <= 200.0
    columns = {name: psd[kept, i] for i, name in enumerate("xyz")}
    columns["xyz"] = psd[kept].sum(axis=1)
    return Spectrum(f[kept], columns, log.axis, log.source)


def write_raw_data(log: AccelerationLog, folder: Path, name: str = "20260101_120000") -> Path:
    """Write `raw_data_<axis>_<name>.csv` as Klipper does; return its path."""
    path = folder / f"raw_data_{file_axis(log.axis)}_{name}.csv"
    rows = np.column_stack([log.time_s, log.accel_mm_s2])
    write_table(path, "#time,accel_x,accel_y,accel_z", "%.6f,%.6f,%.6f,%.6f", rows)
    return path


def _partial_fractions(
    plant: PlantSpec,
) -> tuple[NDArray[np.complex128], NDArray[np.complex128], float]:
    """Return poles (upper half plane), their residues and the direct term.

    Pairs are counted once, with twice the residue: the real part is the sum of both.
    """
    system = continuous(plant)
    if system.order == 0:
        return np.zeros(0, complex), np.zeros(0, complex), system.d
    poles, vectors = np.linalg.eig(system.a)
    if not np.linalg.cond(vectors) < _LARGEST_CONDITION:
        raise ModelError("poles of the plant coincide; move them apart by 0.1 %")
    residues = (system.c @ vectors) * np.linalg.solve(vectors, system.b.astype(complex))
    once = poles.imag >= 0
    twice = np.where(poles.imag > 0, 2.0, 1.0)
    return poles[once].astype(complex), (twice * residues)[once], system.d


def _states_at_knots(pole: complex, knots: Array, driven: Array) -> NDArray[np.complex128]:
    """Advance x' = p x + a from rest over the pieces between the knots."""
    decay = np.exp(pole * np.diff(knots))
    gained = (decay - 1.0) / pole * driven[:-1]
    states = np.zeros(len(knots), complex)
    state = 0j
    for k, (factor, added) in enumerate(zip(decay.tolist(), gained.tolist(), strict=True), 1):
        state = factor * state + added
        states[k] = state
    return states


def _brought_to_rest(profile: VelocityProfile) -> VelocityProfile:
    """Add the stop of the machine's own acceleration after the test."""
    last = float(profile.velocity_mm_s[-1])
    if last == 0.0:
        return profile
    end = profile.duration_s + abs(last) / _STOP_MM_S2
    return VelocityProfile(np.append(profile.time_s, end), np.append(profile.velocity_mm_s, 0.0))


def _axis_name(excitation: Excitation) -> str:
    named = {(1.0, 0.0): "x", (0.0, 1.0): "y"}
    return named.get(excitation.direction, "{:.3f},{:.3f}".format(*excitation.direction))


def file_axis(axis: str | None) -> str:
    """Return how Klipper calls an axis in a file's name."""
    return axis if axis in ("x", "y", "z") else f"axis={axis},0.000"


def write_table(path: Path, header: str, layout: str, rows: Array) -> None:
    """Write rows of numbers as text."""
    lines = (layout % tuple(row) for row in rows.tolist())
    path.write_text("\n".join([header, *lines, ""]), encoding="ascii")
