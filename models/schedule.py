"""Variation of an axis' plant during a print: with the mass on the bed, and with position.

Mass (a bed that moves): stiffness k and viscous damping c are the machine's and stay, the mass
grows from m0 to m0 + m. With w^2 = k / m and 2 zeta w = c / m, frequency and damping ratio of the
bed's mode both fall by 1 / sqrt(1 + m / m0). Modes of the frame stay where they are.

Position: plants measured at points of a grid of x, y and z; between them frequencies, damping
ratios and gains run smoothly from one to the next.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from stillpath.models.document import Document, Positive
from stillpath.models.errors import ModelError
from stillpath.models.plant_specs import (
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
    WeightedMember,
    ZeroPair,
    ZpkSpec,
)
from stillpath.models.roots import frequency_and_damping, to_s

__all__ = [
    "EMPTY",
    "AxisSchedule",
    "Coordinate",
    "GridNode",
    "GridSchedule",
    "MassSchedule",
    "MovingMass",
    "OperatingPoint",
    "moving_mass_from_two_runs",
    "resonances_hz",
]

Coordinate = Literal["x", "y", "z"]
Followed: TypeAlias = ModesSpec | RelativeModesSpec | PairsSpec
"""Plants whose numbers can run from one place to the next."""
COORDINATES: tuple[Coordinate, ...] = ("x", "y", "z")


@dataclass(frozen=True, slots=True)
class OperatingPoint:
    """Where a machine is: what lies on its bed, and the position of the nozzle."""

    mass_kg: float = 0.0
    x_mm: float = 0.0
    y_mm: float = 0.0
    z_mm: float = 0.0


EMPTY = OperatingPoint()
"""An empty bed."""


@dataclass(frozen=True, slots=True)
class MovingMass:
    """Mass that an axis moves, with its standard deviation."""

    mass_kg: float
    sd_kg: float


class MassSchedule(Document):
    """The axis moves the bed, and the print on it.

    Attributes
    ----------
    moving_mass_kg : float
        m0: what the axis moves when its plants were measured (see `moving_mass_from_two_runs`).
    filament_density_g_cm3 : float
        PLA 1.24, PETG 1.27, ABS 1.04.
    modes : sequence of int
        Resonances that the mass lowers, counted from 0 in the order of their frequencies. A zero
        goes with the resonance that is nearest to it.
    """

    moving_mass_kg: Positive
    filament_density_g_cm3: Annotated[float, Field(gt=0, le=25, allow_inf_nan=False)] = 1.24
    modes: Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(min_length=1)] = (0,)

    def factor(self, mass_kg: float) -> float:
        """Return f / f0 = zeta / zeta0 with so much on the bed."""
        return 1.0 / math.sqrt(1.0 + mass_kg / self.moving_mass_kg)

    def loaded(self, plant: PlantSpec, mass_kg: float) -> PlantSpec:
        """Return the plant with so much on the bed; DC gain stays 1.

        Raises
        ------
        ModelError
            If the plant has no such resonance.
        """
        self.check(plant)
        return plant if mass_kg == 0.0 else _scaled(plant, self.factor(mass_kg), set(self.modes))

    def check(self, plant: PlantSpec) -> None:
        """Raise ModelError unless the plant has the resonances that the mass shall lower."""
        count = len(resonances_hz(plant))
        if max(self.modes) >= count:
            raise ModelError(
                f"mass.modes names resonance {max(self.modes)}, but the plant (kind {plant.kind}) "
                f"has {count}, counted from 0"
                + ("; give modes or zeros and poles" if isinstance(plant, FirSpec) else "")
            )


_Place = Annotated[float, Field(ge=-1e5, le=1e5, allow_inf_nan=False)]


class GridNode(Document):
    """The plant at one point; coordinates that do not matter are left out."""

    x_mm: _Place | None = None
    y_mm: _Place | None = None
    z_mm: _Place | None = None
    plant: Annotated[Followed, Field(discriminator="kind")]


class GridSchedule(Document):
    """Plants at the points of a full grid: every x with every y and z that occurs.

    All plants have the same structure, and number i of one is number i of all: mode with mode, pole
    with pole. Beyond the outermost points the plant stays as it is there.
    """

    nodes: Annotated[tuple[GridNode, ...], Field(min_length=2, max_length=400)]

    def coordinates_mm(self, axis: Coordinate) -> tuple[float, ...]:
        """Return the values of a coordinate, rising; empty if the plant does not depend on it."""
        found = {getattr(node, f"{axis}_mm") for node in self.nodes}
        return tuple(sorted(v for v in found if v is not None))

    def plant(self, point: OperatingPoint) -> PlantSpec:
        """Return the plant at a point: a node's own, or between nodes."""
        corners: list[tuple[float, tuple[float, ...]]] = [(1.0, ())]
        for axis in self._axes():
            near = _neighbours(self.coordinates_mm(axis), getattr(point, f"{axis}_mm"))
            corners = [(w * share, (*at, v)) for w, at in corners for v, share in near]
        table = self._table()
        kept = [(w, table[at]) for w, at in corners if w > 0.0]
        return kept[0][1] if len(kept) == 1 else _between(kept)

    def _axes(self) -> list[Coordinate]:
        return [axis for axis in COORDINATES if self.coordinates_mm(axis)]

    def _table(self) -> dict[tuple[float, ...], Followed]:
        axes = self._axes()
        return {tuple(getattr(n, f"{a}_mm") for a in axes): n.plant for n in self.nodes}

    @model_validator(mode="after")
    def _full_grid(self) -> Self:
        axes = self._axes()
        if not axes:
            raise ModelError("a grid needs positions: x_mm, y_mm or z_mm of every node")
        for number, node in enumerate(self.nodes):
            for axis in axes:
                if getattr(node, f"{axis}_mm") is None:
                    raise ModelError(f"node {number} lacks {axis}_mm, which other nodes give")
        table = self._table()
        if len(table) < len(self.nodes):
            raise ModelError(f"{len(self.nodes) - len(table)} nodes lie where another one does")
        for at in itertools.product(*(self.coordinates_mm(axis) for axis in axes)):
            if at not in table:
                where = ", ".join(f"{a} {v:g}" for a, v in zip(axes, at, strict=True))
                raise ModelError(
                    f"the grid has no node at {where} mm: give every combination of the "
                    "coordinates that occur"
                )
        first = self.nodes[0].plant
        for number, node in enumerate(self.nodes):
            if _structure(node.plant) != _structure(first):
                raise ModelError(
                    f"the plant of node {number} ({_structure(node.plant)}) has another structure "
                    f"than that of node 0 ({_structure(first)}); fit all with the same order"
                )
        return self


