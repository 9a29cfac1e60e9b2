"""Find and remove the mode of the frame on its feet, which does not move nozzle against bed.

An accelerometer measures against the ground. A frame that shakes by reaction (mass ratio mu,
frequency w) multiplies what the nozzle does over the bed by 1 - mu s^2/(s^2 + 2 z w s + w^2), to
first order in mu (exactly: `nozzle`): a mode of share mu, or a pair of poles beside a pair of
zeros, far below the mode that rings most.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TypeVar, cast

import numpy as np

from stillpath.models.plants import PairsSpec, PlantSpec, RelativeModesSpec, frequency_response

__all__ = ["LIKELY", "SURELY_HZ", "frame_hz_of", "likely_of", "shaken", "without_frame"]

P = TypeVar("P", bound=PlantSpec)

_HIGHEST_HZ, _BELOW, _SHARE = 30.0, 0.7, 0.25
"""A frame's mode is at most this high, this ratio to the strongest mode, and this large a share."""
LIKELY = 0.8
"""Probability that a weak mode far below the strongest is the frame's; no measurement on the axis
tells. Mistaking the frame's for the nozzle's costs more than the reverse (docs/tried.md)."""
SURELY_HZ = 12.5
"""Below, a weak mode of an axis is not the nozzle's over the bed: its spring would hardly hold an
axis. Tables begin there and hardly tell its share, on which slow motion depends most."""
_UNLIKE, _UNLIKE_LIKELY = 1.5, 0.3
"""A frame stands on the same feet in X and in Y, and its frequencies there are alike: within 1.43
times in spectra of 60 virtual printers, as a moving bed lowers that of Y. Modes further apart are
not of one frame, and rather something that the nozzle feels (1.61 times on a Voron V0)."""
_BESIDE = 0.25
"""Largest |log| of the ratio of a pair of zeros to the pair of poles that it belongs to."""


def shaken(
    crowd: Sequence[P], rng: np.random.Generator, likely: float, known_hz: float | None = None
) -> list[P]:
    """Remove the frame's mode from a share `likely` of plants."""
    frame = rng.random(len(crowd)) < likely
    pairs = zip(crowd, frame, strict=True)
    return [without_frame(p, known_hz) if shakes else p for p, shakes in pairs]


def frame_hz_of(crowd: Sequence[PlantSpec]) -> float | None:
    """Return the frequency of a weak mode of most plants that may be the frame's; else None."""
    lowest = [
        min(mode.f_hz for mode in plant.modes)
        for plant in crowd
        if isinstance(plant, RelativeModesSpec) and without_frame(plant) != plant
    ]
    return float(np.median(lowest)) if 2 * len(lowest) > len(crowd) else None


def likely_of(frames_hz: Iterable[float | None]) -> float:
    """Return the probability that such modes are the frame's, given their frequencies by axis."""
    seen = [f_hz for f_hz in frames_hz if f_hz is not None]
    return LIKELY if not seen or max(seen) < _UNLIKE * min(seen) else _UNLIKE_LIKELY


def without_frame(plant: P, known_hz: float | None = None, highest_hz: float = _HIGHEST_HZ) -> P:
    """Return the plant without weak modes far below its strongest one; others as they are.

    Parameters
    ----------
    known_hz : float, optional
        Frequency of a frame that was found and removed already. What it leaves there is what the
        nozzle does as the frame shakes; a mode elsewhere may be that of the table under it.
    highest_hz : float
        Modes above are kept.
    """
    made: PlantSpec = plant
    if isinstance(plant, RelativeModesSpec):
        made = _modes_without(plant, known_hz, highest_hz)
    elif isinstance(plant, PairsSpec):
        made = _pairs_without(plant, known_hz, highest_hz)
    return cast(P, made)


def _of_known(f_hz: float, known_hz: float | None) -> bool:
    return known_hz is not None and _apart(f_hz, known_hz) < np.log(_UNLIKE)


def _modes_without(
    plant: RelativeModesSpec, known_hz: float | None, highest_hz: float
) -> RelativeModesSpec:
    strongest = max(plant.modes, key=lambda m: abs(m.share) / m.zeta)
    most_hz = min(highest_hz, _BELOW * strongest.f_hz)
    kept = [
        m
        for m in plant.modes
        if abs(m.share) > _SHARE or m.f_hz > most_hz or _of_known(m.f_hz, known_hz)
    ]
    total = sum(m.share for m in kept)
    return RelativeModesSpec(
        modes=tuple(m.model_copy(update={"share": m.share / total}) for m in kept)
    )


def _pairs_without(plant: PairsSpec, known_hz: float | None, highest_hz: float) -> PairsSpec:
    poles, zeros = list(plant.poles), list(plant.zeros)
    if len(poles) < 2:
        return plant
    peaks = np.abs(frequency_response(plant, [p.f_hz for p in poles]))
    most_hz = min(highest_hz, _BELOW * poles[int(np.argmax(peaks))].f_hz)
    for pole in plant.poles:
        if pole.f_hz > most_hz or _of_known(pole.f_hz, known_hz):
            continue
        beside = [z for z in zeros if abs(z.zeta) < 1 and _apart(z.f_hz, pole.f_hz) < _BESIDE]
        if beside:
            poles.remove(pole)
            zeros.remove(min(beside, key=lambda z: _apart(z.f_hz, pole.f_hz)))
    return plant.model_copy(update={"poles": tuple(poles), "zeros": tuple(zeros)})


def _apart(one_hz: float, other_hz: float) -> float:
    return float(abs(np.log(one_hz / other_hz)))
