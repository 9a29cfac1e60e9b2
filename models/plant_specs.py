"""Plants as documents: six kinds of JSON document and the sets made of them.

Every kind is checked where it is read: finite, proper, stable, free of integrators, and with
DC gain 1 (an axis without slip reaches every position it is told to).
"""

from __future__ import annotations

from functools import lru_cache
from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from stillpath.models.document import Document, Finite, Positive
from stillpath.models.errors import ModelError
from stillpath.models.provenance import Provenance
from stillpath.models.roots import Roots, check_stable, dc_gain, normalise_dc, scaled_roots

__all__ = [
    "MOST_FRICTION_MM",
    "FirSpec",
    "Mode",
    "ModesSpec",
    "PairsSpec",
    "ParametricMembers",
    "PlantSetSpec",
    "PlantSpec",
    "PolePair",
    "RelativeMode",
    "RelativeModesSpec",
    "TfSpec",
    "WeightedMember",
    "ZeroPair",
    "ZpkSpec",
]

Damping = Annotated[float, Field(gt=0, le=10, allow_inf_nan=False)]
SamplingTime = Annotated[float, Field(gt=1e-6, le=1.0, allow_inf_nan=False)]
Root = tuple[Finite, Finite]
"""Real and imaginary part of a zero or pole."""

MOST_FRICTION_MM = 0.1
"""Guides that hold an axis back by more are to be mended, not compensated."""


class _Plant(Document):
    """What every kind of plant can say about itself."""

    @property
    def sampling_s(self) -> float | None:
        """Sampling time of a discrete plant, None for a continuous one."""
        return None

    @property
    def notes(self) -> tuple[str, ...]:
        """What was changed on reading, in words (DC gain scaled to 1)."""
        return normalise_dc(self._as_written())[1]

    def roots(self) -> Roots:
        """Zeros and poles of the plant with DC gain 1, in s (rad/s) or in z."""
        return normalise_dc(self._as_written())[0]

    def scaled(self, frequency: float, damping: float) -> _Plant:
        """Return the plant with every frequency and damping ratio multiplied.

        Real poles scale with the frequency; real zeros and roots that only sampling made
        (on the negative real axis of z, or 0) stay. DC gain stays 1.
        """
        roots = scaled_roots(self.roots(), frequency, damping)
        return ZpkSpec(
            zeros=tuple((float(z.real), float(z.imag)) for z in roots.zeros),
            poles=tuple((float(p.real), float(p.imag)) for p in roots.poles),
            dt_s=roots.dt_s,
        )

    def _as_written(self) -> Roots:
        raise NotImplementedError

    @model_validator(mode="after")
    def _usable(self) -> Self:
        roots = self._as_written()
        check_stable(roots)
        normalise_dc(roots)
        return self


class _Resonance(Document):
    f_hz: Positive
    zeta: Damping

    def scaled(self, frequency: float, damping: float) -> Self:
        """Return it with frequency and damping ratio multiplied."""
        values = {"f_hz": self.f_hz * frequency, "zeta": self.zeta * damping}
        return self.model_validate(dict(self) | values)


class Mode(_Resonance):
    """One resonance: gain / (1 + 2 zeta s/w + s^2/w^2) with w = 2 pi f_hz."""

    gain: Finite = 1.0


class ModesSpec(_Plant):
    """Sum of resonances; the gains add up to the DC gain."""

    kind: Literal["modes"] = "modes"
    modes: Annotated[tuple[Mode, ...], Field(min_length=1, max_length=12)]

    def scaled(self, frequency: float, damping: float) -> ModesSpec:
        """See `_Plant.scaled`."""
        return ModesSpec(modes=tuple(m.scaled(frequency, damping) for m in self.modes))

    def _as_written(self) -> Roots:
        return _sum_of_modes(tuple((m.f_hz, m.zeta, m.gain, 0.0) for m in self.modes))


class RelativeMode(_Resonance):
    """share (2 zeta s/w + 1) / (1 + 2 zeta s/w + s^2/w^2), w = 2 pi f_hz.

    Attributes
    ----------
    share : float
        Of a slow motion; those of a plant add up to 1. Negative where the nozzle swings against
        what drives it.
    grounded : float
        Share of the damping that acts against the frame (viscous guides) and not between the
        parts that move: `2 zeta s/w` of the numerator is multiplied by 1 - grounded.
    """

    share: Finite
    grounded: Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)] = 0.0


