"""State space from roots, by real first- and second-order sections in cascade.

Polynomials of high order lose their roots to rounding when the poles crowd (at z = 1, or over
decades of frequency); sections of order two with their poles in the matrix do not.
"""

from __future__ import annotations

import numpy as np

from stillpath.models.arrays import Array, Complex
from stillpath.models.errors import ModelError
from stillpath.models.roots import Roots

__all__ = ["balanced", "cascade", "transmission_zeros"]

System = tuple[Array, Array, Array, float]
_Group = Complex

_LEAST_DECAY = 1e-14
"""Of a pole, relative: with less the Gramians are rounding."""


def cascade(roots: Roots) -> System:
    """Realise `roots` with DC gain 1 as a chain of sections, each with DC gain 1.

    Returns
    -------
    a, b, c : ndarray, shapes (n, n), (n,), (n,)
    d : float
    """
    at_dc = 0.0 if roots.dt_s is None else 1.0
    a, b, c, d = np.zeros((0, 0)), np.zeros(0), np.zeros(0), 1.0
    for poles, zeros in _paired(_groups(roots.poles), _groups(roots.zeros)):
        a2, b2, c2, d2 = _section(poles, zeros, at_dc)
        n, m = len(b), len(b2)
        grown = np.zeros((n + m, n + m))
        grown[:n, :n], grown[n:, n:] = a, a2
        grown[n:, :n] = np.outer(b2, c)
        a, b = grown, np.concatenate([b, b2 * d])
        c, d = np.concatenate([d2 * c, c2]), d2 * d
    return a, b, c, d


def balanced(a: Array, b: Array, c: Array, d: float, *, discrete: bool) -> System:
    """Scale every state so that the command reaches it as well as it reaches the output.

    Diagonal balancing: equal diagonals of both Gramians. Unlike a full balancing it needs no
    inverse, and so it survives zeros that almost cancel poles.

    Raises
    ------
    ModelError
        A pole lies on the edge of stability within rounding.
    """
    # Slow to import, and not needed to check a document.
    from scipy.linalg import solve_discrete_lyapunov

    if len(b) == 0:
        return a, b, c, d
    solve = solve_discrete_lyapunov if discrete else _solve_continuous
    poles = np.linalg.eigvals(a)
    decay = 1.0 - np.abs(poles) if discrete else -poles.real / np.maximum(np.abs(poles), 1e-300)
    if decay.min() < _LEAST_DECAY:
        raise ModelError(
            "the plant has a resonance that never dies away (damping of 0 within rounding): "
            "correct its damping"
        )
    reached = np.abs(np.diag(solve(a, np.outer(b, b))))
    seen = np.abs(np.diag(solve(a.T, np.outer(c, c))))
    used = (reached > 0) & (seen > 0)
    scale = np.where(used, (np.where(used, seen, 1.0) / np.where(used, reached, 1.0)) ** 0.25, 1.0)
    return a * scale[:, None] / scale, b * scale, c / scale, d


def transmission_zeros(a: Array, b: Array, c: Array, d: float) -> Complex:
    """Return the finite generalised eigenvalues of the Rosenbrock pencil."""
    from scipy.linalg import eigvals

    n = len(b)
    if n == 0:
        return np.zeros(0, complex)
    pencil = np.block([[a, b[:, None]], [c[None, :], np.array([[d]])]])
    mass = np.zeros((n + 1, n + 1))
    mass[:n, :n] = np.eye(n)
    alpha, beta = eigvals(pencil, mass, homogeneous_eigvals=True)
    # Infinite zeros come out as beta of rounding size.
    finite = np.abs(beta) > 1e-10 * np.hypot(np.abs(alpha), np.abs(beta))
    zeros: Complex = alpha[finite] / beta[finite]
    return zeros


def _solve_continuous(a: Array, q: Array) -> Array:
    from scipy.linalg import solve_continuous_lyapunov

    return np.asarray(solve_continuous_lyapunov(a, -q), dtype=np.float64)


def _groups(roots: Complex) -> list[_Group]:
    """Conjugate pairs, then real roots two by two, then a single real root."""
    upper = roots[roots.imag > 0]
    groups = [np.array([r, r.conjugate()]) for r in upper]
    real = roots[roots.imag == 0]
    real = real[np.argsort(np.abs(real))]
    groups += [real[i : i + 2] for i in range(0, len(real), 2)]
    return groups


def _paired(poles: list[_Group], zeros: list[_Group]) -> list[tuple[_Group, _Group]]:
    """Give every group of zeros to the nearest free group of poles that is large enough."""
    free = list(range(len(poles)))
    owned: list[_Group] = [np.zeros(0, complex)] * len(poles)
    for group in sorted(zeros, key=len, reverse=True):
        fit = [i for i in free if len(poles[i]) >= len(group)]
        best = min(
            fit,
            key=lambda i: (
                abs(poles[i].mean() - group.mean())
                + abs(abs(poles[i][0].imag) - abs(group[0].imag))
            ),
        )
        owned[best] = group
        free.remove(best)
    return list(zip(poles, owned, strict=True))


def _section(poles: _Group, zeros: _Group, at_dc: float) -> System:
    """One or two poles with at most as many zeros, gain 1 at `at_dc`."""
    gain = float(np.real(np.prod(at_dc - poles) / np.prod(at_dc - zeros)))
    d = gain if len(zeros) == len(poles) else 0.0
    if len(poles) == 1:
        pole = float(poles[0].real)
        rest = gain * (pole - float(zeros[0].real)) if len(zeros) else gain
        return np.array([[pole]]), np.ones(1), np.array([rest]), d
    # Numerator minus d times the denominator: r1 v + r0.
    top = np.zeros(3)
    top[2 - len(zeros) :] = gain * np.real(np.poly(zeros))
    _, r1, r0 = top - d * np.real(np.poly(poles))
    if poles[0].imag != 0:
        re, im = float(poles[0].real), abs(float(poles[0].imag))
        a = np.array([[re, im], [-im, re]])
        return a, np.array([0.0, 1.0]), np.array([(r0 + r1 * re) / im, r1]), d
    p1, p2 = float(poles[0].real), float(poles[1].real)
    return np.array([[p1, 0.0], [1.0, p2]]), np.array([1.0, 0.0]), np.array([r1, r0 + r1 * p2]), d
