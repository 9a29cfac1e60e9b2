"""The response of a plant to a whole command, by matrix products."""

from __future__ import annotations

import numpy as np
from scipy.linalg import toeplitz

from stillpath.compensation._preview_kernels import block_starts
from stillpath.models.arrays import Array
from stillpath.models.plants import DiscretePlant
from stillpath.models.response_kernels import dense_response

__all__ = ["BlockResponse"]

_BLOCK = 16
"""Samples of a block. Longer ones need larger products, shorter ones more steps of the states."""


class BlockResponse:
    """A plant in blocks of samples.

    The samples of a block and the state after it are linear in its commands and in the state before
    it. Only the states follow one after the other; all else is matrix products.
    """

    def __init__(self, plant: DiscretePlant) -> None:
        self._plant = plant
        powers = [np.eye(plant.order)]
        for _ in range(_BLOCK):
            powers.append(plant.a @ powers[-1])
        self._step = powers[-1]
        self._free = np.stack([power.T @ plant.c for power in powers[:-1]], axis=1)
        self._drive = np.stack([power @ plant.b for power in powers[-2::-1]])
        self._answer = toeplitz(plant.impulse_response(_BLOCK), np.zeros(_BLOCK)).T

    def __call__(self, origin: float, state: Array, command: Array) -> Array:
        """Return the response (n,) to a command (n,).

        `state` (order,) is that of the first sample, relative to standing still at `origin`. All
        positions have one unit.
        """
        p, done = self._plant, len(command) // _BLOCK * _BLOCK
        blocks = (command[:done] - origin).reshape(-1, _BLOCK)
        starts = block_starts(self._step, blocks @ self._drive, state)
        y = np.empty(len(command))
        y[:done] = (blocks @ self._answer + starts[:-1] @ self._free).ravel()
        y[:done] += origin
        dense_response(p.a, p.b, p.c, p.d, origin, starts[-1].copy(), command[done:], y[done:])
        return y
