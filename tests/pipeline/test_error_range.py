"""What friction that was not measured adds to a prediction."""

from __future__ import annotations

import numpy as np
import pytest

from stillpath.compensation.shapers import ShaperCompensator
from stillpath.models.friction import with_least_friction
from stillpath.models.machine import Machine
from stillpath.models.plants import PlantSetSpec, RelativeMode, RelativeModesSpec, WeightedMember
from stillpath.models.provenance import Provenance
from stillpath.models.reference_motion import reference_motion_of
from stillpath.models.store import load_machine
from stillpath.pipeline.error_range import error_ranges, unseen_friction_mm
from stillpath.simulation.measures import PathDistances
from stillpath.simulation.printers.bodies import STEP_S, Bodies, Element, Friction

DT_S = 1e-3
TABLE = Provenance(kind="spectrum")


def axis(f_hz: float, zeta: float = 0.06, friction_mm: float | None = None) -> PlantSetSpec:
    plant = RelativeModesSpec(modes=(RelativeMode(f_hz=f_hz, zeta=zeta, share=1.0),))
    members = (WeightedMember(plant=plant), WeightedMember(plant=plant))
    return PlantSetSpec(
        nominal=plant, members=members, band_hz=(8.0, 130.0), friction_mm=friction_mm
    )


@pytest.mark.parametrize("f_hz", [25.0, 48.0, 90.0])
def test_friction_bends_an_axis_as_its_force_does(f_hz: float) -> None:
    """A force F on a mass m whose spring has the frequency f bends it by F / (m (2 pi f)**2)."""
    assert unseen_friction_mm(axis(f_hz)) == pytest.approx(
        1500.0 / (2 * np.pi * f_hz) ** 2, rel=0.02
    )
    assert unseen_friction_mm(axis(f_hz, friction_mm=0.004)) == 0.0


def test_of_several_modes_the_soft_ones_bend_most() -> None:
    modes = (
        RelativeMode(f_hz=40.0, zeta=0.05, share=0.8),
        RelativeMode(f_hz=95.0, zeta=0.05, share=0.2),
    )
    several = PlantSetSpec(nominal=RelativeModesSpec(modes=modes))
    expected = 1500.0 * sum(m.share / (2 * np.pi * m.f_hz) ** 2 for m in modes)
    assert unseen_friction_mm(several) == pytest.approx(expected, rel=0.02)


def test_assumed_friction_is_part_of_what_is_unseen() -> None:
    assumed = with_least_friction(axis(48.0).model_copy(update={"provenance": TABLE}))
    assert assumed.friction_assumed
    assert assumed.friction_mm == pytest.approx(75.0 / (2 * np.pi * 48.0) ** 2, rel=0.02)
    whole_mm = assumed.friction_mm + unseen_friction_mm(assumed)
    assert whole_mm == pytest.approx(unseen_friction_mm(axis(48.0)), rel=1e-12)
    shaken = axis(48.0).nominal.modes[0].model_copy(update={"share": 0.8})
    frame = RelativeMode(f_hz=9.0, zeta=0.1, share=0.2)
    on_feet = PlantSetSpec(nominal=RelativeModesSpec(modes=(shaken, frame)), provenance=TABLE)
    bent_mm = with_least_friction(on_feet).friction_mm
    assert bent_mm == pytest.approx(0.8 * assumed.friction_mm, rel=0.02)
    measured = assumed.with_friction(assumed.friction_mm)
    assert unseen_friction_mm(measured) == 0.0
    # What bends far is still a document that can be read.
    soft = with_least_friction(axis(4.5))
    assert PlantSetSpec.model_validate(soft.model_dump()) == soft


def printer(f_hz: dict[str, float], force_n_kg: float) -> Bodies:
    """One mass per axis on the spring of its belt, on guides that rub."""
    mass_kg, zeta = 0.4, 0.06
    elements, frictions = [], []
    for name, command in (("x", (1.0, 0.0)), ("y", (0.0, 1.0))):
        w = 2 * np.pi * f_hz[name]
        k_n_m, d_n_s_m = mass_kg * w**2, 2 * zeta * w * mass_kg
        elements.append(Element({name: 1.0}, k_n_m, d_n_s_m, command))
        frictions.append(Friction({name: 1.0}, force_n_kg * mass_kg))
    return Bodies({"x": mass_kg, "y": mass_kg}, tuple(elements), tuple(frictions))


def machine_of(f_hz: dict[str, float]) -> Machine:
    axes = {name: axis(f) for name, f in f_hz.items()}
    return load_machine("generic-corexy").model_copy(update={"axes": axes})


@pytest.mark.parametrize("f_hz", [{"x": 60.0, "y": 45.0}, {"x": 48.0, "y": 30.0}])
def test_the_error_of_a_printer_that_rubs_is_within_the_range(f_hz: dict[str, float]) -> None:
    """Bodies with Dahl's friction, 1.2 N/kg, know nothing of the model behind the prediction.

    With a shaper: friction also damps, and a command that makes an axis ring prints better by it.
    """
    machine = machine_of(f_hz)
    path, extruding = reference_motion_of(machine, DT_S)
    distances, at = PathDistances(path, DT_S), np.flatnonzero(extruding)[::5]

    def rms(motion: np.ndarray) -> float:
        return float(np.sqrt(np.mean(distances.at(motion[:, at], at) ** 2)))

    shaper = ShaperCompensator(machine, DT_S, shaper="mzv", fx_hz=f_hz["x"], fy_hz=f_hz["y"])
    command = shaper.compensate(path, extruding, np.zeros((0, 2), np.int64))
    known = error_ranges(machine, {"shaper": command}, rms, DT_S)["shaper"]
    most_um = np.hypot(known.high * known.reference_um, known.friction_um)
    fine = round(DT_S / STEP_S)
    t = np.arange(path.shape[1] * fine - fine + 1) / fine
    finely = np.stack([np.interp(t, np.arange(path.shape[1]), row) for row in command])
    smooth_um, rubbing_um = (
        1e3 * rms(printer(f_hz, force).follow(finely, STEP_S).position_mm[:, ::fine])
        for force in (0.0, 1.2)
    )
    assert smooth_um == pytest.approx(known.reference_um, rel=0.02)
    assert 1.2 * smooth_um < rubbing_um < most_um
