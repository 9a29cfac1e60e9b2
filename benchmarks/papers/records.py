"""What the scripts of this folder share: records, paths, figures of them."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from stillpath.models.arrays import Array

Row = tuple[str, str, str, str]
"""Quantity, the paper's value, ours, and where the difference comes from."""

SAMPLES = 1001


def butterfly(samples: int, size_mm: float, step_mm: float) -> Array:
    """X of a butterfly curve at a steady rate, of the given rms, in motor steps.

    It ends in full motion, so that what comes after the end is missing, and steps shake: on a path
    that is smooth and comes to rest the three bases give the same command to 0.1 um.
    """
    t = np.linspace(0, 2 * np.pi, samples)
    x = np.sin(t) * (np.exp(np.cos(t)) - 2 * np.cos(4 * t) - np.sin(t / 12) ** 5)
    return np.round(x * (size_mm / rms(x)) / step_mm) * step_mm


def white(seeds: int) -> Array:
    """White noise, one record per column."""
    return np.stack([np.random.default_rng(s).normal(size=SAMPLES) for s in range(seeds)], axis=1)


def rms(x: Array) -> Array:
    """Root of the mean square along the samples."""
    return np.sqrt(np.mean(x**2, axis=0))


def plus_minus(values: Array) -> str:
    """Mean and standard deviation between seeds."""
    spread = f" ± {values.std():.2g}" if len(values) > 1 else ""
    return f"{values.mean():.4g}{spread}"


def cpu(work: Callable[[], object], repeats: int) -> float:
    """Least CPU seconds of several runs."""
    took = []
    for _ in range(repeats):
        start = time.process_time()
        work()
        took.append(time.process_time() - start)
    return min(took)
