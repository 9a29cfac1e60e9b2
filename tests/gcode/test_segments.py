"""The segment fit: its bounds, its ends, and what a machine makes of its error."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

import stillpath.gcode.segments as module
from stillpath.gcode._segment_kernels import path_directions
from stillpath.gcode.segments import (
    ACROSS_SHARE,
    ALONG_SHARE,
    LOOSE_SHARE,
    ErrorFilter,
    Segments,
    fit_segments,
)
from stillpath.gcode.timeline import Group, Timeline
from stillpath.models.plants import DiscretePlant
from tests.plants import answer, one_mode

DT_S = 1e-3
GRID_MM = 1e-3
SILENT = DiscretePlant(np.zeros((0, 0)), np.zeros(0), np.zeros(0), 1.0, dt_s=DT_S)
"""Answers only at once: there is nothing to shape."""


def curvy(seed: int, samples: int, speed_mm_s: float = 80.0) -> np.ndarray:
    """A smooth path x y z e with rests of speed at both ends."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0, 1, samples)
    fade = np.sin(np.pi * t) ** 2
    v = np.stack([
        sum(rng.normal() * np.sin(2 * np.pi * (k * t + rng.random())) for k in range(1, 7))
        for _ in range(2)
    ])  # fmt: skip
    v *= speed_mm_s * fade / np.max(np.hypot(*v))
    xy = 100.0 + np.cumsum(v, axis=1) * DT_S
    e = np.cumsum(0.04 * np.hypot(*v)) * DT_S
    return np.vstack([xy, 0.3 + 0.1 * fade, e])


def line_of(command: np.ndarray, cuts: tuple[tuple[int, int], ...] = ()) -> Timeline:
    """A timeline of stretches with rests at the sample ranges `cuts`."""
    n = command.shape[1]
    edges = [0, *(k for pair in cuts for k in pair), n - 1]
    groups = [Group(i, i + 1, rest=bool(i % 2)) for i in range(len(edges) - 1)]
    times = np.array(edges) * DT_S
    return Timeline(
        dt_s=DT_S,
        position_mm=command,
        row=np.zeros(n, np.int64),
        moving=np.ones(n, bool),
        rests=np.array([(a + 1, b + 1) for a, b in cuts], np.int64).reshape(-1, 2),
        groups=groups,
        start_s=times[:-1],
        end_s=times[1:],
        group_start_mm=command[:, edges[:-1]].T.copy(),
        row_start_s=times[:-1],
    )


def executed(segments: Segments, command: np.ndarray) -> np.ndarray:
    """The fit at the command's samples."""
    t = DT_S * np.arange(command.shape[1])
    knots = np.append(0.0, segments.end_s)
    vertices = np.hstack([command[:, :1], segments.end_mm])
    return np.stack([np.interp(t, knots, row) for row in vertices])


def fit(command: np.ndarray, tolerance_mm: float, plant: DiscretePlant = SILENT) -> Segments:
    return fit_segments(line_of(command), command, tolerance_mm, ErrorFilter([plant, plant]))


