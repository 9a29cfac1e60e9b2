"""Dry friction in logs of virtual printers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stillpath.models.identification.alignment import align
from stillpath.models.identification.averaging import mean_response
from stillpath.models.identification.estimation import estimate_aligned, estimate_response
from stillpath.models.identification.friction import better_explained, dry_friction, freed
from stillpath.models.identification.nozzle import frame_of
from stillpath.models.identification.synthetic import LIS2DW, simulate_log
from stillpath.models.identification.types import AccelerationLog, Excitation, FrequencyResponse
from stillpath.models.plants import RelativeMode, RelativeModesSpec
from stillpath.simulation.printers.drawing import draw
from stillpath.simulation.printers.machines import Printer
from stillpath.simulation.printers.resonance_test import NEW_TEST, OLD_TEST, drawn_sensor, run_test


def held_mm(printer: Printer, number: int) -> float:
    """Force over stiffness, solved at rest."""
    bodies = printer.bodies
    _, _, k, _, _ = bodies.matrices()
    friction = bodies.frictions[number]
    along = np.array([friction.along.get(name, 0.0) for name in bodies.names])
    return float(1e3 * friction.force_n * printer.nozzle[number] @ np.linalg.solve(k, along))


def rubbing(printer: Printer, times: float) -> Printer:
    """Scale the dry friction of all guides."""
    frictions = tuple(replace(one, force_n=times * one.force_n) for one in printer.bodies.frictions)
    return replace(printer, bodies=replace(printer.bodies, frictions=frictions))


def logs(  # type: ignore[no-untyped-def]
    printer: Printer, test: Excitation, axis: str = "x", runs: int = 1
):
    rng = np.random.default_rng(4)
    sensor = drawn_sensor(rng, "lis2dw")
    out = []
    test = replace(test, direction=(1.0, 0.0) if axis == "x" else (0.0, 1.0))
    for run in range(runs):
        record = run_test(printer, axis, sensor, rng, test)
        log = AccelerationLog(record.time_s, record.accel_mm_s2, axis, f"raw_{axis}_{run}.csv")
        aligned = align(log, test)
        out.append((log, aligned, estimate_response(log, test, aligned=aligned)))
    return out


def test_it_is_told_by_the_log() -> None:
    printer = draw("bed slinger", 3)
    read = logs(printer, NEW_TEST, runs=2)
    found = dry_friction([one[1] for one in read], [[one[2] for one in read]])
    assert found.held_mm == pytest.approx(held_mm(printer, 0), rel=0.3)
    # What is left follows the command better.
    log, aligned, response = read[0]
    again = estimate_aligned(log, freed(aligned, response, found)[0])
    low = (response.f_hz > 8) & (response.f_hz < 25)
    assert np.mean(1 - again.coherence[low]) < 0.9 * np.mean(1 - response.coherence[low])


def test_a_frame_that_shakes_does_not_hide_it() -> None:
    """The sensor on a bed feels the frame too, at 8 Hz where friction shows most."""
    printer = draw("bed slinger", 2)
    read = logs(printer, OLD_TEST, "y")
    felt = [one[2] for one in read]
    frame = frame_of(mean_response(felt))
    assert frame is not None
    over_it = [frame.over_bed(response) for response in felt]
    found = dry_friction([one[1] for one in read], [felt, over_it])
    assert found.held_mm == pytest.approx(held_mm(printer, 1), rel=0.3)
    assert found.motion == 1


def test_guides_that_do_not_rub_have_none() -> None:
    printer = draw("corexy", 3)
    read = logs(rubbing(printer, 0.0), OLD_TEST)
    assert dry_friction([one[1] for one in read], [[one[2] for one in read]]).held_mm < 2e-4
    assert mean_response([one[2] for one in read]).f_hz[0] < 10


def test_strong_friction_delays_the_fundamental_which_alignment_takes_for_a_later_start() -> None:
    printer = rubbing(draw("bed slinger", 3), 8.0)
    read = logs(printer, OLD_TEST)
    found = dry_friction([one[1] for one in read], [[one[2] for one in read]])
    assert found.held_mm == pytest.approx(held_mm(printer, 0), rel=0.3)
    assert found.late_s > 0.0


@pytest.mark.parametrize(("seed", "test"), [(0, NEW_TEST), (2, OLD_TEST)], ids=["new", "old"])
def test_guides_that_stick_above_the_resonance_act_as_springs(seed: int, test: Excitation) -> None:
    printer = draw("bed slinger", seed)
    ((log, aligned, response),) = logs(rubbing(printer, 8.0), test)
    found = dry_friction([aligned], [[response]])
    sliding, stuck = (estimate_aligned(log, one) for one in freed(aligned, response, found))
    both = better_explained(sliding, stuck)
    sticks = both.response != sliding.response
    resonance_hz = sliding.f_hz[np.argmax(np.abs(sliding.response))]
    assert sliding.f_hz[sticks].min() > resonance_hz
    # The same printer without friction is the truth.
    ((_, _, smooth),) = logs(rubbing(printer, 0.0), test)
    true = np.abs(smooth.response[sticks])

    def error(found: FrequencyResponse) -> float:
        return float(np.median(np.abs(np.abs(found.response[sticks]) - true) / true))

    assert error(both) < 0.5 * error(sliding)


def test_a_start_ever_later_is_no_friction() -> None:
    """A test from 20 Hz: 4.6 µm were found with a start 8 ms earlier, the earliest tried."""
    test = Excitation((1.0, 0.0), 20.0, 120.0, 75.0, 1.0, 0.0, out_and_back=True)
    free = RelativeModesSpec(modes=(RelativeMode(f_hz=48.0, zeta=0.05, share=1.0),))
    rng = np.random.default_rng([1, 1])
    log = simulate_log({"x": free}, test, sensor=LIS2DW, lead_s=0.0, tail_s=0.0, rng=rng)
    aligned = align(log, test)
    response = estimate_response(log, test, aligned=aligned)
    assert dry_friction([aligned], [[response]]).held_mm == 0.0
