"""The plant set of an axis of which only one typed-in resonance is known.

A ringing print or a tuned shaper gives the strongest resonance of an axis, but not its other modes,
which matter as much. On virtual printers, commands designed for that one mode print worse than the
plain shaper at its frequency (docs/tried.md).
"""

from __future__ import annotations

import numpy as np

from stillpath.models.plants import (
    ModesSpec,
    PlantSetSpec,
    RelativeMode,
    RelativeModesSpec,
    WeightedMember,
)
from stillpath.models.provenance import Provenance

__all__ = ["stated_hz", "typed_in"]

_OTHERS, _SEED = 14, 7
_F_SPREAD, _ZETA_SPREAD, _SHARE_SPREAD = 0.12, 0.4, 0.35
"""Standard deviations of the logarithm of frequency and damping, and of the share.

Set such that the errors of virtual printers (seeds 0 to 2) lie in the range of the members.
"""
_SHARES = (0.4, 1.6)
_SECOND, _SECOND_ZETA = (1.3, 3.5), 0.06
"""Range of the other mode's frequency, in frequencies of the stated one, and its damping."""


def typed_in(f_hz: float, zeta: float) -> PlantSetSpec:
    """Return an axis of one resonance, with members typical of axes that ring there.

    Parameters
    ----------
    f_hz, zeta : float
        Where it rings most, and the damping ratio.
    """
    rng = np.random.default_rng(_SEED)
    alone = RelativeModesSpec(modes=(RelativeMode(f_hz=f_hz, zeta=zeta, share=1.0),))
    members = [alone]
    for _ in range(_OTHERS):
        main_hz, other_zeta = (
            f_hz * _spread(rng, _F_SPREAD),
            _SECOND_ZETA * _spread(rng, _ZETA_SPREAD),
        )
        share = float(np.clip(1.0 + _SHARE_SPREAD * rng.standard_normal(), *_SHARES))
        other_hz = f_hz * float(np.exp(rng.uniform(*np.log(_SECOND))))
        main = RelativeMode(f_hz=main_hz, zeta=zeta * _spread(rng, _ZETA_SPREAD), share=share)
        other = RelativeMode(f_hz=other_hz, zeta=other_zeta, share=1.0 - share)
        members.append(RelativeModesSpec(modes=(main, other)))
    return PlantSetSpec(
        nominal=alone,
        members=tuple(WeightedMember(plant=plant) for plant in members),
        provenance=Provenance(kind="typed in"),
    )


def _spread(rng: np.random.Generator, sd: float) -> float:
    return float(np.exp(sd * rng.standard_normal()))


def stated_hz(axis: PlantSetSpec) -> float | None:
    """Return the resonance of an axis with only a typed-in one; None for a measured axis."""
    about, plant = axis.provenance, axis.nominal
    if about is None or about.kind != "typed in":
        return None
    if isinstance(plant, ModesSpec | RelativeModesSpec) and len(plant.modes) == 1:
        return plant.modes[0].f_hz
    return None
