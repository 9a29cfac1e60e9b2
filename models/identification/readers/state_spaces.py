"""State spaces as zeros, poles and gain, whatever the scale of their states."""

from __future__ import annotations

from typing import Any

import numpy as np

from stillpath.models.arrays import Array, Complex
from stillpath.models.errors import ModelError
from stillpath.models.realisation import transmission_zeros
from stillpath.models.roots import dc_gain

__all__ = ["zeros_poles_gain"]


_LARGEST_ORDER = 40
_LARGEST_ERROR = 1e-3


def zeros_poles_gain(
    a: Array, b: Array, c: Array, d: float, dt_s: float | None
) -> tuple[Complex, Complex, float | None]:
    """Return the zeros, poles and leading gain of a state space of one input and output.

    The states are balanced first: a companion form of a printer's axis has entries from 1 to
    1e11, whose zeros a generalised eigenvalue problem gets wrong by itself. As many zeros are
    taken as the relative degree leaves, and the result is compared with the state space.

    Parameters
    ----------
    a, b, c : ndarray, shapes (n, n), (n,), (n,)
    dt_s : float or None
        None: continuous.

    Raises
    ------
    ModelError
        If the matrices do not fit together, there is an integrator, or the result differs from
        the state space.
    """
    n = len(a)
    if a.shape != (n, n) or b.shape != (n,) or c.shape != (n,) or n == 0:
        raise ModelError(
            f"A {a.shape}, B {b.shape}, C {c.shape} do not fit together: one input and one "
            "output, and A square of their length"
        )
    if n > _LARGEST_ORDER:
        raise ModelError(f"{n} states, at most {_LARGEST_ORDER} are read; reduce the model")
    poles = np.linalg.eigvals(a).astype(complex)
    # In units of the poles' size, all entries are near 1.
    unit = 1.0 if dt_s is not None else float(np.exp(np.mean(np.log(np.abs(poles) + 1e-30))))
    a, b = a / unit, b / unit
    whole = np.block([[a, b[:, None]], [c[None, :], np.array([[d]])]])
    from scipy.linalg import matrix_balance  # slow to import, seldom needed

    whole = np.asarray(matrix_balance(whole, permute=False)[0], np.float64)
    a, b, c = whole[:n, :n], whole[:n, n], whole[n, :n]
    zeros = transmission_zeros(a, b, c, d)
    zeros = zeros[np.argsort(np.abs(zeros))][: n - _relative_degree(a, b, c, d)]
    zeros, poles = _conjugated(zeros * unit), _conjugated(poles)
    at = 0.0 if dt_s is None else 1.0
    scale = dc_gain(zeros, poles, dt_s)
    at_dc = float(c @ np.linalg.solve(at * np.eye(n) - a, b) + d)
    gain = at_dc / scale if scale else None
    if gain is not None:
        _check(zeros / unit, poles / unit, at_dc, (a, b, c, d), discrete=dt_s is not None)
    return zeros, poles, gain


def _relative_degree(a: Array, b: Array, c: Array, d: float) -> int:
    """Return the position of the first Markov parameter that is not rounding."""
    size = float(np.linalg.norm(c) * np.linalg.norm(b))
    if abs(d) > 1e-10 * size:
        return 0
    state, norm = b, max(float(np.linalg.norm(a, 2)), 1e-30)
    for degree in range(1, len(b) + 1):
        if abs(c @ state) > 1e-10 * size:
            return degree
        state = a @ state / norm
    return len(b)


def _conjugated(roots: Complex) -> Complex:
    """Return the roots of a real matrix exactly closed under conjugation."""
    near = np.abs(roots.imag) <= 1e-9 * np.abs(roots)
    upper = roots[~near & (roots.imag > 0)]
    return np.concatenate([roots[near].real.astype(complex), upper, upper.conj()])


def _check(zeros: Complex, poles: Complex, at_dc: float, system: Any, *, discrete: bool) -> None:
    """Compare both responses, from low frequencies to beyond every pole."""
    a, b, c, d = system
    if discrete:
        points = np.exp(1j * np.linspace(0.0, np.pi, 200))
    else:
        points = 1j * np.geomspace(1e-2, 10.0, 200) * np.abs(poles).max()
    expected = np.array([c @ np.linalg.solve(p * np.eye(len(b)) - a, b) + d for p in points])
    at = 1.0 if discrete else 0.0
    found = np.full(len(points), at_dc, complex)
    for zero in zeros:
        found *= (points - zero) / (at - zero)
    for pole in poles:
        found *= (at - pole) / (points - pole)
    error = float(np.abs(found - expected).max() / np.abs(expected).max())
    if not error < _LARGEST_ERROR:
        raise ModelError(
            f"the zeros of this state space cannot be computed: its response and that of its zeros "
            f"and poles differ by {error:.2g} of the peak, {_LARGEST_ERROR:g} may be; scale its "
            "states (ssbal), or give zeros, poles and gain"
        )
