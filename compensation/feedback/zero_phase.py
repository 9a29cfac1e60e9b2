"""Command prefilters for closed loops: ZPETC and the zero-phase FIR (paper 002, section IV).

    r = A(1/z) B-(z) / (z^-m B+(1/z) B-(1)^2) y_d,    y / r = z^-m B+ B- / A

`compensation.inversion` inverts the loop's response to its reference; this module adds a low-pass,
delays and a loadable form. The inverse's gain grows to tens of dB: without the low-pass the
quantisation of a reference alone saturates a drive, so `cutoff_hz` should be given.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stillpath.compensation.base import DesignError
from stillpath.compensation.feedback.controller import CoefficientSet, Extreme
from stillpath.compensation.inversion import Inversion, invert
from stillpath.compensation.inverting import zero_phase_fir
from stillpath.models.arrays import Array, Complex
from stillpath.models.loops import Loop
from stillpath.models.plants import DiscretePlant, balanced_discrete

__all__ = ["Prefilter", "design_prefilter", "reference_plant"]

_PREVIEW = 5
_ALTERNATING = 0.95
"""Zeros nearer to -1 are not cancelled (the paper's "at or near -1"): a slow servo that is sampled
fast has one, and metres of command would answer a path of millimetres."""


@dataclass(frozen=True, slots=True, eq=False)
class Prefilter:
    """Turns the desired position into the reference of a loop.

    Attributes
    ----------
    fir : ndarray, shape (2 l + 1,), or None
    """

    inversion: Inversion
    fir: Array | None
    dt_s: float

    @property
    def preview(self) -> int:
        """Samples of the desired position that must be known beforehand."""
        return self.inversion.preview + (0 if self.fir is None else len(self.fir) // 2)

    def apply(self, y_d: Array) -> Array:
        """Return the reference for a completely known desired position, shape (n,)."""
        return self.inversion.apply(y_d, self.fir)

    def response(self, f_hz: Array) -> Complex:
        """Return r / y_d at `f_hz`."""
        value = self.inversion.response(f_hz, self.dt_s)
        if self.fir is not None:
            angle = 2 * np.pi * np.asarray(f_hz, float) * self.dt_s
            half = len(self.fir) // 2
            cosines = np.cos(np.outer(angle, np.arange(1, half + 1)))
            value = value * (self.fir[half] + 2 * cosines @ self.fir[half + 1 :])
        return np.asarray(value)

    @property
    def peak(self) -> Extreme:
        """Largest gain and its frequency."""
        f_hz = np.linspace(0, 0.5 / self.dt_s, 8193)
        gain = np.abs(self.response(f_hz))
        at = int(np.argmax(gain))
        return Extreme(float(gain[at]), float(f_hz[at]))

    @property
    def coefficients(self) -> tuple[CoefficientSet, ...]:
        """Return the coefficients to load: taps, sections and low-pass, in this order."""
        command = self.inversion.command
        parts = [
            CoefficientSet(
                "zpetc", "fir", {"taps": tuple(command.taps.tolist()), "preview": command.preview}
            )
        ]
        if command.sections is not None:
            rows = tuple(tuple(row) for row in command.sections.tolist())
            parts.append(CoefficientSet("inverse", "sos", {"rows": rows}))
        if self.fir is not None:
            parts.append(CoefficientSet("lowpass", "fir", {"taps": tuple(self.fir.tolist())}))
        return tuple(parts)


def design_prefilter(
    loop: Loop,
    *,
    cutoff_hz: float | None = None,
    length: int = _PREVIEW,
) -> Prefilter:
    """Invert the loop's response to its reference, by ZPETC.

    Parameters
    ----------
    cutoff_hz : float, optional
        Of the zero-phase FIR; None: no FIR.
    length : int
        l: the FIR looks l samples ahead.

    Raises
    ------
    DesignError
        If the inverse does not exist, or `length` is below 1.
    """
    if length < 1:
        raise DesignError(f"low-pass that looks {length} samples ahead; at least 1 is needed")
    # A reference has physical units: the inverse must have exact DC gain.
    inversion = invert(
        "zpetc", reference_plant(loop), order=0, alternating_below=_ALTERNATING, unit_dc=True
    )
    fir = None if cutoff_hz is None else zero_phase_fir(cutoff_hz, loop.dt_s, length)
    return Prefilter(inversion, fir, loop.dt_s)


def reference_plant(loop: Loop) -> DiscretePlant:
    """Return the loop from its reference to its output as a plant."""
    error = (loop.error_num, loop.error_den) if loop.fed_back else ((1.0,), (1.0,))
    num = np.convolve(np.convolve(loop.plant_num, loop.rate_den), error[0])
    den = np.asarray(loop.t0_den, float)
    length = max(len(num), len(den))
    top, bottom = (np.pad(p, (0, length - len(p))) / den[0] for p in (num, den))
    # Controller canonical form; loops are strictly proper, so D = 0.
    a = np.eye(length - 1, k=-1)
    a[0] = -bottom[1:]
    b = np.eye(1, length - 1)[0]
    return balanced_discrete(a, b, top[1:], 0.0, loop.notes, loop.dt_s)