class AxisSchedule(Document):
    """What changes the plants of one axis: the mass on the bed, the position, or both.

    A grid takes the place of the axis's nominal plant; the mass then works on what the grid gives.
    """

    mass: MassSchedule | None = None
    grid: GridSchedule | None = None

    def plants(self, spec: PlantSetSpec, point: OperatingPoint) -> PlantSetSpec:
        """Return nominal plant and members of an axis at a point."""
        nominal, members = spec.nominal, spec.members
        if self.grid is not None:
            nominal = self.grid.plant(point)
        if self.mass is not None:
            nominal = self.mass.loaded(nominal, point.mass_kg)
            if not isinstance(members, ParametricMembers):
                members = tuple(
                    WeightedMember(plant=self.mass.loaded(m.plant, point.mass_kg), weight=m.weight)
                    for m in members
                )
        return spec.model_copy(update={"nominal": nominal, "members": members})

    def check(self, spec: PlantSetSpec) -> None:
        """Raise ModelError unless the schedule fits the plants of its axis."""
        if (
            self.grid is not None
            and spec.members
            and not isinstance(spec.members, ParametricMembers)
        ):
            raise ModelError(
                "members that are listed one by one do not follow a grid: give frequency_scale and "
                "damping_scale, or no members"
            )
        if self.mass is not None:
            listed = () if isinstance(spec.members, ParametricMembers) else spec.members
            nodes = self.grid.nodes if self.grid else ()
            for plant in (spec.nominal, *(m.plant for m in listed), *(n.plant for n in nodes)):
                self.mass.check(plant)

    @model_validator(mode="after")
    def _something(self) -> Self:
        if self.mass is None and self.grid is None:
            raise ModelError("a schedule needs `mass`, `grid` or both")
        return self


