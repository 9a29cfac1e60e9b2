"""FIR filters that interpolate the inverse of a plant at given frequencies.

Papers 000 (Propositions 4 and 6) and 001 (Theorem 1), with the signs of the right-hand sides and
the rows of (10) corrected.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from stillpath.compensation.base import DesignError
from stillpath.models.arrays import Array, Complex

__all__ = ["interpolating_fir", "inverse_and_slope"]

_LARGEST_CONDITION = 1e10


def inverse_and_slope(
    num: Sequence[float], den: Sequence[float], w: Array
) -> tuple[Complex, Complex]:
    """Return 1/P and d(1/P)/dw at w rad/sample, for P = num/den in rising powers of z^-1.

    Raises
    ------
    DesignError
        If P is 0 at one of them: no add-on can act at a frequency that the plant blocks.
    """
    top, top_slope = _value_and_slope(num, w)
    bottom, bottom_slope = _value_and_slope(den, w)
    if np.any(np.abs(top) <= 1e-12 * np.sum(np.abs(num))):
        raise DesignError("the plant is 0 at a target frequency: it blocks the disturbance itself")
    return bottom / top, (bottom_slope * top - bottom * top_slope) / top**2


def interpolating_fir(
    w: Array,
    values: Complex,
    slopes: Complex | None = None,
    zeros: Sequence[tuple[float, float]] = (),
) -> Array:
    """Return the taps q of the shortest FIR with Q(e^jw_i) = values_i.

    Parameters
    ----------
    w : ndarray, shape (n,)
        rad/sample, in (0, pi), all different.
    values : ndarray of complex, shape (n,)
    slopes : ndarray of complex, shape (n,), optional
        dQ/dw there too (Hermite interpolation): 4n taps instead of 2n.
    zeros : sequence of (radius, rad/sample), optional
        Q is 0 at radius e^(+-j angle): two taps each, one at the angles 0 and pi.

    Raises
    ------
    DesignError
        If two frequencies are so close that the taps are not determined, or a fixed zero is no
        point of the plane but 0.
    """
    if not all(
        radius > 0 and np.isfinite(radius) and np.isfinite(angle) for radius, angle in zeros
    ):
        raise DesignError("fixed zeros of Q need a radius above 0 and a frequency, both finite")
    angles = [angle for _, angle in zeros]
    real = [bool(np.isclose(np.sin(angle), 0.0, atol=1e-12)) for angle in angles]
    count = (2 if slopes is None else 4) * len(w) + sum(1 if r else 2 for r in real)
    powers = np.arange(count)
    at = np.exp(-1j * np.outer(w, powers))
    rows, wanted = [at.real, at.imag], [values.real, values.imag]
    if slopes is not None:
        steep = -1j * powers * at
        # Scaled by the highest power, so that both kinds of rows have the same magnitude.
        rows += [steep.real / count, steep.imag / count]
        wanted += [slopes.real / count, slopes.imag / count]
    for (radius, angle), is_real in zip(zeros, real, strict=True):
        row = (radius * np.exp(1j * angle)) ** (-powers.astype(float))
        rows.append(row.real[None])
        wanted.append(np.zeros(1))
        if not is_real:
            rows.append(row.imag[None])
            wanted.append(np.zeros(1))
    system = np.concatenate(rows)
    condition = float(np.linalg.cond(system))
    if condition > _LARGEST_CONDITION:
        raise DesignError(
            f"targets too close to each other, to dc or to half the sampling rate for an exact "
            f"interpolation (condition {condition:.1e}, at most {_LARGEST_CONDITION:.0e}); drop "
            "one, or take one wider band for both"
        )
    return np.asarray(np.linalg.solve(system, np.concatenate(wanted)), np.float64)


def _value_and_slope(coefficients: Sequence[float], w: Array) -> tuple[Complex, Complex]:
    powers = np.arange(len(coefficients))
    terms = np.asarray(coefficients, float) * np.exp(-1j * np.outer(w, powers))
    return terms.sum(axis=1), (-1j * powers * terms).sum(axis=1)
