"""Kernels of a window with rests, wrapped by `compensation.window_problem`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillpath.compensation._least_squares_kernels import (
    add_row,
    backward,
    factorise,
    forward,
    weighted_gram,
)
from stillpath.compensation._preview_kernels import advance_window, run_windows
from stillpath.models.arrays import Array, Ints
from stillpath.models.jit import kernel

__all__ = [
    "Functions",
    "Memory",
    "Stepping",
    "Tied",
    "command_of",
    "constraints_at",
    "extremes",
    "solve_windows",
    "tied_window",
]

Flags = NDArray[np.bool_]


class Functions(NamedTuple):
    """Basis functions of a design, and the plants' responses to them.

    Attributes
    ----------
    basis, summed : ndarray, shape (window, n)
        Increments of the functions, and their double running sums: the commands.
    efforts, grams : ndarray, shape (blocks + 1, n, n)
        Running Gram matrices (`weighted_gram`) of `basis` and `filtered`.
    filtered : ndarray, shape (components, window, n)
    free : ndarray, shape (components, window, nz)
        Free responses of the states.
    reach : ndarray, shape (nz - 2, window)
        Maps commands to states at the end of the window.
    stop : ndarray, shape (components, window)
        Response to a step in the command's speed.
    price : float
        Weight of squared increments.
    """

    basis: Array
    summed: Array
    efforts: Array
    filtered: Array
    grams: Array
    free: Array
    reach: Array
    stop: Array
    price: float


class Stepping(NamedTuple):
    """Recursion of a design's windows without rests, and of its plants.

    Attributes
    ----------
    command_gain, state_gain : ndarray, shapes (update, nz) and (nz, nz)
        E and F of `run_windows`.
    advance, state_drive : ndarray, shapes (nz - 2, nz - 2) and (nz, update)
        As in `advance_window`.
    command_from_path, state_from_path : ndarray, shapes (windows, update) and (windows, nz)
        S y_d and H y_d of every window.
    """

    command_gain: Array
    state_gain: Array
    advance: Array
    state_drive: Array
    command_from_path: Array
    state_from_path: Array


class Memory(NamedTuple):
    """Cache of windows solved individually: z before, and the samples committed.

    Attributes
    ----------
    known : ndarray of bool, shape (windows,)
    z, committed : ndarray, shapes (windows, nz) and (windows, update)
    """

    known: Flags
    z: Array
    committed: Array


class Tied(NamedTuple):
    """A window solved individually without bounds.

    Attributes
    ----------
    command : ndarray, shape (window,)
    kept : bool
        Whether the command keeps its limits.
    moving, fixed : ndarray, shapes (k, 2) and (window,)
        Segments between the rests, and the command without functions.
    factor, wish, ends
        As in `_tied_problem`.
    pinned, values : ndarray, shapes (pins, n) and (pins,)
        Constraints that put the command on the path: pinned w = values.
    """

    command: Array
    kept: bool
    moving: Ints
    fixed: Array
    factor: Array
    wish: Array
    ends: Array
    pinned: Array
    values: Array


@kernel
def solve_windows(
    stepping: Stepping,
    functions: Functions,
    rest_functions: Functions,
    squeeze: Array,
    path: Array,
    share: Array,
    slid: Array,
    weight: Array,
    stops: Ints,
    bounded: Flags,
    limits: Array,
    memory: Memory,
    z: Array,
    first: int,
    last: int,
    u: Array,
) -> tuple[int, Tied]:
    """Step windows first..last - 1 until one exceeds its limits.

    Parameters
    ----------
    stepping, functions, rest_functions
        `bounded` windows are solved with `functions`, those that meet a stop with
        `rest_functions`; all others are stepped.
    squeeze : ndarray, shape (k, nz - 2)
        Maps the plants' states to those of `rest_functions`, which may also have fewer components.
    path, weight : ndarray, shape (windows update + window,)
        As in `tied_window`, for the whole piece.
    share : ndarray, shape (components,)
        Each component's target is this share of the path.
    slid : ndarray, shape (components, n) or (components, 0)
        What is added to the targets of the first n samples.
    stops : ndarray of int64, shape (k, 2)
        Ranges [a, b) of samples, rising and disjoint.
    bounded : ndarray of bool, shape (windows,)
    limits
        As in `tied_window`.
    memory : Memory
        Windows with the same initial state as before are not solved again.
    z : ndarray, shape (nz,)
        The plants' states and the last two commands, updated in place.
    u : ndarray, shape (windows update,)
        The command.

    Returns
    -------
    window : int
        Index of the window that exceeds its limits; `last` if none does.
    tied : Tied
        Its solution.
    """
    window, update = len(functions.basis), stepping.command_from_path.shape[1]
    met = coming = 0
    waiting = first
    for w in range(first, last):
        start = w * update
        while met < len(stops) and stops[met, 1] <= start:
            met += 1
        while coming < len(stops) and stops[coming, 0] < start + window:
            coming += 1
        if coming <= met and not bounded[w]:
            continue
        _step(stepping, z, waiting, w, u)
        if not (memory.known[w] and _same(memory.z[w], z)):
            used, states, components = functions, z, len(share)
            if coming > met:
                used, components = rest_functions, len(rest_functions.filtered)
                states = np.concatenate((np.dot(squeeze, z[:-2]), z[-2:]))
            tied = tied_window(
                used,
                states,
                path[start : start + window],
                _targets(share[:components], path, slid, start, window),
                weight[start : start + window],
                stops[met:coming] - start,
                limits,
            )
            if not tied.kept:
                return w, tied
            memory.known[w], memory.z[w] = True, z
            memory.committed[w] = tied.command[:update]
        u[start : start + update] = memory.committed[w]
        advance_window(stepping.advance, stepping.state_drive, z, memory.committed[w])
        waiting = w + 1
    _step(stepping, z, waiting, last, u)
    row, table = np.empty(0), np.empty((0, 0))
    return last, Tied(row, True, np.empty((0, 2), np.int64), row, table, row, table, table, row)


@kernel
def _targets(share: Array, path: Array, slid: Array, start: int, window: int) -> Array:
    """Return the targets of a window, shape (components, window), as in `solve_windows`."""
    out = np.empty((len(share), window))
    for c in range(len(share)):
        for k in range(window):
            out[c, k] = share[c] * path[start + k]
        for k in range(start, min(start + window, slid.shape[1])):
            out[c, k - start] += slid[c, k]
    return out


@kernel
def _same(a: Array, b: Array) -> bool:
    """Return whether two rows of numbers are equal."""
    differing = 0
    for k in range(len(a)):
        differing += a[k] != b[k]
    return differing == 0


@kernel(inline=True)
def _step(stepping: Stepping, z: Array, first: int, last: int, u: Array) -> None:
    """Step windows first..last - 1, which have no rests."""
    if last > first:
        run_windows(
            stepping.command_gain,
            stepping.state_gain,
            stepping.command_from_path,
            stepping.state_from_path,
            z,
            first,
            last,
            u,
        )


@kernel
def tied_window(
    functions: Functions,
    z: Array,
    path: Array,
    targets: Array,
    weight: Array,
    rests: Ints,
    limits: Array,
) -> Tied:
    """Return the command of a window that stands on the path in its rests; check its limits.

    Parameters
    ----------
    path : ndarray, shape (window,)
        Path on which the command stands in the rests.
    rests : ndarray of int64, shape (k - 1, 2)
        Ranges [a, b) of samples, relative to the window; they may reach beyond it.
    limits : ndarray, shape (4,)
        Largest second and first difference, lowest and highest value.

    Others as in `_tied_problem`.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the problem is singular, or the rests contradict each other.
    """
    basis = functions.basis
    last, previous = z[-2], z[-1]
    moving = _between(rests, len(basis))
    factor, wish, ends = _tied_problem(functions, z, targets, weight, moving)
    fixed = tied_command(np.zeros(len(basis)), moving, last, previous)
    first = 1 if len(ends) > 0 and moving[0, 1] == 0 else 0
    pinned = ends[first:].copy()
    values = np.empty(len(pinned))
    found = wish
    if len(pinned) > 0:
        # The nearest w for which the command stands on the path in the rests.
        pull = np.empty(len(pinned))
        for i in range(len(pinned)):
            at = moving[first + i, 1] - 1
            values[i] = path[at] - fixed[at]
            forward(factor, pinned[i])
            pull[i] = np.dot(pinned[i], wish) - values[i]
        meeting = np.dot(pinned, pinned.T)
        factorise(meeting)
        forward(meeting, pull)
        backward(meeting, pull)
        found = wish - np.dot(pull, pinned)
    command = command_of(factor, found, basis, moving, last, previous, path)
    accel, speed, low, high, _ = extremes(command, last, previous, False)
    kept = accel <= limits[0] and speed <= limits[1] and low >= limits[2] and high <= limits[3]
    return Tied(command, kept, moving, fixed, factor, wish, ends, pinned, values)


@kernel
def _between(rests: Ints, window: int) -> Ints:
    """Return the segments [s, e) of a window between its rests; some may be empty."""
    moving = np.zeros((len(rests) + 1, 2), np.int64)
    for m in range(len(rests)):
        moving[m, 1] = max(rests[m, 0], 0)
        moving[m + 1, 0] = min(rests[m, 1], window)
    moving[-1, 1] = window
    return moving


@kernel
def _tied_problem(
    functions: Functions, z: Array, targets: Array, weight: Array, moving: Ints
) -> tuple[Array, Array, Array]:
    """Set up the weighted least squares of a window with rests in factored form: min |w - wish|^2.

    Up to the first stop the functions are the free ones. In later segments their response is the
    free one, minus the continuation of the free functions' states at the segment's start, plus the
    decay of the states left by earlier segments. A rest contains only the latter, a few states for
    many samples: these samples are summed first, and mapped to the functions through the states.

    Parameters
    ----------
    z : ndarray, shape (nz,)
        Member states and the last two commands.
    targets : ndarray, shape (components, window)
        Target of each component of the set: `LiftedWindow.target` times the path, or close to it.
    weight : ndarray, shape (window,)
        Weight of the errors.
    moving : ndarray of int64, shape (k, 2)
        Segments [s, e) between rests; some may be empty.

    Returns
    -------
    factor : ndarray, shape (n, n)
        The triangle L', upper, with w = L' c (`factorise`).
    wish : ndarray, shape (n,)
    ends : ndarray, shape (k - 1, n)
        Values of the functions' commands in each rest.
    """
    normal = _free_normal(functions, weight, moving)
    right = np.zeros(len(normal))
    sources, ends = _sources(functions, z[-2] - z[-1], moving, normal, right)
    _add_errors(functions, z, targets, weight, moving, sources, normal, right)
    factorise(normal)
    forward(normal, right)
    return normal, right, ends


@kernel
def _free_normal(functions: Functions, weight: Array, moving: Ints) -> Array:
    """Return the normal matrix of the increments, and of the errors up to the first stop."""
    basis = functions.basis
    window, n = basis.shape
    normal: Array = functions.price * functions.efforts[-1]
    if len(moving) > 1:
        # Untied increments are weighted too: few samples could leave the matrix singular.
        prices = np.zeros(window)
        for s, e in moving:
            prices[s:e] = functions.price
        weighted_gram(functions.efforts, basis.reshape(1, window, n), prices, normal)
    squares = np.zeros(window)
    for r in range(moving[0, 1]):
        squares[r] = weight[r] * weight[r]
    weighted_gram(functions.grams, functions.filtered, squares, normal)
    return normal


@kernel
def _sources(
    functions: Functions, speed: float, moving: Ints, normal: Array, right: Array
) -> tuple[Array, Array]:
    """Return the states at the borders of segments, and the functions' commands in each rest.

    The increments that stop the command at each rest are added to the normal equations.

    Parameters
    ----------
    speed : float
        Last step of the command before the window.
    normal, right : ndarray, shapes (n, n) and (n,)
        Normal equations, updated in place.

    Returns
    -------
    sources : ndarray, shape (sources, n)
        States that the free functions would have at the start of a segment, and those that a
        segment leaves behind, in the order of `_fill_shares`.
    ends : ndarray, shape (k - 1, n)
    """
    summed, reach, price = functions.summed, functions.reach, functions.price
    n, states = summed.shape[1], len(reach) + 2
    rests = len(moving) - 1
    ends, position = np.zeros((rests, n)), np.zeros(n)
    sources, count = np.empty((2 * rests * states, n)), 0
    for m in range(rests + 1):
        s, e = moving[m]
        if e > s > 0:
            sources[count : count + states] = _states(summed, reach, 0, s)
            count += states
        if m < rests and e > s:
            ended = _states(summed, reach, s, e)
            sources[count : count + states - 1] = ended[:-1]
            count += states - 1
            position += ended[-2]
            step = ended[-2] - ended[-1]
            for i in range(n):
                add_row(price * step[i], step, normal[i])
            if m == 0:
                add_row(-price * speed, step, right)
        if m < rests:
            ends[m] = position
    return sources[:count], ends


@kernel
def _add_errors(
    functions: Functions,
    z: Array,
    targets: Array,
    weight: Array,
    moving: Ints,
    sources: Array,
    normal: Array,
    right: Array,
) -> None:
    """Add all errors to `right`, and those behind the first stop to `normal`, in place."""
    filtered, free, stop = functions.filtered, functions.free, functions.stop
    window, n = functions.basis.shape
    rests, count = len(moving) - 1, len(sources)
    first, speed = moving[0, 1], z[-2] - z[-1]
    shares, square, pull = (
        np.zeros((window - first, count)),
        np.zeros((count, count)),
        np.zeros(count),
    )
    later = 0
    for s, e in moving[1:]:
        later += e - s
    # Rows whose squares are summed.
    rows, row = np.empty((len(filtered) * later, n)), 0
    for c in range(len(filtered)):
        error = weight * (targets[c] - np.dot(free[c], z))
        for r in range(first, window):
            error[r] += weight[r] * speed * stop[c, r - first]
        right += np.dot(weight[:first] * error[:first], filtered[c, :first])
        _fill_shares(free[c], weight, moving, shares)
        for m in range(1, rests + 1):
            s, e = moving[m]
            resting = shares[moving[m - 1, 1] - first : s - first]
            square += np.dot(resting.T, resting)
            pull += np.dot(error[moving[m - 1, 1] : s], resting)
            if e > s:
                part = rows[row : row + e - s]
                np.dot(shares[s - first : e - first], sources, part)
                for r in range(e - s):
                    add_row(weight[s + r], filtered[c, s + r], part[r])
                right += np.dot(error[s:e], part)
                row += e - s
    if count > 0:
        right += np.dot(pull, sources)
        normal += np.dot(sources.T, np.dot(square, sources))
    if row > 0:
        normal += np.dot(rows.T, rows)


@kernel
def _fill_shares(free: Array, weight: Array, moving: Ints, shares: Array) -> None:
    """Fill the weighted responses of one component to each source, from the first stop on.

    Parameters
    ----------
    free : ndarray, shape (window, nz)
    shares : ndarray, shape (window - moving[0, 1], sources)
    """
    window, states = free.shape
    first, rests, column = moving[0, 1], len(moving) - 1, 0
    for m in range(rests + 1):
        s, e = moving[m]
        if e > s > 0:
            for r in range(s, e):
                for i in range(states):
                    shares[r - first, column + i] = -weight[r] * free[r - s, i]
            column += states
        if m < rests and e > s:
            left = states - 1
            for r in range(e, window):
                for i in range(left):
                    shares[r - first, column + i] = weight[r] * free[r - e, i]
                # Both last commands are the same from now on.
                shares[r - first, column + left - 1] += weight[r] * free[r - e, left]
            column += left


@kernel
def _states(summed: Array, reach: Array, s: int, e: int) -> Array:
    """Return the states at e, shape (nz, n), caused by increments in [s, e)."""
    order, samples = len(reach), e - s
    gain = np.zeros((order + 2, samples))
    gain[:order] = reach[:, len(summed) - samples :]
    for i in range(min(2, samples)):
        gain[order + i, samples - 1 - i] = 1.0
    states: Array = np.dot(gain, summed[s:e])
    if s > 0:
        # Relative to the straight line that continues the functions from before s.
        for i in range(order + 2):
            at, by = 0.0, 0.0
            for k in range(samples):
                at += gain[i, k]
                by += gain[i, k] * (k + 1)
            add_row(-at - by, summed[s - 1], states[i])
            if s > 1:
                add_row(by, summed[s - 2], states[i])
    return states


@kernel
def command_of(
    factor: Array, w: Array, basis: Array, moving: Ints, last: float, previous: float, path: Array
) -> Array:
    """Return the command of c with factor c = w, bit-exactly on the path in its rests."""
    c = w.copy()
    backward(factor, c)
    command = tied_command(np.dot(basis, c), moving, last, previous)
    for m in range(len(moving) - 1):
        a, b = moving[m, 1], moving[m + 1, 0]
        command[max(a - 1, 0) : b] = path[a - 1] if a > 0 else last
    return command


@kernel
def tied_command(increments: Array, moving: Ints, last: float, previous: float) -> Array:
    """Return the command of increments, (window,), that stops at the start of every rest."""
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
    """Measure a command that follows the samples `previous` and `last`.

    Returns
    -------
    accel, speed, low, high, mean_square : float
        Largest second and first difference, lowest and highest value, and the mean of the squared
        second differences; with `stops` the one after the last sample is included.
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
    """Return constraints where a command's increments, steps and positions exceed their bounds.

    Parameters
    ----------
    command, fixed : ndarray, shape (window,)
        A command, and the one without functions.
    last, previous : float
        The commands before the window.
    bounds : ndarray, shape (3, 4)
        For increments, steps and positions: lowest and highest value, margin of a constraint, and
        scale of its row.
    factor, summed, moving, ends
        As in `tied_window`.
    taken : ndarray of bool, shape (3, window)
        Samples that already have a constraint; new ones are added.

    Returns
    -------
    rows : ndarray, shape (m, n)
        Constraints on w: low <= rows w <= high.
    low, high : ndarray, shape (m,)
    """
    window, n = summed.shape
    rows = np.zeros((3 * window, n))
    low, high = np.empty(3 * window), np.empty(3 * window)
    count = 0
    for m in range(len(moving)):
        s, e = moving[m]
        # The increment that stops the command is at the first sample of a rest.
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
    """Add the tied functions' commands at sample k times `share` to a row."""
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
        # Subtract the functions' earlier part and the straight line that continues it.
        steps = float(last - s + 1)
        if s > 0:
            row -= share * (steps + 1.0) * summed[s - 1]
        if s > 1:
            row += share * steps * summed[s - 2]


_SHARES = np.array([[1.0, -2.0, 1.0], [1.0, -1.0, 0.0], [1.0, 0.0, 0.0]])
"""Increments, steps and positions as combinations of a command's last samples."""
