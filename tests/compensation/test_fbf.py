"""FBF on two axes: where the command stands, its limits, and what it carries over."""

from __future__ import annotations

import numpy as np
import pytest

from stillpath.compensation.base import DesignError
from stillpath.compensation.fbf import PreviewFbf
from stillpath.compensation.ladder import designs
from stillpath.compensation.preview_axis import AxisTask, PreviewAxis
from stillpath.compensation.window_problem import Bounds
from stillpath.models.machine import CommandLimits, Machine
from stillpath.models.plants import FirSpec, PlantSetSpec, plant_set
from stillpath.models.store import load_machine
from stillpath.simulation.measures import contour_error
from stillpath.simulation.response import response

DT_S = 1e-3
NO_RESTS = np.zeros((0, 2), np.int64)


@pytest.fixture(scope="module")
def machine() -> Machine:
    return load_machine("ender3")


def smooth(samples: int) -> np.ndarray:
    x = np.linspace(0, 1, samples)
    return 10 * x**3 - 15 * x**4 + 6 * x**5


def strokes(rest: int = 120, count: int = 3) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Diagonal strokes of 30 mm with rests between: path, extruding, rests."""
    parts, rests, here, n = [], [], np.array([50.0, 40.0]), 0
    for k in range(count):
        step = np.array([30.0, -12.0]) * (-1) ** k + [0.0, 5.0]
        part = here[:, None] + step[:, None] * smooth(260)
        parts.append(part)
        here, n = here + step, n + 260
        if k + 1 < count:
            parts.append(np.repeat(here[:, None], rest, axis=1))
            rests.append((n, n + rest))
            n += rest
    path = np.hstack(parts)
    extruding = np.ones(n, bool)
    for a, b in rests:
        extruding[a:b] = False
    return path, extruding, np.array(rests, np.int64).reshape(-1, 2)


def made(machine: Machine, start: np.ndarray, **settings: object) -> PreviewFbf:
    fbf = PreviewFbf(machine, DT_S, **settings)  # type: ignore[arg-type]
    fbf.reset(start)
    return fbf


@pytest.mark.parametrize("rest", [1, 2, 40, 400])
def test_rests_of_any_length(machine: Machine, rest: int) -> None:
    path, extruding, rests = strokes(rest)
    u = made(machine, path[:, 0]).compensate(path, extruding, rests)
    for a, b in rests:
        # The sample before the rest is the end of the motion and already stands.
        assert np.max(np.abs(u[:, a - 1 : b] - path[:, a : a + 1])) < 1e-12
    np.testing.assert_allclose(u[:, [0, -1]], path[:, [0, -1]], atol=1e-12)
    assert np.max(np.abs(u - path)) < 1.0


@pytest.mark.parametrize(
    "rests", [[[1, 40]], [[780, 1020]], [[300, 340], [340, 400]], [[300, 350], [340, 400]]]
)
def test_rests_that_touch(machine: Machine, rests: list[list[int]]) -> None:
    """Each other, or the ends of the piece."""
    path, extruding, _ = strokes()
    for a, b in rests:
        path[:, a:b] = path[:, a - 1 : a]
    u = made(machine, path[:, 0]).compensate(path, extruding, np.array(rests, np.int64))
    assert np.isfinite(u).all()
    for a, b in rests:
        np.testing.assert_allclose(u[:, a:b], u[:, a - 1 : a].repeat(b - a, axis=1), atol=1e-12)


@pytest.mark.parametrize("samples", [1, 2, 3, 5, 40])
def test_short_pieces(machine: Machine, samples: int) -> None:
    path = np.array([[10.0], [20.0]]) + np.linspace(0, 0.001, samples) * np.array([[1.0], [0.5]])
    fbf = made(machine, path[:, 0])
    u = fbf.compensate(path, np.ones(samples, bool), NO_RESTS)
    assert u.shape == path.shape
    assert np.isfinite(u).all()
    np.testing.assert_allclose(u[:, [0, -1]], path[:, [0, -1]], atol=1e-9)


def test_the_contour_error_falls_to_a_tenth(machine: Machine) -> None:
    path, extruding, rests = strokes()
    plants = [plant_set(machine.axes[a], DT_S).nominal for a in ("x", "y")]
    u = made(machine, path[:, 0]).compensate(path, extruding, rests)
    rms = [np.sqrt(np.mean(contour_error(path, response(plants, c), DT_S) ** 2)) for c in (path, u)]
    assert rms[1] < 0.1 * rms[0]


def test_keeps_limits(machine: Machine) -> None:
    path, extruding, rests = strokes()
    for accel in (6000.0, 12000.0, 20000.0):
        command = CommandLimits(accel_mm_s2=accel, velocity_mm_s=400)
        fbf = made(machine.model_copy(update={"command": command}), path[:, 0])
        u = fbf.compensate(path, extruding, rests)
        assert np.max(np.abs(np.diff(u, 2))) / DT_S**2 <= accel * (1 + 1e-9)
        assert np.max(np.abs(np.diff(u))) / DT_S <= 400 * (1 + 1e-9)


@pytest.mark.parametrize("command", [CommandLimits(accel_mm_s2=10), CommandLimits(velocity_mm_s=5)])
def test_impossible_limits(machine: Machine, command: CommandLimits) -> None:
    path, extruding, rests = strokes()
    fbf = made(machine.model_copy(update={"command": command}), path[:, 0])
    with pytest.raises(
        DesignError,
        match=r"axis x: even the gentlest design .* mm/s2, \d+ mm/s and .* the path itself",
    ):
        fbf.compensate(path, extruding, rests)


def test_state_is_carried_between_pieces(machine: Machine) -> None:
    path, extruding, rests = strokes(count=2)
    whole = made(machine, path[:, 0]).compensate(path, extruding, rests)
    cut = int(rests[0, 0])
    split = made(machine, path[:, 0])
    first = split.compensate(path[:, :cut], extruding[:cut], NO_RESTS)
    split.commit()
    split.observe(np.hstack([first[:, -1:], path[:, cut : rests[0, 1] - 1]]))
    second = split.compensate(path[:, rests[0, 1] - 1 :], extruding[rests[0, 1] - 1 :], NO_RESTS)
    plants = [plant_set(machine.axes[a], DT_S).nominal for a in ("x", "y")]
    joined = np.hstack([first, path[:, cut : rests[0, 1] - 1], second])
    assert joined.shape == whole.shape
    answers = [response(plants, u) for u in (whole, joined)]
    tail = slice(int(rests[0, 1]), None)
    errors = [contour_error(path, y, DT_S)[tail] for y in answers]
    rms = [1e3 * np.sqrt(np.mean(e**2)) for e in errors]
    # One solution plans across the rest, the other not; both know the vibration they start with.
    assert abs(rms[1] - rms[0]) < 1.0
    assert rms[1] < 3.0


def test_forgetting_the_state_costs(machine: Machine) -> None:
    """The state matters: the same second piece after a `reset` is worse."""
    path, extruding, _ = strokes(count=2)
    cut = 260
    rms = []
    for forget in (False, True):
        fbf = made(machine, path[:, 0])
        # The first piece runs uncompensated and leaves the machine ringing.
        fbf.observe(np.repeat(path[:, :cut:20], 20, axis=1))
        if forget:
            fbf.reset(path[:, cut])
        u = fbf.compensate(path[:, cut:], extruding[cut:], NO_RESTS)
        command = np.hstack([np.repeat(path[:, :cut:20], 20, axis=1)[:, :-1], u])
        plants = [plant_set(machine.axes[a], DT_S).nominal for a in ("x", "y")]
        reference = np.hstack([path[:, :cut][:, :-1], path[:, cut:]])
        error = contour_error(reference, response(plants, command), DT_S)[cut + 20 :]
        rms.append(np.sqrt(np.mean(error**2)))
    assert rms[0] < 0.9 * rms[1]


def test_observe_is_the_plant(machine: Machine) -> None:
    """Observing a motion in blocks or at once comes to the same command."""
    path, extruding, _ = strokes(count=1)
    ringing = path[:, :1] + np.random.default_rng(2).normal(0, 0.1, (2, 300))
    ringing[:, -1] = path[:, 0]
    results = []
    for cuts in ([300], [100, 300], [1, 2, 299, 300]):
        fbf = made(machine, ringing[:, 0])
        begin = 0
        for end in cuts:
            fbf.observe(ringing[:, begin:end])
            begin = end
        results.append(fbf.compensate(path, extruding, NO_RESTS))
    for other in results[1:]:
        np.testing.assert_allclose(other, results[0], atol=1e-9)


def test_nothing_counts_before_commit(machine: Machine) -> None:
    path, extruding, rests = strokes()
    fbf = made(machine, path[:, 0])
    first = fbf.compensate(path, extruding, rests)
    for again in (fbf, made(machine, path[:, 0])):
        np.testing.assert_array_equal(again.compensate(path, extruding, rests), first)


def test_far_from_the_origin(machine: Machine) -> None:
    """Position does not matter: nothing of the command depends on where the path lies."""
    path, extruding, rests = strokes()
    near = made(machine, path[:, 0]).compensate(path, extruding, rests)
    away = path + 1000.0
    far = made(machine, away[:, 0]).compensate(away, extruding, rests)
    np.testing.assert_allclose(far - 1000.0, near, atol=1e-9)


def test_an_axis_without_dynamics_is_told_its_path() -> None:
    still = PlantSetSpec(nominal=FirSpec(taps=(1.0,), dt_s=1e-3))
    machine = load_machine("ender3").model_copy(update={"axes": {"x": still, "y": still}})
    design = PreviewFbf(machine, 1e-3)
    path = np.outer([20.0, 8.0], 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, 400)))
    design.reset(path[:, 0])
    design.observe(path[:, :1])
    command = design.compensate(path, np.ones(400, bool), np.zeros((0, 2), np.int64))
    np.testing.assert_allclose(command, path, atol=1e-3)


def test_a_more_accurate_design_is_tried_where_the_last_refusal_leaves_room(
    machine: Machine,
) -> None:
    plants = plant_set(machine.axes["x"], DT_S).members[:1]
    axis = PreviewAxis("x", designs(plants, (1.0,), 300, 150, "ce-opt"))
    stops = np.array([[-1, 1], [400, 700]])
    bounds = Bounds(np.inf, np.inf, -np.inf, np.inf)

    def following(rung: int, refused_mm_s2: float | None, rms_mm_s2: float) -> int:
        """The next piece's rung, behind one that this design was accepted for."""
        task = AxisTask(10.0 * smooth(400), np.ones(400), stops, bounds, rms_limit_mm_s2=100.0)
        if refused_mm_s2 is not None:
            axis.refuse(rung - 1, task, refused_mm_s2)
        axis.accept(rung, task, rms_mm_s2)
        axis.commit(axis.command(rung, task, frozenset()))
        return axis.rung

    assert following(2, None, 79.0) == 1
    assert following(2, None, 81.0) == 2
    # One rung makes commands smoother by a tenth, the other by a third.
    assert following(2, 110.0, 99.0) == 2
    assert following(2, None, 89.0) == 1
    assert following(1, 120.0, 80.0) == 1
    assert following(1, None, 67.0) == 1
    assert following(1, None, 66.0) == 0
    assert following(1, 300.0, 80.0) == 1
    assert following(1, None, 59.0) == 0
    assert following(2, None, 89.0) == 1
