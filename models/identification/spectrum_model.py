"""The spectrum that Klipper would record for a plant: drive, plant, window, noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stillpath.models.arrays import Array
from stillpath.models.errors import ModelError
from stillpath.models.identification.excitation import (
    drive_spectrum,
    drive_spectrum_regenerated,
    welch_kernel,
)
from stillpath.models.identification.modal_structure import ModalStructure
from stillpath.models.identification.readers.table_range import first_band_hz, start_of_test
from stillpath.models.identification.types import Excitation, Spectrum

__all__ = [
    "SpectrumModel",
    "cross_axis_share",
    "driven_column",
    "moved_most",
    "spectrum_model",
]

_LOWEST_HZ = 8.0
_BELOW_END_HZ = 3.0
_PLATEAU_HZ = (8.0, 15.0)
_CLEAR = 0.8
"""Share of the power of the sensor's axes that the driven one has there, if it is not drowned by
noise: less in 17 of 178 real tables (2026-11-30), most of them of sensors that garble samples. In
three, another axis than the driven one had most noise."""
_USUAL_BIN_HZ = 1.5625
_REACH_HZ = 12.0
"""How far the window is followed; its side lobes there are below 1e-6."""
_FINER = 7
"""Points of the plant's grid per bin."""
_LEAST_BINS = 30
_SAMPLES = 512


@dataclass(frozen=True, slots=True, eq=False)
class SpectrumModel:
    """S(f) = gain^2 sum_nu kernel(f, nu) |G(nu)|^2 + noise.

    Attributes
    ----------
    f_hz, log_psd : ndarray, shape (bins,)
        What is fitted.
    kernel : ndarray, shape (bins, fine)
        Window times drive.
    fine_hz : ndarray, shape (fine,)
    """

    f_hz: Array
    log_psd: Array
    kernel: Array
    fine_hz: Array

    @property
    def band_hz(self) -> tuple[float, float]:
        """Lowest and highest frequency that is fitted."""
        return float(self.f_hz[0]), float(self.f_hz[-1])

    def log_spectrum(self, structure: ModalStructure, vector: Array) -> Array:
        """Return log S, shape (bins,), for the parameters [log gain, log noise, modes ...]."""
        return self.log_spectrum_and_gradient(structure, vector)[0]

    def log_spectrum_and_gradient(
        self, structure: ModalStructure, vector: Array
    ) -> tuple[Array, Array]:
        """Return log S, shape (bins,), and its derivatives, shape (bins, len(vector))."""
        response, slopes = structure.response_and_gradient(vector[2:], self.fine_hz)
        power = np.column_stack(
            [np.abs(response) ** 2, 2 * (response.conj()[:, None] * slopes).real]
        )
        signal = np.exp(2 * vector[0]) * (self.kernel @ power)
        noise = float(np.exp(vector[1]))
        total = signal[:, 0] + noise
        rows = np.column_stack([2 * signal[:, 0], np.full(len(total), noise), signal[:, 1:]])
        return np.log(total), np.asarray(rows / total[:, None])

    @property
    def log_drive(self) -> Array:
        """Logarithm of S for an ideal plant (G = 1) without noise."""
        return np.asarray(np.log(self.kernel.sum(axis=1)))

    def gain_of_plateau(self) -> float:
        """Return the gain that makes the drive alone explain the spectrum below 15 Hz."""
        low = self.f_hz <= max(_PLATEAU_HZ[1], float(self.f_hz[4]))
        return float(np.exp(0.5 * np.median((self.log_psd - self.log_drive)[low])))


def spectrum_model(spectrum: Spectrum, column: str, excitation: Excitation) -> SpectrumModel:
    """Return the model for the bins from 8 Hz to 3 Hz below the end of the test.

    Raises
    ------
    ModelError
        If the column is missing or dead, or too few bins are left.
    """
    f, bin_hz = _bins(spectrum.f_hz)
    source = spectrum.source or "spectrum"
    if column not in spectrum.psd:
        raise ModelError(
            f"{source}: no column of the sensor's axis {column!r}, only "
            f"{', '.join(spectrum.psd)}; give another sensor_axis"
        )
    psd = spectrum.psd[column]
    use = (f >= _LOWEST_HZ) & (f <= excitation.f_end_hz - _BELOW_END_HZ)
    use &= f >= excitation.f_start_hz + bin_hz
    # Klipper interpolates tables of several data sets every 0.2 Hz: no more is known than by bin.
    apart = max(1, round(bin_hz / float(np.median(np.diff(f)))))
    use &= np.arange(len(f)) % apart == 0
    if use.sum() < _LEAST_BINS:
        raise ModelError(
            f"{source}: {int(use.sum())} bins between {_LOWEST_HZ:g} Hz and the end of the test "
            f"at {excitation.f_end_hz:g} Hz, at least {_LEAST_BINS} are needed; check max_freq, "
            "or measure again"
        )
    if not np.all(np.isfinite(psd[use])) or np.count_nonzero(psd[use] > 0) < use.sum():
        raise ModelError(
            f"{source}: column {column!r} is zero or no number within {f[use][0]:.1f} to "
            f"{f[use][-1]:.1f} Hz (dead sensor axis?); name another column or measure again"
        )
    fine = np.arange(
        max(f[use][0] - _REACH_HZ, excitation.f_start_hz), f[use][-1] + _REACH_HZ, bin_hz / _FINER
    )
    window = _window(f[use], fine, bin_hz)
    kernel = window * drive_spectrum(excitation, fine)
    if excitation.sweeping_accel_mm_s2 > 0:
        # The slow square wave adds power at low frequency, where the plant is still flat.
        seen = drive_spectrum_regenerated(excitation, f[use])
        kernel *= (seen / kernel.sum(axis=1))[:, None]
    return SpectrumModel(f[use], np.log(psd[use]), kernel, fine)


