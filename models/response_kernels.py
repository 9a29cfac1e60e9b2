"""Kernels of the plant response, wrapped and checked by `simulation.response`.

They are in this layer because compensators simulate their plants too.
"""

from __future__ import annotations

import numpy as np

from stillpath.models.arrays import Array
from stillpath.models.jit import kernel

__all__ = ["block_states", "dense_response", "in_blocks", "modal_response"]

_CHUNK, _CHUNK_BLOCKS = 1024, 64
_TINY = 1e-150


@kernel(allocates=False)
def modal_response(modes: Array, d: float, origin: float, state: Array, u: Array, y: Array) -> None:
    """Add up first-order complex recurrences, three at a time to hide their latency.

    `modes` has rows (re, im of the eigenvalue, re, im of the output weight), a multiple of three
    of them; `state` has rows (re, im) and is carried on. y = origin + response of u - origin.
    """
    n = len(u)
    for k in range(n):
        y[k] = origin + d * (u[k] - origin)
    for m in range(0, len(modes), 3):
        a_re, a_im, a_wr, a_wi = modes[m, 0], modes[m, 1], modes[m, 2], modes[m, 3]
        b_re, b_im, b_wr, b_wi = modes[m + 1, 0], modes[m + 1, 1], modes[m + 1, 2], modes[m + 1, 3]
        c_re, c_im, c_wr, c_wi = modes[m + 2, 0], modes[m + 2, 1], modes[m + 2, 2], modes[m + 2, 3]
        p, q = state[m, 0], state[m, 1]
        r, s = state[m + 1, 0], state[m + 1, 1]
        v, w = state[m + 2, 0], state[m + 2, 1]
        for first in range(0, n, _CHUNK):
            for k in range(first, min(first + _CHUNK, n)):
                y[k] += (a_wr * p - a_wi * q) + (b_wr * r - b_wi * s)
                y[k] += c_wr * v - c_wi * w
                drive = u[k] - origin
                p_next = (a_re * p - a_im * q) + drive
                q = a_im * p + a_re * q
                p = p_next
                r_next = (b_re * r - b_im * s) + drive
                s = b_im * r + b_re * s
                r = r_next
                v_next = (c_re * v - c_im * w) + drive
                w = c_im * v + c_re * w
                v = v_next
            # Flush decayed states to zero: denormal numbers are a hundred times slower.
            if abs(p) + abs(q) < _TINY:
                p = q = 0.0
            if abs(r) + abs(s) < _TINY:
                r = s = 0.0
            if abs(v) + abs(w) < _TINY:
                v = w = 0.0
        state[m, 0], state[m, 1] = p, q
        state[m + 1, 0], state[m + 1, 1] = r, s
        state[m + 2, 0], state[m + 2, 1] = v, w


@kernel(allocates=False)
def block_states(step: Array, drive: Array, state: Array, out: Array) -> None:
    """Carry the states of modes from block to block, three modes at a time as `modal_response`.

    Parameters
    ----------
    step : ndarray, shape (m, 2)
        Eigenvalues, re and im, to the power of a block's samples.
    drive : ndarray, shape (blocks, 2 m)
        What each block's commands add to the states after it.
    state : ndarray, shape (m, 2)
        Carried on.
    out : ndarray, shape (blocks, 2 m)
        Becomes the states in front of each block.
    """
    n = len(drive)
    for m in range(0, len(step), 3):
        a_re, a_im = step[m, 0], step[m, 1]
        b_re, b_im = step[m + 1, 0], step[m + 1, 1]
        c_re, c_im = step[m + 2, 0], step[m + 2, 1]
        p, q = state[m, 0], state[m, 1]
        r, s = state[m + 1, 0], state[m + 1, 1]
        v, w = state[m + 2, 0], state[m + 2, 1]
        i = 2 * m
        for first in range(0, n, _CHUNK_BLOCKS):
            for k in range(first, min(first + _CHUNK_BLOCKS, n)):
                out[k, i], out[k, i + 1], out[k, i + 2] = p, q, r
                out[k, i + 3], out[k, i + 4], out[k, i + 5] = s, v, w
                p_next = (a_re * p - a_im * q) + drive[k, i]
                q = (a_im * p + a_re * q) + drive[k, i + 1]
                p = p_next
                r_next = (b_re * r - b_im * s) + drive[k, i + 2]
                s = (b_im * r + b_re * s) + drive[k, i + 3]
                r = r_next
                v_next = (c_re * v - c_im * w) + drive[k, i + 4]
                w = (c_im * v + c_re * w) + drive[k, i + 5]
                v = v_next
            # As above: states that decay into denormal numbers.
            if abs(p) + abs(q) < _TINY:
                p = q = 0.0
            if abs(r) + abs(s) < _TINY:
                r = s = 0.0
            if abs(v) + abs(w) < _TINY:
                v = w = 0.0
        state[m, 0], state[m, 1] = p, q
        state[m + 1, 0], state[m + 1, 1] = r, s
        state[m + 2, 0], state[m + 2, 1] = v, w


@kernel(allocates=False)
def in_blocks(u: Array, origin: float, out: Array) -> None:
    """Copy a command minus `origin`, (blocks n,), to the first n columns of `out`; origin last."""
    blocks, last = out.shape[0], out.shape[1] - 1
    n = len(u) // blocks
    for k in range(blocks):
        for i in range(n):
            out[k, i] = u[k * n + i] - origin
        out[k, last] = origin


@kernel
def dense_response(
    a: Array, b: Array, c: Array, d: float, origin: float, state: Array, u: Array, y: Array
) -> None:
    """Advance x(k+1) = a x + b u, y = c x + d u for plants without a usable modal form."""
    n = len(b)
    x = state.copy()
    x_next = np.empty(n)
    for k in range(len(u)):
        drive = u[k] - origin
        value = origin + d * drive
        for i in range(n):
            value += c[i] * x[i]
        y[k] = value
        for i in range(n):
            total = b[i] * drive
            for j in range(n):
                total += a[i, j] * x[j]
            x_next[i] = total if abs(total) > _TINY else 0.0
        x[:] = x_next
    state[:] = x
