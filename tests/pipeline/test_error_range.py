"""What friction that was not measured adds to a prediction."""

from __future__ import annotations

import numpy as np
import pytest

from stillpath.compensation.friction import against_friction
from stillpath.compensation.shapers import ShaperCompensator
from stillpath.models.friction import with_least_friction
from stillpath.models.machine import Machine
from stillpath.models.plants import PlantSetSpec, RelativeMode, RelativeModesSpec, WeightedMember
from stillpath.models.provenance import Provenance
from stillpath.models.reference_motion import reference_motion
from stillpath.models.store import load_machine
from stillpath.pipeline.error_range import error_ranges, nominal_response, unseen_friction_mm
from stillpath.simulation.measures import PathDistances
from stillpath.simulation.printers.bodies import STEP_S, Bodies, Element, Friction

DT_S = 1e-3
NO_RESTS = np.zeros((0, 2), np.int64)
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


def printer(f_hz: dict[str, float], n_kg: float | dict[str, float]) -> Bodies:
    """One mass per axis on the spring of its belt, on guides that rub with so many N per kg."""
    mass_kg, zeta = 0.4, 0.06
    elements, frictions = [], []
    for name, command in (("x", (1.0, 0.0)), ("y", (0.0, 1.0))):
        w = 2 * np.pi * f_hz[name]
        k_n_m, d_n_s_m = mass_kg * w**2, 2 * zeta * w * mass_kg
        elements.append(Element({name: 1.0}, k_n_m, d_n_s_m, command))
        rubs_n_kg = n_kg[name] if isinstance(n_kg, dict) else n_kg
        frictions.append(Friction({name: 1.0}, rubs_n_kg * mass_kg))
    return Bodies({"x": mass_kg, "y": mass_kg}, tuple(elements), tuple(frictions))


def printed(bodies: Bodies, command_mm: np.ndarray) -> np.ndarray:
    """Motion of a printer that executes a command, at the command's samples."""
    fine, n = round(DT_S / STEP_S), command_mm.shape[1]
    t = np.arange(n * fine - fine + 1) / fine
    finely = np.stack([np.interp(t, np.arange(n), row) for row in command_mm])
    return bodies.follow(finely, STEP_S).position_mm[:, ::fine]


class Motion:
    """The reference motion, and errors on it."""

    def __init__(self, *limits: float) -> None:
        self.path, self.extruding = reference_motion(DT_S, *limits)
        self._distances = PathDistances(self.path, DT_S)
        self._at = np.flatnonzero(self.extruding)[::5]

    def shaped(self, machine: Machine, f_hz: dict[str, float]) -> np.ndarray:
        """The command of the shaper MZV."""
        shaper = ShaperCompensator(machine, DT_S, shaper="mzv", fx_hz=f_hz["x"], fy_hz=f_hz["y"])
        return shaper.compensate(self.path, self.extruding, NO_RESTS)

    def rms_mm(self, motion_mm: np.ndarray) -> float:
        return float(np.sqrt(np.mean(self._distances.at(motion_mm[:, self._at], self._at) ** 2)))


def machine_of(
    f_hz: dict[str, float], friction_mm: float | None = None, base: str = "generic-corexy"
) -> Machine:
    axes = {name: axis(f, friction_mm=friction_mm) for name, f in f_hz.items()}
    return load_machine(base).model_copy(update={"axes": axes})


@pytest.mark.parametrize("f_hz", [{"x": 60.0, "y": 45.0}, {"x": 48.0, "y": 30.0}])
def test_the_error_of_a_printer_that_rubs_is_within_the_range(f_hz: dict[str, float]) -> None:
    """Bodies with Dahl's friction, 1.2 N/kg, know nothing of the model behind the prediction.

    With a shaper: friction also damps, and a command that makes an axis ring prints better by it.
    """
    machine, motion = machine_of(f_hz), Motion()
    command = motion.shaped(machine, f_hz)
    known = error_ranges(machine, {"shaper": [command]}, lambda one: motion.rms_mm(one[0]), DT_S)[
        "shaper"
    ]
    most_um = np.hypot(known.high * known.reference_um, known.friction_um)
    smooth_um, rubbing_um = (
        1e3 * motion.rms_mm(printed(printer(f_hz, force), command)) for force in (0.0, 1.2)
    )
    assert smooth_um == pytest.approx(known.reference_um, rel=0.02)
    assert 1.2 * smooth_um < rubbing_um < most_um


@pytest.mark.parametrize(("held_mm", "times"), [(0.004, 1.3), (0.012, 1.8)])
def test_friction_that_was_found_too_small_counts_in_a_gentle_print_too(
    held_mm: float, times: float
) -> None:
    """What it adds depends on where a path turns: it does not shrink with the accelerations.

    Of guides that hold an axis far, only half may have been found.
    """
    f_hz = {"x": 60.0, "y": 45.0}
    machine = machine_of(f_hz, held_mm)
    rubs = {name: times * 1e-3 * held_mm * (2 * np.pi * f) ** 2 for name, f in f_hz.items()}
    hard, gentle = Motion(), Motion(40.0, 300.0)
    commands = [
        against_friction(motion.shaped(machine, f_hz), machine.friction_mm, NO_RESTS, DT_S)
        for motion in (hard, gentle)
    ]
    known = error_ranges(machine, {"after": [commands[0]]}, lambda one: hard.rms_mm(one[0]), DT_S)[
        "after"
    ]
    predicted_um = 1e3 * gentle.rms_mm(nominal_response(machine, commands[1], DT_S))
    low_um, high_um = known.around_um(predicted_um)
    true_um = 1e3 * gentle.rms_mm(printed(printer(f_hz, rubs), commands[1]))
    assert low_um < true_um < high_um
    assert true_um > 2.0 * known.high * predicted_um  # as much as plants alone would explain


def test_a_ring_test_does_not_tell_which_axis_follows_later() -> None:
    """One that does by a third of a millisecond prints within the range, not within raw logs'."""
    f_hz = {"x": 60.0, "y": 45.0}
    machine, motion = machine_of(f_hz, base="generic-bedslinger"), Motion()
    command = motion.shaped(machine, f_hz)
    made = printed(printer(f_hz, 0.0), command)
    late = np.arange(made.shape[1]) - 0.35e-3 / DT_S
    made[1] = np.interp(late, np.arange(made.shape[1]), made[1])
    true_um, most_um = 1e3 * motion.rms_mm(made), {}
    for kind in ("raw log", "ring test"):
        about = Provenance(kind=kind, phase="aligned at low frequency")
        axes = {a: s.model_copy(update={"provenance": about}) for a, s in machine.axes.items()}
        found = error_ranges(
            machine.model_copy(update={"axes": axes}),
            {"shaper": [command]},
            lambda one: motion.rms_mm(one[0]),
            DT_S,
        )["shaper"]
        most_um[kind] = found.around_um(found.reference_um)[1]
    assert most_um["raw log"] < true_um < most_um["ring test"]
