"""Plants for tests, and their answer by the definition."""

from __future__ import annotations

import numpy as np

from stillpath.models.plants import DiscretePlant, Mode, ModesSpec, discretise

__all__ = ["answer", "one_mode"]


def one_mode(f_hz: float = 40.0, zeta: float = 0.05) -> DiscretePlant:
    return discretise(ModesSpec(modes=(Mode(f_hz=f_hz, zeta=zeta),)), 1e-3)


def answer(plant: DiscretePlant, u: np.ndarray, x: np.ndarray | None = None) -> np.ndarray:
    """From a state `x`, or from rest at 0."""
    state, y = np.zeros(plant.order) if x is None else x.copy(), np.empty(len(u))
    for k, value in enumerate(u):
        y[k] = plant.c @ state + plant.d * value
        state = plant.a @ state + plant.b * value
    return y
