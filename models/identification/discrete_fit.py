"""A discrete model refitted to a continuous one, without the zeros that sampling adds.

The product itself discretises by first-order hold (`models.plants.discretise`), exact for a
command that is linear between samples. For export to tools that want B/A in z this model follows
the continuous response more closely than any hold, and has no zero outside the circle that the
plant does not have.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillpath.models.errors import ModelError
from stillpath.models.identification.sanathanan_koerner import polynomial_basis, sanathanan_koerner
from stillpath.models.plant_specs import PlantSpec, ZpkSpec
from stillpath.models.plants import frequency_response

__all__ = ["DiscreteModel", "discrete_model", "zeros_outside"]

_SCALE = 0.3
_NYQUIST_SHARE = 0.8
_POINTS = 600
_SAME_ZERO = 0.1
"""Distance of a zero in z from the image of one in s, as a share of |z - 1|."""


@dataclass(frozen=True, slots=True)
class DiscreteModel:
    """A discrete plant and how far it is from the continuous one.

    Attributes
    ----------
    error : float
        Largest |difference| of the responses up to `f_max_hz`, as a share of the peak.
    notes : tuple of str
        Every zero outside the unit circle, explained.
    """

    spec: ZpkSpec
    error: float
    f_max_hz: float
    notes: tuple[str, ...]


def discrete_model(spec: PlantSpec, dt_s: float, *, f_max_hz: float = 150.0) -> DiscreteModel:
    """Fit B(z)/A(z) of order (n - 1)/n to the response of a continuous plant with n poles.

    Sanathanan-Koerner with the powers of (z - 1)/0.3, where a plant much slower than the
    sampling stays well conditioned, and b0 = a0, which makes the DC gain exactly 1.

    Parameters
    ----------
    spec : PlantSpec
        Continuous.
    f_max_hz : float
        Where the responses shall agree, at most 0.4/dt_s; a smaller range agrees better.

    Raises
    ------
    ModelError
        If the plant is discrete already, its poles are too fast for the sampling time, or the
        fit is unstable.
    """
    roots = spec.roots()
    if roots.dt_s is not None:
        raise ModelError(
            f"the plant is discrete at {roots.dt_s * 1e3:g} ms already; use "
            "models.plants.discretise to bring it to another sampling time"
        )
    order = len(roots.poles)
    fastest_hz = float(np.abs(roots.poles).max()) / (2 * np.pi)
    top_hz = _NYQUIST_SHARE * 0.5 / dt_s
    if fastest_hz > top_hz:
        raise ModelError(
            f"a pole at {fastest_hz:.0f} Hz is too fast for {dt_s * 1e3:g} ms (up to "
            f"{top_hz:.0f} Hz); sample faster"
        )
    f_max = min(f_max_hz, top_hz)
    # Fitted below a resonance only, the polynomials may end up unstable: then beyond it too.
    for reach in (f_max, max(f_max, min(1.2 * fastest_hz, top_hz)), top_hz):
        poles, zeros = _refitted(spec, dt_s, order, reach)
        if np.abs(poles).max() < 1:
            break
    else:
        raise ModelError(
            f"the discrete refit at {dt_s * 1e3:g} ms is unstable (|z| = "
            f"{np.abs(poles).max():.5f}); use the first-order hold"
        )
    discrete = ZpkSpec(zeros=_listed(zeros), poles=_listed(poles), dt_s=dt_s)
    f = _frequencies(f_max)
    wanted = frequency_response(spec, f)
    error = np.abs(frequency_response(discrete, f) - wanted).max() / np.abs(wanted).max()
    return DiscreteModel(discrete, float(error), f_max, zeros_outside(zeros, roots.zeros, dt_s))


def zeros_outside(
    zeros: NDArray[np.complex128], plant_zeros: NDArray[np.complex128], dt_s: float
) -> tuple[str, ...]:
    """Explain every zero in z outside the unit circle: the plant's own, or made by sampling.

    Parameters
    ----------
    zeros : ndarray
        In z.
    plant_zeros : ndarray
        In s, rad/s.
    """
    images = np.exp(plant_zeros[plant_zeros.real > 0] * dt_s)
    out = []
    for zero in zeros[(np.abs(zeros) > 1) & (zeros.imag >= 0)]:
        near = np.abs(images - zero) < _SAME_ZERO * abs(zero - 1)
        hz = abs(np.log(zero)) / (2 * np.pi * dt_s)
        name = f"zero at z = {zero:.4g} (|z| = {abs(zero):.4f})"
        if near.any():
            out.append(
                f"{name}, {hz:.1f} Hz, is the plant's own (right half plane in s): its inverse "
                "needs preview at any sampling time"
            )
        else:
            out.append(
                f"{name} comes from sampling at {dt_s * 1e3:g} ms, the continuous plant has "
                "none there; another sampling time moves it"
            )
    return tuple(out)


def _refitted(
    spec: PlantSpec, dt_s: float, order: int, f_max_hz: float
) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Return poles and zeros in z of the fit up to `f_max_hz`."""
    f = _frequencies(f_max_hz)
    basis = polynomial_basis((np.exp(2j * np.pi * f * dt_s) - 1) / _SCALE, order)
    b, a, _ = sanathanan_koerner(
        basis,
        frequency_response(spec, f),
        np.ones(len(f)),
        order - 1,
        order,
        unit_gain=True,
        rounds=30,
    )
    return _in_z(a), _in_z(b)


def _frequencies(f_max_hz: float) -> NDArray[np.float64]:
    return np.linspace(f_max_hz / _POINTS, f_max_hz, _POINTS)


def _in_z(coefficients: NDArray[np.float64]) -> NDArray[np.complex128]:
    roots = np.roots(coefficients[::-1])
    return np.asarray(1 + _SCALE * roots, np.complex128)


def _listed(roots: NDArray[np.complex128]) -> tuple[tuple[float, float], ...]:
    return tuple((float(r.real), float(r.imag)) for r in roots)
