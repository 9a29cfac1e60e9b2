"""Measurements, how they were excited, and the results of fits."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from stillpath.models.arrays import Array
from stillpath.models.plants import PlantSetSpec, PlantSpec
from stillpath.models.schedule import AxisSchedule

__all__ = [
    "LEAST_COHERENCE",
    "UNSEEN_ZETA",
    "AccelerationLog",
    "Axis",
    "AxisIdentification",
    "DrivenLog",
    "Excitation",
    "Fit",
    "FrequencyResponse",
    "Measurement",
    "ModeEstimate",
    "OrderTrial",
    "PlantModel",
    "Spectrum",
    "StopsLog",
]

Axis: TypeAlias = Literal["x", "y"]

LEAST_COHERENCE = 0.95
"""From here on a frequency counts as coherent: what was measured there follows the command."""
UNSEEN_ZETA = 0.03
"""Least damping of a mode beyond the band, of which only the flank was measured: it hardly shows
the damping, and the mode must not ring by chance."""


@dataclass(frozen=True, slots=True)
class Excitation:
    """Klipper's resonance test (klippy/extras/resonance_tester.py, 2026-08).

    A square wave of acceleration accel_per_hz_mm_s * f whose frequency f rises by hz_per_s; newer
    versions add a slow square wave (`sweeping_*`), and begin a quarter of a period later in it.

    Attributes
    ----------
    direction : tuple of float
        Unit vector of the tested axis, (x, y).
    sweeping_accel_mm_s2 : float
        0: no slow square wave.
    out_and_back : bool
        Every pulse leads out from the start of the test and back to it, as before 2024-12.
    """

    direction: tuple[float, float]
    f_start_hz: float = 5.0
    f_end_hz: float = 135.0
    accel_per_hz_mm_s: float = 60.0
    hz_per_s: float = 1.0
    sweeping_accel_mm_s2: float = 400.0
    sweeping_period_s: float = 1.2
    out_and_back: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class AccelerationLog:
    """Raw accelerations, gravity included.

    Attributes
    ----------
    time_s : ndarray, shape (n,)
        Rising, nearly uniform.
    accel_mm_s2 : ndarray, shape (n, 3)
        Columns of the sensor's x, y, z; NaN columns were not recorded.
    axis : str, optional
        Tested axis as the file says: "x", "y", or a direction like "1.000,1.000".
    source : str
        The file's name, for messages.
    may_hold_test : bool
        Whether a resonance test may have made it: RepRapFirmware has none, and logs other motion.
    """

    time_s: Array
    accel_mm_s2: Array
    axis: str | None = None
    source: str = ""
    notes: tuple[str, ...] = ()
    may_hold_test: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class DrivenLog:
    """A command and what followed, sampled together (swept sine, step, anything).

    Attributes
    ----------
    time_s, command, measured : ndarray, shape (n,)
        In any unit, the same for both, so that the response at low frequency is 1.
    """

    time_s: Array
    command: Array
    measured: Array
    axis: str | None = None
    source: str = ""
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class StopsLog:
    """Sudden stops of one axis as they were planned, and the acceleration that followed.

    Attributes
    ----------
    command_mm : ndarray, shape (n,)
        Planned positions, before dry friction.
    measured_mm_s2 : ndarray, shape (n,)
        Along the axis, on the time of the plan up to a millisecond or so.
    parts : tuple of (int, int)
        First sample and end of each part that was measured; it begins and ends at rest.
    """

    rate_hz: float
    command_mm: Array
    measured_mm_s2: Array
    parts: tuple[tuple[int, int], ...]
    axis: str | None = None
    source: str = ""
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Spectrum:
    """Power spectral densities of acceleration, one-sided, as Klipper's Welch makes them.

    Attributes
    ----------
    f_hz : ndarray, shape (n,)
    psd : dict of str to ndarray, shape (n,)
        By column ("x", "y", "z", "xyz", or a data set's name), (mm/s^2)^2/Hz; Klipper's
        normalisation of calibration_data files is undone.
    """

    f_hz: Array
    psd: dict[str, Array]
    axis: str | None = None
    source: str = ""
    accel_per_hz_mm_s: float | None = None
    """If the file says (Kalico), or the log that it was made of."""
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class FrequencyResponse:
    """Measured G(f), commanded to actual position (or acceleration, which is the same).

    Attributes
    ----------
    f_hz : ndarray, shape (n,)
    response : ndarray of complex128, shape (n,)
        Not normalised: gain and delay of the sensor are still in it.
    sd : ndarray, shape (n,)
        Standard deviation of `response` (of its modulus's error); NaN where unknown.
    coherence : ndarray, shape (n,)
        1: all of the output follows the command; NaN where unknown.
    label : str
        What distinguishes it from others of the axis: amplitude, position, run.
    sensor_direction : tuple of float, optional
        Of the tested axis in the axes of the sensor, if that was found.
    """

    f_hz: Array
    response: NDArray[np.complex128]
    sd: Array
    coherence: Array
    axis: str | None = None
    label: str = ""
    source: str = ""
    notes: tuple[str, ...] = ()
    sensor_direction: tuple[float, ...] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class PlantModel:
    """A model that somebody else fitted, as read from a file."""

    spec: PlantSpec
    axis: str | None = None
    source: str = ""
    notes: tuple[str, ...] = ()


Measurement: TypeAlias = (
    AccelerationLog | StopsLog | DrivenLog | Spectrum | FrequencyResponse | PlantModel
)


@dataclass(frozen=True, slots=True)
class ModeEstimate:
    """A resonance with standard deviations; `peak` is |G| there."""

    f_hz: float
    zeta: float
    f_sd_hz: float
    zeta_sd: float
    peak: float


@dataclass(frozen=True, slots=True)
class OrderTrial:
    """What n pole pairs reached: NRMSE of a response (0.01 is 1 %), rms dB of a spectrum."""

    order: int
    residual: float


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A model of one measurement: stable, DC gain 1.

    Attributes
    ----------
    gain, delay_s : float
        Set aside; measured = gain * exp(-2 pi j f delay_s) * model.
    band_hz : tuple of float
        Frequencies that were fitted.
    trust_below_hz : float, optional
        Above, the model may be far off although it fits.
    warnings : tuple of str
        What the user should look at.
    """

    spec: PlantSpec
    residual: float
    gain: float
    delay_s: float
    band_hz: tuple[float, float]
    modes: tuple[ModeEstimate, ...]
    trials: tuple[OrderTrial, ...] = ()
    magnitude_only: bool = False
    trust_below_hz: float | None = None
    warnings: tuple[str, ...] = ()

    @property
    def order(self) -> int:
        """Number of resonances."""
        return len(self.modes)


@dataclass(frozen=True, slots=True, eq=False)
class AxisIdentification:
    """One axis: its plants and everything that a page shows of how they were found.

    Attributes
    ----------
    plants : PlantSetSpec
        Nominal, members, band and provenance.
    fit : Fit or None
        Of the nominal plant; None for a model that was read.
    measured : tuple
        FrequencyResponse or Spectrum, one per measurement.
    schedule : AxisSchedule, optional
        If the axis was measured with a weight on the bed, or at several places.
    warnings, notes : tuple of str
        What the user should look at, and what was assumed or set aside.
    """

    axis: str
    plants: PlantSetSpec
    fit: Fit | None = None
    measured: tuple[FrequencyResponse | Spectrum, ...] = ()
    member_fits: tuple[Fit, ...] = ()
    schedule: AxisSchedule | None = None
    warnings: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
