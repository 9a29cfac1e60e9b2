"""Kernel of a block diagram, wrapped and checked by `models.diagrams`.

It is in this layer because both feedback designs (for stability) and simulations use it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stillpath.models.arrays import Array
from stillpath.models.jit import kernel

__all__ = ["advance"]

Integers = NDArray[np.int64]
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


@kernel
def advance(
    layout: Integers,
    wires: Integers,
    gains: Array,
    num: Array,
    den: Array,
    shape: Array,
    state: Array,
    cursor: Integers,
    signals: Array,
    tick: int,
    sources: Integers,
    inputs: Array,
    watched: Integers,
    records: Array,
) -> None:
    """Run a diagram for as many ticks as `inputs` has columns.

    `layout` has a row per block: output signal, first and last wire, first coefficient, order,
    first state, delay, first place of the delay line, ticks between runs, phase, zero between
    runs, needs its input at once. `shape` has rows (quantum, limit). `state` holds the states of
    all filters, then all delay lines; `cursor` the place of the oldest sample of each line.

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
            if layout[b, 11] == 0 and (layout[b, 8] == 1 or now % layout[b, 8] == layout[b, 9]):
                value = state[layout[b, 5]] if layout[b, 4] > 0 else 0.0
                if layout[b, 6] > 0:
                    value += num[layout[b, 3]] * state[layout[b, 7] + cursor[b]]
                memory[b] = value
                signals[layout[b, 0]] = _shaped(value, shape[b, 0], shape[b, 1])
            elif layout[b, 10] == 1:
                signals[layout[b, 0]] = 0.0
        for step in range(2):
            for b in range(blocks):
                if layout[b, 11] != 1 - step or (
                    layout[b, 8] != 1 and now % layout[b, 8] != layout[b, 9]
                ):
                    continue
                x = 0.0
                for w in range(layout[b, 1], layout[b, 2]):
                    x += gains[w] * signals[wires[w]]
                order, first = layout[b, 4], layout[b, 5]
                c = layout[b, 3]
                if step == 0:
                    y = num[c] * x
                    if order > 0:
                        y += state[first]
                    signals[layout[b, 0]] = _shaped(y, shape[b, 0], shape[b, 1])
                else:
                    y = memory[b]
                    if layout[b, 6] > 0:
                        place = layout[b, 7] + cursor[b]
                        oldest = state[place]
                        state[place] = x
                        x = oldest
                        cursor[b] = (cursor[b] + 1) % layout[b, 6]
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
