"""Loops of the one-pass segment fit; `gcode.segments` wraps them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from models.jit import kernel

__all__ = ["fit_stretch", "path_directions", "rest_errors"]


@kernel
def path_directions(path: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    """Find the unit direction of the path (2, n) at every sample; at a stand, the last one."""
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


@kernel
def rest_errors(pole: NDArray[np.complex128], states: NDArray[np.complex128], samples: int) -> None:
    """Let the error states of both axes decay over `samples` without error, in place."""
    for axis in range(states.shape[0]):
        for r in range(states.shape[1]):
            states[axis, r] *= pole[axis, r] ** samples


@kernel
def fit_stretch(
    position: NDArray[np.float64],
    direction: NDArray[np.float64],
    along: float,
    across: float,
    loose: float,
    tolerance_z: float,
    tolerance_e: float,
    step: float,
    grid: float,
    dt_s: float,
    start_s: float,
    first: int,
    last: int,
    begin: NDArray[np.float64],
    pole: NDArray[np.complex128],
    weight: NDArray[np.complex128],
    direct: NDArray[np.float64],
    ramp: NDArray[np.float64],
    ramp_state: NDArray[np.complex128],
    tail: NDArray[np.complex128],
    norm: NDArray[np.float64],
    states: NDArray[np.complex128],
    out_t: NDArray[np.float64],
    out_position: NDArray[np.float64],
) -> int:
    """Cover samples first..last of `position` (x y z e, n) with straight segments.

    The fit starts at `begin` at `start_s` and ends exactly at sample `last`. A funnel of slopes in
    the frame of the path's direction says how long a segment may be; where exactly it ends,
    inside the (slightly looser) funnel, is chosen so that the machine's answer to the error stays
    small. That answer is direct e + sum of Re(weight x), x <- pole x + e, per axis; `ramp`,
    `ramp_state`, `tail` and `norm` are what it is for a triangular error
    (`gcode.segments.ErrorFilter`); `states` carries x and is updated in place.
    Vertices in X and Y lie on multiples of `grid`. A segment is cut short where the speed of an
    axis would step by more than `step`, as far as one sample allows. Returns their number.
    """
    order = pole.shape[1]
    longest = ramp.shape[1] - 1
    low, high = np.empty(4), np.empty(4)
    new_low, new_high = np.empty(4), np.empty(4)
    wide_low, wide_high = np.empty(2), np.empty(2)
    tolerance = np.array([along, across, tolerance_z, tolerance_e])
    value = np.empty(4)
    slope = np.empty(4)
    wish, straight, inner = np.empty(2), np.empty(2), np.empty(2)
    trial = np.empty((2, order), np.complex128)
    origin = begin.copy()
    origin_s = start_s
    speed = np.zeros(2)
    k = first
    count = 0
    while k <= last:
        cx, cy = direction[0, k], direction[1, k]
        for i in range(4):
            low[i], high[i] = -np.inf, np.inf
        for i in range(2):
            wide_low[i], wide_high[i] = -np.inf, np.inf
        j = k
        while j <= last:
            span = j * dt_s - origin_s
            rate = 1.0 / span
            dx, dy = position[0, j] - origin[0], position[1, j] - origin[1]
            if j > k:
                # The speed may not step too far, neither into the segment nor into the stop.
                if abs(dx * rate - speed[0]) > step or abs(dy * rate - speed[1]) > step:
                    break
                if j == last and max(abs(dx), abs(dy)) > step * span:
                    break
            value[0] = cx * dx + cy * dy
            value[1] = cx * dy - cy * dx
            value[2] = position[2, j] - origin[2]
            value[3] = position[3, j] - origin[3]
            # Where the path has turned, slack along the frame is slack across the path.
            turn = abs(cx * direction[1, j] - cy * direction[0, j])
            tolerance[0] = along
            if turn * along > 0.5 * across:
                tolerance[0] = max(across, 0.5 * across / turn)
            fits = True
            for i in range(4):
                slack = 0.0 if j == last else tolerance[i]
                new_low[i] = max(low[i], (value[i] - slack) * rate)
                new_high[i] = min(high[i], (value[i] + slack) * rate)
                if new_low[i] > new_high[i] + 1e-9:
                    fits = False
            if not fits:
                break
            # Element by element: a slice of four numbers would cost more than the rest.
            for i in range(4):
                low[i], high[i] = new_low[i], new_high[i]
            for i in range(2):
                wide_low[i] = max(wide_low[i], (value[i] - tolerance[i] - loose) * rate)
                wide_high[i] = min(wide_high[i], (value[i] + tolerance[i] + loose) * rate)
            j += 1
        end = max(j - 1, k)
        samples = end - k + 1
        span = end * dt_s - origin_s
        shaped = j > k and end < last
        # The answer to the straight line to the sample `end`; any other end adds a ramp to it.
        weigh = shaped and samples <= longest
        for axis in range(2):
            straight[axis] = (position[axis, end] - origin[axis]) / span
            inner[axis] = 0.0
            for r in range(order):
                trial[axis, r] = states[axis, r]
        # Both axes side by side: each waits for its own last result only.
        for i in range(samples):
            at = k + i
            since = at * dt_s - origin_s
            for axis in range(2):
                error = origin[axis] + straight[axis] * since - position[axis, at]
                answer = direct[axis] * error
                for r in range(order):
                    x = trial[axis, r]
                    answer += (weight[axis, r] * x).real
                    trial[axis, r] = pole[axis, r] * x + error
                if weigh:
                    inner[axis] += answer * ramp[axis, samples, i]
        for axis in range(2):
            wish[axis] = 0.0
            if weigh:
                for r in range(order):
                    inner[axis] += (trial[axis, r] * tail[axis, samples, r]).real
                wish[axis] = -inner[axis] / norm[axis, samples]
        if shaped:
            dx = position[0, end] + wish[0] - origin[0]
            dy = position[1, end] + wish[1] - origin[1]
            along_slope = min(max((cx * dx + cy * dy) / span, wide_low[0]), wide_high[0])
            across_slope = min(max((cx * dy - cy * dx) / span, wide_low[1]), wide_high[1])
            slope[0] = cx * along_slope - cy * across_slope
            slope[1] = cy * along_slope + cx * across_slope
            moves = False
            for axis in range(2):
                wish[axis] = slope[axis] * span
                target = grid * np.round((origin[axis] + wish[axis]) / grid)
                slope[axis] = (target - origin[axis]) / span
                moves = moves or abs(target - origin[axis]) > 0.5 * grid
            if not moves:
                # A segment of no length cannot pass the time; one grid step can.
                axis = 0 if abs(wish[0]) >= abs(wish[1]) else 1
                slope[axis] = (grid if wish[axis] >= 0.0 else -grid) / span
            slope[2] = 0.5 * (low[2] + high[2])
            slope[3] = 0.5 * (low[3] + high[3])
        else:
            # The exact end of the stretch, or not even one sample fits: through the sample.
            for i in range(4):
                slope[i] = (position[i, end] - origin[i]) / span
        for axis in range(2):
            shift = origin[axis] + slope[axis] * span - position[axis, end]
            for r in range(order):
                states[axis, r] = trial[axis, r]
                if samples <= longest:
                    states[axis, r] += shift * ramp_state[axis, samples, r]
        for i in range(4):
            origin[i] = position[i, last] if end == last else origin[i] + slope[i] * span
        speed[0], speed[1] = slope[0], slope[1]
        origin_s = end * dt_s
        out_t[count] = origin_s
        for i in range(4):
            out_position[i, count] = origin[i]
        count += 1
        k = end + 1
    return count
