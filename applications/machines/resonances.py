"""The resonances of a plant, and the matching of those of two plants."""

from __future__ import annotations

import numpy as np

from stillpath.models.plants import PlantSpec, frequency_response
from stillpath.models.roots import frequency_and_damping

__all__ = ["Resonance", "leading", "matched", "resonances"]

Resonance = tuple[float, float]
"""Frequency (Hz) and damping ratio."""

_SAME = 0.3
"""Relative distance above which frequencies belong to different modes."""


def resonances(plant: PlantSpec, *, zeros: bool = False) -> list[Resonance]:
    """Return frequency and damping ratio of the pairs of poles (or zeros), rising in frequency."""
    roots = plant.roots()
    rows = frequency_and_damping(roots.zeros if zeros else roots.poles, roots.dt_s)
    return [(float(f), float(zeta)) for f, zeta in rows]


def leading(plant: PlantSpec) -> Resonance | None:
    """Return the dominant mode: the largest |G|^2 f zeta (area of its peak)."""
    modes = resonances(plant)
    if not modes:
        return None
    f, zeta = np.array(modes).T
    return modes[int(np.argmax(np.abs(frequency_response(plant, f)) ** 2 * f * np.abs(zeta)))]


def matched(
    old: list[Resonance], new: list[Resonance]
) -> list[tuple[Resonance | None, Resonance | None]]:
    """Return old and new modes in pairs, nearest first; None where there is no counterpart."""
    gaps = sorted(
        (abs(np.log(b[0] / a[0])), i, j) for i, a in enumerate(old) for j, b in enumerate(new)
    )
    partner: dict[int, int] = {}
    for gap, i, j in gaps:
        if gap < _SAME and i not in partner and j not in partner.values():
            partner[i] = j
    pairs: list[tuple[Resonance | None, Resonance | None]] = [
        (mode, new[partner[i]] if i in partner else None) for i, mode in enumerate(old)
    ]
    pairs += [(None, mode) for j, mode in enumerate(new) if j not in partner.values()]
    return sorted(pairs, key=lambda pair: (pair[0] or pair[1] or (0.0,))[0])
