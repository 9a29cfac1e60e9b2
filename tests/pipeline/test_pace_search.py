"""The search for the quickest paces, on made-up machines whose errors follow known laws."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stillpath.gcode.pacing import TRAVEL, FirstLayer
from stillpath.models.plants import PlantSetSpec
from stillpath.models.store import load_machine
from stillpath.pipeline.measuring.set_errors import ClassError, ErrorSum, machine_numbers
from stillpath.pipeline.pacing.budget import SpeedBudget
from stillpath.pipeline.pacing.pace_search import PaceChoice, allowed_um, search
from stillpath.pipeline.pacing.pace_trials import Factors, Tried
from stillpath.simulation.machine_response import MachineStream

WALL, INFILL = 0, 1


@dataclass
class Law:
    """Errors of a class: its own, and what travel adds after it."""

    own_um: dict[int, float]
    from_travel_um: dict[int, float] = field(default_factory=dict)
    power: float = 1.0
    unfit_above: float = np.inf
    trials: list[Factors] = field(default_factory=list)

    def __call__(self, factors: Factors) -> Tried:
        self.trials.append(dict(factors))
        errors = {}
        for one, own_um in self.own_um.items():
            shaken_um = self.from_travel_um.get(one, 0.0) * factors.get(TRAVEL, 1.0) ** self.power
            error_um = float(np.hypot(own_um * factors.get(one, 1.0) ** self.power, shaken_um))
            errors[one] = ClassError(error_um, 10.0)
        unfit = {one for one, factor in factors.items() if factor > self.unfit_above}
        return Tried(errors, unfit, sum(1.0 + 1.0 / factor for factor in factors.values()))


@settings(max_examples=30)
@given(
    own=st.lists(st.floats(0.01, 2.0), min_size=2, max_size=2),
    shaken=st.lists(st.floats(0.0, 1.0), min_size=2, max_size=2),
    power=st.floats(0.5, 1.8),
    unfit=st.floats(1.5, 30.0),
)
def test_it_keeps_bounds_and_limits(
    own: list[float], shaken: list[float], power: float, unfit: float
) -> None:
    law = Law(
        {WALL: own[0], INFILL: own[1], TRAVEL: 0.1},
        dict(zip((WALL, INFILL), shaken, strict=True)),
        power,
        unfit,
    )
    most = {WALL: 20.0, INFILL: 8.0, TRAVEL: 5.0}
    found = search(law, 1.0, most, 1.0)
    came = law(found.factors)
    assert found.reached
    assert not came.unfit
    assert all(1.0 <= found.factors[one] <= most[one] for one in most)
    at_first = law.trials[0]
    assert set(at_first.values()) == {1.0}
    for one, error in came.errors.items():
        first_um = law(at_first).errors[one].rms_um
        # What exceeds the budget as it was sliced becomes at most a tenth worse, and because of
        # others only.
        assert error.rms_um <= max(allowed_um(one, 1.0), 1.1 * first_um)
        assert error.rms_um <= allowed_um(one, 1.0) or found.factors[one] == 1.0
    assert came.seconds <= law(at_first).seconds
    assert search(law, 1.0, most, 1.0) == found


def test_it_uses_the_budget() -> None:
    found = search(Law({WALL: 0.1, INFILL: 0.3}), 1.0, {WALL: 50.0, INFILL: 2.0}, 1.0)
    assert found.factors[INFILL] == 2.0
    assert 0.1 * found.factors[WALL] == pytest.approx(0.95, abs=0.05)


def test_travel_comes_down_for_what_it_shakes() -> None:
    law = Law({WALL: 0.8, TRAVEL: 0.01}, {WALL: 0.2})
    found = search(law, 1.0, {WALL: 1.0, TRAVEL: 50.0}, 1.0)
    assert 1.5 < found.factors[TRAVEL] < 3.0


def test_a_shaper_may_be_slower_than_the_file() -> None:
    found = search(Law({WALL: 4.0}), 0.05, {WALL: 10.0}, 1.0)
    assert found.reached
    assert 0.2 < found.factors[WALL] < 0.25
    never = search(Law({WALL: 400.0}), 0.05, {WALL: 10.0}, 1.0)
    assert not never.reached


def sums(rms_um: float, seconds: float) -> ErrorSum:
    return ErrorSum(np.array([0.5, 1.0]) * rms_um**2 * seconds, seconds)


def budget(**factors: float) -> SpeedBudget:
    numbers = {"wall": WALL, "travel": TRAVEL}
    chosen = {numbers[name]: factor for name, factor in factors.items()}
    bounds = {one: allowed_um(one, 10.0) for one in chosen}
    choice = PaceChoice(chosen, bounds)
    tops = dict.fromkeys(chosen, 6.0)
    return SpeedBudget(load_machine("ender3"), 10.0, FirstLayer(), choice, choice, tops)


def told(paces: SpeedBudget, errors: dict[int, ErrorSum]) -> dict[str, float]:
    figures = paces.figures(errors, ["Perimeter"], 2.0, 1.0)
    return {one.name: one.acceleration_factor for one in figures.classes}


def test_paces_follow_the_errors_both_ways() -> None:
    paces = budget(wall=4.0, travel=2.0)
    low = {WALL: sums(3.0, 30.0), TRAVEL: sums(3.0, 30.0)}
    paces.correct(low)
    # That piece was written at the first pace, the next one will be quicker.
    assert told(paces, low) == {"Perimeter": 4.0, "travel": 2.0}
    raised = dict(paces.factors)
    assert raised[WALL] > 4.0
    assert raised[TRAVEL] > 2.0
    high = {WALL: sums(12.0, 90.0), TRAVEL: sums(3.0, 90.0)}
    paces.correct(high)
    assert paces.factors[WALL] < raised[WALL]
    mean = (4.0**30 * raised[WALL] ** 60) ** (1 / 90)
    assert told(paces, high)["Perimeter"] == pytest.approx(mean, rel=1e-4)
    for k in range(60):
        paces.correct({WALL: sums(1.0, 100.0 + 30.0 * k), TRAVEL: sums(1.0, 100.0 + 30.0 * k)})
    # Never above the machine's limits, nor far above what the samples said.
    assert paces.factors == {WALL: 6.0, TRAVEL: 4.0}


def test_a_file_above_its_budget_is_written_anew() -> None:
    first = budget(wall=4.0, travel=2.0)
    over = {WALL: sums(12.0, 90.0), TRAVEL: sums(3.0, 90.0)}
    assert first.gentler({WALL: sums(9.9, 90.0)}) is None
    second = first.gentler(over)
    assert second is not None
    assert 1.0 < second.factors[WALL] < 4.0
    third = second.gentler(over)
    assert third is not None
    assert 1.0 < third.factors[TRAVEL] < 2.0
    last = third.gentler(over)
    assert last is not None
    assert set(last.factors.values()) == {1.0}
    assert last.gentler(over) is None
    # What is as it was sliced cannot be milder.
    assert budget(wall=1.0, travel=1.0).gentler(over) is None


def test_all_slow_down_where_the_print_as_a_whole_uses_up_its_budget() -> None:
    """Infill was above the budget as sliced, and may become a tenth worse; the print may not."""
    chosen = {WALL: 4.0, INFILL: 1.0, TRAVEL: 2.0}
    bounds = {WALL: 10.0, INFILL: 13.0, TRAVEL: 20.0}
    choice = PaceChoice(chosen, bounds)
    tops = dict.fromkeys(chosen, 6.0)
    paces = SpeedBudget(load_machine("ender3"), 10.0, FirstLayer(), choice, choice, tops)
    travel = sums(18.5, 10.0)
    paces.correct({WALL: sums(9.2, 90.0), INFILL: sums(12.9, 5.0), TRAVEL: travel})
    assert paces.factors == chosen
    paces.correct({WALL: sums(9.2, 90.0), INFILL: sums(12.9, 60.0), TRAVEL: travel})
    assert paces.factors[TRAVEL] < 2.0


@pytest.mark.parametrize(
    ("budget_um", "remedy"), [(10.0, "give a smaller budget"), (0.5, "without a budget it keeps")]
)
def test_a_remedy_is_one_that_can_be_given(budget_um: float, remedy: str) -> None:
    paces = replace(budget(wall=4.0), budget_um=budget_um)
    over = {WALL: sums(12.0, 90.0)}
    paces.correct(over)
    *_, warning = paces.warnings(over, ["Perimeter"])
    assert remedy in warning


@pytest.mark.parametrize(
    ("accel_mm_s2", "factor", "count"), [(20_000.0, 4.0, 1), (20_000.0, 1.0, 0), (4500.0, 4.0, 0)]
)
def test_limits_that_nobody_measured_are_named_where_they_are_used(
    accel_mm_s2: float, factor: float, count: int
) -> None:
    machine = load_machine("ender3")
    command = machine.command.model_copy(update={"accel_mm_s2": accel_mm_s2})
    paces = replace(budget(wall=factor), machine=machine.model_copy(update={"command": command}))
    within = {WALL: sums(9.0, 90.0)}
    paces.correct(within)
    warnings = paces.warnings(within, ["Perimeter"])
    assert [w for w in warnings if "up to 14000 mm/s2" in w and "motor-test" in w] == warnings
    assert len(warnings) == count


def test_every_plant_of_the_larger_set_is_judged() -> None:
    """Also where one axis was measured, and the other has one plant."""
    machine = load_machine("ender3")
    one = PlantSetSpec(nominal=machine.axes["y"].nominal)
    narrow = machine.model_copy(update={"axes": {**machine.axes, "y": one}})
    count = len(machine.axes["x"].weighted_members())
    assert machine_numbers(narrow, 1e-3) == [None, *range(count)]
    path = np.outer([1.0, 1.0], np.linspace(0.0, 20.0, 300) % 7.0)
    moved = [MachineStream(narrow, 1e-3, member=k).push(path, path) for k in range(count)]
    assert len({part[0].tobytes() for part in moved}) == count
    assert len({part[1].tobytes() for part in moved}) == 1
