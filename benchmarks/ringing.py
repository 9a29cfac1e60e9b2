"""A ring test on a virtual printer, and the machine that is identified from its logs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from stillpath.applications.identification.run import InputFile, identify_files
from stillpath.applications.proof.recorders import RingSettings
from stillpath.applications.proof.ring_test import write_ring_test
from stillpath.models.machine import Machine
from stillpath.pipeline.file_dialect import dialect_for
from stillpath.pipeline.file_motion import TextMotion
from stillpath.simulation.printers.bodies import STEP_S
from stillpath.simulation.printers.machines import Printer
from stillpath.simulation.printers.resonance_test import Accelerometer

__all__ = ["identified_from_stops"]

_CLOCK = 1 + 5e-5
"""Rate of the sensor's clock."""


def identified_from_stops(
    printer: Printer,
    typed: Machine,
    sensor: Accelerometer,
    rng: np.random.Generator,
    folder: Path,
    accel_mm_s2: float | None = None,
) -> Machine:
    """Return the machine that a ring test of a machine with typed-in resonances leads to.

    The sensor of a bed slinger is on the head, then, in a second run, on the bed.
    """
    ring = folder / "ring.gcode"
    write_ring_test(typed, ring, RingSettings(accel_mm_s2=accel_mm_s2), cache_dir=folder)
    with ring.open("rb") as file:
        motion = TextMotion(file, typed, dialect_for(typed, None), STEP_S)
        command = np.concatenate([part.samples.xyz_mm[:2] for part in motion], axis=1)
    felt = printer.felt @ printer.follow(command).accel_mm_s2
    files = [InputFile("ring.gcode", ring.read_bytes())]
    whole = ((True, True),) if printer.kind == "corexy" else ((True, False), (False, True))
    for number, axes in enumerate(whole):
        accel = np.vstack([felt * np.array(axes)[:, None], np.zeros((1, felt.shape[1]))])
        record = sensor.record(STEP_S * np.arange(felt.shape[1]), accel, rng)
        record = replace(record, time_s=record.time_s * _CLOCK)
        files.append(InputFile(f"adxl345-ring-{number}.csv", record.raw_data()))
    return identify_files(files, typed, name=typed.name).machine
