"""Errors of a scanner along and across every hatch line."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillpath.models.arrays import Array

__all__ = ["TrackErrors", "track_errors"]


@dataclass(frozen=True, slots=True, eq=False)
class TrackErrors:
    """Errors of every track, each of shape (tracks,), in the unit they were given in.

    Attributes
    ----------
    rms, largest : ndarray
        Of the distance to where the beam should be at that time.
    across : ndarray
        rms of its component across the track, independent of timing.
    total_rms, total_largest, total_across : float
        Over all samples of all tracks.
    """

    rms: Array
    largest: Array
    across: Array
    total_rms: float
    total_largest: float
    total_across: float


def track_errors(wanted: Array, actual: Array, track: NDArray[np.int64]) -> TrackErrors:
    """Return the errors of every track.

    Parameters
    ----------
    wanted, actual : ndarray, shape (2, n)
        Positions at the same times.
    track : ndarray of int64, shape (n,)
        Numbers from 0 on; -1 where nothing is drawn. Every number has samples.

    Raises
    ------
    ValueError
        If nothing is drawn.
    """
    drawn = track >= 0
    if not drawn.any():
        raise ValueError("no sample lies on a track")
    number = track[drawn]
    error = (actual - wanted)[:, drawn]
    ahead = np.gradient(wanted, axis=1)[:, drawn]
    length = np.hypot(*ahead)
    along = np.divide(ahead, length, out=np.zeros_like(ahead), where=length > 0)
    across = along[0] * error[1] - along[1] * error[0]
    square = np.sum(error**2, axis=0)
    count = np.bincount(number)
    largest = np.zeros(len(count))
    np.maximum.at(largest, number, np.sqrt(square))
    return TrackErrors(
        np.sqrt(np.bincount(number, square) / count),
        largest,
        np.sqrt(np.bincount(number, across**2) / count),
        float(np.sqrt(square.mean())),
        float(largest.max()),
        float(np.sqrt(np.mean(across**2))),
    )
