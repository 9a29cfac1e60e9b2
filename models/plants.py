"""Plants in computable form: state space, exact discretisation, frequency response.

The command of a machine is linear between samples, so a continuous plant is discretised with a
first-order hold (triangle hold): exact for such a command, at every sample. Discrete plants
count as the same thing already done at their sampling time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.polynomial.polynomial import polyval
from numpy.typing import ArrayLike

from stillpath.models.arrays import Array, Complex
from stillpath.models.errors import ModelError
from stillpath.models.plant_specs import (
    MOST_FRICTION_MM,
    FirSpec,
    Mode,
    ModesSpec,
    PairsSpec,
    ParametricMembers,
    PlantSetSpec,
    PlantSpec,
    PolePair,
    RelativeMode,
    RelativeModesSpec,
    TfSpec,
    WeightedMember,
    ZeroPair,
    ZpkSpec,
)
from stillpath.models.realisation import balanced, cascade, transmission_zeros
from stillpath.models.roots import Roots, frequency_and_damping

__all__ = [
    "MOST_FRICTION_MM",
    "ContinuousPlant",
    "DiscretePlant",
    "FirSpec",
    "Mode",
    "ModesSpec",
    "PairsSpec",
    "ParametricMembers",
    "PlantSet",
    "PlantSetSpec",
    "PlantSpec",
    "PolePair",
    "RelativeMode",
    "RelativeModesSpec",
    "TfSpec",
    "WeightedMember",
    "ZeroPair",
    "ZpkSpec",
    "continuous",
    "discretise",
    "frequency_response",
    "plant_set",
]

_MOST_ELEMENTS = 1_000_000
"""Of the matrices that a frequency response inverts at a time."""


@dataclass(frozen=True, slots=True, eq=False)
class _StateSpace:
    """Single input, single output; x is the state, u the command, y the position.

    Attributes
    ----------
    a, b, c : ndarray, shapes (n, n), (n,), (n,)
    notes : tuple of str
        What was changed on reading the model.
    """

    a: Array
    b: Array
    c: Array
    d: float
    notes: tuple[str, ...] = ()

    @property
    def order(self) -> int:
        """Number of states."""
        return len(self.b)

    def poles(self) -> Complex:
        """Return the eigenvalues of `a`."""
        return np.linalg.eigvals(self.a).astype(complex)

    def zeros(self) -> Complex:
        """Return the finite transmission zeros."""
        return transmission_zeros(self.a, self.b, self.c, self.d)

    def _at(self, points: Complex) -> Complex:
        if self.order == 0:
            return np.full(len(points), self.d, complex)
        response = np.empty(len(points), complex)
        # A long FIR plant has hundreds of states: not all matrices at once.
        block = max(1, _MOST_ELEMENTS // self.order**2)
        for begin in range(0, len(points), block):
            part = points[begin : begin + block]
            shifted = part[:, None, None] * np.eye(self.order) - self.a
            states = np.linalg.solve(
                shifted, np.broadcast_to(self.b[:, None], (len(part), self.order, 1))
            )
            response[begin : begin + block] = states[:, :, 0] @ self.c + self.d
        return response


@dataclass(frozen=True, slots=True, eq=False)
class ContinuousPlant(_StateSpace):
    """x' = a x + b u, y = c x + d u, in seconds."""

    def frequency_response(self, f_hz: ArrayLike) -> Complex:
        """Return G(2 pi j f) at the frequencies `f_hz`."""
        return self._at(2j * np.pi * np.atleast_1d(np.asarray(f_hz, float)))

    def modes(self) -> Array:
        """Return rows (f_hz, zeta) of the resonances, rising in frequency, shape (modes, 2)."""
        return frequency_and_damping(self.poles(), None)

    def settling_time_s(self, tolerance: float = 0.01) -> float:
        """Return the time in which the slowest pole decays to `tolerance`."""
        return float(-np.log(tolerance) / np.min(-self.poles().real)) if self.order else 0.0

    def discretise(self, dt_s: float) -> DiscretePlant:
        """Return the first-order-hold equivalent, exact for commands linear between samples."""
        from scipy.linalg import expm  # slow to import, not needed to check a document

        n = self.order
        if n == 0:
            return DiscretePlant(self.a, self.b, self.c, self.d, self.notes, dt_s)
        # exp of [[A, B, 0], [0, 0, 1/T], [0, 0, 0]] T: a constant and a ramp drive the plant
        # (Franklin, Powell, Workman, Digital Control of Dynamic Systems, triangle hold).
        block = np.zeros((n + 2, n + 2))
        block[:n, :n] = self.a * dt_s
        block[:n, n] = self.b * dt_s
        block[n, n + 1] = 1.0
        grown = expm(block)
        phi, step, ramp = grown[:n, :n], grown[:n, n], grown[:n, n + 1]
        # The true state is x = xi + ramp u; xi needs no command of the future.
        return balanced_discrete(
            phi, step - ramp + phi @ ramp, self.c, self.d + float(self.c @ ramp), self.notes, dt_s
        )


