"""Remove the delay of slow motion, which a recording without a common clock cannot show."""

from __future__ import annotations

import numpy as np

from stillpath.models.identification.sanathanan_koerner import pairs_of
from stillpath.models.identification.types import Fit
from stillpath.models.plants import PairsSpec, PlantSpec, PolePair, RelativeModesSpec, ZeroPair

__all__ = ["advanced", "delay_of", "delayed", "prompt"]

_MOST_ZETA = 10.0
"""Largest damping ratio of a pair of real zeros: beyond, one of them lies decades away."""


def prompt(fit: Fit) -> PlantSpec:
    """Return the plant of a fit without its delay of slow motion.

    The start of a recording is unknown: the fit can only guess how its delay at low frequency
    divides between plant and clock. The measured phases of resonances relative to slow motion are
    kept. A plant without measured phase is returned unchanged.
    """
    return fit.spec if fit.magnitude_only else advanced(fit.spec)


def advanced(plant: PlantSpec) -> PlantSpec:
    """Return the plant advanced by its delay of slow motion."""
    if isinstance(plant, RelativeModesSpec) and plant.delay_s != 0.0:
        plant = _as_pairs(plant) or plant.without_delay()
    return plant.without_delay() if isinstance(plant, PairsSpec) else plant


def delayed(plant: PlantSpec, delay_s: float) -> PlantSpec:
    """Return a plant without delay whose slow motion is late, as guides that damp it make it.

    At most all of the damping acts against the guides; other structures are returned unchanged.
    """
    if isinstance(plant, PairsSpec):
        most_s = sum(pole.zeta / (np.pi * pole.f_hz) for pole in plant.poles)
        tau_s = plant.real_zero_tau_s - min(delay_s, most_s)
        return plant.model_copy(update={"real_zero_tau_s": float(tau_s)})
    if isinstance(plant, RelativeModesSpec):
        most = [mode.model_copy(update={"grounded": 1.0}) for mode in plant.modes]
        most_s = RelativeModesSpec(modes=tuple(most)).delay_s
        grounded = min(1.0, delay_s / most_s) if most_s > 0.0 else 0.0
        return RelativeModesSpec(
            modes=tuple(m.model_copy(update={"grounded": grounded}) for m in plant.modes)
        )
    return plant


def delay_of(plant: PlantSpec) -> float:
    """Return the delay of slow motion [s]: sum of 1/zero minus sum of 1/pole.

    0 for a discrete plant, where the part due to sampling is unknown.
    """
    roots = plant.roots()
    if roots.dt_s is not None:
        return 0.0
    return float(np.real(np.sum(1 / roots.zeros) - np.sum(1 / roots.poles)))


def _as_pairs(plant: RelativeModesSpec) -> PairsSpec | None:
    """Return the same plant by pairs; None if its real zeros are no pair, or one of two scales."""
    zeros = plant.roots().zeros
    if np.any(zeros == 0):
        return None
    size = float(np.exp(np.mean(np.log(np.abs(zeros))))) if len(zeros) else 1.0
    pairs, left = pairs_of(np.atleast_1d(np.real(np.poly(zeros / size)))[::-1])
    if len(left) > 1 or np.any(np.abs(pairs[:, 1]) > _MOST_ZETA):
        return None
    return PairsSpec(
        poles=tuple(PolePair(f_hz=m.f_hz, zeta=m.zeta) for m in plant.modes),
        zeros=tuple(
            ZeroPair(f_hz=float(w * size / (2 * np.pi)), zeta=float(zeta)) for w, zeta in pairs
        ),
        real_zero_tau_s=float(left[0] / size) if len(left) else 0.0,
    )
