"""Loops of a window with rests; `compensation.window_problem` wraps them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from models.jit import kernel

__all__ = ["command_of", "constraints_at", "extremes", "tied_window"]

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Flags = NDArray[np.bool_]


@kernel
def tied_window(
    basis: Array,
    summed: Array,
    effort: Array,
    filtered: Array,
    free: Array,
    reach: Array,
    stop: Array,
    price: float,
    z: Array,
    path: Array,
    targets: Array,
    weight: Array,
    moving: Ints,
) -> tuple[Array, Array, Array, Array, Array, Array, Array]:
    """Command of a window that stands on the path in its rests, without bounds.

    Parameters
    ----------
    path : ndarray, shape (window,)
        On which the command stands in the rests.

    Others as in `_tied_problem`.

    Returns
    -------
    command : ndarray, shape (window,)
    fixed : ndarray, shape (window,)
        The command without functions.
    factor, wish, ends
        As in `_tied_problem`, the factor as its transpose.
    pinned, values : ndarray, shapes (pins, n) and (pins,)
        Where the command stands on the path: pinned w = values.

    Raises
    ------
    numpy.linalg.LinAlgError
        When the problem is singular, or the rests contradict each other.
    """
    last, previous = z[-2], z[-1]
    factor, wish, ends = _tied_problem(
        basis, summed, effort, filtered, free, reach, stop, price, z, targets, weight, moving
    )
    fixed = tied_command(np.zeros(len(basis)), moving, last, previous)
    first = 1 if len(ends) > 0 and moving[0, 1] == 0 else 0
    pinned = ends[first:].copy()
    values = np.empty(len(pinned))
    found = wish
    if len(pinned) > 0:
        # The nearest w for which the command stands on the path in the rests.
        lacking = np.empty(len(pinned))
        for i in range(len(pinned)):
            at = moving[first + i, 1] - 1
            values[i] = path[at] - fixed[at]
            forward(factor, pinned[i])
            lacking[i] = np.dot(pinned[i], wish) - values[i]
        pull = np.linalg.solve(np.dot(pinned, pinned.T), lacking)
        found = wish - np.dot(pull, pinned)
    command = command_of(factor, found, basis, moving, last, previous)
    return command, fixed, factor, wish, ends, pinned, values


@kernel
def _tied_problem(
    basis: Array,
    summed: Array,
    effort: Array,
    filtered: Array,
    free: Array,
    reach: Array,
    stop: Array,
    price: float,
    z: Array,
    targets: Array,
    weight: Array,
    moving: Ints,
) -> tuple[Array, Array, Array]:
    """Weighted least squares of a window with rests, factored: least |w - wish|^2.

    Between rests the tied functions are the free ones without a past: their response is the free
    one minus what the states at the segment's start would go on to do, plus what the segments
    before left behind. In a rest there is only what was left behind, a few states for many samples:
    these samples are summed up first, and meet the functions by way of the states.

    Parameters
    ----------
    basis, summed : ndarray, shape (window, n)
        Increments of the functions, and their double running sums: the commands.
    effort : ndarray, shape (n, n)
        Gram matrix of `basis`.
    filtered : ndarray, shape (components, window, n)
    free : ndarray, shape (components, window, nz)
        What states do by themselves.
    reach : ndarray, shape (nz - 2, window)
        From commands to states at the window's end.
    stop : ndarray, shape (components, window)
        Response to a step of the command's speed.
    price : float
        Of squared increments.
    z, targets, weight
        As in `compensation.window_problem.solve_window`.
    moving : ndarray of int64, shape (k, 2)
        Segments [s, e) between rests, some of them without samples.

    Returns
    -------
    factor : ndarray, shape (n, n)
        The triangle L', upper, with w = L' c.
    wish : ndarray, shape (n,)
    ends : ndarray, shape (k - 1, n)
        Where the functions' commands stand in each rest.
    """
    window, n = basis.shape
    rests, states = len(moving) - 1, free.shape[2]
    left = states - 1
    speed = z[-2] - z[-1]
    # What segments leave behind: the plants' states and the position, as the command stands.
    behind = np.zeros((rests * left, n))
    ends, position = np.zeros((rests, n)), np.zeros(n)
    normal, right = _effort(basis, effort, moving, price), np.zeros(n)
    # Rows of which the squares are added up.
    rows, count = np.zeros((len(filtered) * window + rests, n)), 0
    for m in range(rests):
        state = _states(summed, reach, moving[m, 0], moving[m, 1])
        behind[m * left : (m + 1) * left] = state[:-1]
        position += state[-2]
        ends[m] = position
        step = state[-2] - state[-1]
        _add(np.sqrt(price), step, rows[count])
        count += 1
        if m == 0:
            _add(-price * speed, step, right)
    first_stop = moving[0, 1]
    for c in range(len(filtered)):
        error = weight * (targets[c] - np.dot(free[c], z))
        for r in range(first_stop, window):
            error[r] += weight[r] * speed * stop[c, r - first_stop]
        square, pull = np.zeros((rests * left, rests * left)), np.zeros(rests * left)
        gain = np.zeros(rests * left)
        for m in range(rests + 1):
            s, e = moving[m]
            following = moving[m + 1, 0] if m < rests else window
            # What the functions did before s: left behind, and what they would go on to do.
            known = m * left if s > 0 else 0
            sources = np.empty((known + (states if s > 0 else 0), n))
            sources[:known] = behind[:known]
            if e > s > 0:
                sources[known:] = _states(summed, reach, 0, s)
            shares = np.empty((e - s, len(sources)))
            for r in range(s, following):
                for before in range(m + 1 if r >= e else m):
                    at = r - moving[before, 1]
                    for i in range(left):
                        gain[before * left + i] = weight[r] * free[c, at, i]
                    # Both last commands are the same from now on.
                    gain[(before + 1) * left - 1] += weight[r] * free[c, at, left]
                if r < e:
                    for i in range(known):
                        shares[r - s, i] = gain[i]
                    for i in range(known, len(sources)):
                        shares[r - s, i] = -weight[r] * free[c, r - s, i - known]
                    continue
                for i in range((m + 1) * left):
                    pull[i] += gain[i] * error[r]
                    for j in range(i + 1):
                        square[i, j] += gain[i] * gain[j]
            if e > s:
                part = rows[count : count + e - s]
                for r in range(s, e):
                    for j in range(n):
                        part[r - s, j] = weight[r] * filtered[c, r, j]
                if s > 0:
                    part += np.dot(shares, sources)
                right += np.dot(error[s:e], part)
                count += e - s
        for i in range(len(pull)):
            _add(pull[i], behind[i], right)
            for j in range(i):
                square[j, i] = square[i, j]
        if rests:
            normal += np.dot(behind.T, np.dot(square, behind))
    normal += np.dot(rows[:count].T, rows[:count])
    factor = np.linalg.cholesky(normal).T.copy()
    forward(factor, right)
    return factor, right, ends


@kernel
def _effort(basis: Array, effort: Array, moving: Ints, price: float) -> Array:
    """Price of the increments while the command moves, and of the untied ones.

    The untied ones keep the matrix definite when a rest leaves few samples.
    """
    if len(moving) == 1:
        return price * effort
    still = 0
    for m in range(len(moving) - 1):
        still += moving[m + 1, 0] - moving[m, 1]
    # Outside the rests the increments are the untied ones: whichever samples are fewer.
    few = 2 * still <= len(basis)
    rows, count = np.empty((len(basis), basis.shape[1])), 0
    for m in range(len(moving) - 1 if few else len(moving)):
        first, last = (moving[m, 1], moving[m + 1, 0]) if few else (moving[m, 0], moving[m, 1])
        rows[count : count + last - first] = basis[first:last]
        count += last - first
    square = np.dot(rows[:count].T, rows[:count])
    out: Array = price * (2.0 * effort - square) if few else price * (effort + square)
    return out


@kernel(inline=True)
def _add(gain: float, row: Array, out: Array) -> None:
    for j in range(len(out)):
        out[j] += gain * row[j]


@kernel
def _states(summed: Array, reach: Array, s: int, e: int) -> Array:
    """States at e, shape (nz, n), that increments in [s, e) leave behind."""
    order, samples = len(reach), e - s
    gain = np.zeros((order + 2, samples))
    gain[:order] = reach[:, len(summed) - samples :]
    for i in range(min(2, samples)):
        gain[order + i, samples - 1 - i] = 1.0
    states: Array = np.dot(gain, summed[s:e])
    if s > 0:
        # Off the straight line on which the functions go on from before.
        for i in range(order + 2):
            at, by = 0.0, 0.0
            for k in range(samples):
                at += gain[i, k]
                by += gain[i, k] * (k + 1)
            _add(-at - by, summed[s - 1], states[i])
            if s > 1:
                _add(by, summed[s - 2], states[i])
    return states


@kernel
def forward(factor: Array, values: Array) -> None:
    """Solve factor' x = values in place, for an upper triangle."""
    for j in range(len(values)):
        values[j] /= factor[j, j]
        for i in range(j + 1, len(values)):
            values[i] -= factor[j, i] * values[j]


