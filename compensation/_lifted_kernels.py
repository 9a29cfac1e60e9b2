"""Kernels of lifted systems that are not Toeplitz, wrapped by `compensation.operators`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stillpath.models.jit import kernel

__all__ = ["run_adjoint", "run_forward"]


@kernel
def run_forward(
    a: NDArray[np.float64],
    b: NDArray[np.float64],
    c: NDArray[np.float64],
    d: NDArray[np.float64],
    which: NDArray[np.int64],
    u: NDArray[np.float64],
    x: NDArray[np.float64],
    y: NDArray[np.float64],
) -> None:
    """Fill y(k) = c x(k) + d u(k), x(k+1) = a x(k) + b u(k) with the plant `which[k]`, in place.

    Every column of `u` is a separate input. `x`, shape (order, columns), holds their initial states
    and receives the final ones.
    """
    samples, columns = u.shape
    order = b.shape[1]
    following = np.empty_like(x)
    for k in range(samples):
        p = which[k]
        for j in range(columns):
            total = d[p] * u[k, j]
            for i in range(order):
                total += c[p, i] * x[i, j]
            y[k, j] = total
        for i in range(order):
            for j in range(columns):
                following[i, j] = b[p, i] * u[k, j]
            for q in range(order):
                gain = a[p, i, q]
                for j in range(columns):
                    following[i, j] += gain * x[q, j]
        x[:] = following


@kernel
def run_adjoint(
    a: NDArray[np.float64],
    b: NDArray[np.float64],
    c: NDArray[np.float64],
    d: NDArray[np.float64],
    which: NDArray[np.int64],
    e: NDArray[np.float64],
    v: NDArray[np.float64],
) -> None:
    """Fill v = G' e, running the costate s(k) = a' s(k+1) + c' e(k) backward, in place."""
    samples, columns = e.shape
    order = b.shape[1]
    s = np.zeros((order, columns))
    earlier = np.empty_like(s)
    for k in range(samples - 1, -1, -1):
        p = which[k]
        for j in range(columns):
            total = d[p] * e[k, j]
            for i in range(order):
                total += b[p, i] * s[i, j]
            v[k, j] = total
        for i in range(order):
            for j in range(columns):
                earlier[i, j] = c[p, i] * e[k, j]
            for q in range(order):
                gain = a[p, q, i]
                for j in range(columns):
                    earlier[i, j] += gain * s[q, j]
        s[:] = earlier
