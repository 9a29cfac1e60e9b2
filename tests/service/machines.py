"""Machines that look like measured ones, for the tests of the store and what lies around it."""

from __future__ import annotations

from datetime import date
from typing import Any

from stillpath.models.confirmation import Confirmation
from stillpath.models.firmware.klipper import PlannerLimits
from stillpath.models.machine import Machine
from stillpath.models.plants import PlantSetSpec
from stillpath.models.store import load_machine

__all__ = ["make_confirmation", "make_machine", "make_plants", "with_accel"]


def make_plants(
    f_hz: float = 52.3, zeta: float = 0.05, *, kind: str = "raw log", on: date | None = None
) -> PlantSetSpec:
    return PlantSetSpec.model_validate(
        {
            "nominal": {"kind": "modes", "modes": [{"f_hz": f_hz, "zeta": zeta}]},
            "members": {"frequency_scale": (0.98, 1.0, 1.02), "damping_scale": (0.8, 1.2)},
            "provenance": {"kind": kind, "measured_on": on, "residual": 0.004},
        }
    )


def make_confirmation(measured_um: float) -> Confirmation:
    digest = "0123456789ab"
    return Confirmation(
        tested_on=date(2026, 3, 2),
        verdict="confirmed",
        predicted_um=(1.0, 9.0),
        measured_um=measured_um,
        scatter_um=0.1,
        uncompensated_um=20.0,
        ratio=measured_um / 20.0,
        sources=(),
        machine="mine",
        revision=digest,
        plants=digest,
    )


def make_machine(name: str = "mine", **changes: Any) -> Machine:
    """A CoreXY machine; `changes` are fields of the document."""
    document = load_machine("generic-corexy").model_dump() | {"name": name, "title": "My printer"}
    return Machine.model_validate(document | changes)


def with_accel(machine: Machine, accel: float) -> Machine:
    planner = PlannerLimits(max_accel_mm_s2=accel)
    firmware = machine.firmware.model_copy(update={"planner": planner})
    return machine.model_copy(update={"firmware": firmware})
