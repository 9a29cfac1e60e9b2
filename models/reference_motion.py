"""A generated test path, on which shapers are tuned while the print is not known.

Squares, zigzags and circles at several speeds and accelerations, with the trapezoidal speed
profile of a planner that takes every corner at 5 mm/s.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from stillpath.models.arrays import Array
from stillpath.models.machine import Machine

__all__ = ["reference_limits", "reference_motion", "reference_motion_of"]

_CORNER_MM_S = 5.0
_TRAVEL_MM_S, _TRAVEL_MM_S2 = 200.0, 5000.0
_FIGURES = (
    # speed mm/s, acceleration mm/s2, size mm
    (60.0, 1500.0, 20.0),
    (100.0, 3000.0, 16.0),
    (150.0, 5000.0, 24.0),
    (250.0, 5000.0, 30.0),
)
_REST_S = 0.15


def reference_limits(machine: Machine) -> tuple[float, float]:
    """Return the speed [mm/s] and acceleration [mm/s2] up to which a machine plans the motion."""
    fastest_mm_s = max(_TRAVEL_MM_S, *(v for v, _, _ in _FIGURES))
    largest_accel_mm_s2 = max(_TRAVEL_MM_S2, *(a for _, a, _ in _FIGURES))
    firmware = machine.firmware
    return (
        min(fastest_mm_s, firmware.fastest_mm_s),
        min(largest_accel_mm_s2, firmware.largest_accel_mm_s2),
    )


def reference_motion_of(machine: Machine, dt_s: float = 1e-3) -> tuple[Array, NDArray[np.bool_]]:
    """Return the reference motion (`reference_motion`) as the firmware of a machine would plan it.

    Motion that it would never plan is of no interest.
    """
    return reference_motion(dt_s, *reference_limits(machine))


def reference_motion(
    dt_s: float = 1e-3, fastest_mm_s: float = math.inf, largest_accel_mm_s2: float = math.inf
) -> tuple[Array, NDArray[np.bool_]]:
    """Return the path, shape (2, n) in mm, and where it extrudes, shape (n,).

    About 25 s around the origin, longer within low limits; it starts and ends at rest, and rests
    between the figures.

    Parameters
    ----------
    fastest_mm_s, largest_accel_mm_s2 : float
        Limits of speed and acceleration; from 250 mm/s and 5000 mm/s2 they change nothing.
    """
    path, extruding = [np.zeros((2, 1))], [np.zeros(1, bool)]
    here = np.zeros(2)
    for printing_mm_s, printing_mm_s2, size in _FIGURES:
        for figure in (_square(size), _zigzag(size), _circle(size / 2), _circle(size / 6)):
            away = np.stack([here, figure[:, 0]], axis=1)
            for line, feeds, v, a in (
                (away, False, _TRAVEL_MM_S, _TRAVEL_MM_S2),
                (figure, True, printing_mm_s, printing_mm_s2),
            ):
                speed, accel = min(v, fastest_mm_s), min(a, largest_accel_mm_s2)
                samples = _drive(line, speed, accel, dt_s)
                path.append(samples)
                extruding.append(np.full(samples.shape[1], feeds))
            here = figure[:, -1]
        rest = round(_REST_S / dt_s)
        path.append(np.repeat(here[:, None], rest, axis=1))
        extruding.append(np.zeros(rest, bool))
    return np.hstack(path), np.concatenate(extruding)


def _square(size: float) -> Array:
    corners = np.array([[0.0, 0, 1, 1, 0], [0, 1, 1, 0, 0]]) - 0.5
    turned = math.radians(20.0)
    turn = np.array([[math.cos(turned), -math.sin(turned)], [math.sin(turned), math.cos(turned)]])
    return np.hstack([corners * size, turn @ corners * (0.8 * size)])


def _zigzag(size: float) -> Array:
    rows = np.arange(0.0, 8.0)
    x = np.repeat(rows, 2) * 0.05 - 0.2
    y = np.where(np.arange(len(x)) % 4 % 3 == 0, -0.4, 0.4)
    return size * np.hstack([np.vstack([x, y]), np.vstack([y, x])[:, ::-1] * 0.7])


def _circle(radius: float) -> Array:
    angle = np.linspace(0, 2 * math.pi, 361)
    return radius * np.vstack([np.cos(angle), np.sin(angle)])


def _drive(line: Array, speed_mm_s: float, accel_mm_s2: float, dt_s: float) -> Array:
    """Sample a polyline (2, n), driven from rest to rest: at least once, the last time at its end.

    A line without length has no samples.
    """
    step = np.diff(line, axis=1)
    length = np.hypot(step[0], step[1])
    keep = length > 1e-9
    if not keep.any():
        return np.zeros((2, 0))
    step, length = step[:, keep], length[keep]
    corners = _corner_speeds(step, length, speed_mm_s, accel_mm_s2)
    times, along, speeds = _knots(length, corners, speed_mm_s, accel_mm_s2)
    # At least one sample beyond the end, so that the last one is at the end point.
    t = np.arange(1, math.ceil(times[-1] / dt_s) + 1) * dt_s
    knot = np.clip(np.searchsorted(times, t, side="right") - 1, 0, len(times) - 2)
    into = np.minimum(t, times[-1]) - times[knot]
    rate = (speeds[knot + 1] - speeds[knot]) / np.diff(times)[knot]
    s = along[knot] + speeds[knot] * into + rate * into * into / 2
    ends = np.concatenate([[0.0], np.cumsum(length)])
    start = line[:, :1]
    vertices = np.hstack([start, start + np.cumsum(step, axis=1)])
    return np.vstack([np.interp(s, ends, row) for row in vertices])


def _corner_speeds(step: Array, length: Array, speed_mm_s: float, accel_mm_s2: float) -> Array:
    """Return the speed at every vertex of lines (2, n), shape (n + 1,): 0 at both ends.

    Each is reached from its neighbours within the acceleration.
    """
    heading = step / length
    turn = np.sum(heading[:, 1:] * heading[:, :-1], axis=0)
    # Corners of a circle's polygon are no corners; they are taken at the speed that the
    # centripetal acceleration allows.
    gentle = turn > math.cos(math.radians(6.0))
    swing = np.maximum(np.arccos(np.clip(turn, -1, 1)), 1e-9)
    curve = np.sqrt(accel_mm_s2 * np.minimum(length[1:], length[:-1]) / swing)
    limit = np.where(gentle, np.minimum(speed_mm_s, curve), _CORNER_MM_S)
    corner = np.concatenate([[0.0], limit, [0.0]])
    lines = range(len(length))
    ahead, back = [(i, i, i + 1) for i in lines], [(i, i + 1, i) for i in reversed(lines)]
    for i, a, b in (*ahead, *back):
        corner[b] = min(corner[b], math.sqrt(corner[a] ** 2 + 2 * accel_mm_s2 * length[i]))
    return corner


def _knots(
    length: Array, corners: Array, speed_mm_s: float, accel_mm_s2: float
) -> tuple[Array, Array, Array]:
    """Return time, way and speed of every knot between constant accelerations, shape (n,) each.

    Each line has a trapezoid of speed: up from its first corner, along, and down to its last.
    """
    times, along, speeds = [0.0], [0.0], [0.0]
    for size, v0, v1 in zip(length.tolist(), corners[:-1], corners[1:], strict=True):
        top = min(speed_mm_s, math.sqrt((v0 * v0 + v1 * v1) / 2 + accel_mm_s2 * size))
        up, down = (top * top - v0 * v0) / 2, (top * top - v1 * v1) / 2
        cruise = max(size - (up + down) / accel_mm_s2, 0.0)
        for distance, v in ((up / accel_mm_s2, top), (cruise, top), (down / accel_mm_s2, v1)):
            if distance > 1e-12:
                times.append(times[-1] + 2 * distance / (speeds[-1] + v))
                along.append(along[-1] + distance)
                speeds.append(v)
    return np.array(times), np.array(along), np.array(speeds)