@settings(max_examples=60)
@given(
    seed=st.integers(0, 10**6),
    samples=st.integers(3, 600),
    tolerance_um=st.sampled_from([0.5, 2.0, 5.0, 20.0]),
    speed=st.sampled_from([5.0, 60.0, 300.0]),
    shaped=st.booleans(),
)
@example(seed=322, samples=319, tolerance_um=5.0, speed=5.0, shaped=False)
@example(seed=218724, samples=211, tolerance_um=20.0, speed=5.0, shaped=False)
def test_segments_stay_within_their_tolerance(
    seed: int, samples: int, tolerance_um: float, speed: float, shaped: bool
) -> None:
    command, tolerance = curvy(seed, samples, speed), 1e-3 * tolerance_um
    segments = fit(command, tolerance, one_mode(45.0, 0.03) if shaped else SILENT)
    error = executed(segments, command) - command
    # The funnel is a little loose, and its vertices are rounded.
    spare = LOOSE_SHARE * tolerance + np.sqrt(0.5) * GRID_MM
    along, across = ALONG_SHARE * tolerance, ACROSS_SHARE * tolerance
    # Ends lie within the bounds; between two that were moved apart the motion may leave them a bit.
    assert np.max(np.hypot(*error[:2])) <= 1.1 * np.hypot(along, across) + spare + GRID_MM / 2
    direction = np.empty((2, samples))
    path_directions(command[:2], direction)
    if tolerance_um >= 5 and speed == 60:
        sideways = direction[0] * error[1] - direction[1] * error[0]
        assert np.sqrt(np.mean(sideways**2)) <= across + spare
    assert np.max(np.abs(error[2])) <= module.Z_TOLERANCE_MM * 1.01
    # Filament moves with the ends; .04 mm of it belong to each mm of the path.
    moved = 1.5 * 0.04 * np.max(np.hypot(*error[:2]))
    assert np.max(np.abs(error[3])) <= module.E_TOLERANCE_MM * 1.01 + moved


def test_segments_end_at_marked_samples() -> None:
    command = np.zeros((4, 401))
    command[0] = np.linspace(0.0, 20.0, 401)
    ends = np.zeros(401, np.bool_)
    ends[[7, 150, 151, 300]] = True
    error_filter = ErrorFilter([SILENT, SILENT])
    segments = fit_segments(line_of(command), command, 2e-3, error_filter, ends=ends)
    assert {7, 150, 151, 300} <= set(np.rint(segments.end_s / DT_S).tolist())
    assert len(segments) <= len(fit(command, 2e-3)) + 4


@settings(max_examples=30)
@given(seed=st.integers(0, 10**6), samples=st.integers(60, 400), shaped=st.booleans())
def test_ends_grid_and_order(seed: int, samples: int, shaped: bool) -> None:
    command = curvy(seed, samples)
    a, b = samples // 3, samples // 3 + 11
    command[:, a : b + 1] = command[:, a : a + 1]
    command[3, b:] += 0.5  # filament that the rest moves
    line = line_of(command, ((a, b),))
    line.group_start_mm[2, 3] = command[3, b]
    plant = one_mode(45.0, 0.03) if shaped else SILENT
    segments = fit_segments(line, command, 5e-3, ErrorFilter([plant, plant]))
    assert set(segments.group.tolist()) == {0, 2}
    assert np.all(np.diff(segments.end_s) > 0)
    last = np.flatnonzero(np.append(np.diff(segments.group) != 0, True))
    # A stretch ends exactly on its last sample.
    np.testing.assert_allclose(segments.end_s[last], [a * DT_S, (samples - 1) * DT_S])
    np.testing.assert_array_equal(segments.end_mm[:, last], command[:, [a, samples - 1]])
    inner = np.delete(segments.end_mm[:2], last, axis=1) / GRID_MM
    assert np.max(np.abs(inner - np.round(inner)), initial=0) < 1e-6
    ticks = segments.end_s / DT_S
    assert np.max(np.abs(ticks - np.round(ticks))) < 1e-6
    assert not np.any((segments.end_s > a * DT_S + 1e-9) & (segments.end_s <= b * DT_S))


def test_straight_lines_are_one_segment() -> None:
    t = np.linspace(0, 1, 501)
    command = np.stack([10 + 30 * t, 20 - 5 * t, 0 * t, 2 * t])
    assert len(fit(command, 5e-3)) == 1


def test_tolerance_pays() -> None:
    counts = [len(fit(curvy(3, 2000), 1e-3 * t)) for t in (0.5, 2.0, 5.0, 20.0)]
    assert counts == sorted(counts, reverse=True)
    assert counts[-1] < 0.5 * counts[0]


