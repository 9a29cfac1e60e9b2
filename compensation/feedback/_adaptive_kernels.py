"""Kernel of the frequency identification, wrapped by `adaptive`."""

from __future__ import annotations

import numpy as np

from stillpath.models.arrays import Array
from stillpath.models.jit import kernel

__all__ = ["track"]


@kernel
def track(
    x: Array,
    theta: Array,
    covariance: Array,
    history: Array,
    poles: Array,
    radius: Array,
    forgetting: Array,
    levels: Array,
) -> None:
    """Recursive least squares of a mirror-symmetric notch A(z)/A(rho z) over the samples x.

    `theta` has a_1 .. a_m of A = 1 + a_1 z^-1 + .. + a_m z^-m + .. + a_1 z^-(2m-1) + z^-2m;
    `poles` the same numbers as used in A(rho z). `history` has the last 2m filtered samples,
    newest first. `radius` and `forgetting` hold (now, end, decay towards the end); `levels` the
    mean squares of error, filtered signal and signal. All but x and poles are updated in place.
    """
    m = len(theta)
    psi = np.empty(m)
    gain = np.empty(m)
    for k in range(len(x)):
        filtered = x[k]
        power = 1.0
        for i in range(2 * m):
            power *= radius[0]
            if i < m:
                a = poles[i]
            elif i < 2 * m - 1:
                a = poles[2 * m - 2 - i]
            else:
                a = 1.0
            filtered -= a * power * history[i]
        for j in range(m - 1):
            psi[j] = history[j] + history[2 * m - 2 - j]
        psi[m - 1] = history[m - 1]
        error = filtered + history[2 * m - 1]
        for j in range(m):
            error += theta[j] * psi[j]
        scale = forgetting[0]
        for i in range(m):
            gain[i] = 0.0
            for j in range(m):
                gain[i] += covariance[i, j] * psi[j]
            scale += psi[i] * gain[i]
        for i in range(m):
            theta[i] -= gain[i] * error / scale
        for i in range(m):
            for j in range(m):
                covariance[i, j] = (covariance[i, j] - gain[i] * gain[j] / scale) / forgetting[0]
        for i in range(2 * m - 1, 0, -1):
            history[i] = history[i - 1]
        history[0] = filtered
        levels[0] += 0.05 * (error * error - levels[0])
        levels[1] += 0.05 * (filtered * filtered - levels[1])
        levels[2] += 0.05 * (x[k] * x[k] - levels[2])
        radius[0] = radius[1] - (radius[1] - radius[0]) * radius[2]
        forgetting[0] = forgetting[1] - (forgetting[1] - forgetting[0]) * forgetting[2]
