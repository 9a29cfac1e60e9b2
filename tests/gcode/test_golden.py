"""The golden plans: what Klipper's own planner queued for the open corpus."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest

from stillpath.gcode.firmware.klipper.planner import Planner
from stillpath.gcode.firmware.planning import join_phases
from stillpath.models.machine import Machine
from tests.gcode.cutting import blocks_of

pytestmark = pytest.mark.shared

NAMES = [
    "arcwelder_mk3s_xyzcube",
    "cura_ender3_gear24",
    "cura_prusa_mk3_reltiveE_tris24",
    "klipper_excludeobj_multi",
    "ps_ender3_pauses_hept24f",
    "ps_mk3s_xyzcube",
    "ps_mk3s_xyzcube__a10000_scv8_mcr0",
]
FIRST_PRINT_TIME_S = 0.25


def machine_of(name: str, machine: Machine) -> Machine:
    if "__" not in name:
        return machine
    limits = {
        "max_accel_mm_s2": 10_000.0,
        "square_corner_velocity_mm_s": 8.0,
        "minimum_cruise_ratio": 0.0,
    }
    planner = machine.firmware.planner.model_copy(update=limits)
    firmware = machine.firmware.model_copy(update={"planner": planner})
    return machine.model_copy(update={"firmware": firmware})


@pytest.mark.parametrize("name", NAMES)
def test_same_plan_as_klipper(name: str, golden_machine: Machine, shared_dir: Path) -> None:
    golden = np.load(shared_dir / "golden" / "klipper" / f"{name}.npz")
    source = shared_dir / "corpus" / "own" / f"{name.split('__')[0]}.gcode.gz"
    machine = machine_of(name, golden_machine)
    planner = Planner(machine.firmware)
    parts = [planner.push(b) for b in blocks_of(gzip.decompress(source.read_bytes()), machine)]
    plan = join_phases([*parts, planner.flush()])

    times = np.column_stack(
        (plan.t_s + FIRST_PRINT_TIME_S, plan.accel_s, plan.cruise_s, plan.decel_s)
    )
    speeds = np.column_stack((plan.start_mm_s, plan.cruise_mm_s, plan.accel_mm_s2))
    straight = np.any(plan.direction[:, :3] != 0.0, axis=1)
    xyz = np.column_stack((times, plan.start_mm[:, :3], plan.direction[:, :3], speeds))[straight]
    assert len(xyz) == golden["n_xyz"]
    n = len(golden["xyz"])
    np.testing.assert_allclose(xyz[:n], golden["xyz"], rtol=0.0, atol=1e-9)

    ratio = plan.direction[:, 3]
    advance = (ratio > 0.0) & np.any(plan.direction[:, :2] != 0.0, axis=1)
    zero = np.zeros_like(ratio)
    e = np.column_stack(
        (times, plan.start_mm[:, 3], zero, zero, zero + 1.0, advance, zero, speeds * ratio[:, None])
    )[ratio != 0.0]
    assert len(e) == golden["n_e"]
    m = len(golden["e"])
    np.testing.assert_allclose(e[:m], golden["e"], rtol=0.0, atol=1e-9)

    end = plan.end_s[-1]
    assert end == pytest.approx(float(golden["total_time_s"]), rel=0.0, abs=1e-8)
