"""Cache a function's last value, for solvers that need residual and Jacobian at one point."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from stillpath.models.arrays import Array

__all__ = ["last_kept"]

T = TypeVar("T")


def last_kept(function: Callable[[Array], T]) -> Callable[[Array], T]:
    """Return the function with its last value kept, for as long as the vector is the same."""
    kept: dict[bytes, T] = {}

    def known(vector: Array) -> T:
        key = vector.tobytes()
        if key not in kept:
            kept.clear()
            kept[key] = function(vector)
        return kept[key]

    return known
