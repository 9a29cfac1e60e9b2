"""Resonances whose damping acts on relative speed, and their derivatives.

G(s) = 1 - s^2 sum_i r_i / (s^2 + 2 z_i w_i s + w_i^2),  sum_i r_i = 1

which is the sum of r_i (2 z_i w_i s + w_i^2) / (s^2 + 2 z_i w_i s + w_i^2). Whatever the parameters
are, a slow motion comes out as it went in, without delay: what a measurement without phase cannot
tell is not left to its noise. Where the phase was measured, a share of the damping may act against
the frame (`grounded`), which delays slow motion by what viscous guides can, and no more.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stillpath.models.arrays import Array, Complex
from stillpath.models.plants import RelativeMode, RelativeModesSpec

__all__ = ["ModalStructure"]


@dataclass(frozen=True, slots=True)
class ModalStructure:
    """Number of modes, and the order of the parameters.

    The vector is [log f, log zeta, shares of all modes but the last], and, if that is fitted, the
    share of the damping that is grounded, one for all modes; frequencies in units of `unit_hz`, so
    that all parameters are of order 1.
    """

    modes: int
    unit_hz: float
    grounded: bool = False

    @property
    def size(self) -> int:
        """Number of parameters."""
        return 3 * self.modes - 1 + self.grounded

    def split(self, theta: Array) -> tuple[Array, Array, Array]:
        """Return frequencies (in units), damping ratios and shares, shape (modes,) each."""
        n = self.modes
        shares = theta[2 * n : 3 * n - 1]
        return np.exp(theta[:n]), np.exp(theta[n : 2 * n]), np.append(shares, 1.0 - shares.sum())

    def response(self, theta: Array, f_hz: Array) -> Complex:
        """Return G at the frequencies, shape (len(f_hz),)."""
        return self.response_and_gradient(theta, f_hz)[0]

    def response_and_gradient(self, theta: Array, f_hz: Array) -> tuple[Complex, Complex]:
        """Return G, shape (len(f_hz),), and its derivatives, shape (len(f_hz), size)."""
        s = np.asarray(1j * f_hz[:, None] / self.unit_hz, np.complex128)
        f, zeta, share = self.split(theta)
        below = s * s + 2 * zeta * f * s + f * f
        part = s * s / below
        # The stiffness and the damping of each mode stand in its denominator alone.
        slope = share * part / below
        by_zeta = slope * (2 * zeta * f * s)
        by_f = by_zeta + slope * (2 * f * f)
        by_share = part[:, -1:] - part[:, :-1]
        relative = 1.0 - part @ share
        if not self.grounded:
            return relative, np.concatenate([by_f, by_zeta, by_share], axis=1)
        against = float(theta[-1])
        lag = 2 * zeta * f * s / below
        lost = share * lag
        by_f = by_f - against * lost * (1 - (2 * zeta * f * s + 2 * f * f) / below)
        by_zeta = by_zeta - against * lost * (1 - lag)
        by_share = by_share - against * (lag[:, :-1] - lag[:, -1:])
        by_grounded = -lost.sum(axis=1, keepdims=True)
        return (
            relative + against * by_grounded[:, 0],
            np.concatenate([by_f, by_zeta, by_share, by_grounded], axis=1),
        )

    def log_gradient(self, theta: Array, f_hz: Array) -> Complex:
        """Return the derivatives of log G, shape (len(f_hz), size)."""
        response, gradient = self.response_and_gradient(theta, f_hz)
        return np.asarray(gradient / response[:, None])

    def parameters(self, f_hz: Array, zeta: Array, share: Array, grounded: float = 0.0) -> Array:
        """Return the vector of modes, shape (modes,) each; shares are made to add up to 1."""
        share = share + (1.0 - share.sum()) / len(share)
        last = [grounded] if self.grounded else []
        return np.concatenate([np.log(f_hz / self.unit_hz), np.log(zeta), share[:-1], last])

    def parameters_of(self, spec: RelativeModesSpec) -> Array:
        """Return the vector of a plant that has this many modes."""
        f_hz, zeta, share = np.array([[m.f_hz, m.zeta, m.share] for m in spec.modes]).T
        return self.parameters(f_hz, zeta, share, spec.modes[0].grounded)

    def spec(self, theta: Array) -> RelativeModesSpec:
        """Return the plant of a vector (size,), its modes rising in frequency."""
        f, zeta, share = self.split(theta)
        grounded = float(np.clip(theta[-1], 0.0, 1.0)) if self.grounded else 0.0
        return RelativeModesSpec(
            modes=tuple(
                RelativeMode(
                    f_hz=float(f[i] * self.unit_hz),
                    zeta=float(zeta[i]),
                    share=float(share[i]),
                    grounded=grounded,
                )
                for i in np.argsort(f)
            )
        )

    def bounds(
        self, f_hz: tuple[float, float], zeta: tuple[float, float], share: tuple[float, float]
    ) -> tuple[Array, Array]:
        """Return lowest and highest parameters; the last mode's share follows from the others."""
        n = self.modes
        rows = (
            (np.log(f_hz[0] / self.unit_hz), np.log(f_hz[1] / self.unit_hz), n),
            (np.log(zeta[0]), np.log(zeta[1]), n),
            (share[0], share[1], n - 1),
            (0.0, 1.0, int(self.grounded)),
        )
        low, high = (np.concatenate([np.full(row[2], row[i]) for row in rows]) for i in (0, 1))
        return low, high