@pytest.mark.parametrize("f_hz", [26.0, 60.0])
def test_a_machine_responds_less(f_hz: float) -> None:
    """Its resonance counts: where a fit ignores it, the machine responds more."""
    plant = one_mode(f_hz, 0.03)
    command = curvy(5, 4000, 120)
    rms = []
    for assumed in (SILENT, plant):
        fitted = fit_segments(line_of(command), command, 5e-3, ErrorFilter([assumed, assumed]))
        error = executed(fitted, command) - command
        rms.append(np.sqrt(np.mean([answer(plant, row) ** 2 for row in error[:2]])))
    assert rms[1] < 0.9 * rms[0]


# Twin of the kernels


def twin(command: np.ndarray, tolerance: float, plant: DiscretePlant) -> np.ndarray:
    """The fit of one stretch in plain words; returns rows (t, x, y, z, e)."""
    ends = twin_ends(command, ErrorFilter([plant, plant]).share * tolerance)
    samples = np.append(0, np.rint(ends[:, 0] / DT_S).astype(int))
    hats = np.stack([np.interp(np.arange(command.shape[1]), samples, row)
                     for row in np.eye(len(samples))])  # fmt: skip
    inner, counts = hats[1:-1], correlation(plant)
    lag = np.abs(np.subtract.outer(*2 * [np.arange(command.shape[1])]))
    g = np.where(lag < len(counts), counts[np.minimum(lag, len(counts) - 1)], 0.0)
    shift = np.zeros((2, len(inner)))
    for axis in range(2):
        missed = command[axis] - command[axis, samples] @ hats
        shift[axis] = np.linalg.solve(inner @ g @ inner.T, inner @ g @ missed)
        ends[:-1, 1 + axis] = command[axis, samples[1:-1]] + shift[axis]
    # Filament by the way that an end moves along the path.
    steps = np.diff(command[:2, samples]).T
    ways = np.maximum(np.hypot(*steps.T), 1e-9)
    per_mm = np.diff(np.append(command[3, 0], ends[:, 4])) / ways
    for i in range(len(inner)):
        ends[i, 4] += max(0.0, min(per_mm[i : i + 2])) * (shift[:, i] @ steps[i + 1]) / ways[i + 1]
    ends[:-1, 1:3] = GRID_MM * np.round(ends[:-1, 1:3] / GRID_MM)
    return ends


def correlation(plant: DiscretePlant) -> np.ndarray:
    """How errors count together: that of the machine's response, fading to 0 over 32 samples."""
    pulse = np.append(1.0, np.zeros(3000))
    reply = answer(plant, pulse) + module.BEYOND_MODEL * pulse
    lags = np.arange(32)
    return np.array([reply[: len(reply) - k] @ reply[k:] for k in lags]) * (1.0 - lags / 32)


def twin_ends(command: np.ndarray, tolerance: float) -> np.ndarray:
    n = command.shape[1]
    heading = np.tile([1.0, 0.0], (n, 1))
    for k in range(n):
        d = command[:2, min(k + 1, n - 1)] - command[:2, max(k - 1, 0)]
        heading[k] = d / np.hypot(*d) if np.hypot(*d) > 1e-7 else heading[max(k - 1, 0)]
    along, across = ALONG_SHARE * tolerance, ACROSS_SHARE * tolerance
    origin, at = command[:, 0], 0
    out, k = [], 1
    while k < n:
        frame = np.array([heading[k], [-heading[k][1], heading[k][0]]])
        narrow = [np.full(4, -np.inf), np.full(4, np.inf)]
        wide = [np.full(2, -np.inf), np.full(2, np.inf)]
        j = k
        while j < n:
            span = (j - at) * DT_S
            way = command[:, j] - origin
            value = np.append(frame @ way[:2], way[2:])
            turn = abs(heading[k][0] * heading[j][1] - heading[k][1] * heading[j][0])
            slack = np.array([along, across, module.Z_TOLERANCE_MM, module.E_TOLERANCE_MM])
            if turn * along > 0.5 * across:
                slack[0] = max(across, 0.5 * across / turn)
            loose = slack[:2] + LOOSE_SHARE * tolerance
            used = np.zeros(4) if j == n - 1 else slack
            low = np.maximum(narrow[0], (value - used) / span)
            high = np.minimum(narrow[1], (value + used) / span)
            if np.any(low > high + 1e-9):
                break
            narrow = [low, high]
            wide = [np.maximum(wide[0], (value[:2] - loose) / span),
                    np.minimum(wide[1], (value[:2] + loose) / span)]  # fmt: skip
            j += 1
        end = max(j - 1, k)
        span = (end - at) * DT_S
        target = command[:, end].copy()
        if end < n - 1:
            turned = np.clip(frame @ (command[:2, end] - origin[:2]) / span, *wide)
            target[:2] = origin[:2] + frame.T @ turned * span
            target[2:] = origin[2:] + 0.5 * (narrow[0] + narrow[1])[2:] * span
        origin, at, k = target, end, end + 1
        out.append([end * DT_S, *target])
    return np.array(out)


