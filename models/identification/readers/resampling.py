"""A model at another sampling time, with the error of the change."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stillpath.models.errors import ModelError
from stillpath.models.identification.readers.state_spaces import zeros_poles_gain
from stillpath.models.plants import PlantSpec, ZpkSpec, discretise, frequency_response

__all__ = ["resampled"]


def resampled(
    spec: PlantSpec, dt_s: float, band_hz: float | None = None
) -> tuple[PlantSpec, float]:
    """Return the plant at the sampling time `dt_s`, and by how much its response changed.

    By first-order hold: a continuous plant directly, a discrete one by way of the continuous
    plant whose first-order-hold equivalent it is.

    Parameters
    ----------
    spec : PlantSpec
    dt_s : float
    band_hz : float, optional
        The error counts up to here; default (and limit): the lower of the Nyquist frequencies.

    Returns
    -------
    spec : PlantSpec
        The same one if it has this sampling time.
    error : float
        Largest |difference of the responses| as a share of the peak, 0.01 is 1 %.

    Raises
    ------
    ModelError
        If a discrete plant has no continuous one (a pure delay, a pole on the negative real
        axis), or the result is not usable.
    """
    own = spec.sampling_s
    if own is not None and abs(own - dt_s) <= 1e-9 * dt_s:
        return spec, 0.0
    plant = discretise(spec, dt_s)
    zeros, poles, _ = zeros_poles_gain(plant.a, plant.b, plant.c, plant.d, dt_s)
    changed = ZpkSpec(zeros=_pairs(zeros), poles=_pairs(poles), dt_s=dt_s)
    limit_hz = 0.5 / max(dt_s, own or 0.0)
    if band_hz is not None and band_hz <= 0:
        raise ModelError(f"band_hz {band_hz} must be positive")
    f_hz = np.linspace(0.0, min(limit_hz, band_hz or limit_hz), 2001)
    before, after = frequency_response(spec, f_hz), frequency_response(changed, f_hz)
    return changed, float(np.abs(after - before).max() / np.abs(before).max())


def _pairs(roots: NDArray[np.complex128]) -> tuple[tuple[float, float], ...]:
    return tuple((float(r.real), float(r.imag)) for r in roots)
