"""Virtual printers: bodies against textbooks and other solvers, tables against their readers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import StateSpace, lsim

from stillpath.models.identification.readers import ReadSettings, read_content
from stillpath.models.identification.types import AccelerationLog, Spectrum
from stillpath.simulation.printers._kernels import followed
from stillpath.simulation.printers.bodies import STEP_S, Bodies, Element, Friction
from stillpath.simulation.printers.drawing import KINDS, draw
from stillpath.simulation.printers.machines import Printer
from stillpath.simulation.printers.resonance_test import (
    OLD_TEST,
    Accelerometer,
    drawn_sensor,
    run_test,
)

QUIET = Accelerometer(rate_hz=3200.0, step_mm_s2=1e-6, noise_mm_s2=0.0)


def one_mass(friction_n: float = 0.0, d_n_s_m: float = 0.0) -> Bodies:
    """A mass of .5 kg on a spring to the command."""
    return Bodies(
        {"mass": 0.5},
        (Element({"mass": 1.0}, 20_000.0, d_n_s_m, (1.0, 0.0)),),
        (Friction({"mass": 1.0}, friction_n, 1e-4),),
    )


def step_of(size_mm: float, seconds: float) -> np.ndarray:
    command = np.zeros((2, round(seconds / STEP_S)))
    command[0, 1:] = size_mm
    return command


def test_two_masses_have_the_modes_of_the_closed_form() -> None:
    m1, m2, k1, k2 = 0.3, 0.7, 30_000.0, 12_000.0
    bodies = Bodies(
        {"a": m1, "b": m2},
        (Element({"a": 1.0}, k1, 0.0, (1.0, 0.0)), Element({"b": 1.0, "a": -1.0}, k2)),
    )
    half = (k1 + k2) / m1 + k2 / m2
    root = np.sqrt(half**2 - 4 * k1 * k2 / (m1 * m2))
    expected = np.sqrt((half + np.array([-root, root])) / 2) / (2 * np.pi)
    found = bodies.natural_modes()
    np.testing.assert_allclose(found[:, 0], expected, rtol=1e-9)
    np.testing.assert_allclose(found[:, 1], 0.0, atol=1e-9)


def test_without_damping_the_energy_stays() -> None:
    bodies = one_mass()
    motion = bodies.follow(step_of(1.0, 1.0))
    away, speed = motion.position_mm[0] - 1.0, motion.velocity_mm_s[0]
    energy = 0.5 * 20_000.0 * away**2 + 0.5 * 0.5 * speed**2
    np.testing.assert_allclose(energy[2:], energy[2], rtol=1e-9)


def test_dry_friction_takes_the_same_from_every_swing() -> None:
    """Free vibration with Coulomb friction: amplitudes fall by 4 F/k a period (Den Hartog 1931)."""
    force_n = 0.4
    motion = one_mass(force_n).follow(step_of(1.0, 0.5))
    away = motion.position_mm[0] - 1.0
    peaks = away[1:-1][(away[1:-1] > away[:-2]) & (away[1:-1] > away[2:]) & (away[1:-1] > 0.1)]
    assert len(peaks) >= 5
    lost_mm = 4e3 * force_n / 20_000.0
    np.testing.assert_allclose(-np.diff(peaks), lost_mm, rtol=0.02)


def test_at_rest_friction_holds_within_its_dead_band() -> None:
    away = one_mass(1.0, 40.0).follow(step_of(1.0, 2.0)).position_mm[0, -1] - 1.0
    assert 0.0 < abs(away) <= 1e3 * 1.0 / 20_000.0


def linear(kind: str, seed: int = 1) -> Printer:
    printer = draw(kind, seed)
    return replace(printer, bodies=replace(printer.bodies, frictions=()))


@pytest.mark.parametrize("kind", KINDS)
def test_the_linear_part_is_that_of_another_solver(kind: str) -> None:
    """scipy's lsim, the damping of the command as an input of its own."""
    bodies = linear(kind).bodies
    m, d, k, by_command, by_rate = bodies.matrices()
    n, inverse = len(m), np.linalg.inv(m)
    a = np.block([[np.zeros((n, n)), np.eye(n)], [-inverse @ k, -inverse @ d]])
    b = np.concatenate([np.zeros((n, 4)), inverse @ np.hstack([by_command, by_rate])])
    t = STEP_S * np.arange(3000)
    way = 2.0 * (1 - np.cos(2 * np.pi * 7.0 * t))
    rate = np.gradient(way, STEP_S)
    command = np.stack([way, 0.5 * way])
    system = StateSpace(a, b, np.hstack([np.eye(n), np.zeros((n, n))]), np.zeros((n, 4)))
    _, expected, _ = lsim(system, np.stack([way, 0.5 * way, rate, 0.5 * rate], axis=1), t)
    found = bodies.follow(command).position_mm
    np.testing.assert_allclose(found.T, expected, atol=2e-3)


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=15)
@given(seed=st.integers(0, 10_000))
def test_every_printer_stands_where_it_is_told(kind: str, seed: int) -> None:
    """Slow motion arrives whole; guides delay it by at most d/k, and nothing else does."""
    printer = draw(kind, seed)
    f_hz = 0.01
    slow = printer.frequency_response(np.array([f_hz]))[0]
    assert np.abs(slow - np.eye(2)).max() < 1e-3
    delay_s = -np.angle(np.diag(slow)) / (2 * np.pi * f_hz)
    assert np.all(delay_s > -1e-9)
    assert np.all(delay_s < 2e-3)
    assert np.all(printer.bodies.natural_modes()[:, 1] > 0.0)


