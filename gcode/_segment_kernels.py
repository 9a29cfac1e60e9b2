"""Kernels of the one-pass segment fit, wrapped by `gcode.segments`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillpath.models.jit import kernel

__all__ = ["LONGEST", "Answers", "Bounds", "fit_stretch", "path_directions", "rest_errors"]

LONGEST = 64
"""Longest segment whose end is chosen for the least response to its error."""


class Bounds(NamedTuple):
    """Tolerances of a segment [mm], and its largest speed step [mm/s].

    Tolerances along and across the path, the widening of the funnel in which the end is chosen, and
    tolerances of z and e; then the largest speed step of an axis.
    """

    along_mm: float
    across_mm: float
    loose_mm: float
    z_mm: float
    e_mm: float
    step_mm_s: float


class Answers(NamedTuple):
    """Tables of a machine's response to a fit's errors, in the form of `models.modal`.

    A segment of m samples has the error of its straight line, plus one that rises from 0 to `shift`
    over these samples and falls over the next ones if its end is shifted. The energy of the
    response to all errors so far is least for `shift` = -(Re(head[m] state) + echo[m] error) /
    norm[m]; all sums extend to the end of the response.

    Attributes
    ----------
    pole : ndarray of complex128, shape (axes, order)
    power : ndarray of complex128, shape (axes, LONGEST, order)
        Powers of the poles: the decay of an error.
    head : ndarray of complex128, shape (axes, LONGEST + 1, order)
    echo : ndarray, shape (axes, LONGEST + 1, LONGEST)
    lift : ndarray of complex128, shape (axes, LONGEST + 1, order)
        Change of the state at the segment's end per unit shift.
    norm : ndarray, shape (axes, LONGEST + 1)
    """

    pole: NDArray[np.complex128]
    power: NDArray[np.complex128]
    head: NDArray[np.complex128]
    echo: NDArray[np.float64]
    lift: NDArray[np.complex128]
    norm: NDArray[np.float64]


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


@kernel
def rest_errors(pole: NDArray[np.complex128], states: NDArray[np.complex128], samples: int) -> None:
    """Let the error states of both axes decay over `samples` without error, in place."""
    for axis in range(states.shape[0]):
        for r in range(states.shape[1]):
            states[axis, r] *= pole[axis, r] ** samples


@kernel(allocates=False)
def fit_stretch(
    position: NDArray[np.float64],
    direction: NDArray[np.float64],
    bounds: Bounds,
    grid: float,
    dt_s: float,
    start_s: float,
    first: int,
    last: int,
    begin: NDArray[np.float64],
    level: bool,
    ends: NDArray[np.bool_],
    answers: Answers,
    states: NDArray[np.complex128],
    errors: NDArray[np.float64],
    begun: int,
    out_t: NDArray[np.float64],
    out_position: NDArray[np.float64],
) -> int:
    """Cover samples first..last of `position` (x y z e, n) with straight segments.

    The fit starts at `begin` at `start_s` and ends exactly at sample `last`. A funnel of slopes in
    the frame of the path's direction determines the length of a segment; its exact end, inside the
    (slightly wider) funnel, is chosen so that the machine's response to the error stays small.
    `states` (axes, order) is the state of that response and is updated in place. With `level` set,
    z is the same at `begin` and at all samples. A segment ends at every sample marked in `ends`.
    `errors` (LONGEST,) is scratch.
    Vertices in X and Y lie on multiples of `grid`; they are written from row `begun` on. A segment
    is cut short where the speed of an axis would step too far, as far as one sample allows.
    Returns their number.
    """
    x, y, z, e = begin[0], begin[1], begin[2], begin[3]
    origin_s = start_s
    speed_x = speed_y = 0.0
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
            k,
            last,
            level,
            ends,
        )
        span = end * dt_s - origin_s
        end_x, end_y = position[0, end], position[1, end]
        since = k * dt_s - origin_s
        wish_x = _least_answer(position[0, k : end + 1], x, since, dt_s, answers, 0, states, errors)
        wish_y = _least_answer(position[1, k : end + 1], y, since, dt_s, answers, 1, states, errors)
        new_x, new_y = end_x, end_y
        if end < last:
            cx, cy = direction[0, k], direction[1, k]
            dx, dy = end_x + wish_x - x, end_y + wish_y - y
            along = min(max(cx * dx + cy * dy, low * span), high * span)
            across = min(max(cx * dy - cy * dx, left * span), right * span)
            dx, dy = cx * along - cy * across, cy * along + cx * across
            new_x, new_y = grid * np.round((x + dx) / grid), grid * np.round((y + dy) / grid)
            if abs(new_x - x) <= 0.5 * grid and abs(new_y - y) <= 0.5 * grid:
                # A segment of zero length has no duration; one of a grid step has.
                if abs(dx) >= abs(dy):
                    new_x = x + (grid if dx >= 0.0 else -grid)
                else:
                    new_y = y + (grid if dy >= 0.0 else -grid)
            z += z_slope * span
            e += e_slope * span
        else:
            z, e = position[2, last], position[3, last]
        samples = end - k + 1
        if samples <= LONGEST:
            for r in range(states.shape[1]):
                states[0, r] += (new_x - end_x) * answers.lift[0, samples, r]
                states[1, r] += (new_y - end_y) * answers.lift[1, samples, r]
        speed_x, speed_y = (new_x - x) / span, (new_y - y) / span
        x, y = new_x, new_y
        origin_s = end * dt_s
        out_t[count] = origin_s
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
    along, across, loose, z_tolerance, e_tolerance, step = bounds
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


@kernel(force_inline=True, allocates=False)
def _least_answer(
    position: NDArray[np.float64],
    begin: float,
    since_s: float,
    dt_s: float,
    answers: Answers,
    axis: int,
    states: NDArray[np.complex128],
    errors: NDArray[np.float64],
) -> float:
    """Advance the states of an axis along a straight line that ends on the last sample.

    `begin` is where it starts, `since_s` before the first sample. Returns by how much the end is
    best shifted. `errors` (LONGEST,) is scratch.
    """
    samples = len(position)
    slope = (position[-1] - begin) / (since_s + (samples - 1) * dt_s)
    order = states.shape[1]
    if samples > LONGEST:
        for i in range(samples):
            error = begin + slope * (since_s + i * dt_s) - position[i]
            for r in range(order):
                states[axis, r] = answers.pole[axis, r] * states[axis, r] + error
        return 0.0
    answer = 0.0
    # The last sample has no error.
    for i in range(samples - 1):
        errors[i] = begin + slope * (since_s + i * dt_s) - position[i]
        answer += answers.echo[axis, samples, i] * errors[i]
    for r in range(order):
        state = states[axis, r]
        answer += (answers.head[axis, samples, r] * state).real
        state *= answers.power[axis, samples, r]
        for i in range(samples - 1):
            state += errors[i] * answers.power[axis, samples - 1 - i, r]
        states[axis, r] = state
    return float(-answer / answers.norm[axis, samples])
