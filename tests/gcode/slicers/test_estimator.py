"""The slicers' estimator: cases worked out by hand, a plain twin of the queue, the corpus."""

from __future__ import annotations

import gzip
import io
import math
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stillpath.gcode.slicers._estimator_kernels import queue_times, trapezoid_s
from stillpath.gcode.slicers.estimator import Rules, estimated_s, rules_of
from stillpath.gcode.slicers.facts import SlicerFacts, read_facts

LIMITS = {
    **{f"machine_max_acceleration_{a}": "1000" for a in "xyze"},
    **{f"machine_max_feedrate_{a}": "200" for a in "xyze"},
    **{f"machine_max_jerk_{a}": "10" for a in "xyze"},
    "machine_max_acceleration_extruding": "1000",
    "machine_max_acceleration_retracting": "1000",
    "gcode_flavor": "marlin",
}
FACTS = SlicerFacts("PrusaSlicer", "2.5.0", "marlin", settings=MappingProxyType(LIMITS))


def seconds(text: str, rules: Rules | None = None) -> float:
    found = estimated_s(io.BytesIO(text.encode()), FACTS, rules)
    assert found is not None
    return found


def block_s(v0: float, v1: float, v2: float, accel: float, mm: float) -> float:
    up, down = (v1 * v1 - v0 * v0) / (2 * accel), (v1 * v1 - v2 * v2) / (2 * accel)
    return (v1 - v0) / accel + (v1 - v2) / accel + (mm - up - down) / v1


def test_two_moves_in_line() -> None:
    # From rest 10 mm/s (jerk) up to 50, no slower between them, and down to 10 again.
    text = "M83\nG1 X20 E1 F3000\nG1 X40 E1\n"
    assert seconds(text) == pytest.approx(
        block_s(10, 50, 50, 1000, 20) + block_s(50, 50, 10, 1000, 20)
    )


def test_a_right_angle_is_passed_at_the_jerk() -> None:
    text = "M83\nG1 X20 E1 F3000\nG1 Y20 E1\n"
    assert seconds(text) == pytest.approx(2 * block_s(10, 50, 10, 1000, 20))


def test_a_reversal_is_a_stop_of_one_axis() -> None:
    # Of the vector's jerk it would be 100 mm/s, of the axis it is 50: but stopping is better still.
    text = "M83\nG1 X20 E1 F3000\nG1 X0 E1\n"
    assert seconds(text) == pytest.approx(2 * block_s(10, 50, 10, 1000, 20))


def test_acceleration_by_kind() -> None:
    text = "M204 P500 R250 T800\nM83\nG1 X20 E1 F3000\nG1 E-2 F1200\nG1 X0 F6000\n"
    flat = Rules(scaled=True)
    wanted = (
        block_s(10, 50, 10, 500, 20) + block_s(10, 20, 10, 250, 2) + block_s(10, 100, 10, 800, 20)
    )
    assert seconds(text, flat) == pytest.approx(wanted)


def test_limit_of_an_axis_in_both_forms() -> None:
    diagonal = "M201 X500\nM83\nG1 X30 Y40 E1 F3000\nG1 E-1 F600\n"
    plain, scaled = seconds(diagonal), seconds(diagonal, Rules(scaled=True))
    rest = block_s(10, 10, 10, 1000, 1)
    assert plain == pytest.approx(block_s(10, 50, 10, 500, 50) + rest)
    assert scaled == pytest.approx(block_s(10, 50, 10, 500 / 0.6, 50) + rest)


def test_homing_is_a_move_to_zero_and_arcs_may_be_passed_over() -> None:
    text = "M83\nG1 X20 E1 F3000\nG2 X40 Y0 I10 J0 E1\nG28 X\nG1 E-1 F600\n"
    arcs_ignored = 2 * block_s(10, 50, 10, 1000, 20) + block_s(10, 10, 10, 1000, 1)
    assert seconds(text) == pytest.approx(arcs_ignored)
    # A half circle of 10 mm radius at v**2 = a r = 100**2: not limited, but 31.4 mm long.
    as_block = seconds(text, Rules(scaled=True, arcs="blocks", centripetal=True))
    pieces = seconds(text, Rules(scaled=True, arcs="pieces"))
    assert as_block > arcs_ignored + 0.5
    assert pieces == pytest.approx(as_block, rel=0.1)


