"""The encoder's view of single moves against the same rules on whole columns."""

from __future__ import annotations

import numpy as np

from stillpath.gcode.firmware._encoding_kernels import MoveLimits
from stillpath.gcode.firmware.klipper._encoder_kernels import MOST_LOST, expected_braking
from stillpath.gcode.firmware.klipper._limit_kernels import move_limits

FACTS = (20.0, 200.0, 100.0, 5000.0, 1.0)


def test_limits_of_moves() -> None:
    """klippy/toolhead.py and extruder.py, a column at a time."""
    rng = np.random.default_rng(2)
    n = 400
    travel = rng.normal(0.0, 0.3, (n, 4)) * (rng.random((n, 4)) < [0.9, 0.9, 0.2, 0.7])
    travel[::17, :3] = 0.0
    travel[::17, 3] = rng.normal(0.0, 1.0, len(travel[::17]))
    start = np.cumsum(travel, axis=0) - travel
    limits = np.array(
        [[500.0, 3e5, 500.0, 0.0, 0.0], [80.0, 3000.0, 5.0, 0.5, 0.0], [80.0, 3e3, 5.0, 0.5, 1e3]]
    )
    which = rng.integers(0, 3, n).astype(np.int32)
    allowed, stops = MoveLimits(*np.empty((4, n))), np.empty(n, bool)
    move_limits(start, start + travel, which, limits, FACTS, allowed, stops)
    length, accel, speed, junction = allowed
    z_speed, z_accel, e_speed, e_accel, e_corner = FACTS
    travel = (start + travel) - start
    path = np.linalg.norm(travel[:, :3], axis=1)
    np.testing.assert_array_equal(stops, path == 0.0)
    path = np.where(stops, np.abs(travel[:, 3]), path)
    safe = np.where(path > 0.0, path, 1.0)
    np.testing.assert_allclose(length, path, rtol=1e-12)
    climb, ratio = np.abs(travel[:, 2]) / safe, travel[:, 3] / safe
    alone = (travel[:, 0] == 0.0) & (travel[:, 1] == 0.0)
    pull = np.where(alone | (ratio < 0.0), np.abs(ratio), 0.0)
    with np.errstate(divide="ignore"):
        # The extruder alone has limits of its own; the cruise ratio caps its peak.
        given = np.where(stops, np.inf, limits[which, 1])
        most = np.minimum.reduce([given, z_accel / climb, e_accel / pull])
        given = np.where(stops, np.inf, limits[which, 0])
        smooth = np.where(
            limits[which, 4] > 0.0, limits[which, 4], limits[which, 1] * (1.0 - limits[which, 3])
        )
        smooth = np.minimum(smooth, most)
        peak = np.where(stops, np.sqrt(path * smooth), np.inf)
        fastest = np.minimum.reduce([given, z_speed / climb, e_speed / pull, peak])
        by_filament = e_corner / np.abs(np.diff(ratio))
    np.testing.assert_allclose(accel, most, rtol=1e-9)
    np.testing.assert_allclose(speed, fastest, rtol=1e-9)
    unit = travel[:, :3] / safe[:, None]
    cosine = np.clip(np.sum(unit[1:] * unit[:-1], axis=1), -1.0, 1.0)
    tangent = np.sqrt((1.0 + cosine) / np.maximum(1.0 - cosine, 1e-12))
    reach = np.minimum(path[1:] * most[1:], path[:-1] * most[:-1])
    half = np.sqrt(0.5 * (1.0 + cosine))
    turn = np.sqrt((np.sqrt(2.0) - 1.0) * half / np.maximum(1.0 - half, 1e-12))
    corner = limits[which, 2] * np.sqrt(accel / limits[which, 1])
    corner = turn * np.minimum(corner[1:], corner[:-1])
    expected = np.minimum.reduce([by_filament, np.sqrt(0.5 * reach * tangent), corner])
    assert junction[0] == 0.0
    np.testing.assert_allclose(junction[1:], expected, rtol=1e-7)


def test_expected_braking_is_that_of_planned_speeds() -> None:
    rng = np.random.default_rng(5)
    n = 300
    ours, stops = rng.random(n) < 0.8, rng.random(n) < 0.3
    stops &= ~ours
    length, planned = rng.uniform(0.01, 1.0, n), rng.uniform(1e-3, 1e-2, n)
    speed, accel, junction = rng.uniform(10.0, [[150.0], [3e4], [150.0]], (3, n))
    braking = np.full(n, np.nan)
    allowed = MoveLimits(length, accel, speed, junction)
    expected_braking(ours, stops, allowed, planned, braking)
    v = np.where(ours, np.minimum(length / planned, speed), speed)
    leave = np.append(np.minimum.reduce([v[:-1], v[1:], junction[1:]]) * ~stops[1:], 0.0)
    lost = np.minimum((v - leave) ** 2 / (2.0 * accel * v), MOST_LOST * planned)
    np.testing.assert_allclose(braking, np.where(ours, lost, 0.0), rtol=1e-12)
