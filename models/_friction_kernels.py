"""Kernels of dry friction, wrapped by `models.friction`."""

from __future__ import annotations

import numpy as np

from stillpath.models.arrays import Array
from stillpath.models.jit import kernel

__all__ = ["bent", "received"]

_ROUNDS = 4
_SMALL = 0.003
"""Last round over the bend's travel from which a series to its third power is exact to 1e-11."""


@kernel(allocates=False)
def bent(way: Array, bend: float, kept: float, out: Array) -> None:
    """Compute the bend of guides along a path from rest, -1 to 1 (Dahl 1968), exactly.

    A share `kept` of the bend remains from one sample to the next.
    """
    now = 0.0
    out[0] = now
    for k in range(1, len(way)):
        step = way[k] - way[k - 1]
        now *= kept
        if step != 0.0:
            towards = 1.0 if step > 0.0 else -1.0
            now = towards + (now - towards) * np.exp(-abs(step) / bend)
        out[k] = now


@kernel(allocates=False)
def received(
    command: Array, held: Array, bend: float, kept: float, states: Array, out: Array
) -> None:
    """Solve w + held bent(w) = command for every axis; `states` are (w, bent) of the last sample.

    Axis by axis takes twice as long: what one waits for, the other computes meanwhile.
    """
    axes, samples = command.shape
    for k in range(samples):
        for axis in range(axes):
            w, now = states[axis, 0], states[axis, 1] * kept
            # What the guides let go of moves the axis as a command does.
            step = command[axis, k] - (w + held[axis] * now)
            if step != 0.0:
                towards = 1.0 if step > 0.0 else -1.0
                asked = abs(step)
                # way + room (1 - exp(-way / bend)) = asked: concave, so Newton's rounds from a way
                # that is too short stay below.
                room = held[axis] * (1.0 - towards * now)
                way = max(asked - room, asked * bend / (bend + room))
                left, last = 1.0, bend
                for _ in range(_ROUNDS):
                    left = np.exp(-way / bend)
                    last = (asked - way - room * (1.0 - left)) * bend / (bend + room * left)
                    way += last
                    if last < _SMALL * bend:
                        break
                # exp(-way / bend) behind the last round, by a series.
                x = last / bend
                left *= 1.0 - x * (1.0 - x * (0.5 - x * (1.0 / 6.0)))
                now = towards + (now - towards) * left
                # What these rounds leave is not lost.
                w = command[axis, k] - held[axis] * now
            states[axis, 0], states[axis, 1] = w, now
            out[axis, k] = w
