"""What else explains responses: plants that do explain them."""

from __future__ import annotations

import numpy as np
import pytest

from stillpath.models.identification.identify import Measured, identify
from stillpath.models.identification.readers import ReadSettings
from stillpath.models.identification.types import AccelerationLog
from stillpath.models.plants import PairsSpec, RelativeModesSpec
from stillpath.simulation.printers.drawing import draw
from stillpath.simulation.printers.resonance_test import OLD_TEST, drawn_sensor, run_test


@pytest.mark.slow
def test_all_members_have_the_resonance_that_was_measured() -> None:
    """In noisy logs fits to what might have come out lose their way: they find 7 or 130 Hz."""
    printer, rng = draw("bed slinger", 17), np.random.default_rng(7)
    sensor, measured = drawn_sensor(rng), []
    for run in range(2):
        record = run_test(printer, "y", sensor, rng, OLD_TEST)
        log = AccelerationLog(record.time_s, record.accel_mm_s2, "y", f"raw_y_{run}.csv")
        measured.append(Measured(log))
    settings = ReadSettings(
        accel_per_hz_mm_s=OLD_TEST.accel_per_hz_mm_s,
        f_start_hz=OLD_TEST.f_start_hz,
        f_end_hz=OLD_TEST.f_end_hz,
        hz_per_s=OLD_TEST.hz_per_s,
        sweeping_accel_mm_s2=OLD_TEST.sweeping_accel_mm_s2,
    )
    found = identify(measured, settings)["y"].plants
    true_hz = 40.1
    for member in found.weighted_members():
        plant = member.plant
        assert isinstance(plant, PairsSpec | RelativeModesSpec)
        modes = plant.poles if isinstance(plant, PairsSpec) else plant.modes
        assert min(abs(mode.f_hz / true_hz - 1.0) for mode in modes) < 0.15
