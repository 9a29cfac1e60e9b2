"""How much of the compensation a machine's set bears."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from stillpath.compensation.registry import compensator
from stillpath.compensation.shapers import ShaperCompensator
from stillpath.models.firmware.klipper import FirmwareShaper
from stillpath.models.friction import with_least_friction
from stillpath.models.machine import Machine
from stillpath.models.plants import (
    PlantSetSpec,
    RelativeMode,
    RelativeModesSpec,
    WeightedMember,
    plant_set,
)
from stillpath.models.reference_motion import reference_motion, reference_motion_of
from stillpath.models.store import load_machine
from stillpath.pipeline.caution import (
    caution_for,
    choose_caution,
    design_mode,
)
from stillpath.pipeline.caution_notes import prediction_note, stated_note
from stillpath.pipeline.measuring.reference_shaper import BestShaper, cached_shaper
from stillpath.pipeline.options import Options
from stillpath.simulation.measures import contour_error
from stillpath.simulation.response import response

DT_S = 1e-3
NO_RESTS = np.zeros((0, 2), np.int64)


def one_mode(f_hz: float) -> RelativeModesSpec:
    return RelativeModesSpec(modes=(RelativeMode(f_hz=f_hz, zeta=0.06, share=1.0),))


def machine_of(*frequencies_hz: float) -> Machine:
    """A machine whose axes may have any of these resonances, the first the nominal one."""
    plants = PlantSetSpec(
        nominal=one_mode(frequencies_hz[0]),
        members=tuple(WeightedMember(plant=one_mode(f)) for f in frequencies_hz),
        band_hz=(8.0, 130.0),
    )
    return load_machine("generic-corexy").model_copy(update={"axes": {"x": plants, "y": plants}})


def shaper(f_hz: float) -> BestShaper:
    return BestShaper("mzv", f_hz, f_hz, 0.1, 0.0, 0.0)


def contour_um(machine: Machine, command: np.ndarray, member: int) -> float:
    """Contour error of a member, computed in another way than the choice's."""
    path, extruding = reference_motion(DT_S)
    plants = [plant_set(machine.axes[a], DT_S).members[member] for a in ("x", "y")]  # type: ignore[index]
    error = contour_error(path, response(plants, command), DT_S)
    return float(1e3 * np.sqrt(np.mean(error[extruding] ** 2)))


def test_a_wide_set_asks_for_more_of_the_shaper(tmp_path: Path) -> None:
    narrow, wide = (
        choose_caution(machine_of(*f), shaper(45.0), tmp_path, DT_S)[1]
        for f in ((45.0, 44.5, 45.5), (45.0, 25.0, 90.0))
    )
    assert min(narrow.shares) > max(wide.shares)
    # Where the plants leave little error, straight segments must not be the larger one.
    assert narrow.rms_um < wide.rms_um
    assert narrow.fit_share == 0.5
    # A shaper alone has more edges, and is followed as closely.
    assert wide.fit_share == (1.0 if any(wide.shares) else 0.5)
    assert narrow.mean < wide.mean <= wide.worst


def with_axes(machine: Machine, **change: Callable[[PlantSetSpec], PlantSetSpec]) -> Machine:
    axes = {k: change.get(k, lambda axis: axis)(axis) for k, axis in machine.axes.items()}
    return machine.model_copy(update={"axes": axes})


@pytest.mark.parametrize("name", ["ender3", pytest.param("voron-v24-250", marks=pytest.mark.slow)])
def test_no_member_fares_worse_than_with_the_shaper(name: str, cache: Path) -> None:
    """The promise, member by member, measured without the code that made the choice."""
    machine = load_machine(name)
    best = cached_shaper(machine, cache)
    options = Options()
    assert design_mode(machine) == "ensemble"
    chosen = caution_for(machine, options, best, cache, DT_S)
    assert chosen is not None
    caution, choice = chosen
    note = prediction_note(machine, choice)
    assert f"({choice.worst:.2f} for the worst plant)" in note
    assert re.search(r"an axis back by \d+ µm \(X\) and \d+ µm \(Y\); more is possible", note)
    rubbing = with_axes(machine, x=with_least_friction, y=with_least_friction)
    assert prediction_note(rubbing, choice) == note
    known = with_axes(rubbing, x=lambda axis: axis.with_friction(0.004))
    assert re.search(r"an axis back by \d+ µm \(Y\); more", prediction_note(known, choice))
    path, extruding = reference_motion(DT_S)
    ours = compensator("fbf", machine, DT_S, robust="ensemble", caution=caution)
    ours.reset(path[:, 0])
    smooth = ShaperCompensator(machine, DT_S, shaper=best.type, fx_hz=best.fx_hz, fy_hz=best.fy_hz)
    commands = [one.compensate(path, extruding, NO_RESTS) for one in (ours, smooth)]
    for member in range(len(machine.axes["x"].weighted_members())):
        a, b = (contour_um(machine, command, member) for command in commands)
        assert a <= b
        assert a < contour_um(machine, path, member)