class RelativeModesSpec(_Plant):
    """Sum of resonances whose damping acts on relative speed, inside belts and joints.

    At rest and at constant speed such an axis stands where it is told: its delay at zero frequency
    is 0 whatever the parameters are, unless damping is `grounded`.
    """

    kind: Literal["relative_modes"] = "relative_modes"
    modes: Annotated[tuple[RelativeMode, ...], Field(min_length=1, max_length=12)]

    @property
    def delay_s(self) -> float:
        """Delay of slow motion: sum of share 2 zeta grounded / w."""
        total = sum(m.share for m in self.modes)
        return float(
            sum(m.share * m.zeta * m.grounded / (np.pi * m.f_hz) for m in self.modes) / total
        )

    def without_delay(self) -> RelativeModesSpec:
        """Return the plant with all of its damping between the parts that move."""
        return RelativeModesSpec(
            modes=tuple(m.model_copy(update={"grounded": 0.0}) for m in self.modes)
        )

    def scaled(self, frequency: float, damping: float) -> RelativeModesSpec:
        """See `_Plant.scaled`."""
        return RelativeModesSpec(modes=tuple(m.scaled(frequency, damping) for m in self.modes))

    def _as_written(self) -> Roots:
        return _sum_of_modes(tuple((m.f_hz, m.zeta, m.share, 1.0 - m.grounded) for m in self.modes))


class PolePair(_Resonance):
    """1 + 2 zeta s/w + s^2/w^2 in the denominator, w = 2 pi f_hz."""


class ZeroPair(_Resonance):
    """1 + 2 zeta s/w + s^2/w^2 in the numerator; zeta < 0 is non-minimum phase."""

    zeta: Annotated[float, Field(ge=-10, le=10, allow_inf_nan=False)]


class PairsSpec(_Plant):
    """G(s) = (1 + tau s) prod zeros / prod poles; DC gain 1 by construction."""

    kind: Literal["pairs"] = "pairs"
    poles: Annotated[tuple[PolePair, ...], Field(min_length=1, max_length=12)]
    zeros: tuple[ZeroPair, ...] = ()
    real_zero_tau_s: Finite = 0.0

    def without_delay(self) -> PairsSpec:
        """Return the plant whose slow motion is not delayed: `real_zero_tau_s` makes it so.

        A recording does not tell when it began, so a delay of the plant and one of the clock look
        alike; an axis at constant speed stands where it is told. To first order in frequency this
        is the plant, advanced by its delay; at a resonance it differs by 2 zeta^2.
        """
        poles_s = sum(p.zeta / (np.pi * p.f_hz) for p in self.poles)
        zeros_s = sum(z.zeta / (np.pi * z.f_hz) for z in self.zeros)
        return self.model_copy(update={"real_zero_tau_s": float(poles_s - zeros_s)})

    def scaled(self, frequency: float, damping: float) -> PairsSpec:
        """See `_Plant.scaled`; `real_zero_tau_s` stays."""
        return PairsSpec(
            poles=tuple(p.scaled(frequency, damping) for p in self.poles),
            zeros=tuple(z.scaled(frequency, damping) for z in self.zeros),
            real_zero_tau_s=self.real_zero_tau_s,
        )

    def _as_written(self) -> Roots:
        zeros = [_pair(z.f_hz, z.zeta) for z in self.zeros]
        if self.real_zero_tau_s != 0.0:
            zeros.append(np.array([-1.0 / self.real_zero_tau_s]))
        poles = [_pair(p.f_hz, p.zeta) for p in self.poles]
        return Roots(_complex(*zeros), _complex(*poles), 1.0, None)


class ZpkSpec(_Plant):
    """Zeros and poles as (real, imaginary): in s (rad/s), or in z when `dt_s` is given.

    `gain` None means: whatever makes the DC gain 1.
    """

    kind: Literal["zpk"] = "zpk"
    zeros: tuple[Root, ...] = ()
    poles: Annotated[tuple[Root, ...], Field(min_length=1, max_length=40)]
    gain: Finite | None = None
    dt_s: SamplingTime | None = None

    @property
    def sampling_s(self) -> float | None:
        """See `_Plant.sampling_s`."""
        return self.dt_s

    def _as_written(self) -> Roots:
        zeros = _conjugate(self.zeros, "zero")
        poles = _conjugate(self.poles, "pole")
        gain = 1.0 if self.gain is None else self.gain * dc_gain(zeros, poles, self.dt_s)
        return Roots(zeros, poles, gain, self.dt_s)


