"""Marlin slows short moves that climb by a step of Z; vases are compensated all the same."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from stillpath.models.machine import Machine
from tests.compensating import compensated
from tests.gcode.cutting import ender3_with
from tests.gcode.prints import vase

Z_STEPS_PER_MM = 400.0


@pytest.mark.parametrize(
    ("junction", "speed_mm_s", "turns"),
    [
        ("deviation", 60.0, 2),
        ("deviation", 80.0, -2),
        ("classic_jerk", 80.0, 2),
        ("classic_jerk", 60.0, -2),
    ],
)
def test_a_vase_is_compensated(
    junction: str, speed_mm_s: float, turns: int, tmp_path: Path, cache: Path
) -> None:
    document = ender3_with("marlin").model_dump(mode="json")
    document["firmware"]["junction"] = junction
    text = vase(speed_mm_s, turns=abs(turns))
    if turns < 0:  # it sinks
        text = re.sub(r"(?<= Z)[\d.]+", lambda z: f"{2.0 - float(z[0]):.3f}", text)
    result, written = compensated(text, tmp_path, cache, Machine.model_validate(document))
    assert result.put_back == []
    rms_um = result.features[0].contour_rms_um
    assert rms_um["after"] < rms_um["shaper"] < rms_um["before"]
    assert rms_um["after"] < (3.0 if junction == "deviation" else 5.2)

    # Z climbs evenly, by a step at a time, and comes to where the file says.
    stream = written.decode().split("stillpath: stream on\n")[1].split("stream off")[0]
    z_steps = Z_STEPS_PER_MM * np.array([float(z) for z in re.findall(r"G1.* Z([\d.]+)", stream)])
    assert np.abs(np.diff(z_steps)).max() < 1.01
    assert z_steps[-1] == pytest.approx(Z_STEPS_PER_MM * float(re.findall(r" Z([\d.]+)", text)[-1]))


@pytest.mark.parametrize(
    ("junction", "accel_mm_s2", "speed_mm_s"),
    [
        ("classic_jerk", 1500.0, 40.0),
        ("classic_jerk", 6000.0, 80.0),
        ("deviation", 1500.0, 60.0),
        ("deviation", 3000.0, 80.0),
        ("deviation", 6000.0, 100.0),
    ],
)
def test_with_low_accelerations_too(
    junction: str, accel_mm_s2: float, speed_mm_s: float, tmp_path: Path, cache: Path
) -> None:
    """M201 X500, M205 Z0.3 of most bed slingers: lost time is not made up for."""
    document = ender3_with("marlin").model_dump(mode="json")
    document["firmware"]["junction"] = junction
    planner = document["firmware"]["planner"]
    own = accel_mm_s2 / 3.0
    planner |= {"accel_mm_s2": own, "travel_accel_mm_s2": own, "junction_deviation_mm": 0.05}
    planner["max_accel_mm_s2"] |= {"x": own, "y": own, "z": 100.0}
    document["firmware"]["steps_per_mm"]["e"] = 93.0
    planner["jerk_mm_s"] = {"x": 10.0, "y": 10.0, "z": 0.3, "e": 5.0}
    document["command"] = {"accel_mm_s2": accel_mm_s2}
    text = vase(speed_mm_s, turns=4, lobes=0)
    result, _ = compensated(text, tmp_path, cache, Machine.model_validate(document))
    assert result.put_back == []
    rms_um = result.features[0].contour_rms_um
    assert rms_um["after"] < 0.7 * rms_um["before"]
