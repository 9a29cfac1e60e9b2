"""The uncertainty of a measured spectrum: deviations that a model need not explain.

Two tables of one axis, taken minutes apart, differ by more than counting noise, and differ
smoothly: the level drifts with friction and temperature, a peak moves by a fraction of a hertz,
and where the response is small, other motion dominates the sensor. A fit that explains every such
difference invents modes, and with them phase. Here the errors have a white part, independent by
bin, and a smooth one that neighbouring frequencies share; size and smoothness are unknown, so
several assumptions are used side by side.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from stillpath.models.arrays import Array
from stillpath.models.identification.spectrum_model import SpectrumModel

__all__ = ["SCATTERS", "Scatter"]

_DB = 10 / np.log(10)
_DRIFT = 3.0
_CROWDED_HZ, _LEAST = 25.0, 0.6
"""From this frequency on a table shows more modes than are fitted, and bins are off by as much.
Below, the error falls with frequency, to this share at least: neighbouring bins of 45 real tables
lie within 0.1 dB of a smooth curve there. How |G| rises there is how far slow motion is moved, so
a fit that may miss it by half a decibel says little of that."""


@dataclass(frozen=True, slots=True)
class Scatter:
    """Standard deviations of the errors of a spectrum.

    Attributes
    ----------
    white_db : float
        Of every bin by itself; less below 25 Hz.
    smooth_db, octaves : float
        Of the part that neighbours share, and over how much of the scale.
    shift_hz : float
        Of a peak's place: where |G| is steep, bins are off by that times the slope.
    floor : float
        |G| below which other motion is seen instead.
    """

    white_db: float = 0.5
    smooth_db: float = 0.15
    octaves: float = 0.7
    shift_hz: float = 0.4
    floor: float = 0.03

    def covariance(self, model: SpectrumModel) -> Array:
        """Return the covariance of the errors of log S, shape (bins, bins)."""
        log_power = model.log_psd - model.log_drive
        size = np.exp(0.5 * log_power) / model.gain_of_plateau()
        slope = np.gradient(log_power, model.f_hz)
        alone_db = self.white_db * np.clip(model.f_hz / _CROWDED_HZ, _LEAST, 1.0)
        white = (alone_db / _DB) ** 2 + (slope * self.shift_hz) ** 2
        white = white + (2.0 * self.floor / size) ** 2
        apart = np.subtract.outer(np.log2(model.f_hz), np.log2(model.f_hz)) / self.octaves
        smooth = (self.smooth_db / _DB) ** 2 * np.exp(-0.5 * apart**2)
        return np.asarray(np.diag(white) + smooth)

    def drifted(self) -> Scatter:
        """Return what tables of one axis differ by over weeks: the machine changed meanwhile."""
        return replace(self, smooth_db=_DRIFT * self.smooth_db)


SCATTERS = (
    Scatter(),
    Scatter(octaves=0.35),
    Scatter(smooth_db=0.225),
    Scatter(white_db=0.7, smooth_db=0.225, octaves=0.35, floor=0.01),
)
"""Repeats within a session differ by .3 to .5 dB bin by bin; tables of one axis weeks apart by .5
to 1 dB over an octave (45 real tables), because the machine changed meanwhile. A fit counts the
former as a table's error. The latter is in the models that are drawn around it: as an error of one
table it lets fits miss the level at low frequency, and with it all of |G| (`docs/tried.md`)."""
