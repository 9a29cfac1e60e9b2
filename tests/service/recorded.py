"""Accelerometer logs of prints, simulated: a plant of their own, a turned sensor, another clock."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from stillpath.models.friction import DryFriction
from stillpath.models.machine import Machine
from stillpath.models.plants import discretise
from stillpath.models.shaping import OFF, Shaping
from stillpath.pipeline.shaping import shaped
from stillpath.pipeline.simulate import plan_file
from stillpath.simulation.response import PlantStream

__all__ = ["record"]

_RATE_HZ = 4000
_GRAVITY_MM_S2 = 9806.65


def record(
    printed: Path,
    machine: Machine,
    log: Path,
    *,
    frequency: tuple[float, float] = (1.0, 1.0),
    damping: float = 1.0,
    sees: tuple[float, float] = (1.0, 1.0),
    rate_hz: float = 1600.0,
    start_s: float = 0.0,
    seconds: float = 40.0,
    clock: float = 1.0 + 1e-4,
    noise_mm_s2: float = 60.0,
    step_mm_s2: float = 37.0,
    seed: int = 0,
    shaping: Shaping = OFF,
    rrf: bool = False,
) -> None:
    """Write what a sensor of unknown mounting records during a print.

    Parameters
    ----------
    frequency, damping
        Factors between the machine's model and the true plants of x and y.
    sees : (float, float)
        How much of X and Y the sensor takes part in.
    clock : float
        Log seconds in a second of the print.
    shaping : Shaping
        The firmware's shaper, if the file sets none.
    rrf : bool
        As RepRapFirmware's M956 writes it, else as Klipper does.
    """
    with tempfile.TemporaryDirectory() as folder:
        motion = Path(folder, "motion.npz")
        plan_file(printed, motion, machine, rate_hz=_RATE_HZ)
        with np.load(motion) as columns:
            position = np.stack([columns["x"], columns["y"]])
    if shaping.is_on:
        position = shaped(position, shaping, 1 / _RATE_HZ)
    plants = [
        discretise(machine.axes[axis].nominal.scaled(factor, damping), 1 / _RATE_HZ)
        for axis, factor in zip(("x", "y"), frequency, strict=True)
    ]
    nozzle = PlantStream(plants).push(
        DryFriction(machine.friction_mm, 1 / _RATE_HZ).received_mm(position)
    )
    accel = np.zeros_like(nozzle)
    accel[:, 1:-1] = np.diff(nozzle, 2) * _RATE_HZ**2
    count = int(seconds * rate_hz)
    t = start_s + np.arange(count) / rate_hz
    own = np.arange(nozzle.shape[1]) / _RATE_HZ
    felt = [s * np.interp(t, own, row, 0, 0) for s, row in zip(sees, accel, strict=True)]
    rng = np.random.default_rng(seed)
    turned, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    rows = (turned @ np.stack([*felt, np.full(count, _GRAVITY_MM_S2)])).T
    rows += noise_mm_s2 * rng.normal(size=rows.shape)
    rows = step_mm_s2 * np.round(rows / step_mm_s2)
    with log.open("w") as file:
        if rrf:
            file.write("Sample,X,Y,Z\n")
            table = np.column_stack([np.arange(count), rows / _GRAVITY_MM_S2])
            np.savetxt(file, table, fmt=["%d", "%.4f", "%.4f", "%.4f"], delimiter=",")
            file.write(f"Rate {rate_hz / clock:.0f}, overflows 0\n")
        else:
            file.write("#time,accel_x,accel_y,accel_z\n")
            stamped = np.column_stack([1234.5 + clock * t, rows])
            np.savetxt(file, stamped, fmt="%.6f", delimiter=",")