def moving_mass_from_two_runs(
    f0_hz: float,
    f1_hz: float,
    added_kg: float,
    *,
    f0_sd_hz: float = 0.0,
    f1_sd_hz: float = 0.0,
) -> MovingMass:
    """Return the moving mass from the resonance without and with a known weight on the bed.

    m0 = dm / ((f0 / f1)^2 - 1), which follows from f ~ 1 / sqrt(m) at constant stiffness.

    Parameters
    ----------
    f0_hz, f1_hz : float
        Frequency of the bed's mode with the bed empty, and with the weight at its centre.
    f0_sd_hz, f1_sd_hz : float
        Standard deviations; that of the result is propagated to first order.

    Raises
    ------
    ModelError
        If a value is not positive, the weight did not lower the frequency, or the two runs differ
        by so little that the mass is uncertain by half of itself.
    """
    for name, value in (("f0_hz", f0_hz), ("f1_hz", f1_hz), ("added_kg", added_kg)):
        if not (math.isfinite(value) and value > 0):
            raise ModelError(f"{name} is {value:g}; a positive number is needed")
    if f1_hz >= f0_hz:
        raise ModelError(
            f"with {added_kg:g} kg on the bed the resonance is at {f1_hz:g} Hz, not below the "
            f"{f0_hz:g} Hz of the empty bed: were the runs swapped, another axis measured, or did "
            "the weight slide?"
        )
    ratio = (f0_hz / f1_hz) ** 2
    mass_kg = added_kg / (ratio - 1.0)
    relative = 2.0 * ratio / (ratio - 1.0) * math.hypot(f0_sd_hz / f0_hz, f1_sd_hz / f1_hz)
    sd_kg = mass_kg * relative
    if sd_kg > 0.5 * mass_kg:
        raise ModelError(
            f"{f0_hz:g} Hz without and {f1_hz:g} Hz with {added_kg:g} kg give {mass_kg:.3g} kg "
            f"+- {sd_kg:.2g} kg: the shift is lost in the scatter of the runs; take a heavier "
            "weight"
        )
    return MovingMass(mass_kg, sd_kg)


def resonances_hz(plant: PlantSpec) -> NDArray[np.float64]:
    """Return the frequencies of the resonances, rising (none for kind fir)."""
    if isinstance(plant, (ModesSpec, RelativeModesSpec)):
        return np.sort([m.f_hz for m in plant.modes])
    if isinstance(plant, PairsSpec):
        return np.sort([p.f_hz for p in plant.poles])
    if isinstance(plant, FirSpec):
        return np.zeros(0)
    roots = plant.roots()
    return np.asarray(frequency_and_damping(roots.poles, roots.dt_s)[:, 0])


def _scaled(plant: PlantSpec, factor: float, chosen: Collection[int]) -> PlantSpec:
    """Return the plant with frequency and damping of some resonances multiplied by `factor`."""
    if isinstance(plant, (ModesSpec, RelativeModesSpec)):
        by = _factors([m.f_hz for m in plant.modes], factor, chosen)
        modes = tuple(m.scaled(g, g) for m, g in zip(plant.modes, by, strict=True))
        return plant.model_validate({"modes": modes})
    if isinstance(plant, PairsSpec):
        poles = [p.f_hz for p in plant.poles]
        by = _factors(poles, factor, chosen)
        follow = [by[_nearest(poles, z.f_hz)] for z in plant.zeros]
        return PairsSpec(
            poles=tuple(p.scaled(g, g) for p, g in zip(plant.poles, by, strict=True)),
            zeros=tuple(z.scaled(g, g) for z, g in zip(plant.zeros, follow, strict=True)),
            # c / k of the damper between motor and bed: no mass in it.
            real_zero_tau_s=plant.real_zero_tau_s,
        )
    roots = plant.roots()
    known = resonances_hz(plant)
    every = _factors(known, factor, chosen)
    return ZpkSpec(
        zeros=_listed(_moved(roots.zeros, roots.dt_s, known, every)),
        poles=_listed(_moved(roots.poles, roots.dt_s, known, every)),
        dt_s=roots.dt_s,
    )


