"""Approximate inverses of a plant, with several treatments of zeros that cannot be cancelled.

With the plant in the shift operator q,

    G(q) = G(1) * N(q) * b(q),   b(q) = prod (q - a) / (1 - a) over the uncancellable zeros,

N is inverted exactly, and the five methods differ in the X that approximates 1 / b:

=============  ==========================================  ================================
kind           X                                           F G = b X
=============  ==========================================  ================================
``npz-ignore`` 1                                           b: gain and phase error
``zmetc``      1 / b*,  b* = prod (1 - a q) / (1 - a)      all-pass: phase error alone
``zpetc``      b(1/q)                                      |b|^2: gain error alone
``ebzpetc``    b(1/q) * sum_{k <= n1} (1 - |b|^2)^k        1 - (1 - |b|^2)^(n1 + 1)
``ts``         first n1 terms of the series of 1 / b       1 - (q / a)^n1 for a single zero
=============  ==========================================  ================================

Every method looks ahead by the plant's delay and the order of its X: the filters are non-causal and
need the whole array.

Sources: Tomizuka 1987 (zpetc); Butterworth, Pao, Abramovitch 2012 (npz-ignore, zmetc); Torfs, De
Schutter, Swevers 1992 (ebzpetc); Gross, Tomizuka, Messner 1994 (ts), as reviewed in paper 003,
section 1.2.1, whose equations 2.18, 2.28 and 2.29 are what the tests compare with.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import toeplitz
from scipy.signal import lfilter, sosfilt, zpk2sos

from stillpath.compensation.base import DesignError
from stillpath.models.arrays import Array
from stillpath.models.plants import DiscretePlant

__all__ = ["KINDS", "NEAR_CIRCLE", "Inversion", "TwoSidedFilter", "invert"]

Roots = NDArray[np.complex128]

NEAR_CIRCLE = 5e-4
"""Zeros this near the unit circle count as on it: their inverse would ring for 2000 samples."""


@dataclass(frozen=True, slots=True, eq=False)
class TwoSidedFilter:
    """A linear filter that looks ahead: q^preview * T(1/q) * K(q).

    Attributes
    ----------
    preview : int
        Samples by which the output leads; negative: a delay.
    taps : ndarray, shape (k,)
        T, the coefficients of q^0, q^-1, ...
    sections : ndarray, shape (s, 6), or None
        K, stable second-order sections; None: 1.
    """

    preview: int
    taps: Array
    sections: Array | None = None

    @property
    def dc_gain(self) -> float:
        """Gain at zero frequency."""
        gain = float(np.sum(self.taps))
        if self.sections is not None:
            gain *= float(np.prod(self.sections[:, :3].sum(1) / self.sections[:, 3:].sum(1)))
        return gain

    def response(self, f_hz: ArrayLike, dt_s: float) -> Roots:
        """Return the discrete frequency response at `f_hz`."""
        late = np.exp(-2j * np.pi * np.atleast_1d(np.asarray(f_hz, float)) * dt_s)
        value = np.polynomial.polynomial.polyval(late, self.taps) * late ** (-self.preview)
        for b0, b1, b2, a0, a1, a2 in [] if self.sections is None else self.sections:
            value *= (b0 + b1 * late + b2 * late**2) / (a0 + a1 * late + a2 * late**2)
        return np.asarray(value, np.complex128)

    def impulse_response(self, samples: int) -> Array:
        """Return the response at -(samples - 1) .. samples - 1, shape (2 samples - 1,)."""
        # The time k belongs to the tap number k + preview of T K.
        first, last = self.preview + 1 - samples, self.preview + samples - 1
        out = np.zeros(2 * samples - 1)
        if last < 0:
            return out
        pulse = np.zeros(last + 1)
        used = min(len(self.taps), last + 1)
        pulse[:used] = self.taps[:used]
        if self.sections is not None:
            pulse = sosfilt(self.sections, pulse)
        out[max(-first, 0) :] = pulse[max(first, 0) :]
        return out

    def lifted(self, samples: int) -> Array:
        """Return the matrix, shape (samples, samples), from input to output samples."""
        h = self.impulse_response(samples)
        return np.asarray(toeplitz(h[samples - 1 :], h[samples - 1 :: -1]), np.float64)

    def apply(self, values: Array, fir: Array | None = None) -> Array:
        """Filter an array, shape (n,), that keeps its end values beyond its ends.

        Parameters
        ----------
        values : ndarray, shape (n,)
        fir : ndarray, shape (2 l + 1,), optional
            A symmetric (zero-phase) filter on top.
        """
        if len(values) == 0:
            return np.empty(0)
        half = 0 if fir is None else len(fir) // 2
        taps = self.taps if fir is None else np.convolve(self.taps, fir)
        ahead = self.preview + half
        # Relative to the first value, the past is zero and there is no transient.
        origin = float(values[0])
        padded = np.pad(values - origin, (max(-ahead, 0), max(ahead, 0)), mode="edge")
        out = np.convolve(padded, taps)[: len(padded)]
        if self.sections is not None:
            out = sosfilt(self.sections, out)
        return np.asarray(out[max(ahead, 0) :][: len(values)] + self.dc_gain * origin)


@dataclass(frozen=True, slots=True, eq=False)
class Inversion:
    """One approximate inverse F of a plant G.

    Attributes
    ----------
    kind : str
        A key of `KINDS`.
    order : int
        n1 of ``ebzpetc`` and ``ts``; the others do not use it.
    uncancelled : ndarray of complex
        The zeros that are not inverted.
    command : TwoSidedFilter
        F, from desired position to command.
    overall : TwoSidedFilter
        L = F G, from desired to actual position, without the cancelled roots.
    """

    kind: str
    order: int
    uncancelled: Roots
    command: TwoSidedFilter
    overall: TwoSidedFilter

    @property
    def preview(self) -> int:
        """Samples of the desired position that the command must know beforehand."""
        return max(self.command.preview, 0)

    def apply(self, y_d: Array, fir: Array | None = None) -> Array:
        """Return the command for a desired position, both of shape (n,)."""
        return self.command.apply(y_d, fir)

    def response(self, f_hz: ArrayLike, dt_s: float) -> Roots:
        """Return F(exp(2 pi j f dt))."""
        return self.command.response(f_hz, dt_s)

    def lifted(self, samples: int) -> Array:
        """Return C, shape (samples, samples)."""
        return self.command.lifted(samples)

    def lifted_error(self, samples: int) -> Array:
        """Return E, shape (samples, samples): the matrix of 1 - F G (paper 003, 2.28, 2.29).

        It applies to a desired position that continues beyond the ends: I - G C has a few more rows
        of error at its end, where the preview is missing.
        """
        return np.asarray(np.eye(samples) - self.overall.lifted(samples))

    def error_metric(self, samples: int) -> float:
        """Return J_e = |E|_F / sqrt(samples) (paper 003, 2.18)."""
        left = self.overall.impulse_response(samples)
        left[samples - 1] -= 1.0
        return _toeplitz_norm(left)

    def effort_metric(self, samples: int) -> float:
        """Return J_c = |C|_F / sqrt(samples) (paper 003, section 3.3)."""
        return _toeplitz_norm(self.command.impulse_response(samples))


def invert(
    kind: str,
    plant: DiscretePlant,
    order: int = 5,
    *,
    cancel_below: float = 1.0 - NEAR_CIRCLE,
    alternating_below: float = 1.0,
    unit_dc: bool = False,
) -> Inversion:
    """Design the approximate inverse `kind` of a plant.

    Parameters
    ----------
    kind : str
        A key of `KINDS`.
    order : int
        n1: additional terms of ``ebzpetc`` (0 is ``zpetc``), terms of ``ts``.
    cancel_below : float
        Zeros of smaller modulus are cancelled; 0: none, as in figures 2.3 and 2.4 of paper 003.
    alternating_below : float
        The same for zeros of negative real part: sampling adds them near -1, and their inverse
        alternates from sample to sample.
    unit_dc : bool
        Scale F to reach constant positions exactly, which ``ts`` alone does not do by itself:
        its truncation leaves a^-n1.

    Raises
    ------
    DesignError
        If the method cannot handle the plant or one of its zeros; the message says which and why.
    """
    if kind not in KINDS:
        raise DesignError(f"no inversion is called {kind!r}; there are {', '.join(KINDS)}")
    if order < (1 if kind == "ts" else 0):
        raise DesignError(f"{kind} of order {order}: at least one term is needed")
    poles, zeros = plant.poles(), plant.zeros()
    if np.any(np.abs(poles) >= 1):
        raise DesignError(f"{kind}: pole |z| = {np.abs(poles).max():.6g}; only stable plants")
    # Zeros at infinity of rounding size are delays, and far ones are harmless.
    limit = np.where(zeros.real < 0, min(cancel_below, alternating_below), cancel_below)
    kept, cancelled = zeros[np.abs(zeros) >= limit], zeros[np.abs(zeros) < limit]
    for zero in kept[np.abs(kept - 1) < NEAR_CIRCLE]:
        raise DesignError(
            f"{kind}: zero z = {_number(zero)} lies at 1: the plant does not answer slow motion, "
            "by which every approximate inverse is scaled; use fbf, or check the model"
        )
    b = _polynomial(kept)
    x = KINDS[kind](kept, b, order, plant.dt_s)
    if unit_dc:
        x = TwoSidedFilter(x.preview, x.taps / x.dc_gain, x.sections)
    delays = len(poles) - len(cancelled)
    inverse = _sections(poles, np.concatenate([cancelled, np.zeros(delays)]))
    dc_gain = float(plant.frequency_response(0.0)[0].real)
    command = TwoSidedFilter(x.preview + delays, x.taps / dc_gain, _joined(inverse, x.sections))
    overall = TwoSidedFilter(x.preview + len(kept), np.convolve(x.taps, b), x.sections)
    return Inversion(kind, order, kept, command, overall)


def _npz_ignore(zeros: Roots, b: Array, order: int, dt_s: float) -> TwoSidedFilter:  # noqa: ARG001
    return TwoSidedFilter(0, np.ones(1))


def _zmetc(zeros: Roots, b: Array, order: int, dt_s: float) -> TwoSidedFilter:  # noqa: ARG001
    for zero in zeros[np.abs(zeros) < 1 + NEAR_CIRCLE]:
        raise DesignError(
            f"zmetc: zero {_place(zero, dt_s)}: its reflection becomes a pole of the command, "
            "which would ring without end; use zpetc or fbf"
        )
    mirrored = 1.0 / zeros
    return TwoSidedFilter(
        -len(zeros), np.ones(1), _sections(np.zeros(len(zeros), complex), mirrored)
    )


def _zpetc(zeros: Roots, b: Array, order: int, dt_s: float) -> TwoSidedFilter:  # noqa: ARG001
    return TwoSidedFilter(0, b[::-1].copy())


def _ebzpetc(zeros: Roots, b: Array, order: int, dt_s: float) -> TwoSidedFilter:  # noqa: ARG001
    # 1 - |b|^2, symmetric about its middle; Horner's rule for the sum of its powers.
    left = -np.convolve(b, b[::-1])
    left[len(b) - 1] += 1.0
    series = np.ones(1)
    for _ in range(order):
        series = np.convolve(series, left)
        series[len(series) // 2] += 1.0
    return TwoSidedFilter(len(series) // 2, np.convolve(b[::-1], series))


def _ts(zeros: Roots, b: Array, order: int, dt_s: float) -> TwoSidedFilter:  # noqa: ARG001
    size = np.abs(zeros)
    for zero in zeros[np.abs(size - 1) < NEAR_CIRCLE]:
        raise DesignError(
            f"ts: zero {_place(zero, dt_s)}: the series of its inverse does not converge on "
            "either side; use zpetc or fbf"
        )
    # Zeros outside are expanded into the future, zeros inside into the past.
    outside, inside = _polynomial(zeros[size > 1]), _polynomial(zeros[size < 1])
    future, past = _reciprocal(outside[::-1], order)[::-1], _reciprocal(inside, order)
    return TwoSidedFilter(len(future) - len(inside), np.convolve(future, past))


KINDS: dict[str, Callable[[Roots, Array, int, float], TwoSidedFilter]] = {
    "npz-ignore": _npz_ignore,
    "zmetc": _zmetc,
    "zpetc": _zpetc,
    "ebzpetc": _ebzpetc,
    "ts": _ts,
}
"""The approximations X of 1 / b, from the zeros, b, n1 and the sampling time."""


def _polynomial(zeros: Roots) -> Array:
    """Coefficients of prod (q - a) / (1 - a), highest power first."""
    out = np.ones(1, complex)
    for zero in zeros:
        # Factor by factor, so that zeros near infinity do not overflow.
        out = np.convolve(out, np.array([1.0, -zero]) / (1.0 - zero))
    return np.asarray(out.real, np.float64)


def _reciprocal(rising: Array, terms: int) -> Array:
    """First terms of the power series of 1 / polynomial, which is [1] if the polynomial is."""
    if len(rising) == 1:
        return 1.0 / rising
    return np.asarray(lfilter([1.0], rising, np.eye(1, terms)[0]), np.float64)


def _sections(top: NDArray[Any], bottom: NDArray[Any]) -> Array | None:
    """Second-order sections with zeros `top`, poles `bottom` (as many) and DC gain 1."""
    if len(top) == 0:
        return None
    gain = float(np.real(np.prod(1 - bottom) / np.prod(1 - top)))
    return np.asarray(zpk2sos(top, bottom, gain), np.float64)


def _joined(one: Array | None, other: Array | None) -> Array | None:
    both = [part for part in (one, other) if part is not None]
    return np.concatenate(both) if both else None


def _toeplitz_norm(h: Array) -> float:
    """|H|_F / sqrt(samples) of the lifted matrix of a response at -(samples - 1) .. samples - 1."""
    samples = len(h) // 2 + 1
    count = samples - np.abs(np.arange(1 - samples, samples))
    return math.sqrt(float(count @ h**2) / samples)


def _place(zero: complex, dt_s: float) -> str:
    """Describe a zero on the unit circle for a message."""
    f_hz = abs(float(np.angle(zero))) / (2 * math.pi * dt_s)
    return f"z = {_number(zero)} lies on the unit circle ({f_hz:.4g} Hz)"


def _number(value: complex) -> str:
    return f"{value:.6g}" if value.imag else f"{value.real:.6g}"
