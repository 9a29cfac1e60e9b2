"""Sliding targets: the kernel against its definition, and what they do for a set."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stillpath.compensation._sliding_kernels import contour_square, move_targets
from stillpath.compensation.base import DesignError
from stillpath.compensation.fbf import PreviewFbf
from stillpath.models.machine import Machine
from stillpath.models.plants import Mode, ModesSpec, ParametricMembers, PlantSetSpec, plant_set
from stillpath.models.reference_motion import reference_motion
from stillpath.models.store import load_machine
from stillpath.simulation.measures import contour_error
from stillpath.simulation.response import response

DT_S = 1e-3
NO_RESTS = np.zeros((0, 2), np.int64)


@pytest.fixture(scope="module")
def machine() -> Machine:
    scale = (0.8, 0.9, 1.0, 1.1, 1.2)
    axis = PlantSetSpec(
        nominal=ModesSpec(modes=(Mode(f_hz=45.0, zeta=0.05),)),
        members=ParametricMembers(frequency_scale=scale),
    )
    return load_machine("generic-bedslinger").model_copy(update={"axes": {"x": axis, "y": axis}})


@pytest.fixture(scope="module")
def motion() -> tuple[np.ndarray, np.ndarray]:
    path, extruding = reference_motion(DT_S)
    half = path.shape[1] // 2
    stand = np.repeat(path[:, -1:], 200, axis=1)
    return np.hstack([path[:, half:], stand]), np.append(extruding[half:], np.zeros(200, bool))


def contours(machine: Machine, path: np.ndarray, extruding: np.ndarray, **chosen: object):
    fbf = PreviewFbf(machine, DT_S, **chosen)  # type: ignore[arg-type]
    fbf.reset(path[:, 0])
    u = fbf.compensate(path, extruding, NO_RESTS)
    sets = [plant_set(machine.axes[a], DT_S).members for a in ("x", "y")]
    errors = [contour_error(path, response(pair, u), DT_S) for pair in zip(*sets, strict=True)]
    return u, np.array([1e3 * np.sqrt(np.mean(e[extruding] ** 2)) for e in errors])


@pytest.mark.slow
def test_sliding_helps_every_summary(machine: Machine, motion) -> None:
    path, extruding = motion
    _, plain = contours(machine, path, extruding, robust="ensemble", along=1.0)
    u, slid = contours(machine, path, extruding, robust="ensemble", along=0.1)
    _, balanced = contours(machine, path, extruding, robust="minimax", along=0.1)
    assert slid.mean() < 0.8 * plain.mean()
    assert slid.max() < 0.8 * plain.max()
    assert balanced.max() < 0.9 * slid.max()
    assert balanced.mean() < 1.1 * slid.mean()
    np.testing.assert_array_equal(u[:, -1], path[:, -1])
    peak = np.abs(np.diff(path, 2)).max()
    assert np.abs(np.diff(u, 2)).max() <= 2.0 * peak * (1 + 1e-9)


def test_rests_stay_exact(machine: Machine) -> None:
    t = np.linspace(0, 1, 300)
    stroke = 10 * t**3 - 15 * t**4 + 6 * t**5
    x = np.concatenate([30 * stroke, np.full(90, 30.0), 30 + 10 * stroke])
    path = np.stack([x, 0.5 * x])
    extruding = np.ones(len(x), bool)
    rests = np.array([[300, 390]])
    extruding[300:390] = False
    fbf = PreviewFbf(machine, DT_S, robust="ensemble")
    fbf.reset(path[:, 0])
    u = fbf.compensate(path, extruding, rests)
    assert np.max(np.abs(u[:, 299:390] - path[:, 299:300])) < 1e-12


def test_the_state_of_all_members_is_carried(machine: Machine, motion) -> None:
    """Committing a command leaves the same state as observing it."""
    path, extruding = motion
    cut = 3000
    commands = []
    for observed in (False, True):
        fbf = PreviewFbf(machine, DT_S, robust="ensemble")
        fbf.reset(path[:, 0])
        first = fbf.compensate(path[:, :cut], extruding[:cut], NO_RESTS)
        if observed:
            fbf.observe(first[:, :-1])  # the last sample is the next piece's first
        else:
            fbf.commit()
        commands.append(fbf.compensate(path[:, cut - 1 : 2 * cut], extruding[: cut + 1], NO_RESTS))
    np.testing.assert_allclose(commands[0], commands[1], atol=1e-7)


@pytest.mark.parametrize("along", [0.0, -0.1, 1.5, float("nan")])
def test_wrong_weights_along_the_path(machine: Machine, along: float) -> None:
    with pytest.raises(DesignError, match=f"weight along the path is {along}; above 0"):
        PreviewFbf(machine, DT_S, along=along)


@pytest.mark.parametrize(("setting", "value"), [("basis", "fourier"), ("robust", "yes")])
def test_unknown_settings(machine: Machine, setting: str, value: str) -> None:
    with pytest.raises(DesignError, match=f"called '{value}'; there are"):
        PreviewFbf(machine, DT_S, **{setting: value})  # type: ignore[arg-type]


def test_a_robust_basis_needs_a_set(machine: Machine) -> None:
    with pytest.raises(DesignError, match=r"robust off\): choose robust ensemble"):
        PreviewFbf(machine, DT_S, basis="robust")


def test_sets_do_better_than_their_nominal_with_every_basis(machine: Machine, motion) -> None:
    path, extruding = motion
    _, nominal = contours(machine, path, extruding, robust="off")
    _, ensemble = contours(machine, path, extruding, robust="ensemble", along=1.0)
    assert ensemble.max() < 0.7 * nominal.max()
    assert ensemble.mean() < nominal.mean()
    for basis in ("robust", "dct", "bspline"):
        _, other = contours(machine, path, extruding, robust="ensemble", along=1.0, basis=basis)
        assert other.mean() < 1.5 * ensemble.mean(), basis


def nearest(path: np.ndarray, point: np.ndarray, k: int, reach: int) -> np.ndarray:
    best = path[:, k]
    for i in range(max(0, k - reach), min(path.shape[1] - 1, k + reach)):
        a, b = path[:, i], path[:, i + 1]
        size = (b - a) @ (b - a)
        s = np.clip((point - a) @ (b - a) / size, 0, 1) if size else 0.0
        candidate = a + s * (b - a)
        if np.linalg.norm(point - candidate) < np.linalg.norm(point - best):
            best = candidate
    return best


@settings(max_examples=30)
@given(
    st.integers(0, 2**31), st.floats(0, 1), st.floats(0, 1), st.integers(1, 6), st.floats(0.5, 1.9)
)
def test_twin_of_move_targets(
    seed: int, tau: float, travel: float, reach: int, relax: float
) -> None:
    rng = np.random.default_rng(seed)
    path = np.cumsum(rng.normal(size=(2, 20)), axis=1)
    answer = path + rng.normal(0, 0.3, (2, 20))
    extruding, targets = rng.random(20) < 0.7, path + rng.normal(0, 0.1, (2, 20))
    expected = targets.copy()
    for k in range(20):
        if extruding[k]:
            point = nearest(path, answer[:, k], k, reach)
            wanted = point + tau * (path[:, k] - point)
        else:
            wanted = answer[:, k] + travel * (path[:, k] - answer[:, k])
        expected[:, k] += relax * (wanted - targets[:, k])
    move_targets(path, answer, extruding, tau, travel, reach, relax, targets)
    np.testing.assert_allclose(targets, expected, atol=1e-9)
    gaps = [nearest(path, answer[:, k], k, reach) - answer[:, k] for k in range(0, 20, 2)]
    squares = [g @ g for g, e in zip(gaps, extruding[::2], strict=True) if e]
    mean = contour_square(path, answer, extruding, reach, 2)
    assert mean == pytest.approx(np.mean(squares) if squares else 0.0, abs=1e-9)