def test_waits_count_where_they_do() -> None:
    text = "M83\nG1 X20 E1 F3000\nG4 S3\nG1 X0 E1\nM400 P500\n"
    assert seconds(text, Rules(waits=True)) - seconds(text) == pytest.approx(3.5, abs=0.01)


def test_other_families_have_no_estimate() -> None:
    assert rules_of(SlicerFacts("Cura", "4.13.0")) is None
    assert estimated_s(io.BytesIO(b"G1 X1 F600\n"), SlicerFacts("PrusaSlicer", "2.5.0")) is None
    assert estimated_s(io.BytesIO(b"; nothing\n"), FACTS) == 0.0


speeds = st.floats(0.1, 300.0)


@given(
    st.lists(
        st.tuples(st.floats(0.01, 50.0), speeds, st.floats(0, 1), st.floats(0, 1)),
        min_size=2,
        max_size=400,
    )
)
def test_the_queue_is_the_plain_plan_where_it_is_long_enough(
    blocks: list[tuple[float, float, float, float]],
) -> None:
    """Back, then forward over all blocks at once: the queue of 64 differs by little or nothing."""
    distance, cruise = (np.array(c) for c in list(zip(*blocks, strict=True))[:2])
    safe = cruise * np.array([b[2] for b in blocks])
    least = np.minimum(cruise, np.concatenate([[np.inf], cruise[:-1]]))
    junction = least * np.array([b[3] for b in blocks])
    n, accel = len(blocks), np.full(len(blocks), 1000.0)
    entry = junction.copy()
    entry[0] = safe[0]
    # A move that reaches its speed from the safe one is looked at no further.
    free = cruise <= np.sqrt(safe**2 + 2000 * distance)
    leave = safe[-1]
    for i in range(n - 1, -1, -1):
        if i == n - 1 or not free[i]:
            entry[i] = min(entry[i], math.sqrt(leave**2 + 2000 * distance[i]))
        leave = entry[i]
    for i in range(n - 1):
        if not free[i]:
            entry[i + 1] = min(entry[i + 1], math.sqrt(entry[i] ** 2 + 2000 * distance[i]))
    leaves = np.append(entry[1:], safe[-1])
    wanted = sum(trapezoid_s(entry[i], cruise[i], leaves[i], 1000.0, distance[i]) for i in range(n))
    stops = np.zeros(n, dtype=bool)
    got = queue_times(distance, accel, cruise, safe, junction, stops, False)
    assert got == pytest.approx(wanted, rel=1e-6 if n <= 256 else 0.02)


@pytest.mark.shared
@pytest.mark.parametrize(
    "name",
    [
        "own/klipper_excludeobj_multi",
        "own/ps_ender3_gear24_absE",
        "own/ps_ender3_pauses_hept24f",
        "own/ps_jubilee_rrf_toolchange",
        "own/ps_mk3s_xyzcube",
        "own/ps_trilab_rrf_tris24",
        "third_party/real_bambustudio1.10_k1max",
        "third_party/real_libbgcode_mini_cube_b_ref",
        "third_party/real_prusaslicer2.3.3_thumb",
    ],
)
def test_the_slicers_own_estimate(shared_dir: Path, name: str) -> None:
    packed = shared_dir / "corpus" / f"{name}.gcode.gz"
    file = io.BytesIO(gzip.decompress(packed.read_bytes()))
    facts = read_facts(file)
    found = estimated_s(file, facts)
    assert found is not None
    assert facts.estimate_s is not None
    assert abs(found - facts.estimate_s) <= 0.01 * facts.estimate_s + 1.0
