"""Ring tests on two bodies per axis with dry friction, felt by an imperfect sensor."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from stillpath.models.machine import Machine
from stillpath.models.plants import ParametricMembers, PlantSetSpec, PlantSpec, TfSpec
from stillpath.models.ripple import MachineRipple
from stillpath.models.store import load_machine
from stillpath.pipeline.file_dialect import dialect_for
from stillpath.pipeline.file_motion import TextMotion
from stillpath.simulation.printers.bodies import STEP_S, Bodies, Element, Friction
from stillpath.simulation.printers.resonance_test import Accelerometer, Record

__all__ = ["SENSOR", "TRUE", "Chain", "machine_of", "recorded"]

SENSOR = Accelerometer(
    rate_hz=3200 * 1.003,
    step_mm_s2=38.3,
    noise_mm_s2=60.0,
    gains=(1.1, 1.07, 0.95),
    turn_rad=(0.4, 0.1, 1.2),
    offset_s=812.3,
)


@dataclass(frozen=True)
class Chain:
    """Command -> carriage -> head: stiffness and damping of both, masses, friction of the first."""

    f_hz: tuple[float, float]
    zeta: tuple[float, float] = (0.06, 0.04)
    masses_kg: tuple[float, float] = (0.5, 0.12)
    friction_n: float = 0.15

    def _rates(self) -> tuple[tuple[float, float], tuple[float, float]]:
        w = [2 * np.pi * f for f in self.f_hz]
        total = (sum(self.masses_kg), self.masses_kg[1])
        k = tuple(m * v * v for m, v in zip(total, w, strict=True))
        d = tuple(2 * z * m * v for z, m, v in zip(self.zeta, total, w, strict=True))
        return (k[0], k[1]), (d[0], d[1])

    def spec(self) -> TfSpec:
        """Head over command, without friction."""
        k, d = self._rates()
        first, second = ([d[i], k[i]] for i in range(2))
        m = self.masses_kg
        den = np.polysub(
            np.polymul([m[0], d[0] + d[1], k[0] + k[1]], [m[1], *second]),
            np.polymul(second, second),
        )
        num = np.polymul(first, second)
        return TfSpec(num=tuple(num / den[-1]), den=tuple(den / den[-1]))

    def bodies(self, command: tuple[float, float]) -> Bodies:
        """The same with friction."""
        k, d = self._rates()
        elements = (
            Element({"carriage": 1.0}, k[0], d[0], command),
            Element({"head": 1.0, "carriage": -1.0}, k[1], d[1]),
        )
        masses = dict(zip(("carriage", "head"), self.masses_kg, strict=True))
        return Bodies(masses, elements, (Friction({"carriage": 1.0}, self.friction_n),))


TRUE = {"x": Chain((46.0, 120.0)), "y": Chain((36.0, 95.0))}


def machine_of(specs: Mapping[str, PlantSpec]) -> Machine:
    """A machine of these nominal plants, and 3 % of frequency and 20 % of damping around them."""
    base = load_machine("generic-corexy").model_dump()
    members = ParametricMembers(frequency_scale=(0.97, 1.0, 1.03), damping_scale=(0.8, 1.2))
    base["axes"] = {
        axis: PlantSetSpec(nominal=spec, members=members).model_dump()
        for axis, spec in specs.items()
    }
    return Machine.model_validate(base | {"name": "mine"})


def recorded(
    ring: Path,
    machine: Machine,
    true: Mapping[str, Chain] = TRUE,
    *,
    sees: tuple[float, float] = (1.0, 1.0),
    sensor: Accelerometer = SENSOR,
    part_s: tuple[float, float] = (0.0, np.inf),
) -> Record:
    """Return what the sensor records of a file, part of it if need be."""
    with ring.open("rb") as file:
        motion = TextMotion(file, machine, dialect_for(machine, None), STEP_S)
        command = np.concatenate([part.samples.xyz_mm[:2] for part in motion], axis=1)
    command = MachineRipple(machine.kinematics, machine.ripple).received_mm(command)
    felt = np.zeros((3, command.shape[1]))
    for k, (axis, chain) in enumerate(true.items()):
        along = (1.0, 0.0) if axis == "x" else (0.0, 1.0)
        felt[k] = sees[k] * chain.bodies(along).follow(command).accel_mm_s2[1]
    time_s = STEP_S * np.arange(command.shape[1])
    kept = (time_s >= part_s[0]) & (time_s <= part_s[1])
    record = sensor.record(time_s[kept], felt[:, kept], np.random.default_rng(5))
    return replace(record, time_s=record.time_s * (1 + 5e-5))