class TfSpec(_Plant):
    """Numerator and denominator, highest power first, in s or (with `dt_s`) in z."""

    kind: Literal["tf"] = "tf"
    num: Annotated[tuple[Finite, ...], Field(min_length=1, max_length=41)]
    den: Annotated[tuple[Finite, ...], Field(min_length=2, max_length=41)]
    dt_s: SamplingTime | None = None

    @property
    def sampling_s(self) -> float | None:
        """See `_Plant.sampling_s`."""
        return self.dt_s

    def _as_written(self) -> Roots:
        num = np.trim_zeros(np.array(self.num), "f")
        den = np.trim_zeros(np.array(self.den), "f")
        if len(den) < 2:
            raise ModelError("the denominator `den` has no pole; use kind 'fir' for a pure gain")
        if len(num) == 0:
            raise ModelError("the numerator `num` is zero")
        if self.dt_s is None:
            at_dc, size = float(den[-1]), float(np.abs(den).max())
            # Continuous coefficients span decades: only an exact zero is an integrator here,
            # `check_stable` finds the rest.
            integrator = at_dc == 0.0
            gain = float(num[-1]) / at_dc if at_dc else 0.0
        else:
            at_dc, size = float(den.sum()), float(np.abs(den).sum())
            integrator = abs(at_dc) < 1e-9 * size
            gain = float(num.sum()) / at_dc if at_dc else 0.0
        if integrator:
            raise ModelError(
                f"model has an integrator (coefficients rounded?): the denominator is {at_dc:.1e} "
                f"at zero frequency, against coefficients of {size:.3g} in all, so its DC gain is "
                "infinite; give more decimals, or let models.repair.repair_rounded find the "
                "smallest change within the rounding that makes the DC gain 1"
            )
        return Roots(_complex(np.roots(num)), _complex(np.roots(den)), gain, self.dt_s)


class FirSpec(_Plant):
    """Impulse response at `dt_s`: y(k) = sum_i taps[i] u(k - i)."""

    kind: Literal["fir"] = "fir"
    taps: Annotated[tuple[Finite, ...], Field(min_length=1, max_length=512)]
    dt_s: SamplingTime

    @property
    def sampling_s(self) -> float | None:
        """See `_Plant.sampling_s`."""
        return self.dt_s

    def scaled(self, frequency: float, damping: float) -> FirSpec:
        """Refuse: taps have no frequencies (only the factors 1, 1 pass)."""
        if frequency == 1.0 and damping == 1.0:
            return self
        raise ModelError(
            "a plant of kind 'fir' has no frequencies to scale; list its members one by one"
        )

    def _as_written(self) -> Roots:
        taps = np.array(self.taps)
        used = np.trim_zeros(taps, "f")
        return Roots(
            _complex(np.roots(used)),
            np.zeros(len(taps) - 1, complex),
            float(taps.sum()),
            self.dt_s,
        )


PlantSpec = Annotated[
    ModesSpec | RelativeModesSpec | PairsSpec | ZpkSpec | TfSpec | FirSpec,
    Field(discriminator="kind"),
]


class WeightedMember(Document):
    """One plant the axis may turn into, with its share of the design."""

    plant: PlantSpec
    weight: Positive = 1.0


class ParametricMembers(Document):
    """Members = the nominal plant with every frequency scale x every damping scale."""

    frequency_scale: Annotated[tuple[Positive, ...], Field(min_length=1, max_length=15)] = (1.0,)
    damping_scale: Annotated[tuple[Positive, ...], Field(min_length=1, max_length=15)] = (1.0,)