@dataclass(frozen=True, slots=True, eq=False)
class DiscretePlant(_StateSpace):
    """x(k+1) = a x(k) + b u(k), y(k) = c x(k) + d u(k), samples `dt_s` apart."""

    dt_s: float = 0.0

    def frequency_response(self, f_hz: ArrayLike) -> Complex:
        """Return G(exp(2 pi j f dt)) at the frequencies `f_hz`, from samples to samples."""
        f = np.atleast_1d(np.asarray(f_hz, float))
        return self._at(np.exp(2j * np.pi * f * self.dt_s))

    def modes(self) -> Array:
        """Return rows (f_hz, zeta) of the resonances, rising in frequency, shape (modes, 2)."""
        return frequency_and_damping(self.poles(), self.dt_s)

    def settling_time_s(self, tolerance: float = 0.01) -> float:
        """Return the time in which the slowest pole decays to `tolerance`.

        At least one sample per state: a plant of pure delays needs that long.
        """
        if self.order == 0:
            return 0.0
        radius = float(np.abs(self.poles()).max())
        slowest = np.log(tolerance) / np.log(radius) if radius > 0 else 0.0
        return float(max(slowest, self.order) * self.dt_s)

    def impulse_response(self, samples: int) -> Array:
        """Return the first `samples` Markov parameters d, cb, cab, ..., shape (samples,)."""
        out = np.empty(samples)
        x = self.b.copy()
        for k in range(samples):
            out[k] = self.d if k == 0 else self.c @ x
            if k:
                x = self.a @ x
        return out

    def rest_state(self, u: float = 1.0) -> Array:
        """Return the state (order,) in which the plant stands still at the constant command `u`."""
        return np.asarray(np.linalg.solve(np.eye(self.order) - self.a, self.b) * u, np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class PlantSet:
    """The plant of one axis and its members, all at one sampling time.

    Attributes
    ----------
    weights : ndarray, shape (len(members),)
        Positive, sum 1.
    """

    nominal: DiscretePlant
    members: tuple[DiscretePlant, ...]
    weights: Array

    @property
    def dt_s(self) -> float:
        """Sampling time."""
        return self.nominal.dt_s

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes of all plants, each once."""
        return tuple(dict.fromkeys(n for p in (self.nominal, *self.members) for n in p.notes))

    def settling_time_s(self, tolerance: float = 0.01) -> float:
        """Return the longest settling time of the set."""
        return max(p.settling_time_s(tolerance) for p in (self.nominal, *self.members))


def continuous(spec: PlantSpec) -> ContinuousPlant:
    """Return the plant in continuous time.

    A discrete plant becomes the continuous one whose first-order-hold equivalent it is.

    Raises
    ------
    ModelError
        If a discrete plant has none: a pure delay, or a pole on the negative real axis.
    """
    if spec.sampling_s is None:
        roots = spec.roots()
        return ContinuousPlant(*balanced(*cascade(roots), discrete=False), spec.notes)
    return _undo_hold(_as_sampled(spec), spec)


def discretise(spec: PlantSpec, dt_s: float) -> DiscretePlant:
    """Return the plant at the sampling time `dt_s`; DC gain 1.

    Continuous plants by first-order hold, exact for a command that is linear between samples.
    Discrete plants as they are if their sampling time is `dt_s`, otherwise by way of the
    continuous plant whose first-order-hold equivalent they are.

    Raises
    ------
    ModelError
        If `dt_s` is not positive, or a discrete plant cannot be brought to it.
    """
    if not (np.isfinite(dt_s) and dt_s > 0):
        raise ModelError(f"sampling time {dt_s} s must be positive")
    return _discretised(spec, float(dt_s))


@lru_cache(maxsize=64)
def plant_set(spec: PlantSetSpec, dt_s: float) -> PlantSet:
    """Discretise the nominal plant and the members of `spec`."""
    listed = spec.weighted_members()
    weights = np.array([m.weight for m in listed])
    return PlantSet(
        discretise(spec.nominal, dt_s),
        tuple(discretise(m.plant, dt_s) for m in listed),
        weights / weights.sum(),
    )


def frequency_response(
    plant: PlantSpec | ContinuousPlant | DiscretePlant, f_hz: ArrayLike
) -> Complex:
    """Return the response at `f_hz`, of its shape; a document answers from its roots."""
    if isinstance(plant, (ContinuousPlant, DiscretePlant)):
        return plant.frequency_response(f_hz)
    f = np.atleast_1d(np.asarray(f_hz, float))
    if isinstance(plant, FirSpec):
        taps = np.array(plant.taps) / float(np.sum(plant.taps))
        return np.asarray(polyval(np.exp(-2j * np.pi * f * plant.dt_s), taps), complex)
    roots = plant.roots()
    discrete = roots.dt_s is not None
    at = np.exp(2j * np.pi * f * (roots.dt_s or 0.0)) if discrete else 2j * np.pi * f
    dc = 1.0 if discrete else 0.0
    response = np.ones(len(f), complex)
    for zero in roots.zeros:
        response *= (at - zero) / (dc - zero)
    for pole in roots.poles:
        response *= (dc - pole) / (at - pole)
    return response


def balanced_discrete(
    a: Array, b: Array, c: Array, d: float, notes: Sequence[str], dt_s: float
) -> DiscretePlant:
    """Return a DiscretePlant with its states scaled to equal size at input and output."""
    return DiscretePlant(*balanced(a, b, c, d, discrete=True), tuple(notes), dt_s)


@lru_cache(maxsize=512)
def _discretised(spec: PlantSpec, dt_s: float) -> DiscretePlant:
    own = spec.sampling_s
    if own is not None and abs(own - dt_s) <= 1e-9 * dt_s:
        return replace(_as_sampled(spec), dt_s=dt_s)
    plant = continuous(spec).discretise(dt_s)
    if own is None:
        return plant
    note = f"discrete model at {own * 1e3:g} ms converted to {dt_s * 1e3:g} ms"
    return replace(plant, notes=(*plant.notes, note))


def _as_sampled(spec: PlantSpec) -> DiscretePlant:
    """Realise a discrete document at its own sampling time."""
    dt_s = spec.sampling_s
    assert dt_s is not None
    if isinstance(spec, FirSpec):
        taps = np.array(spec.taps) / float(np.sum(spec.taps))
        n = len(taps) - 1
        shift = np.eye(n, k=-1)
        return DiscretePlant(
            shift, np.eye(n, 1)[:, 0], taps[1:].copy(), float(taps[0]), spec.notes, dt_s
        )
    return balanced_discrete(*cascade(spec.roots()), spec.notes, dt_s)


def _undo_hold(plant: DiscretePlant, spec: PlantSpec) -> ContinuousPlant:
    """Invert the first-order hold."""
    from scipy.linalg import expm, logm

    if plant.order == 0:
        return ContinuousPlant(plant.a, plant.b, plant.c, plant.d, plant.notes)
    roots: Roots = spec.roots()
    negative = (roots.poles.imag == 0) & (roots.poles.real <= 0)
    if negative.any():
        pole = roots.poles[negative][0].real
        raise ModelError(
            f"the discrete plant ({plant.dt_s * 1e3:g} ms) has a pole at z = {pole:.4g}: "
            "a pure delay or an alternation that no continuous plant has, so it cannot be "
            f"used at another sampling time; design at {plant.dt_s * 1e3:g} ms or give a "
            "continuous model"
        )
    n, dt_s = plant.order, plant.dt_s
    rate = np.asarray(np.real(logm(plant.a)) / dt_s, np.float64)
    block = np.zeros((3 * n, 3 * n))
    block[:n, :n] = rate * dt_s
    block[:n, n : 2 * n] = np.eye(n) * dt_s
    block[n : 2 * n, 2 * n :] = np.eye(n)
    grown = expm(block)
    step, ramp = grown[:n, n : 2 * n], grown[:n, 2 * n :]
    b = np.asarray(np.linalg.solve(step - ramp + plant.a @ ramp, plant.b), np.float64)
    d = plant.d - float(plant.c @ ramp @ b)
    return ContinuousPlant(*balanced(rate, b, plant.c, d, discrete=False), plant.notes)
