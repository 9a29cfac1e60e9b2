"""Which axis follows later, told by the clocks of raw logs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from stillpath.models.identification.clocks import Lateness, lateness, timed
from stillpath.models.identification.identify import Measured, identify
from stillpath.models.identification.prompt import delay_of, delayed
from stillpath.models.identification.readers import ReadSettings
from stillpath.models.identification.synthetic import ADXL345, simulate_log
from stillpath.models.identification.types import (
    AccelerationLog,
    Axis,
    AxisIdentification,
    Excitation,
    FrequencyResponse,
)
from stillpath.models.plants import (
    PairsSpec,
    PlantSetSpec,
    PlantSpec,
    PolePair,
    RelativeMode,
    RelativeModesSpec,
    frequency_response,
)
from stillpath.models.provenance import Provenance
from stillpath.models.schedule import AxisSchedule, GridNode, GridSchedule, OperatingPoint

TEST = Excitation((1.0, 0.0), f_start_hz=5.0, f_end_hz=100.0, hz_per_s=2.0)
GUIDED = RelativeModesSpec(
    modes=(RelativeMode(f_hz=42.0, zeta=0.09, share=1.0, grounded=0.5),),
)
FREE = RelativeModesSpec(modes=(RelativeMode(f_hz=48.0, zeta=0.05, share=1.0),))


def logged(axis: str, run: int, lead_s: float = 0.0, tail_s: float = 0.0) -> AccelerationLog:
    test = replace(TEST, direction=(1.0, 0.0) if axis == "x" else (0.0, 1.0))
    log = simulate_log(
        {"x": FREE, "y": GUIDED},
        test,
        # Every sensor delays, both axes alike.
        sensor=replace(ADXL345, delay_s=0.6e-3),
        lead_s=lead_s,
        tail_s=tail_s,
        rng=np.random.default_rng([run, axis == "x"]),
    )
    return replace(log, source=f"raw_data_{axis}_{run}.csv")


def delays_s(logs: Sequence[AccelerationLog]) -> dict[str, float]:
    settings = ReadSettings(f_end_hz=TEST.f_end_hz, hz_per_s=TEST.hz_per_s)
    found = identify([Measured(log) for log in logs], settings)
    return {axis: delay_of(one.plants.nominal) for axis, one in found.items()}


def test_an_axis_whose_guides_damp_it_is_later() -> None:
    """The truth: half of a damping of .09 at 42 Hz acts against the guides."""
    found = delays_s([logged(axis, run) for axis in "xy" for run in (0, 1)])
    assert GUIDED.delay_s == pytest.approx(0.341e-3, abs=1e-6)
    assert found["x"] == pytest.approx(0.0, abs=1e-9)
    # The sensor samples every .31 ms, and a log begins anywhere within that.
    assert found["y"] == pytest.approx(GUIDED.delay_s, abs=0.15e-3)


def test_nobody_knows_where_a_log_was_cut_off() -> None:
    cut = logged("y", 0, lead_s=0.2)
    assert delays_s([logged("x", 0), cut]) == pytest.approx({"x": 0.0, "y": 0.0}, abs=1e-9)


def test_recordings_of_shake_and_tune_do_not_say_which_axis_is_later() -> None:
    """They begin before the test, by what its host takes, and end a quarter of a second later."""
    recorded = [
        logged(axis, run, lead_s=0.015 + (0.8e-3 if axis == "y" else 0.0), tail_s=0.26)
        for axis in "xy"
        for run in (0, 1)
    ]
    assert delays_s(recorded) == pytest.approx({"x": 0.0, "y": 0.0}, abs=1e-9)


def of_both(**plants: PlantSpec) -> dict[Axis, AxisIdentification]:
    return {
        axis: AxisIdentification(axis=axis, plants=PlantSetSpec(nominal=plants[axis]))
        for axis in ("x", "y")
    }


def in_bands(*late_ms: float, whole: bool = True, interval_ms: float = 1e-3) -> Lateness:
    return Lateness(1e-3 * np.array(late_ms), 1e-3 * interval_ms, whole)


BOTH = of_both(x=FREE, y=FREE)
F_HZ = np.arange(6.0, 98.0, 0.5)
RESPONSE = FrequencyResponse(
    F_HZ, frequency_response(GUIDED, F_HZ), np.full(len(F_HZ), 0.01), np.ones(len(F_HZ))
)
ON_TIME = in_bands(0.3, 0.3, 0.3, 0.3)


@pytest.mark.parametrize(
    ("x", "y", "expected_ms"),
    [
        ([ON_TIME], [in_bands(0.5, 0.5, 0.5, 0.5)], {"y": 0.2}),
        ([in_bands(0.6, 0.6, 0.6, 0.6)], [ON_TIME], {"x": 0.3}),
        # One band is that of a mode that was not found.
        ([ON_TIME], [in_bands(0.5, 1.4, 0.52, 0.54)], {"y": 0.22}),
        ([ON_TIME], [in_bands(0.25, 1.1, 0.67, 0.62)], {}),
        ([ON_TIME], [in_bands(0.5, np.nan, 0.5, np.nan)], {}),
        # The test of a stiff axis ends below the last band.
        ([ON_TIME], [in_bands(0.5, 0.5, 0.5, np.nan)], {"y": 0.2}),
        ([in_bands(0.3, 0.3, 0.3, np.nan)], [in_bands(np.nan, 0.5, 0.5, 0.5)], {}),
        # Less than the clocks tell, and more than guides do.
        ([ON_TIME], [in_bands(0.32, 0.33, 0.34, 0.33)], {}),
        ([ON_TIME], [in_bands(2.5, 2.5, 2.5, 2.5)], {}),
        # No axis moves before its command: where Y seems to, X is not late by that.
        ([in_bands(0.06, 0.06, 0.02, 0.0)], [in_bands(-0.3, -0.3, -0.3, -0.4)], {}),
        ([in_bands(0.2, 0.2, 0.2, 0.2)], [in_bands(-0.2, -0.2, -0.2, -0.2)], {"x": 0.2}),
        # Slow motion is on time: a wrong mode makes the rest late.
        ([in_bands(0.1, 0.02, 0.03, 0.03)], [in_bands(0.04, 0.63, 0.6, 0.69)], {}),
        ([in_bands(0.2, 0.0, 0.0, 0.0)], [in_bands(0.5, 0.13, 0.2, 0.14)], {"y": 0.1566667}),
        # What lies before the test in a log differs from run to run, even where it looks alike.
        ([in_bands(*4 * [500.0], whole=False)], [in_bands(*4 * [500.2], whole=False)], {}),
        (
            2 * [in_bands(*4 * [500.0], whole=False)],
            2 * [in_bands(*4 * [500.2], whole=False)],
            {},
        ),
        ([ON_TIME, in_bands(*4 * [0.3], whole=False)], [in_bands(*4 * [0.5])], {"y": 0.2}),
        # One alignment missed by a swing.
        ([ON_TIME, ON_TIME, in_bands(*4 * [83.0])], [in_bands(0.5, 0.5, 0.5, 0.5)], {"y": 0.2}),
        ([ON_TIME, in_bands(*4 * [83.0])], [in_bands(0.5, 0.5, 0.5, 0.5)], {}),
        # Slow sensors leave more to what is usual, and two kinds of them tell nothing.
        (
            3 * [in_bands(0.3, 0.3, 0.3, 0.3, interval_ms=0.625)],
            3 * [in_bands(0.7, 0.7, 0.7, 0.7, interval_ms=0.625)],
            {"y": 0.26331},
        ),
        # By where logs begin alone, an axis may seem late by as much where nothing delays it.
        (
            3 * [in_bands(0.3, 0.3, 0.3, 0.3, interval_ms=0.3125)],
            3 * [in_bands(0.43, 0.43, 0.43, 0.43, interval_ms=0.3125)],
            {"y": 0.064863},
        ),
        (
            [in_bands(0.3, 0.3, 0.3, 0.3, interval_ms=0.3125)],
            [in_bands(0.43, 0.43, 0.43, 0.43, interval_ms=0.3125)],
            {},
        ),
        ([ON_TIME], [in_bands(0.5, 0.5, 0.5, 0.5, interval_ms=2e-3)], {}),
        ([], [ON_TIME], {}),
    ],
)
def test_what_the_logs_of_both_axes_agree_on(
    x: list[Lateness], y: list[Lateness], expected_ms: dict[str, float]
) -> None:
    found = timed(BOTH, {"x": x, "y": y})
    told_ms = {
        axis: round(1e3 * delay_of(one.plants.nominal), 6)
        for axis, one in found.items()
        if one.plants != BOTH[axis].plants
    }
    assert told_ms == pytest.approx(expected_ms, rel=1e-4)
    assert [axis for axis, one in found.items() if one.notes] == list(expected_ms)


@pytest.mark.parametrize(("friction_um", "is_told"), [(0.0, True), (3.0, True), (40.0, False)])
def test_friction_makes_lateness_unsure(friction_um: float, is_told: bool) -> None:
    """It delays by up to 5 ms itself, and its own law is hardly known."""
    unsure_s = lateness(
        logged("y", 0), TEST, 0.0, RESPONSE, GUIDED, friction_mm=1e-3 * friction_um
    ).unsure_s
    found = timed(BOTH, {"x": [ON_TIME], "y": [replace(in_bands(*4 * [0.5]), unsure_s=unsure_s)]})
    assert bool(found["y"].notes) is is_told


def late_by_plant(*late_ms: float | None) -> Lateness:
    """Late by .5 ms, and so much against other plants of the set; None: bands differ."""
    rows = [[0.1, 0.4, 0.8, 1.2] if one is None else 4 * [one] for one in late_ms]
    return replace(in_bands(*4 * [0.5]), by_plant_s=1e-3 * np.array(rows))


@pytest.mark.parametrize(
    ("y", "is_told"),
    [
        (late_by_plant(0.5, 0.45, 0.6, None, None), True),
        # Bed slinger 26 of benchmarks/closed_chain.py: .1 ms in truth.
        (late_by_plant(0.5, -0.13, 0.8, 0.1, None), False),
        (late_by_plant(0.5, 0.5, None, None, None), False),
        # What is no set says nothing.
        (late_by_plant(0.5, None), True),
    ],
)
def test_the_plants_of_a_set_must_tell_the_same(y: Lateness, is_told: bool) -> None:
    found = timed(BOTH, {"x": [ON_TIME], "y": 2 * [y]})
    assert delay_of(found["y"].plants.nominal) == pytest.approx(
        0.2e-3 if is_told else 0.0, rel=1e-4
    )
    assert bool(found["y"].notes) is is_told
    # The other way round it is X that is later.
    found = timed(BOTH, {"x": 2 * [y], "y": [ON_TIME]})
    assert bool(found["x"].notes) is is_told


def test_other_places_have_the_delay_too() -> None:
    pairs = (PairsSpec(poles=(PolePair(f_hz=f, zeta=0.08),)) for f in (40.0, 52.0))
    low, high = (one.without_delay() for one in pairs)
    nodes = (GridNode(z_mm=0.0, plant=low), GridNode(z_mm=200.0, plant=high))
    both = {
        axis: replace(
            one,
            plants=one.plants.model_copy(update={"provenance": Provenance(kind="raw log")}),
            schedule=AxisSchedule(grid=GridSchedule(nodes=nodes)),
        )
        for axis, one in BOTH.items()
    }
    found = timed(both, {"x": [ON_TIME], "y": [in_bands(0.5, 0.5, 0.5, 0.5)]})
    assert found["x"].schedule == both["x"].schedule
    schedule = found["y"].schedule
    assert schedule is not None
    for z_mm in (0.0, 200.0):
        plants = schedule.plants(found["y"].plants, OperatingPoint(z_mm=z_mm)).without_delay()
        assert delay_of(plants.nominal) == pytest.approx(0.2e-3, rel=1e-4)


def test_an_axis_of_little_damping_is_as_late_as_that_allows() -> None:
    stiff = RelativeModesSpec(modes=(RelativeMode(f_hz=60.0, zeta=0.02, share=1.0),))
    late: dict[Axis, list[Lateness]] = {"x": [ON_TIME], "y": [in_bands(0.6, 0.6, 0.6, 0.6)]}
    found = timed(of_both(x=FREE, y=stiff), late)["y"]
    assert delay_of(found.plants.nominal) == pytest.approx(0.02 / (np.pi * 60.0))
    assert "0.11 ms later than X" in found.notes[0]


@pytest.mark.parametrize(
    "plant",
    [
        FREE,
        PairsSpec(poles=(PolePair(f_hz=40.0, zeta=0.08), PolePair(f_hz=90.0, zeta=0.05))),
    ],
)
def test_a_delayed_plant_is_late_and_resonates_as_before(plant: RelativeModesSpec) -> None:
    prompt = plant.without_delay()
    late = delayed(prompt, 0.2e-3)
    assert delay_of(late) == pytest.approx(0.2e-3, rel=1e-9)
    f_hz = np.array([5.0, 40.0])
    ratio = frequency_response(late, f_hz) / frequency_response(prompt, f_hz)
    assert np.abs(ratio) == pytest.approx([1.0, 1.0], abs=0.01)
    assert -np.angle(ratio) / (2 * np.pi * f_hz) == pytest.approx([0.2e-3, 0.2e-3], rel=0.05)
    # No more than if all of the damping acted against the guides.
    assert delay_of(delayed(prompt, 1.0)) < 5e-3