class PlantSetSpec(Document):
    """The plant of one axis (commanded to actual position) and what it may turn into.

    Attributes
    ----------
    members : sequence of WeightedMember, or ParametricMembers
        Empty: the nominal plant alone.
    band_hz : (low, high), optional
        Where the model was measured; it is a guess outside.
    provenance : Provenance, optional
        How the plants were found.
    friction_mm : float, optional
        How far dry friction holds the axis back, force over stiffness (`models.friction`).
    """

    nominal: PlantSpec
    members: tuple[WeightedMember, ...] | ParametricMembers = ()
    band_hz: tuple[Positive, Positive] | None = None
    provenance: Provenance | None = None
    friction_mm: Annotated[float, Field(ge=0, le=MOST_FRICTION_MM)] | None = None

    @model_validator(mode="after")
    def _members_usable(self) -> Self:
        if self.band_hz is not None and self.band_hz[0] >= self.band_hz[1]:
            raise ModelError(f"band_hz {self.band_hz} must rise")
        self.weighted_members()
        return self

    def with_friction(self, held_mm: float | None, *, assumed: bool = False) -> PlantSetSpec:
        """Return the set with friction that holds the axis back so far; `assumed`: not measured."""
        about = self.provenance
        if about is not None:
            about = about.model_copy(update={"friction": "assumed" if assumed else None})
        return self.model_copy(update={"friction_mm": held_mm, "provenance": about})

    @property
    def friction_assumed(self) -> bool:
        """Whether its friction was assumed, not measured."""
        return self.provenance is not None and self.provenance.friction == "assumed"

    def without_delay(self) -> PlantSetSpec:
        """Return the set for which commands are designed: none of its modes' damping is `grounded`.

        Spectra do not show how much of it is, and leading by what the clocks of logs show made some
        printers better and others worse (docs/tried.md). Other plants keep what delay they have.
        """
        if isinstance(self.members, ParametricMembers):
            members: tuple[WeightedMember, ...] | ParametricMembers = self.members
        else:
            members = tuple(
                m.model_copy(update={"plant": _without_delay(m.plant)}) for m in self.members
            )
        return self.model_copy(update={"nominal": _without_delay(self.nominal), "members": members})

    def weighted_members(self) -> tuple[WeightedMember, ...]:
        """Return the members written out, the nominal plant alone if there are none."""
        if isinstance(self.members, ParametricMembers):
            return tuple(
                WeightedMember.model_validate({"plant": self.nominal.scaled(f, z).model_dump()})
                for f in self.members.frequency_scale
                for z in self.members.damping_scale
            )
        return self.members or (WeightedMember(plant=self.nominal),)


def _without_delay(plant: PlantSpec) -> PlantSpec:
    return plant.without_delay() if isinstance(plant, RelativeModesSpec) else plant


# A machine's document is read again and again, with the same dozens of members.
@lru_cache(4096)
def _sum_of_modes(modes: tuple[tuple[float, float, float, float], ...]) -> Roots:
    """Return the roots of a sum of gain (1 + relative 2 zeta s/w) / (1 + 2 zeta s/w + s^2/w^2).

    Parameters
    ----------
    modes : tuple of (f_hz, zeta, gain, relative)
    """
    # In units of the mean frequency the polynomials stay well scaled.
    unit = 2 * np.pi * float(np.exp(np.mean([np.log(f_hz) for f_hz, *_ in modes])))
    denominators = [
        np.array([(unit / w) ** 2, 2 * zeta * unit / w, 1.0])
        for f_hz, zeta, _, _ in modes
        for w in (2 * np.pi * f_hz,)
    ]
    numerator = np.zeros(2 * len(denominators))
    for i, (_, _, gain, relative) in enumerate(modes):
        term = gain * np.array([relative * denominators[i][1], 1.0])
        for j, other in enumerate(denominators):
            if j != i:
                term = np.convolve(term, other)
        numerator[len(numerator) - len(term) :] += term
    # A leading coefficient of rounding size would be a zero at infinity in disguise.
    tiny = 1e-13 * np.abs(numerator).max()
    numerator = np.trim_zeros(np.where(np.abs(numerator) < tiny, 0.0, numerator), "f")
    zeros = np.roots(numerator) * unit if len(numerator) else np.zeros(0)
    poles = np.concatenate([_pair(f_hz, zeta) for f_hz, zeta, _, _ in modes])
    roots = Roots(_complex(zeros), _complex(poles), sum(gain for _, _, gain, _ in modes), None)
    roots.zeros.flags.writeable = roots.poles.flags.writeable = False  # many share them
    return roots


def _pair(f_hz: float, zeta: float) -> NDArray[np.complex128]:
    root = np.sqrt(complex(zeta * zeta - 1.0))
    return 2 * np.pi * f_hz * np.array([-zeta + root, -zeta - root], dtype=np.complex128)


def _complex(*parts: NDArray[np.generic]) -> NDArray[np.complex128]:
    return np.concatenate([np.zeros(0, complex), *parts]).astype(complex)


def _conjugate(listed: tuple[Root, ...], what: str) -> NDArray[np.complex128]:
    """Return the listed roots, exactly closed under conjugation."""
    roots = np.array([complex(*r) for r in listed], dtype=complex)
    upper = roots[roots.imag > 0]
    lower = list(roots[roots.imag < 0])
    for root in upper:
        gaps = [abs(root.conjugate() - other) for other in lower]
        if not gaps or min(gaps) > 1e-9 * abs(root):
            raise ModelError(
                f"{what} {root:.6g} lacks its complex conjugate; list both of the pair"
            )
        lower.pop(int(np.argmin(gaps)))
    if lower:
        raise ModelError(
            f"{what} {lower[0]:.6g} lacks its complex conjugate; list both of the pair"
        )
    return _complex(roots[roots.imag == 0], upper, upper.conj())