@kernel
def command_of(
    factor: Array, w: Array, basis: Array, moving: Ints, last: float, previous: float
) -> Array:
    """Command of the coefficients c with factor c = w."""
    c = w.copy()
    for j in range(len(c) - 1, -1, -1):
        for i in range(j + 1, len(c)):
            c[j] -= factor[j, i] * c[i]
        c[j] /= factor[j, j]
    return tied_command(np.dot(basis, c), moving, last, previous)


@kernel
def tied_command(increments: Array, moving: Ints, last: float, previous: float) -> Array:
    """Command of increments, (window,), that stops with the first sample of every rest."""
    window = len(increments)
    out = np.empty(window)
    u, step = last, last - previous
    for m in range(len(moving)):
        s, e = moving[m]
        for k in range(s, e):
            step += increments[k]
            u += step
            out[k] = u
        step = 0.0
        following = moving[m + 1, 0] if m + 1 < len(moving) else window
        out[e:following] = u
    return out


@kernel
def extremes(
    command: Array, last: float, previous: float, stops: bool
) -> tuple[float, float, float, float, float]:
    """Look at a command that follows the samples `previous` and `last`.

    Returns
    -------
    accel, speed, low, high, mean_square : float
        Largest second and first difference, lowest and highest value, and the mean of the squared
        second differences; with `stops` that behind the last sample is looked at too.
    """
    accel = speed = total = 0.0
    low = high = command[0]
    step = last - previous
    for k in range(len(command)):
        value = command[k]
        following = value - last
        bend = following - step
        accel = max(accel, abs(bend))
        speed = max(speed, abs(following))
        low, high = min(low, value), max(high, value)
        total += bend * bend
        last, step = value, following
    if stops:
        accel = max(accel, abs(step))
        total += step * step
    return accel, speed, low, high, total / len(command)


