"""Kernel of the Klipper encoder: limits of every move without look-ahead."""

from __future__ import annotations

from math import inf, sqrt
from typing import Any

from stillpath.gcode.firmware._encoding_kernels import MoveLimits
from stillpath.models.jit import kernel

__all__ = ["move_limits"]


@kernel
def move_limits(
    start: Any,
    end: Any,
    limits_id: Any,
    limits: Any,
    facts: Any,
    allowed: MoveLimits,
    stops: Any,
) -> None:
    """Compute the limits of every move.

    Rules: klippy/toolhead.py, klippy/kinematics/extruder.py, 2026-08.

    Parameters
    ----------
    start, end : ndarray, shape (n, 4)
    limits : ndarray, shape (m, 5)
        Velocity, acceleration, square corner velocity, minimum cruise ratio and the acceleration
        that older ones have in its place (0: none) of a `limits_id`.
    facts : tuple of float
        Speed and acceleration of Z, of the extruder alone, and its instantaneous corner velocity.
    allowed : MoveLimits
        Filled.
    stops : ndarray of bool, shape (n,)
        Filled: moves of the extruder alone.
    """
    length, accel, speed, junction = allowed
    z_speed, z_accel, e_speed, e_accel, e_corner = facts
    x0 = y0 = z0 = ratio0 = corner0 = 0.0
    for i in range(len(length)):
        dx, dy = end[i, 0] - start[i, 0], end[i, 1] - start[i, 1]
        dz, de = end[i, 2] - start[i, 2], end[i, 3] - start[i, 3]
        path = sqrt(dx * dx + dy * dy + dz * dz)
        stops[i] = path == 0.0
        if stops[i]:
            path = abs(de)
        length[i] = path
        safe = path if path > 0.0 else 1.0
        x, y, z, ratio = dx / safe, dy / safe, dz / safe, de / safe
        own = limits[limits_id[i]]
        velocity, most, corner = own[0], own[1], own[2]
        if stops[i]:
            velocity = most = inf  # no limit but the extruder's own
        if z != 0.0:
            most = min(most, z_accel / abs(z))
            velocity = min(velocity, z_speed / abs(z))
        if ratio < 0.0 or (dx == 0.0 and dy == 0.0 and ratio != 0.0):
            most = min(most, e_accel / abs(ratio))
            velocity = min(velocity, e_speed / abs(ratio))
        if stops[i]:
            # From rest to rest; the minimum cruise ratio caps the peak as a gentler acceleration.
            smooth = min(own[1], own[4]) if own[4] > 0.0 else own[1] * (1.0 - own[3])
            velocity = min(velocity, sqrt(path * min(smooth, most)))
        accel[i], speed[i] = most, velocity
        # The deviation follows from the limits, the acceleration from the move: Z's is lower.
        corner *= sqrt(most / own[1])
        junction[i] = 0.0
        if i > 0:
            step = abs(ratio - ratio0)
            highest = e_corner / step if step > 0.0 else inf
            cosine = min(max(x * x0 + y * y0 + z * z0, -1.0), 1.0)
            tangent = sqrt((1.0 + cosine) / max(1.0 - cosine, 1e-12))
            reach = min(path * most, length[i - 1] * accel[i - 1])
            half = sqrt(0.5 * (1.0 + cosine))
            turn = sqrt((sqrt(2.0) - 1.0) * half / max(1.0 - half, 1e-12))
            junction[i] = min(highest, sqrt(0.5 * reach * tangent), turn * min(corner, corner0))
        x0, y0, z0, ratio0, corner0 = x, y, z, ratio, corner