@settings(max_examples=5, derandomize=True)
@given(seed=st.integers(0, 10**6), tolerance_um=st.sampled_from([2.0, 5.0]))
@pytest.mark.parametrize("shaped", [False, True])
def test_the_fit_agrees_with_plain_python(shaped: bool, seed: int, tolerance_um: float) -> None:
    command = curvy(seed, 60, 60)
    plant = one_mode(45.0, 0.1) if shaped else SILENT
    segments = fit(command, 1e-3 * tolerance_um, plant)
    expected = twin(command, 1e-3 * tolerance_um, plant)
    np.testing.assert_allclose(segments.end_s, expected[:, 0], atol=1e-9)
    np.testing.assert_allclose(segments.end_mm.T, expected[:, 1:], atol=1e-7)


def test_long_and_short_segments_together() -> None:
    """Equations hold where a segment of a minute meets some of a millisecond."""
    n = 30_000
    command = np.zeros((4, n))
    command[0] = np.interp(np.arange(n), [0, n - 40, n - 1], [0, 100.0, 100.2])
    command[1] = 0.01 * np.sin(np.arange(n) / 3.0) * (np.arange(n) > n - 200)
    segments = fit(command, 1e-3, one_mode(45.0, 0.03))
    error = executed(segments, command) - command
    assert segments.end_s[0] > 10.0
    assert len(segments) > 50
    assert np.max(np.abs(error[:2])) < 2e-3


def test_slow_end_before_z_is_merged() -> None:
    """A stretch does not crawl into a Z move: vertices before a slow end go, if that fits."""
    x = np.append(np.linspace(0, 10, 201), 10 + 0.001 * np.arange(1, 5))
    command = np.stack([x, 0 * x, 0 * x, 0 * x])
    sample, end_mm = (
        np.array([100, 200, 204]),
        np.array([[5.0, 10.0, 10.004], *np.zeros((3, 3))]),
    )
    kept = [
        module._merge_crawl(sample.copy(), end_mm.copy(), 3, command, DT_S, allowed)
        for allowed in (5e-3, 0.3)
    ]
    assert kept == [3, 2]


def test_before_z_reaches_the_end() -> None:
    command = curvy(11, 300)
    plain = line_of(command)
    before_z = replace(plain, groups=[Group(0, 1, rest=False, before_z=True)])
    silent = ErrorFilter([SILENT, SILENT])
    many, few = (fit_segments(line, command, 5e-3, silent) for line in (plain, before_z))
    assert len(few) <= len(many)
    assert few.end_s[-1] == many.end_s[-1]
    np.testing.assert_array_equal(few.end_mm[:, -1], many.end_mm[:, -1])
    error = executed(few, command) - command
    assert np.max(np.hypot(*error[:2])) <= 5e-3 + module.END_EXCESS_MM + 1e-6
