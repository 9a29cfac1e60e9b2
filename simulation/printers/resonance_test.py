"""Klipper's resonance test on a virtual printer, and the files that it writes.

The accelerometer has the faults of real ones: wrong gains, a rotated mounting, noise, quantisation,
a sampling rate that is not quite the nominal one, and a clock with an arbitrary origin.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from stillpath.models.arrays import Array
from stillpath.models.identification.excitation import klipper_psd, regenerate
from stillpath.models.identification.types import Excitation
from stillpath.simulation.printers.bodies import STEP_S, Bodies, Element
from stillpath.simulation.printers.machines import Printer

__all__ = ["NEW_TEST", "OLD_TEST", "Accelerometer", "Record", "drawn_sensor", "run_test"]

OLD_TEST = Excitation((1.0, 0.0), 5.0, 133.33, 75.0, 1.0, 0.0, out_and_back=True)
NEW_TEST = Excitation((1.0, 0.0))
_GRAVITY_MM_S2 = 9806.65
_DWELL_S = 0.5
_BEGAN_S = 10.0 + _DWELL_S
"""When the test begins, on the clock of the command."""
_HIGHEST_HZ = 200.0
_CHIPS = {"adxl345": (3200.0, 38.3), "lis2dw": (1600.0, 2.4)}
"""Rate in Hz and step in mm/s2."""


@dataclass(frozen=True, slots=True)
class Accelerometer:
    """A sensor.

    Attributes
    ----------
    gains : tuple of float
        Of its three axes.
    turn_rad : tuple of float
        Rotation about x, y and z.
    offset_s : float
        Lead of its clock over the command's.
    """

    rate_hz: float
    step_mm_s2: float
    noise_mm_s2: float
    gains: tuple[float, float, float] = (1.0, 1.0, 1.0)
    turn_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)
    offset_s: float = 0.0

    def record(self, time_s: Array, accel_mm_s2: Array, rng: np.random.Generator) -> Record:
        """Return its record of accelerations (3, n) at times (n,), gravity included."""
        own_s = np.arange(time_s[0], time_s[-1], 1.0 / self.rate_hz)
        seen = np.stack([np.interp(own_s, time_s, row) for row in accel_mm_s2])
        seen[2] += _GRAVITY_MM_S2
        seen = np.array(self.gains)[:, None] * (_turned(self.turn_rad) @ seen)
        seen += self.noise_mm_s2 * rng.standard_normal(seen.shape)
        seen = self.step_mm_s2 * np.round(seen / self.step_mm_s2)
        return Record(own_s + self.offset_s, seen.T.copy())


@dataclass(frozen=True, slots=True, eq=False)
class Record:
    """Record of an accelerometer: `time_s` (n,), `accel_mm_s2` (n, 3)."""

    time_s: Array
    accel_mm_s2: Array

    def raw_data(self) -> bytes:
        """Return the file that Klipper writes with OUTPUT=raw_data."""
        rows = (
            f"{t:.6f},{x:.6f},{y:.6f},{z:.6f}"
            for t, (x, y, z) in zip(self.time_s, self.accel_mm_s2, strict=True)
        )
        return ("#time,accel_x,accel_y,accel_z\n" + "\n".join(rows) + "\n").encode()

    def resonances(self) -> bytes:
        """Return the table that Klipper writes with OUTPUT=resonances."""
        f_hz, psd = klipper_psd(self.time_s, self.accel_mm_s2)
        lines = ["freq,psd_x,psd_y,psd_z,psd_xyz"]
        for f, row in zip(f_hz, psd, strict=True):
            if f <= _HIGHEST_HZ:
                x, y, z = row
                lines.append(f"{f:.1f},{x:.3e},{y:.3e},{z:.3e},{row.sum():.3e}")
        return ("\n".join(lines) + "\n").encode()


def drawn_sensor(rng: np.random.Generator, chip: str | None = None) -> Accelerometer:
    """Draw a typical accelerometer: gains up to 15 % off, rotated by some degrees."""
    chip = chip or str(rng.choice(sorted(_CHIPS)))
    rate_hz, step_mm_s2 = _CHIPS[chip]
    gains = rng.uniform(0.85, 1.15, 3)
    turn = np.deg2rad(rng.uniform(-5.0, 5.0, 3))
    return Accelerometer(
        rate_hz=float(rate_hz * rng.uniform(0.98, 1.02)),
        step_mm_s2=step_mm_s2,
        noise_mm_s2=float(rng.uniform(30.0, 90.0)),
        gains=(float(gains[0]), float(gains[1]), float(gains[2])),
        turn_rad=(float(turn[0]), float(turn[1]), float(turn[2])),
        offset_s=float(rng.uniform(-0.05, 0.05)),
    )


def run_test(
    printer: Printer,
    axis: str,
    sensor: Accelerometer,
    rng: np.random.Generator,
    test: Excitation = NEW_TEST,
    *,
    rests: bool = True,
) -> Record:
    """Test an axis, "x" or "y"; the machine changes slightly from run to run.

    Stiffnesses move by 1 % (half of that in frequency), dry friction by 10 %, from run to run.

    Parameters
    ----------
    rests : bool
        Whether the rests before and after are recorded too. Klipper's raw logs lack them: they hold
        what is sampled between the first move and the last (klippy/extras/adxl345.py, 2026-08-07).
    """
    number = "xy".index(axis)
    profile = regenerate(replace(test, direction=(1.0, 0.0) if number == 0 else (0.0, 1.0)))
    time_s = np.arange(-_DWELL_S, profile.duration_s + 0.2, STEP_S)
    speed = np.interp(time_s, profile.time_s, profile.velocity_mm_s, left=0.0, right=0.0)
    way = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * STEP_S)])
    command = np.zeros((2, len(time_s)))
    command[number] = way
    today = replace(printer, bodies=_another_day(printer.bodies, rng))
    motion = today.follow(command)
    felt = printer.felt @ motion.accel_mm_s2
    accel = np.vstack([felt, np.zeros((1, len(time_s)))])
    if printer.kind == "bed slinger":
        # The sensor sits on the head in tests of X and on the bed in those of Y.
        accel[1 - number] = 0.0
    record = sensor.record(time_s + _BEGAN_S, accel, rng)
    if rests:
        return record
    since_s = record.time_s - sensor.offset_s - _BEGAN_S
    kept = (since_s >= 0.0) & (since_s <= profile.duration_s)
    return Record(record.time_s[kept], record.accel_mm_s2[kept])


def _another_day(bodies: Bodies, rng: np.random.Generator) -> Bodies:
    def drift(one: Element) -> Element:
        factor = float(np.exp(0.01 * rng.standard_normal()))
        return replace(one, k_n_m=one.k_n_m * factor)

    frictions = tuple(
        replace(f, force_n=f.force_n * float(np.exp(0.1 * rng.standard_normal())))
        for f in bodies.frictions
    )
    return replace(bodies, elements=tuple(map(drift, bodies.elements)), frictions=frictions)


def _turned(angles_rad: tuple[float, float, float]) -> Array:
    (cx, cy, cz), (sx, sy, sz) = np.cos(angles_rad), np.sin(angles_rad)
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1.0]])
    return np.asarray(about_z @ about_y @ about_x)