def _factors(f_hz: Iterable[float], factor: float, chosen: Collection[int]) -> list[float]:
    """Factor of every resonance, in the order in which they are listed."""
    rank = np.argsort(np.argsort(list(f_hz), kind="stable"), kind="stable")
    return [factor if int(k) in chosen else 1.0 for k in rank]


def _nearest(f_hz: Sequence[float] | NDArray[np.float64], wanted_hz: float) -> int:
    return int(np.argmin(np.abs(np.log(np.asarray(f_hz) / wanted_hz))))


def _moved(
    roots: NDArray[np.complex128],
    dt_s: float | None,
    known_hz: NDArray[np.float64],
    factors: Sequence[float],
) -> NDArray[np.complex128]:
    """Move the pairs that go with a resonance; real roots stay."""
    moved = roots.copy()
    for k, s in enumerate(to_s(roots, dt_s)[0]):
        if roots[k].imag == 0:
            continue
        size = abs(s)
        by = factors[_nearest(known_hz, size / (2 * math.pi))]
        zeta = -s.real / size * by
        new = size * by * complex(-zeta, math.copysign(math.sqrt(1.0 - zeta * zeta), s.imag))
        moved[k] = new if dt_s is None else np.exp(new * dt_s)
    return moved


def _listed(roots: NDArray[np.complex128]) -> tuple[tuple[float, float], ...]:
    return tuple((float(r.real), float(r.imag)) for r in roots)


def _structure(plant: Followed) -> str:
    if isinstance(plant, (ModesSpec, RelativeModesSpec)):
        return f"{len(plant.modes)} {plant.kind.replace('_', ' ')}"
    real = " and a real zero" if plant.real_zero_tau_s else ""
    return f"{len(plant.poles)} pole pairs, {len(plant.zeros)} zero pairs{real}"


def _neighbours(values: Sequence[float], wanted: float) -> list[tuple[float, float]]:
    """Values on both sides of a wanted one, and their shares."""
    k = int(np.clip(np.searchsorted(values, wanted, "right") - 1, 0, max(len(values) - 2, 0)))
    if len(values) == 1:
        return [(values[0], 1.0)]
    low, high = values[k], values[k + 1]
    share = float(np.clip((wanted - low) / (high - low), 0.0, 1.0))
    return [(low, 1.0 - share), (high, share)]


def _between(corners: Sequence[tuple[float, Followed]]) -> PlantSpec:
    """Mean of plants of one structure: of logarithms for what is positive."""
    shares = [share for share, _ in corners]

    def log_mean(values: Iterable[float]) -> float:
        return math.exp(sum(w * math.log(v) for w, v in zip(shares, values, strict=True)))

    def mean(values: Iterable[float]) -> float:
        return sum(w * v for w, v in zip(shares, values, strict=True))

    plants = [plant for _, plant in corners]
    modal = [p for p in plants if isinstance(p, ModesSpec)]
    if modal:
        return ModesSpec(
            modes=tuple(
                Mode(
                    f_hz=log_mean(m.f_hz for m in same),
                    zeta=log_mean(m.zeta for m in same),
                    gain=mean(m.gain for m in same),
                )
                for same in zip(*(p.modes for p in modal), strict=True)
            )
        )
    relative = [p for p in plants if isinstance(p, RelativeModesSpec)]
    if relative:
        return RelativeModesSpec(
            modes=tuple(
                RelativeMode(
                    f_hz=log_mean(m.f_hz for m in same),
                    zeta=log_mean(m.zeta for m in same),
                    share=mean(m.share for m in same),
                    grounded=mean(m.grounded for m in same),
                )
                for same in zip(*(p.modes for p in relative), strict=True)
            )
        )
    pairs = [p for p in plants if isinstance(p, PairsSpec)]
    return PairsSpec(
        poles=tuple(
            PolePair(f_hz=log_mean(q.f_hz for q in same), zeta=log_mean(q.zeta for q in same))
            for same in zip(*(p.poles for p in pairs), strict=True)
        ),
        zeros=tuple(
            ZeroPair(f_hz=log_mean(z.f_hz for z in same), zeta=mean(z.zeta for z in same))
            for same in zip(*(p.zeros for p in pairs), strict=True)
        ),
        real_zero_tau_s=mean(p.real_zero_tau_s for p in pairs),
    )
