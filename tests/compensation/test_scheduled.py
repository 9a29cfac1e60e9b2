"""Compensators along a schedule: taking over at rest, and blends over the position."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from stillpath.compensation.base import Compensator, DesignError
from stillpath.compensation.fbf import LADDER, PreviewFbf
from stillpath.compensation.ladder import BAND_MARGIN, functions_within
from stillpath.compensation.registry import compensator
from stillpath.compensation.scheduled import DESIGN_STEP, ScheduledCompensator
from stillpath.models.machine import CommandLimits, Machine
from stillpath.models.operating import BLEND_STEP, OperatingGrid, machine_at
from stillpath.models.plants import Mode, ModesSpec, plant_set
from stillpath.models.ripple import AxisRipple, RippleHarmonic, RippleSource
from stillpath.models.schedule import (
    AxisSchedule,
    GridNode,
    GridSchedule,
    MassSchedule,
    OperatingPoint,
)
from stillpath.models.store import load_machine
from stillpath.simulation.machine_response import MachineStream
from stillpath.simulation.measures import contour_error
from stillpath.simulation.response import response

Array = NDArray[np.float64]
Piece = tuple[Array, NDArray[np.bool_], NDArray[np.int64]]

DT_S = 1e-3
HALF = OperatingPoint(mass_kg=0.5)


def bedslinger(moving_kg: float | None = None) -> Machine:
    machine = load_machine("generic-bedslinger")
    if moving_kg is None:
        return machine
    schedule = AxisSchedule(mass=MassSchedule(moving_mass_kg=moving_kg))
    return machine.model_copy(update={"schedules": {"y": schedule}})


def strokes(start: tuple[float, float], rest: int = 150) -> Piece:
    """Three strokes with rests between: path, extruding, rests."""
    s = np.linspace(0, 1, 240)
    smooth = 10 * s**3 - 15 * s**4 + 6 * s**5
    parts, rests, here, n = [], [], np.array(start), 0
    for k, step in enumerate(([40.0, 20.0], [-25.0, 35.0], [-10.0, -45.0])):
        parts.append(here[:, None] + np.array(step)[:, None] * smooth)
        here, n = here + step, n + 240
        if k < 2:
            parts.append(np.repeat(here[:, None], rest, axis=1))
            rests.append((n, n + rest))
            n += rest
    path = np.hstack(parts)
    extruding = np.ones(n, bool)
    for a, b in rests:
        extruding[a:b] = False
    return path, extruding, np.array(rests, np.int64)


def run(one: Compensator, pieces: list[Piece], points: list[OperatingPoint]) -> list[Array]:
    one.reset(pieces[0][0][:, 0])
    out = []
    for piece, point in zip(pieces, points, strict=True):
        one.operate_at(point)
        out.append(one.compensate(*piece))
        one.commit()
        one.observe(np.repeat(piece[0][:, -1:], 20, axis=1))
    return out


def pieces(count: int = 3) -> list[Piece]:
    out, here = [], (60.0, 50.0)
    for _ in range(count):
        out.append(strokes(here))
        here = tuple(out[-1][0][:, -1].tolist())
    return out


@pytest.mark.parametrize("method", ["fbf", "zpetc", "shaper:mzv"])
def test_one_operating_point_changes_nothing(method: str) -> None:
    plain = compensator(method, bedslinger(), DT_S)
    # Half a kilogram on a ton.
    following = compensator(method, bedslinger(1000.0), DT_S)
    assert isinstance(following, ScheduledCompensator)
    assert (following.name, following.lead_s) == (plain.name, plain.lead_s)
    jobs = pieces()
    points = [OperatingPoint(mass_kg=m) for m in (0.0, 0.2, 0.5)]
    for a, b in zip(run(plain, jobs, points), run(following, jobs, points), strict=True):
        np.testing.assert_array_equal(a, b)


def test_standstill_for_a_shaper_follows_its_length() -> None:
    machine = bedslinger(0.8)
    harmonic = RippleHarmonic(number=1, amplitude_um=5.0, phase_deg=0.0)
    source = RippleSource(name="belt", pitch_mm=2.0, harmonics=(harmonic,))
    machine = machine.model_copy(update={"ripple": {"x": AxisRipple(sources=(source,))}})
    plain, over = (compensator(name, machine, DT_S) for name in ("shaper:mzv", "shaper:mzv+ripple"))
    empty_s = plain.lead_s
    for one in (plain, over):
        one.operate_at(HALF)
    assert plain.lead_s > 1.2 * empty_s
    assert (over.lead_s, over.tail_s) == (plain.lead_s, plain.tail_s)


def test_takes_over_the_vibration() -> None:
    """The design of the new mass sees the machine as if it had watched from the start."""
    jobs = pieces(2)
    following = compensator("fbf", bedslinger(0.8), DT_S)
    first, second = run(following, jobs, [OperatingPoint(), HALF])
    np.testing.assert_array_equal(second[:, 0], first[:, -1])
    heavy = compensator("fbf", machine_at(bedslinger(0.8), following._level), DT_S)
    heavy.reset(jobs[0][0][:, 0])
    heavy.observe(np.hstack([first[:, :-1], np.repeat(first[:, -1:], 20, axis=1)]))
    np.testing.assert_allclose(second, heavy.compensate(*jobs[1]), atol=1e-6)
    # It matters: a design that takes the machine to stand still commands something else.
    still = compensator("fbf", machine_at(bedslinger(0.8), following._level), DT_S)
    still.reset(jobs[1][0][:, 0])
    assert np.max(np.abs(second - still.compensate(*jobs[1]))) > 1e-4


def test_commands_join_without_a_step() -> None:
    jobs = pieces(4)
    points = [OperatingPoint(mass_kg=m) for m in (0.0, 0.15, 0.35, 0.5)]
    machine = bedslinger(0.8)
    commands = run(compensator("fbf", machine, DT_S), jobs, points)
    for (path, _, rests), u in zip(jobs, commands, strict=True):
        np.testing.assert_array_equal(u[:, [0, -1]], path[:, [0, -1]])
        for a, b in rests:
            np.testing.assert_array_equal(u[:, a:b], path[:, a:b])
    joined = np.hstack(commands)
    limit = machine.command.accel_mm_s2
    assert np.max(np.abs(np.diff(joined, 2))) / DT_S**2 <= limit * (1 + 1e-9)


def test_the_right_mass_is_much_better() -> None:
    jobs = pieces(3)
    points = [HALF] * 3
    machine = bedslinger(0.8)
    heavy = machine_at(machine, HALF)
    plants = [plant_set(heavy.axes["x"], DT_S).nominal, plant_set(heavy.axes["y"], DT_S).nominal]
    rms = {}
    for name, made in (("fixed", bedslinger()), ("following", machine)):
        commands = run(compensator("fbf", made, DT_S), jobs, points)
        stand = [np.repeat(u[:, -1:], 20, axis=1) for u in commands]
        u = np.hstack([part for pair in zip(commands, stand, strict=True) for part in pair])
        path = np.hstack([q for p, s in zip(jobs, stand, strict=True) for q in (p[0], s)])
        error = contour_error(path, response(plants, u), DT_S)
        rms[name] = float(np.sqrt(np.mean(error**2)))
    assert rms["following"] < 0.1 * rms["fixed"]


def across(f_hz: dict[float, float], **changes: object) -> Machine:
    """A machine whose Y depends on x."""
    nodes = tuple(
        GridNode(x_mm=x, plant=ModesSpec(modes=(Mode(f_hz=f, zeta=0.06),))) for x, f in f_hz.items()
    )
    update = {"schedules": {"y": AxisSchedule(grid=GridSchedule(nodes=nodes))}, **changes}
    return load_machine("generic-bedslinger").model_copy(update=update)


def test_blend_of_equals_is_the_same() -> None:
    alike = across({60.0: 35.0, 140.0: 35.0})
    axes = dict(alike.axes)
    axes["y"] = axes["y"].model_copy(
        update={"nominal": ModesSpec(modes=(Mode(f_hz=35.0, zeta=0.06),))}
    )
    plain = alike.model_copy(update={"schedules": {}, "axes": axes})
    jobs, points = pieces(), [OperatingPoint()] * 3
    commands = run(compensator("fbf", alike, DT_S), jobs, points)
    expected = run(compensator("fbf", plain, DT_S), jobs, points)
    for a, b in zip(commands, expected, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-7)


def test_blend_keeps_what_a_command_must() -> None:
    machine = across({50.0: 36.0, 110.0: 32.0})
    jobs = pieces()
    commands = run(compensator("fbf", machine, DT_S), jobs, [OperatingPoint()] * 3)
    for (path, _, rests), u in zip(jobs, commands, strict=True):
        np.testing.assert_array_equal(u[:, [0, -1]], path[:, [0, -1]])
        for a, b in rests:
            np.testing.assert_array_equal(u[:, a:b], path[:, a:b])
        assert np.max(np.abs(np.diff(u, 2))) / DT_S**2 <= machine.command.accel_mm_s2
        # No step anywhere: neither of the command nor, beyond what designs do, of its speed.
        assert np.max(np.abs(np.diff(u))) / DT_S < 1.5 * np.max(np.abs(np.diff(path))) / DT_S


def test_blend_beats_the_plant_of_one_place() -> None:
    machine = across({40.0: 38.0, 130.0: 31.0})
    jobs, rms = pieces(), {}
    middle = machine_at(machine, OperatingPoint(x_mm=85.0))
    for name, made in (("fixed", middle), ("blended", machine)):
        commands = run(compensator("fbf", made, DT_S), jobs, [OperatingPoint()] * 3)
        path, u = np.hstack([p[0] for p in jobs]), np.hstack(commands)
        y = MachineStream(machine, DT_S).push(u, path)
        rms[name] = float(np.sqrt(np.mean(contour_error(path, y, DT_S) ** 2)))
    assert rms["blended"] < 0.35 * rms["fixed"]


def test_blend_beyond_the_limits_is_refused() -> None:
    """Plants that differ by an octave within two millimetres cannot be followed."""
    narrow = across({79.0: 25.0, 81.0: 50.0}, command=CommandLimits(accel_mm_s2=6500.0))
    with pytest.raises(DesignError, match=r"axis y: blended over the position.*mm/s2"):
        run(compensator("fbf", narrow, DT_S), pieces(1), [OperatingPoint()])


def test_nodes_that_a_print_does_not_touch_are_not_designed() -> None:
    machine = across({0.0: 35.0, 110.0: 30.0, 220.0: 26.0})
    asked = []

    def make(then: Machine) -> Compensator:
        asked.append(then)
        return PreviewFbf(then, DT_S)

    one = ScheduledCompensator(machine, make, DT_S)
    assert len(asked) == 1
    run(one, pieces(2), [OperatingPoint()] * 2)
    assert (
        2
        <= len(asked)
        < 0.7 * OperatingGrid(machine, step=DESIGN_STEP, blend_step=BLEND_STEP).nodes
    )


def test_designs_fail_where_they_are_made() -> None:
    with pytest.raises(DesignError, match="no basis is called"):
        compensator("fbf", bedslinger(0.8), DT_S, basis="none")


def banded(high_hz: float | None) -> Machine:
    machine = load_machine("generic-bedslinger")
    band_hz = None if high_hz is None else (5.0, high_hz)
    axes = {n: a.model_copy(update={"band_hz": band_hz}) for n, a in machine.axes.items()}
    return machine.model_copy(update={"axes": axes})


def test_functions_end_near_the_band() -> None:
    assert functions_within(None, DT_S) == 300
    # n functions over .3 s reach n / .6 Hz.
    for high_hz in (20.0, 60.0, 130.0):
        n = functions_within((5.0, high_hz), DT_S)
        assert n / 0.6 <= BAND_MARGIN * high_hz < (n + 1) / 0.6
    # The library's machines (130 Hz) keep the whole ladder.
    assert functions_within((8.0, 130.0), DT_S) >= LADDER[0].n


def test_command_stays_within_a_narrow_band() -> None:
    n = 1000
    corner = np.abs(np.linspace(-30, 30, n))
    zigzag = np.stack([60.0 + corner, 50.0 + 0.5 * corner])
    zigzag[:, :40], zigzag[:, -40:] = zigzag[:, 40:41], zigzag[:, -41:-40]
    beyond = {}
    for high_hz in (None, 40.0):
        fbf = PreviewFbf(banded(high_hz), DT_S)
        fbf.reset(zigzag[:, 0])
        u = fbf.compensate(zigzag, np.ones(n, bool), np.zeros((0, 2), np.int64))
        f = np.fft.rfftfreq(n - 2, DT_S)
        spectrum = np.abs(np.fft.rfft(np.diff(u, 2) * np.hanning(n - 2))) ** 2
        beyond[high_hz] = float(np.sum(spectrum[:, f > 1.5 * 40.0]) / np.sum(spectrum))
    assert beyond[40.0] < 0.25 * beyond[None]
