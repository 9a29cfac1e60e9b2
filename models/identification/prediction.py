"""The recording of a resonance test as a model predicts it."""

from __future__ import annotations

import numpy as np

from stillpath.models.arrays import Array
from stillpath.models.identification.excitation import drive_spectrum
from stillpath.models.identification.spectrum_model import spectrum_model
from stillpath.models.identification.types import Excitation, Fit, Spectrum
from stillpath.models.plants import PlantSpec, frequency_response

__all__ = ["predicted_psd", "predicted_spectrum"]

_BIN_HZ = 1.5625
_F_MAX_HZ = 200.0


def predicted_psd(
    spectrum: Spectrum, column: str, excitation: Excitation, fit: Fit
) -> tuple[Array, Array, Array]:
    """Return frequencies, the measured and the predicted spectrum, without noise, of a column.

    Shapes (n,); densities in (mm/s^2)^2/Hz.

    Raises
    ------
    ModelError
        If the column cannot be used.
    """
    model = spectrum_model(spectrum, column, excitation)
    power = np.abs(frequency_response(fit.spec, model.fine_hz)) ** 2
    predicted = fit.gain**2 * (model.kernel @ power)
    return model.f_hz, np.exp(model.log_psd), np.asarray(predicted, np.float64)


def predicted_spectrum(plant: PlantSpec, excitation: Excitation) -> tuple[Array, Array]:
    """Return frequencies up to 200 Hz and the density that the test would show.

    Shapes (n,); the density in (mm/s^2)^2/Hz.
    """
    f = np.arange(_BIN_HZ, _F_MAX_HZ, _BIN_HZ)
    power = np.abs(frequency_response(plant, f)) ** 2
    return f, np.asarray(drive_spectrum(excitation, f) * power, np.float64)
