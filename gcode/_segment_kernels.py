"""Kernels that choose the ends of segments, wrapped by `gcode.segments`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillpath.models.jit import kernel

__all__ = ["Bounds", "choose_ends", "path_directions"]

_SLOWEST_MM_S = 1e-3


class Bounds(NamedTuple):
    """Tolerances and largest speed steps of a segment.

    Attributes
    ----------
    along_mm, across_mm : float
        Tolerances along and across the path.
    loose_mm : float
        By how much the funnel in which the end is chosen is wider.
    z_mm, e_mm : float
        Tolerances of z and e.
    step_mm_s : float
        Largest speed step of an axis.
    feed_step_mm_s : float
        Largest speed step of the extruder at one speed along the path, which is what a change of
        filament per mm means.
    """

    along_mm: float
    across_mm: float
    loose_mm: float
    z_mm: float
    e_mm: float
    step_mm_s: float
    feed_step_mm_s: float


@kernel
def path_directions(path: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    """Compute the unit direction of the path (2, n) at every sample, held at standstill."""
    n = path.shape[1]
    x, y = 1.0, 0.0
    for k in range(n):
        before, after = max(k - 1, 0), min(k + 1, n - 1)
        dx = path[0, after] - path[0, before]
        dy = path[1, after] - path[1, before]
        length = np.sqrt(dx * dx + dy * dy)
        if length > 1e-7:
            x, y = dx / length, dy / length
        out[0, k] = x
        out[1, k] = y


@kernel(allocates=False)
def choose_ends(
    position: NDArray[np.float64],
    direction: NDArray[np.float64],
    bounds: Bounds,
    dt_s: float,
    start_s: float,
    first: int,
    last: int,
    begin: NDArray[np.float64],
    level: bool,
    ends: NDArray[np.bool_],
    begun: int,
    out_sample: NDArray[np.int64],
    out_position: NDArray[np.float64],
) -> int:
    """Choose where the straight segments end that cover samples first..last of `position` (4, n).

    The fit starts at `begin` (x y z e) at `start_s` and ends exactly at sample `last`. A funnel of
    slopes in the frame of the path's direction determines the length of a segment; it ends at the
    command, or as near as the slightly wider funnel allows. With `level` set, z is the same at
    `begin` and at all samples. A segment ends at every sample marked in `ends`, and is cut short
    where the speed of an axis would step too far, as far as one sample allows.
    Samples and places are written from row `begun` on. Returns their number.
    """
    x, y, z, e = begin[0], begin[1], begin[2], begin[3]
    origin_s = start_s
    speed_x = speed_y = per_mm = 0.0
    k = first
    count = begun
    while k <= last:
        end, low, high, left, right, z_slope, e_slope = _reach(
            position,
            direction,
            bounds,
            dt_s,
            origin_s,
            x,
            y,
            z,
            e,
            speed_x,
            speed_y,
            per_mm,
            k,
            last,
            level,
            ends,
        )
        span = end * dt_s - origin_s
        dx, dy = position[0, end] - x, position[1, end] - y
        if end < last:
            cx, cy = direction[0, k], direction[1, k]
            along = min(max(cx * dx + cy * dy, low * span), high * span)
            across = min(max(cx * dy - cy * dx, left * span), right * span)
            dx, dy = cx * along - cy * across, cy * along + cx * across
            z += z_slope * span
            e += e_slope * span
        else:
            z, e = position[2, last], position[3, last]
        speed_x, speed_y = dx / span, dy / span
        per_mm = e_slope / max(np.sqrt(speed_x * speed_x + speed_y * speed_y), _SLOWEST_MM_S)
        x += dx
        y += dy
        origin_s = end * dt_s
        out_sample[count] = end
        out_position[0, count] = x
        out_position[1, count] = y
        out_position[2, count] = z
        out_position[3, count] = e
        count += 1
        k = end + 1
    return count - begun


@kernel(force_inline=True, allocates=False)
def _reach(
    position: NDArray[np.float64],
    direction: NDArray[np.float64],
    bounds: Bounds,
    dt_s: float,
    origin_s: float,
    x: float,
    y: float,
    z: float,
    e: float,
    speed_x: float,
    speed_y: float,
    per_mm: float,
    k: int,
    last: int,
    level: bool,
    ends: NDArray[np.bool_],
) -> tuple[int, float, float, float, float, float, float]:
    """Find the last sample at which a segment that begins with sample `k` may end.

    Returns it with the slopes that the end may have, lowest and highest along the path, the same
    across it, and those of z and e.
    """
    cx, cy = direction[0, k], direction[1, k]
    along, across, loose, z_tolerance, e_tolerance, step, feed_step = bounds
    along_low = across_low = z_low = e_low = wide_low = left = -np.inf
    along_high = across_high = z_high = e_high = wide_high = right = np.inf
    end = k
    for j in range(k, last + 1):
        span = j * dt_s - origin_s
        rate = 1.0 / span
        dx, dy = position[0, j] - x, position[1, j] - y
        if j > k:
            # The speed may not step too far, neither into the segment nor into the stop.
            if abs(dx * rate - speed_x) > step or abs(dy * rate - speed_y) > step:
                break
            if j == last and max(abs(dx), abs(dy)) > step * span:
                break
        on, off, up, fed = (
            cx * dx + cy * dy,
            cx * dy - cy * dx,
            position[2, j] - z,
            position[3, j] - e,
        )
        if j > k and abs(fed - per_mm * np.sqrt(dx * dx + dy * dy)) * rate > feed_step:
            break
        # Where the path has turned, tolerance along the frame acts across the path.
        turn = abs(cx * direction[1, j] - cy * direction[0, j])
        slack = along
        if turn * along > 0.5 * across:
            slack = max(across, 0.5 * across / turn)
        given = 0.0 if j == last else 1.0
        a0 = max(along_low, (on - given * slack) * rate)
        a1 = min(along_high, (on + given * slack) * rate)
        b0 = max(across_low, (off - given * across) * rate)
        b1 = min(across_high, (off + given * across) * rate)
        e0 = max(e_low, (fed - given * e_tolerance) * rate)
        e1 = min(e_high, (fed + given * e_tolerance) * rate)
        if a0 > a1 + 1e-9 or b0 > b1 + 1e-9 or e0 > e1 + 1e-9:
            break
        if not level:
            z0 = max(z_low, (up - given * z_tolerance) * rate)
            z1 = min(z_high, (up + given * z_tolerance) * rate)
            if z0 > z1 + 1e-9:
                break
            z_low, z_high = z0, z1
        along_low, along_high, across_low, across_high, e_low, e_high = a0, a1, b0, b1, e0, e1
        wide_low = max(wide_low, (on - slack - loose) * rate)
        wide_high = min(wide_high, (on + slack + loose) * rate)
        left = max(left, (off - across - loose) * rate)
        right = min(right, (off + across + loose) * rate)
        end = j
        if ends[j]:
            break
    z_slope = 0.0 if level else 0.5 * (z_low + z_high)
    return end, wide_low, wide_high, left, right, z_slope, 0.5 * (e_low + e_high)