def driven_column(spectrum: Spectrum, f_start_hz: float = 0.0) -> str:
    """Return the column that follows the drive: the largest from 8 to 15 Hz.

    Not always the tested axis: sensors are mounted turned. Of a test that begins higher
    (`f_start_hz`), the largest in its first 7 Hz: below there is only noise. Where a sensor's axes
    hardly differ there, noise drowns the test, which is weakest at its beginning: then the largest
    of the whole test.
    """
    names = [name for name in spectrum.psd if name != "xyz"] or list(spectrum.psd)
    low_hz = max(_PLATEAU_HZ[0], f_start_hz)
    high_hz = max(_PLATEAU_HZ[1], low_hz + _PLATEAU_HZ[1] - _PLATEAU_HZ[0])

    def power(upper_hz: float) -> dict[str, float]:
        use = (spectrum.f_hz >= low_hz) & (spectrum.f_hz <= upper_hz)
        return {name: float(np.nansum(spectrum.psd[name][use])) for name in names}

    first = power(high_hz)
    drowned = set(names) == {"x", "y", "z"} and max(first.values()) < _CLEAR * sum(first.values())
    of = power(np.inf) if drowned else first
    return max(of, key=of.__getitem__)


def moved_most(spectrum: Spectrum) -> tuple[str, float]:
    """Return the sensor's axis that followed the drive, and its share of the power there.

    Returns
    -------
    (str, float)
        ("", 0.0) where the table does not part the sensor's axes.
    """
    low_hz, high_hz = first_band_hz(start_of_test(spectrum)[0])
    low = (spectrum.f_hz >= low_hz) & (spectrum.f_hz <= high_hz)
    power = {n: float(np.nansum(spectrum.psd[n][low])) for n in "xyz" if n in spectrum.psd}
    total = sum(power.values())
    most = max(power, key=power.__getitem__, default="")
    return (most, power[most] / total) if total > 0.0 else ("", 0.0)


def cross_axis_share(
    spectrum: Spectrum, column: str, band_hz: tuple[float, float]
) -> tuple[float, str]:
    """Return the largest power of another sensor axis as a share of the column's, and its name."""
    inside = (spectrum.f_hz >= band_hz[0]) & (spectrum.f_hz <= band_hz[1])
    power = {name: float(np.nansum(psd[inside])) for name, psd in spectrum.psd.items()}
    others = [(power[name], name) for name in ("x", "y", "z") if name in power and name != column]
    largest, name = max(others, default=(0.0, ""))
    return largest / power[column], name


def _bins(f_hz: Array) -> tuple[Array, float]:
    """Return the frequencies before they were rounded to 0.1 Hz, and the window's bin."""
    index = np.arange(len(f_hz))
    step, start = np.polyfit(index, f_hz, 1)
    exact = start + step * index
    uniform = bool(np.abs(exact - f_hz).max() < 0.11)
    # 0.5 s rounded up to a power of two gives 1 to 2 Hz; else the file was interpolated.
    bin_hz = float(step) if uniform and 0.95 < step < 2.05 else _USUAL_BIN_HZ
    return (exact if uniform else f_hz), bin_hz


def _window(f: Array, fine: Array, bin_hz: float) -> Array:
    """Return Klipper's spectral window as quadrature weights, shape (len(f), len(fine))."""
    offsets = np.arange(0.0, _REACH_HZ + bin_hz, bin_hz / 32)
    shape = welch_kernel(_SAMPLES, _SAMPLES * bin_hz, offsets)
    distance = np.abs(f[:, None] - fine)
    weights = np.interp(distance, offsets, shape, right=0.0) * (fine[1] - fine[0])
    return np.asarray(weights, np.float64)
