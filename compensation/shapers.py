"""Input shapers as the firmware defines them, as a reference and as compensators.

A shaper replaces the command by a weighted sum of delayed copies of itself; the weights and
delays make the vibrations of the copies cancel.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from stillpath.compensation._shaper_kernels import add_delayed
from stillpath.compensation.base import DesignError, Memoryless
from stillpath.compensation.rests import stand_still
from stillpath.models import shaper_pulses as firmware
from stillpath.models.arrays import Array
from stillpath.models.errors import ModelError
from stillpath.models.machine import Machine
from stillpath.models.plants import plant_set
from stillpath.models.shaper_pulses import SHAPERS, Pulses

__all__ = ["SHAPERS", "ShaperCompensator", "shape", "shape_xy", "shaper_pulses"]


def shaper_pulses(name: str, f_hz: float, zeta: float = 0.1) -> Pulses:
    """Return `models.shaper_pulses.shaper_pulses`; raise DesignError for a bad shaper."""
    try:
        return firmware.shaper_pulses(name, f_hz, zeta)
    except ModelError as error:
        raise DesignError(str(error)) from None


def shape(
    command_mm: Array,
    dt_s: float,
    pulses: Pulses,
    *,
    centred: bool = True,
    out: Array | None = None,
) -> Array:
    """Apply a shaper to a command that is linear between its samples.

    Parameters
    ----------
    command_mm : ndarray, shape (..., n)
        At rest before its first and after its last sample.
    pulses : (weights, delays_s)
        As `shaper_pulses` returns them.
    centred : bool
        Advance by the mean delay (as Klipper does), so that slow motion is not delayed.
    out : ndarray, shape (..., n), optional
        Contiguous output array; default: a new one.

    Returns
    -------
    ndarray, shape (..., n)
        The shaped command at the same instants, exactly.
    """
    weights, delays = pulses
    shift = float(weights @ delays) if centred else 0.0
    late = (delays - shift) / dt_s
    whole = np.floor(late)
    part = late - whole
    # A pulse between two samples is split between them.
    samples = np.stack([whole, whole + 1.0], axis=1).astype(np.int64).ravel()
    gains = (weights[:, None] * np.stack([1.0 - part, part], axis=1)).ravel()
    used = gains != 0.0
    command = np.ascontiguousarray(command_mm, dtype=np.float64)
    out = np.empty_like(command) if out is None else out
    out[...] = 0.0
    n = command.shape[-1]
    if n == 0:
        return out
    for row, shaped in zip(command.reshape(-1, n), out.reshape(-1, n), strict=True):
        add_delayed(row, samples[used], gains[used], shaped)
    return out


def shape_xy(command_mm: Array, dt_s: float, pulses: Sequence[Pulses]) -> Array:
    """Apply the shapers of X and Y to a command (2, n); see `shape`."""
    return np.stack([shape(row, dt_s, own) for row, own in zip(command_mm, pulses, strict=True)])


class ShaperCompensator(Memoryless):
    """A firmware shaper applied to the plan, so that any firmware can use it.

    Parameters
    ----------
    fx_hz, fy_hz : float, optional
        Default: the resonance of the nominal plant that rings most.
    """

    def __init__(
        self,
        machine: Machine,
        dt_s: float,
        *,
        shaper: str = "mzv",
        fx_hz: float | None = None,
        fy_hz: float | None = None,
        zeta: float = 0.1,
    ) -> None:
        self.name = f"shaper:{shaper}"
        self._dt_s = dt_s
        chosen = [
            dominant_frequency(machine, axis, dt_s) if f_hz is None else f_hz
            for axis, f_hz in (("x", fx_hz), ("y", fy_hz))
        ]
        self.frequencies_hz = (chosen[0], chosen[1])
        self.pulses = [shaper_pulses(shaper, f_hz, zeta) for f_hz in chosen]
        self._blend = max(2, round(0.03 / dt_s))
        # Centred: half of the pulses come before the plan, half of them after it.
        self.lead_s = max(float(weights @ delays) for weights, delays in self.pulses)
        self.tail_s = max(float(delays[-1] - weights @ delays) for weights, delays in self.pulses)

    def compensate(
        self,
        y_d_mm: Array,
        extruding: NDArray[np.bool_],  # noqa: ARG002
        rests: NDArray[np.int64],
    ) -> Array:
        """See `compensation.base.Compensator.compensate`."""
        shaped = shape_xy(y_d_mm, self._dt_s, self.pulses)
        return stand_still(shaped, y_d_mm, rests, self._blend)


def dominant_frequency(machine: Machine, axis: str, dt_s: float) -> float:
    """Return the frequency [Hz] where the nominal plant of an axis rings most.

    The peak of |G|^2 f between 5 and 200 Hz, refined to the mode nearest to it: vibration
    energy per octave, so that a low resonance does not hide a higher one that rings as much.
    """
    plant = plant_set(machine.axes["x" if axis == "x" else "y"], dt_s).nominal
    f = np.geomspace(5.0, min(200.0, 0.4 / dt_s), 400)
    peak = float(f[np.argmax(np.abs(plant.frequency_response(f)) ** 2 * f)])
    modes = plant.modes()
    if len(modes) == 0:
        return peak
    nearest = float(modes[np.argmin(np.abs(np.log(modes[:, 0] / peak))), 0])
    return nearest if abs(nearest / peak - 1) < 0.2 else peak
