"""Simulate the linear response of plants to a command, block by block."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stillpath.models.arrays import Array
from stillpath.models.modal import modal_form
from stillpath.models.plants import DiscretePlant
from stillpath.models.response_kernels import (
    block_states,
    dense_response,
    in_blocks,
    modal_response,
)

__all__ = ["PlantStream", "response"]


_BLOCK, _LEAST_BLOCKS = 16, 4
"""Samples of a block, and the least number of blocks that justifies matrix products."""


@dataclass(slots=True)
class _Axis:
    plant: DiscretePlant
    modes: Array | None
    state: Array
    blocks: _Blocks | None

    def push(self, u: Array, origin: float, y: Array) -> None:
        done = 0
        if self.blocks is not None:
            done = self.blocks.push(u, origin, self.state, y)
        if self.modes is not None:
            modal_response(self.modes, self.plant.d, origin, self.state, u[done:], y[done:])
        else:
            p = self.plant
            dense_response(p.a, p.b, p.c, p.d, origin, self.state, u, y)


class _Blocks:
    """The response of modes to many samples, computed in blocks.

    A block's positions and final states are linear in its commands and initial states: the
    recurrence only runs from block to block, and the rest are matrix products.
    """

    def __init__(self, modes: Array, d: float) -> None:
        pole = modes[:, 0] + 1j * modes[:, 1]
        weight = modes[:, 2] + 1j * modes[:, 3]
        powers = pole ** np.arange(_BLOCK)[:, None]
        answer = np.append(d, (powers[:-1] @ weight).real)
        late = np.arange(_BLOCK) - np.arange(_BLOCK)[:, None]
        rings = weight * powers
        free = np.stack([rings.real, -rings.imag], axis=2).reshape(_BLOCK, -1).T
        self._answer = np.concatenate(
            [np.where(late >= 0, answer[np.maximum(late, 0)], 0.0), free, np.ones((1, _BLOCK))]
        )
        drives = powers[::-1]
        self._drive = np.stack([drives.real, drives.imag], axis=2).reshape(_BLOCK, -1)
        step = pole**_BLOCK
        self._step = np.stack([step.real, step.imag], axis=1)

    def push(self, u: Array, origin: float, state: Array, y: Array) -> int:
        """Fill `y` for whole blocks and update `state`; return the number of samples."""
        blocks = len(u) // _BLOCK
        if blocks < _LEAST_BLOCKS:
            return 0
        done = blocks * _BLOCK
        known = np.empty((blocks, len(self._answer)))
        in_blocks(u[:done], origin, known)
        block_states(self._step, known[:, :_BLOCK] @ self._drive, state, known[:, _BLOCK:-1])
        np.matmul(known, self._answer, out=y[:done].reshape(blocks, _BLOCK, copy=False))
        return done


class PlantStream:
    """Response of several axes to a command that arrives in blocks.

    The axes stand still at the first sample pushed.

    Parameters
    ----------
    plants : sequence of DiscretePlant
        One per row of the command; all with DC gain 1 and the same sampling time.
    """

    def __init__(self, plants: Sequence[DiscretePlant]) -> None:
        if len({p.dt_s for p in plants}) > 1:
            raise ValueError("plants of one stream must share their sampling time")
        self._axes = []
        for plant in plants:
            modes = modal_form(plant)
            shape = (plant.order,) if modes is None else (len(modes), 2)
            blocks = None if modes is None or len(modes) == 0 else _Blocks(modes, plant.d)
            self._axes.append(_Axis(plant, modes, np.zeros(shape), blocks))
        self._origin: Array | None = None

    def stand(self) -> None:
        """Stand still from here on: the next sample pushed is the first one again."""
        for axis in self._axes:
            axis.state[:] = 0.0
        self._origin = None

    def push(self, u_mm: Array, out: Array | None = None) -> Array:
        """Return the response to the command block `u_mm`, shape (axes, n).

        They are written to `out`, if that is given.

        Raises
        ------
        ValueError
            For another number of axes.
        """
        u = np.asarray(u_mm, dtype=np.float64)
        if u.ndim != 2 or len(u) != len(self._axes):
            raise ValueError(f"command of shape {u.shape}, expected ({len(self._axes)}, n)")
        y = np.empty(u.shape) if out is None else out
        if u.shape[1] == 0:
            return y
        if self._origin is None:
            # Relative to the start for precision: the response to an offset is that offset.
            self._origin = u[:, 0].copy()
        for axis, origin, row_u, row_y in zip(self._axes, self._origin, u, y, strict=True):
            axis.push(np.ascontiguousarray(row_u), float(origin), row_y)
        return y


def response(plants: Sequence[DiscretePlant], u_mm: Array) -> Array:
    """Return the response to a whole command at once, shape (axes, n)."""
    return PlantStream(plants).push(u_mm)
