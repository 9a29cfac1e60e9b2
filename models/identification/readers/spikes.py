"""Readings that a sensor's cable garbled: single samples far from those before and behind."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d

from stillpath.models.arrays import Array
from stillpath.models.errors import ModelError

__all__ = ["sound_samples"]

_BLOCK_S = 0.25
_USUAL, _TIMES, _LEAST_MM_S2 = 95.0, 5.0, 1000.0
"""A spike stands out by so many times what this percentile of the samples around it does, and by
at least so much: less is lost in the noise of sensors."""
_PASSES = 3
"""Of two or three garbled samples side by side, one may hide another."""
_MOST = 0.02
"""Share of the samples that a log can do without: the transforms see no difference."""


def sound_samples(
    time_s: Array, accel_mm_s2: Array, source: str
) -> tuple[NDArray[np.intp], tuple[str, ...]]:
    """Return the positions of the samples that are no spikes, and a note on those that are.

    No machine moves so: what shakes it shakes the samples beside too, and what steps stays. Logs
    of Klipper have them where interference reaches the sensor's cable: of an ADXL345 it checks
    the sign bits alone (src/sensor_adxl345.c, 2026-08), of other sensors nothing.

    Parameters
    ----------
    time_s : ndarray, shape (n,)
    accel_mm_s2 : ndarray, shape (n, 3)
    source : str
        For the message.

    Raises
    ------
    ModelError
        If more than 2 % of the samples are spikes.
    """
    count = len(time_s)
    block = max(1, round(_BLOCK_S * count / float(time_s[-1] - time_s[0])))
    is_sound = np.ones(count, np.bool_)
    for values in accel_mm_s2.T:
        is_sound &= _sound(values, block)
    sound = np.flatnonzero(is_sound)
    lost = count - len(sound)
    if lost == 0:
        return sound, ()
    text = f"{lost} samples ({lost / count:.2%}) are spikes: far from those before and behind"
    if lost > _MOST * count:
        raise ModelError(
            f"{source}: {text}, at most {_MOST:.0%} may be; the sensor's cable is loose, too long "
            "or beside a motor's (shield it, or lower the rate of its bus): measure again"
        )
    return sound, (f"{text}, as a bad cable of the sensor makes them; they were left out",)


def _sound(values: Array, block: int) -> NDArray[np.bool_]:
    """Return which of the values, shape (n,), are no spikes."""
    at = np.arange(len(values))
    sound = np.ones(len(values), np.bool_)
    bridged = values
    for _ in range(_PASSES):
        spikes = _spikes(bridged, block)
        if not spikes.any():
            break
        sound &= ~spikes
        bridged = np.interp(at, at[sound], values[sound])
    return sound


def _spikes(values: Array, block: int) -> NDArray[np.bool_]:
    """Return which of the values, shape (n,), stand out from all around.

    From the neighbours, of which a step is near one; and from the cubic through two on either
    side, on which the sharpest peak of a motion is.
    """
    steps = np.diff(values)
    rises, falls = steps[:-1], -steps[1:]
    above = np.where(rises * falls > 0.0, np.minimum(np.abs(rises), np.abs(falls)), 0.0)
    beside, beyond = values[1:-3] + values[3:-1], values[:-4] + values[4:]
    heights = np.zeros(len(values))
    heights[2:-2] = np.minimum(above[1:-1], np.abs(values[2:-2] - (4.0 * beside - beyond) / 6.0))
    parts = np.array_split(heights, max(1, len(heights) // block))
    usual = np.repeat([np.percentile(part, _USUAL) for part in parts], [len(p) for p in parts])
    # Beside a spike, peaks of a motion look like some, too: the highest of five goes first.
    highest = heights >= maximum_filter1d(heights, 5)
    return highest & (heights > np.maximum(_LEAST_MM_S2, _TIMES * usual))