def slow(machine: Machine, planned_mm_s2: float, borne_mm_s2: float) -> Machine:
    """A machine whose printer.cfg says less than most."""
    firmware = machine.firmware
    planner = firmware.planner.model_copy(update={"max_accel_mm_s2": planned_mm_s2})
    return machine.model_copy(
        update={
            "firmware": firmware.model_copy(update={"planner": planner}),
            "command": machine.command.model_copy(update={"accel_mm_s2": borne_mm_s2}),
        }
    )


@pytest.mark.parametrize(("planned_mm_s2", "borne_mm_s2"), [(3000, 4500), (1000, 1500), (500, 500)])
def test_a_machine_is_tried_within_its_own_limits(
    planned_mm_s2: float, borne_mm_s2: float, tmp_path: Path
) -> None:
    """It once was on motion at 5000 mm/s2, which no command can follow within less."""
    usual = choose_caution(machine_of(45.0, 44.5, 45.5), shaper(45.0), tmp_path, DT_S)[1]
    machine = slow(machine_of(45.0, 44.5, 45.5), planned_mm_s2, borne_mm_s2)
    choice = choose_caution(machine, shaper(45.0), tmp_path, DT_S)[1]
    assert choice.shares == usual.shares
    assert choice.worst < 1.2 * usual.worst
    path, extruding = reference_motion_of(machine, DT_S)
    accel = np.abs(np.diff(path, 2)).max(axis=0)[extruding[1:-1]] / DT_S**2
    assert np.median(accel[accel > 1.0]) <= planned_mm_s2


def test_chosen_once(tmp_path: Path) -> None:
    machine = machine_of(45.0, 40.0)
    first = choose_caution(machine, shaper(45.0), tmp_path, DT_S)
    (kept,) = tmp_path.iterdir()
    assert choose_caution(machine, shaper(45.0), tmp_path, DT_S) == first
    kept.write_text("{ half")
    assert choose_caution(machine, shaper(45.0), tmp_path, DT_S) == first


def nobody_said_how(machine: Machine) -> Machine:
    """The machine with plants of unknown origin."""
    axes = {a: p.model_copy(update={"provenance": None}) for a, p in machine.axes.items()}
    return machine.model_copy(update={"axes": axes})


def test_of_a_resonance_that_was_typed_in_the_shaper_is_made(tmp_path: Path) -> None:
    """Nothing is known of the other modes; what is stated is stated of a shaper."""
    machine = load_machine("generic-corexy")
    best = cached_shaper(machine, tmp_path)
    assert (best.type, best.fx_hz, best.fy_hz) == ("zv", 60.0, 50.0)
    chosen = caution_for(machine, Options(), best, tmp_path, DT_S)
    assert chosen is not None
    caution, _ = chosen
    assert caution.shares == (0.0, 0.0)
    path, extruding = reference_motion(DT_S)
    ours = compensator("fbf", machine, DT_S, caution=caution)
    ours.reset(path[:, 0])
    own = ShaperCompensator(machine, DT_S, shaper="zv", fx_hz=60.0, fy_hz=50.0)
    np.testing.assert_allclose(
        ours.compensate(path, extruding, NO_RESTS), own.compensate(path, extruding, NO_RESTS)
    )
    note = stated_note(machine, best)
    assert note is not None
    assert "zv 60.0 / 50.0 Hz" in note
    # The type that printer.cfg states for both axes, where it does.
    tuned = FirmwareShaper(freq_x_hz=61.0, freq_y_hz=49.0)
    firmware = machine.firmware.model_copy(update={"shaper": tuned})
    configured = machine.model_copy(update={"firmware": firmware})
    assert cached_shaper(configured, tmp_path).type == "mzv"
    # Who asks for it gets filtered basis functions.
    assert caution_for(machine, Options(robust="off"), best, tmp_path, DT_S) is None


def test_nobody_is_cautious_without_a_measured_set(tmp_path: Path) -> None:
    machine = nobody_said_how(load_machine("generic-corexy"))
    assert design_mode(machine) == "off"
    for options in (Options(), Options(robust="off"), Options(method="shaper:mzv")):
        assert caution_for(machine, options, shaper(45.0), tmp_path, DT_S) is None
    measured = machine_of(45.0, 40.0)
    assert caution_for(measured, Options(robust="minimax"), shaper(45.0), tmp_path, DT_S) is None
