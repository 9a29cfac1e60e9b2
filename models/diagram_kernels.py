"""Kernel of a block diagram, wrapped and checked by `models.diagrams`.

It is in this layer because both feedback designs (for stability) and simulations use it.
"""

from __future__ import annotations

import numpy as np

from stillpath.models.arrays import Array, Ints
from stillpath.models.jit import kernel

__all__ = ["advance"]

(
    _OUTPUT,
    _FIRST_WIRE,
    _END_OF_WIRES,
    _COEFFICIENTS,
    _ORDER,
    _STATES,
    _DELAY,
    _DELAY_LINE,
    _EVERY,
    _PHASE,
    _ZERO_BETWEEN,
    _DIRECT,
) = range(12)
"""Columns of a layout: the fields of `models.diagrams._Row`."""
_QUANTUM, _LIMIT = 0, 1
"""Columns of a shape."""
_TINY = 1e-150
_FLUSH = 255


@kernel(inline=True)
def _shaped(value: float, quantum: float, limit: float) -> float:
    """Round to the quantum, then clip."""
    if quantum > 0.0:
        value = quantum * np.floor(value / quantum + 0.5)
    if value > limit:
        value = limit
    elif value < -limit:
        value = -limit
    return value


@kernel(inline=True)
def _runs(layout: Ints, b: int, now: int) -> bool:
    """Return whether a block runs at a tick."""
    every = layout[b, _EVERY]
    return bool(every == 1 or now % every == layout[b, _PHASE])


@kernel
def advance(
    layout: Ints,
    wires: Ints,
    gains: Array,
    num: Array,
    den: Array,
    shape: Array,
    state: Array,
    cursor: Ints,
    signals: Array,
    tick: int,
    sources: Ints,
    inputs: Array,
    watched: Ints,
    records: Array,
) -> None:
    """Run a diagram for as many ticks as `inputs` has columns.

    `layout` has a row per block, `shape` its quantum and limit. `state` holds the states of all
    filters, then all delay lines; `cursor` the place of the oldest sample of each line.

    A tick has three passes: blocks without direct feedthrough write their output, then the others
    run in order, and finally the first ones read their inputs.
    """
    blocks = len(layout)
    memory = np.zeros(blocks)
    for k in range(inputs.shape[1]):
        now = tick + k
        for i in range(len(sources)):
            signals[sources[i]] = inputs[i, k]
        for b in range(blocks):
            if layout[b, _DIRECT] == 0 and _runs(layout, b, now):
                value = state[layout[b, _STATES]] if layout[b, _ORDER] > 0 else 0.0
                if layout[b, _DELAY] > 0:
                    oldest = state[layout[b, _DELAY_LINE] + cursor[b]]
                    value += num[layout[b, _COEFFICIENTS]] * oldest
                memory[b] = value
                signals[layout[b, _OUTPUT]] = _shaped(value, shape[b, _QUANTUM], shape[b, _LIMIT])
            elif layout[b, _ZERO_BETWEEN] == 1:
                signals[layout[b, _OUTPUT]] = 0.0
        for step in range(2):
            for b in range(blocks):
                if layout[b, _DIRECT] != 1 - step or not _runs(layout, b, now):
                    continue
                x = 0.0
                for w in range(layout[b, _FIRST_WIRE], layout[b, _END_OF_WIRES]):
                    x += gains[w] * signals[wires[w]]
                order, first = layout[b, _ORDER], layout[b, _STATES]
                c = layout[b, _COEFFICIENTS]
                if step == 0:
                    y = num[c] * x
                    if order > 0:
                        y += state[first]
                    signals[layout[b, _OUTPUT]] = _shaped(y, shape[b, _QUANTUM], shape[b, _LIMIT])
                else:
                    y = memory[b]
                    if layout[b, _DELAY] > 0:
                        place = layout[b, _DELAY_LINE] + cursor[b]
                        oldest = state[place]
                        state[place] = x
                        x = oldest
                        cursor[b] = (cursor[b] + 1) % layout[b, _DELAY]
                # Direct form II, transposed.
                for i in range(order - 1):
                    state[first + i] = (
                        state[first + i + 1] + num[c + i + 1] * x - den[c + i + 1] * y
                    )
                if order > 0:
                    state[first + order - 1] = num[c + order] * x - den[c + order] * y
        for j in range(len(watched)):
            records[j, k] = signals[watched[j]]
        if (k & _FLUSH) == _FLUSH:
            # Flush decayed states to zero: denormal numbers are a hundred times slower.
            for i in range(len(state)):
                if abs(state[i]) < _TINY:
                    state[i] = 0.0
