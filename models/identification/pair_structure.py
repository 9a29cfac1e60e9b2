"""The fitted plant structure: pairs of poles and zeros, with its derivatives.

G(s) = (1 + tau s) prod_i (1 + 2 zz_i s/wz_i + s^2/wz_i^2) / prod_i (1 + 2 z_i s/w_i + s^2/w_i^2)

DC gain 1 whatever the parameters are, stable because frequency and damping of the poles are
fitted as logarithms. Frequencies are in units of `unit_hz`, so that all parameters are of order 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from stillpath.models.arrays import Array, Complex
from stillpath.models.identification.types import UNSEEN_ZETA
from stillpath.models.plants import PairsSpec, PolePair, ZeroPair

__all__ = ["PairStructure"]

# A zero exactly on the imaginary axis would make log G infinite at its frequency.
_SMALL = 1e-9
_NO_TAU = 1e-5
_NEW_ZETA = 0.1
"""Damping that a new pair begins with."""


@dataclass(frozen=True, slots=True)
class PairStructure:
    """Numbers of pairs, and the order of the parameters.

    The vector is [tau, log f of the poles, log zeta of the poles, log f of the zeros, zeta of the
    zeros]; tau in units of 1/(2 pi unit_hz).
    """

    poles: int
    zeros: int
    unit_hz: float

    @property
    def size(self) -> int:
        """Number of parameters."""
        return 1 + 2 * self.poles + 2 * self.zeros

    def split(self, theta: Array) -> tuple[float, Array, Array, Array, Array]:
        """Return tau, log f and log zeta of the poles, log f and zeta of the zeros."""
        n, m = self.poles, self.zeros
        cuts = np.cumsum([1, n, n, m])
        tau, *rest = np.split(np.asarray(theta, float), cuts)
        return float(tau[0]), rest[0], rest[1], rest[2], rest[3]

    def response(self, theta: Array, f_hz: Array) -> Complex:
        """Return G at the frequencies, shape (len(f_hz),)."""
        x = np.asarray(1j * f_hz / self.unit_hz, np.complex128)
        tau, log_f, log_z, log_fz, zz = self.split(theta)
        zeros = _factors(x, log_fz, zz)
        poles = _factors(x, log_f, np.exp(log_z))
        return np.asarray((1 + tau * x) * zeros.prod(axis=1) / poles.prod(axis=1))

    def log_gradient(self, theta: Array, f_hz: Array) -> Complex:
        """Return the derivatives of log G, shape (len(f_hz), size)."""
        x = np.asarray(1j * f_hz / self.unit_hz, np.complex128)
        tau, log_f, log_z, log_fz, zz = self.split(theta)
        zeta = np.exp(log_z)
        poles = _factors(x, log_f, zeta)
        zeros = _factors(x, log_fz, zz) + _SMALL
        over_pole, over_zero = x[:, None] / np.exp(log_f), x[:, None] / np.exp(log_fz)
        return np.concatenate(
            [
                (x / (1 + tau * x))[:, None],
                2 * over_pole * (zeta + over_pole) / poles,
                -2 * zeta * over_pole / poles,
                -2 * over_zero * (zz + over_zero) / zeros,
                2 * over_zero / zeros,
            ],
            axis=1,
        )

    def extended(self, theta: Array, f_hz: float) -> tuple[PairStructure, Array]:
        """Return a structure with one more pole pair at `f_hz`, a zero pair near it, and start."""
        tau, log_f, log_z, log_fz, zz = self.split(theta)
        log_new = np.log(f_hz / self.unit_hz)
        poles = [np.append(log_f, log_new), np.append(log_z, np.log(_NEW_ZETA))]
        zeros = [np.append(log_fz, log_new + 0.03), np.append(zz, _NEW_ZETA)]
        larger = PairStructure(self.poles + 1, self.zeros + 1, self.unit_hz)
        return larger, np.concatenate([[tau], *poles, *zeros])

    def without(self, theta: Array, pole: int) -> tuple[PairStructure, Array]:
        """Return the structure and vector without a pole pair and the zero pair nearest to it."""
        tau, log_f, log_z, log_fz, zz = self.split(theta)
        zero = int(np.argmin(np.abs(log_fz - log_f[pole]))) if self.zeros else 0
        kept = [np.delete(v, pole) for v in (log_f, log_z)]
        kept += [np.delete(v, zero) if self.zeros else v for v in (log_fz, zz)]
        smaller = PairStructure(self.poles - 1, max(self.zeros - 1, 0), self.unit_hz)
        return smaller, np.concatenate([[tau], *kept])

    def parameters(self, spec: PairsSpec) -> Array:
        """Return the vector of a plant that has this many pairs."""
        return np.concatenate(
            [
                [spec.real_zero_tau_s * 2 * np.pi * self.unit_hz],
                np.log([p.f_hz / self.unit_hz for p in spec.poles]),
                np.log([p.zeta for p in spec.poles]),
                np.log([z.f_hz / self.unit_hz for z in spec.zeros]),
                [z.zeta for z in spec.zeros],
            ]
        )

    def spec(self, theta: Array) -> PairsSpec:
        """Return the plant of a vector (size,), its pairs rising in frequency."""
        tau, log_f, log_z, log_fz, zz = self.split(theta)
        poles = sorted(zip(np.exp(log_f) * self.unit_hz, np.exp(log_z), strict=True))
        zeros = sorted(zip(np.exp(log_fz) * self.unit_hz, zz, strict=True))
        return PairsSpec(
            poles=tuple(PolePair(f_hz=float(f), zeta=float(z)) for f, z in poles),
            zeros=tuple(ZeroPair(f_hz=float(f), zeta=float(z)) for f, z in zeros),
            real_zero_tau_s=0.0 if abs(tau) < _NO_TAU else tau / (2 * np.pi * self.unit_hz),
        )

    def bounds(
        self,
        f_hz: tuple[float, float],
        zeta: tuple[Array, float],
        *,
        zeros_hz: tuple[float, float] | None = None,
    ) -> tuple[Array, Array]:
        """Return lowest and highest parameters for pairs within `f_hz` and damping `zeta`.

        The least damping is given for every pole pair (`least_damping`); zeros are within
        `zeros_hz` if that is given.
        """
        n, m = self.poles, self.zeros
        log_f = np.log(np.array(f_hz) / self.unit_hz)
        log_fz = np.log(np.array(zeros_hz or f_hz) / self.unit_hz)
        # Slower real zeros than the lowest frequency would make a differentiator of the plant.
        tau, zz = self.unit_hz / f_hz[0], 1.5
        low = [[-tau], np.full(n, log_f[0]), np.log(zeta[0]), np.full(m, log_fz[0])]
        high = [[tau], np.full(n, log_f[1]), np.full(n, np.log(zeta[1])), np.full(m, log_fz[1])]
        return np.concatenate([*low, np.full(m, -zz)]), np.concatenate([*high, np.full(m, zz)])

    def least_damping(self, theta: Array, least: float, top_hz: float) -> Array:
        """Return the least damping of every pole pair: `least`, above `top_hz` `UNSEEN_ZETA`."""
        _, log_f, _, _, _ = self.split(theta)
        beyond = np.exp(log_f) * self.unit_hz > top_hz
        return np.where(beyond, max(UNSEEN_ZETA, least), least)


def _factors(x: Complex, log_f: Array, zeta: ArrayLike) -> Complex:
    """Return 1 + 2 zeta s/w + s^2/w^2 of every pair, shape (len(x), pairs)."""
    scaled = x[:, None] / np.exp(log_f)
    return np.asarray(1 + 2 * np.asarray(zeta) * scaled + scaled**2)
