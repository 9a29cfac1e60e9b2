"""Where printed lines begin and end at rest, the plan stands as long as the command needs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lsim

from stillpath.compensation.defaults import DT_S
from stillpath.gcode.timeline import group_rows
from stillpath.models.arrays import Array
from stillpath.models.machine import Machine
from stillpath.models.plant_specs import RelativeModesSpec
from stillpath.models.plants import PlantSetSpec, plant_set
from stillpath.pipeline.options import Options
from stillpath.pipeline.piece_compensator import PieceCompensator
from stillpath.pipeline.standing import Standing, yielding_s2
from tests.gcode.cutting import HEAD, ender3_with, pieces_of

LINE, BACK = "G1 X90 Y80 E1 F9000\n", "G1 X60 Y60 E1\n"
RETRACT, PRIME = "G1 E-.8 F2100\n", "G1 E.8 F2100\n"
LIMIT = {"klipper": "SET_VELOCITY_LIMIT ACCEL=", "marlin": "M204 P"}


def machine_of(*modes: tuple[float, float], zeta: float = 0.05, kind: str = "klipper") -> Machine:
    """A machine that lags in X and Y by modes of these frequencies and shares."""
    written = [{"f_hz": f, "zeta": zeta, "share": share} for f, share in modes]
    plants = PlantSetSpec(nominal=RelativeModesSpec.model_validate({"modes": written}))
    return ender3_with(kind).model_copy(update={"axes": {"x": plants, "y": plants}})


@pytest.mark.parametrize("modes", [((30.0, 1.0),), ((30.0, 0.6), (90.0, 0.4))])
def test_springs_yield_by_the_square_of_their_periods(modes: tuple[tuple[float, float]]) -> None:
    plant = plant_set(machine_of(*modes).axes["x"], DT_S).nominal
    expected = sum(share / (2 * np.pi * f) ** 2 for f, share in modes)
    assert yielding_s2(plant) == pytest.approx(expected, rel=0.02)


def standing(text: str, machine: Machine) -> tuple[list[float], list[float]]:
    """Standing times before and after each group of the piece of a text, in ms."""
    phases = pieces_of(HEAD + text, machine)[-1].phases
    before, after = Standing(machine, DT_S).of(phases, group_rows(phases))
    return (1e3 * before).round(2).tolist(), (1e3 * after).round(2).tolist()


@pytest.mark.parametrize("kind", LIMIT)
def test_the_command_has_the_time_to_jump_from_rest_to_rest(kind: str) -> None:
    """An axis at 3000 mm/s2 of 30 Hz lags by 84 um: 4.1 ms at 20 000 mm/s2, as s = a t^2 / 4.

    Marlin, which ends lines at a speed, needs no more.
    """
    machine = machine_of((30.0, 1.0), kind=kind)
    accel = 3000.0
    text = f"{LIMIT[kind]}{accel}\nG1 X90 E1 F9000\n{RETRACT}G1 X60 F9000\n{PRIME}"
    before, after = standing(text, machine)
    needed_ms = 1e3 * 2.0 * np.sqrt(accel / (2 * np.pi * 30.0) ** 2 / 20_000.0)
    # The line, and neither the retraction nor the travel.
    assert before[0] == pytest.approx(needed_ms, rel=0.02)
    assert after[0] == pytest.approx(needed_ms, rel=0.02)
    assert not any(before[1:] + after[1:])


def test_stiff_printers_and_slow_lines_take_no_longer() -> None:
    assert standing(LINE, machine_of((150.0, 1.0))) == ([0.0], [0.0])
    text = LINE + RETRACT + PRIME + BACK
    before, after = standing(text, machine_of((120.0, 1.0), kind="marlin"))
    assert not any(before + after)
    assert standing("G1 X61 E.1 F40\n", machine_of((30.0, 1.0))) == ([0.0], [0.0])


def test_shapers_need_none() -> None:
    machine = machine_of((30.0, 1.0))
    piece = pieces_of(HEAD + LINE, machine)[-1]
    work = PieceCompensator(machine, Options(method="shaper:zv"))
    planned_s = piece.phases.duration_s
    lead_s, tail_s = work.compensator.lead_s, work.compensator.tail_s
    lasts_s = work.compensate(piece).timeline.end_s[-1]
    assert lasts_s == pytest.approx(planned_s + lead_s + tail_s, abs=DT_S)


def printed(machine: Machine, accel: float, *, stands: bool) -> tuple[Array, float]:
    """Largest error (um) of lines with retractions on another printer, and their time."""
    text = f"SET_VELOCITY_LIMIT ACCEL={accel}\n" + (LINE + RETRACT + PRIME + BACK) * 3
    piece = pieces_of(HEAD + text, machine)[-1]
    work = PieceCompensator(machine, Options(robust="off"))
    if not stands:
        work._standing = None
    work.compensator.reset(piece.phases.start_mm[0, :2])
    made = work.compensate(piece)
    path, command = made.timeline.position_mm[:2], made.command_mm[:2]
    # Printed by a spring that the design has not seen.
    w, zeta = 2 * np.pi * 31.0, 0.07
    spring = ([2 * zeta * w, w**2], [1.0, 2 * zeta * w, w**2])
    t = DT_S * np.arange(path.shape[1])
    answer = np.stack([lsim(spring, row - row[0], t)[1] + row[0] for row in command])
    return 1e3 * np.hypot(*(answer - path))[made.extruding], float(t[-1])


@pytest.mark.parametrize("accel", [3000.0, 8000.0])
def test_lines_end_without_a_bump(accel: float) -> None:
    machine = machine_of((30.0, 1.0))
    (without, short_s), (error_um, long_s) = (
        printed(machine, accel, stands=stands) for stands in (False, True)
    )
    assert error_um.max() < 0.6 * without.max()
    assert long_s - short_s < 0.1


def test_short_lines_in_the_plan_of_many_small_moves() -> None:
    """A curve begins with moves shorter than the spring's time: all of them count."""
    machine = machine_of((30.0, 1.0))
    whole = standing("G1 X70 E1 F9000\n", machine)
    parts = standing(
        "".join(f"G1 X{60 + k / 20:.3f} E.005 F9000\n" for k in range(1, 201)), machine
    )
    np.testing.assert_allclose(parts, whole, rtol=0.05)


def test_phases_whose_times_overlap_by_rounding() -> None:
    machine = machine_of((30.0, 1.0))
    phases = pieces_of(HEAD + LINE + RETRACT + PRIME + BACK, machine)[-1].phases
    nudged = replace(phases, t_s=phases.t_s - 1e-13 * np.arange(len(phases.t_s)))
    a, b = (Standing(machine, DT_S).of(each, group_rows(each)) for each in (phases, nudged))
    np.testing.assert_allclose(a, b, atol=1e-6)