def test_equal_belts_couple_nothing() -> None:
    printer = linear("corexy")
    equal = printer.bodies.elements[2]
    b = printer.bodies.elements[3]
    elements = list(printer.bodies.elements)
    elements[3] = replace(b, k_n_m=equal.k_n_m, d_n_s_m=equal.d_n_s_m)
    elements[1] = replace(elements[1], k_n_m=elements[0].k_n_m, d_n_s_m=elements[0].d_n_s_m)
    even = replace(printer, bodies=replace(printer.bodies, elements=tuple(elements)))
    f_hz = np.linspace(5.0, 150.0, 40)
    assert np.abs(even.frequency_response(f_hz)[:, 0, 1]).max() < 1e-9
    assert np.abs(printer.frequency_response(f_hz)[:, 0, 1]).max() > 1e-3


def test_the_kernel_is_its_plain_twin() -> None:
    rng = np.random.default_rng(0)
    step = 0.4 * rng.standard_normal((4, 4))
    now, slope = rng.standard_normal((2, 4, 5))
    command = np.cumsum(0.1 * rng.standard_normal((2, 50)), axis=1)
    slips, force, bend = np.array([[1.0, -0.5]]), np.array([0.7]), np.array([0.05])
    states = np.zeros((50, 4))
    followed(step, now, slope, command, 1e-4, slips, force, bend, states)
    x, bent = np.zeros(4), 0.0
    for k in range(1, 50):
        u, change = command[:, k - 1], command[:, k] - command[:, k - 1]
        before = x
        x = step @ x + now[:, :2] @ u + slope[:, :2] @ change + now[:, 2:4] @ change / 1e-4
        x = x + now[:, 4] * force[0] * bent
        way = float(slips[0] @ (x[:2] - before[:2]))
        towards = 1.0 if way > 0 else -1.0
        bent = towards + (bent - towards) * np.exp(-abs(way) / bend[0])
        np.testing.assert_allclose(states[k], x, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_files_are_read_as_klipper_s(kind: str) -> None:
    short = replace(OLD_TEST, f_end_hz=20.0)
    record = run_test(draw(kind, 3), "x", QUIET, np.random.default_rng(0), short)
    (log,) = read_content(record.raw_data(), "raw_data_x_a.csv", settings=ReadSettings())
    assert isinstance(log, AccelerationLog)
    np.testing.assert_allclose(log.accel_mm_s2, record.accel_mm_s2, atol=1e-5)
    (table,) = read_content(record.resonances(), "resonances_x_a.csv", settings=ReadSettings())
    assert isinstance(table, Spectrum)
    assert table.axis == "x"
    assert table.f_hz[-1] <= 200.0


def test_the_same_seed_is_the_same_printer_and_run() -> None:
    short = replace(OLD_TEST, f_end_hz=12.0)
    files = []
    for _ in range(2):
        rng = np.random.default_rng(5)
        files.append(run_test(draw("corexy", 8), "y", drawn_sensor(rng), rng, short).raw_data())
    assert files[0] == files[1]
    other = run_test(draw("corexy", 8), "y", QUIET, np.random.default_rng(6), short).raw_data()
    assert other != files[0]


def test_steps_of_the_command_must_be_short() -> None:
    with pytest.raises(ValueError, match=r"0\.001 s is longer than 0\.0001 s"):
        one_mass().follow(np.zeros((2, 10)), 1e-3)
    with pytest.raises(ValueError, match="there are bed slinger, corexy"):
        draw("delta", 1)
