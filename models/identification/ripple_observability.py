"""Whether passes suffice to observe a harmonic of the ripple.

A sensor slower than the ripple still sees every harmonic, folded, unless two of them fold onto one
another, or one onto a constant. `Observability` says how far a pass is from that (reference,
finding (vi)): the noise gain of the fit decides, the distance in Hz says which speed to choose
instead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stillpath.models.arrays import Array
from stillpath.models.errors import ModelError

__all__ = ["Observability", "folded_distances", "observability", "refuse_unobservable"]

_LARGEST_NOISE_GAIN = 4.0
"""Above, a harmonic is not observable: noise would count four times as much as for a wave alone."""


@dataclass(frozen=True, slots=True)
class Observability:
    """How well the passes show one harmonic.

    Attributes
    ----------
    noise_gain : float
        Standard deviation of the coefficient over that of a wave alone among white noise; 1 is
        the best, infinite in the singular set.
    distance_hz : float or None
        At steady speed: from folding onto a constant, onto itself, or onto another harmonic.
    """

    source: str
    number: int
    noise_gain: float
    distance_hz: float | None
    observable: bool


def observability(
    matrix: Array, waves: Sequence[tuple[str, int]], distances_hz: Sequence[Array]
) -> tuple[Observability, ...]:
    """Judge all passes together by noise gain; the distance is the largest of a single one.

    Parameters
    ----------
    matrix : ndarray, shape (k, m)
        Of the fit; its first columns are sine and cosine of every wave.
    waves : sequence of (str, int)
        Name of the source, number of the harmonic.
    distances_hz : sequence of ndarray, shape (len(waves),)
        `folded_distances` of each pass at steady speed.
    """
    scale = np.linalg.norm(matrix, axis=0)
    scale[scale == 0.0] = 1.0
    # 1 / sqrt of the inverse's diagonal is each column's part that no other column explains.
    _, sizes, right = np.linalg.svd(matrix / scale, full_matrices=False)
    kept = np.maximum(sizes, 1e-9 * sizes[0])
    spread = np.sqrt(np.sum((right / kept[:, None]) ** 2, axis=0))
    farthest = np.max(distances_hz, axis=0) if len(distances_hz) else None
    out = []
    for k, (name, number) in enumerate(waves):
        gain = float(np.max(spread[2 * k : 2 * k + 2]))
        distance = None if farthest is None else float(farthest[k])
        out.append(Observability(name, number, gain, distance, gain <= _LARGEST_NOISE_GAIN))
    return tuple(out)


def refuse_unobservable(seen: Sequence[Observability]) -> None:
    """Raise `ModelError` if a harmonic is not observable; says which, and the remedy."""
    named = ", ".join(
        f"{one.source} {one.number} (noise gain {one.noise_gain:.3g}"
        + ("" if one.distance_hz is None else f", {one.distance_hz:.3g} Hz from folding")
        + ")"
        for one in seen
        if not one.observable
    )
    if named:
        raise ModelError(
            f"not observable at the speeds driven: {named}; limit {_LARGEST_NOISE_GAIN:g}. The "
            "sensor cannot tell them apart: add a pass at another speed (f = h v / pitch), or "
            "learn fewer harmonics"
        )


def folded_distances(f_hz: Array, sensor_hz: float) -> Array:
    """Return how far each frequency is from the singular set of a sensor, shape (m,).

    The smallest |f_i|, |2 f_i| or |f_i +- f_k|, modulo `sensor_hz`: at 0 the samples cannot tell
    the harmonic from a constant, its own mirror image, or another one (paper 001, section III).
    Keep more than 1 / (length of the record).
    """
    f = np.abs(np.asarray(f_hz, np.float64))
    candidates = [f, 2 * f]
    for shift in range(1, len(f)):
        other = np.roll(f, shift)
        candidates += [f - other, f + other]
    folded = np.abs(np.array(candidates))
    return np.asarray(np.min(np.abs(folded - sensor_hz * np.round(folded / sensor_hz)), axis=0))