@kernel
def constraints_at(
    command: Array,
    fixed: Array,
    last: float,
    previous: float,
    bounds: Array,
    factor: Array,
    summed: Array,
    moving: Ints,
    ends: Array,
    taken: Flags,
) -> tuple[Array, Array, Array]:
    """Bound a command's increments, steps and positions where they leave their bounds.

    Parameters
    ----------
    command, fixed : ndarray, shape (window,)
        A command, and the one without functions.
    last, previous : float
        The commands before the window.
    bounds : ndarray, shape (3, 4)
        For increments, steps and positions: lowest and highest value, by how much a constraint is
        tighter, and what rows are scaled by.
    factor, summed, moving, ends
        As in `tied_window`.
    taken : ndarray of bool, shape (3, window)
        Samples that have a constraint; those found are added.

    Returns
    -------
    rows : ndarray, shape (m, n)
        For w.
    low, high : ndarray, shape (m,)
    """
    window, n = summed.shape
    rows = np.zeros((3 * window, n))
    low, high = np.empty(3 * window), np.empty(3 * window)
    count = 0
    for m in range(len(moving)):
        s, e = moving[m]
        # The first sample of a rest has the increment that stops the command.
        for k in range(s, min(e + 1, window)):
            for kind in range(3 if k < e else 1):
                value, constant = 0.0, 0.0
                for back in range(3 - kind):
                    share = _SHARES[kind, back]
                    i = k - back
                    before = last if i == -1 else previous
                    value += share * (command[i] if i >= 0 else before)
                    constant += share * (fixed[i] if i >= 0 else before)
                lowest, highest, margin, scale = bounds[kind]
                if taken[kind, k] or lowest <= value <= highest:
                    continue
                taken[kind, k] = True
                for back in range(3 - kind):
                    share = _SHARES[kind, back] / scale
                    _add_position(share, k - back, summed, moving, ends, rows[count])
                forward(factor, rows[count])
                low[count] = (lowest + margin - constant) / scale
                high[count] = (highest - margin - constant) / scale
                count += 1
    return rows[:count].copy(), low[:count].copy(), high[:count].copy()


@kernel
def _add_position(
    share: float, k: int, summed: Array, moving: Ints, ends: Array, row: Array
) -> None:
    """Add a share of the tied functions' commands at sample k."""
    if k < 0:
        return
    m = len(moving) - 1
    while moving[m, 0] > k:
        m -= 1
    s, e = moving[m]
    if m > 0:
        row += share * ends[m - 1]
    last = min(k, e - 1)
    if last >= s:
        row += share * summed[last]
        # Without what the functions did before, and the line on which they would go on.
        steps = float(last - s + 1)
        if s > 0:
            row -= share * (steps + 1.0) * summed[s - 1]
        if s > 1:
            row += share * steps * summed[s - 2]


_SHARES = np.array([[1.0, -2.0, 1.0], [1.0, -1.0, 0.0], [1.0, 0.0, 0.0]])
"""How increments, steps and positions are made of a command's last samples."""
