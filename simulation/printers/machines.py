"""Printers made of bodies: bed slingers and CoreXY machines, and where they print and measure.

The nozzle prints relative to the bed, while an accelerometer measures its body against the ground;
a frame excited by reaction therefore shows more in the second than in the first.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from stillpath.models.arrays import Array
from stillpath.simulation.printers.bodies import STEP_S, Bodies, Element, Friction, Motion

__all__ = ["Axis", "CoreXY", "Frame", "Mount", "Printer", "bed_slinger", "corexy"]


@dataclass(frozen=True, slots=True)
class Mount:
    """The mounting of a body: mass, natural frequency on a fixed support, damping."""

    mass_kg: float
    f_hz: float
    zeta: float

    def element(self, along: dict[str, float]) -> Element:
        """Return the corresponding spring and damper."""
        w = 2 * np.pi * self.f_hz
        return Element(along, self.mass_kg * w * w, 2 * self.zeta * self.mass_kg * w)


@dataclass(frozen=True, slots=True)
class Axis:
    """A drive by motor and belt, and its load.

    Attributes
    ----------
    rotor_kg : float
        Inertia of rotor and pulley as a mass at the belt.
    field_n_m, field_zeta : float
        Stiffness of the magnetic field that holds the rotor, and damping of the rotor in it.
    belt : Mount
        Mass that it moves, frequency at which this mass swings on the belt alone, and damping.
    viscous : float
        Damping of the guides, as a share of the belt's.
    friction_n : float
        Of the guides.
    """

    rotor_kg: float
    field_n_m: float
    field_zeta: float
    belt: Mount
    viscous: float
    friction_n: float

    def motor(self, rotor: str, command: tuple[float, float]) -> Element:
        """Return what holds the rotor to the command."""
        damping = 2 * self.field_zeta * np.sqrt(self.field_n_m * self.rotor_kg)
        return Element({rotor: 1.0}, self.field_n_m, float(damping), command)

    def guide(self, along: dict[str, float]) -> Element:
        """Return the viscous part of the guides."""
        w = 2 * np.pi * self.belt.f_hz
        return Element(along, 0.0, 2 * self.belt.zeta * self.viscous * self.belt.mass_kg * w)


@dataclass(frozen=True, slots=True)
class Frame:
    """A frame on its feet; the same in X and Y but for the frequency."""

    mass_kg: float
    fx_hz: float
    fy_hz: float
    zeta: float


@dataclass(frozen=True, slots=True)
class CoreXY:
    """Two belts that move one carriage.

    Attributes
    ----------
    a, b : Axis
        Motors and belts; `belt.mass_kg` is the mass with which `belt.f_hz` is stated: the carriage.
    carriage_kg, beam_kg : float
        What moves in X; what moves with it in Y.
    """

    a: Axis
    b: Axis
    carriage_kg: float
    beam_kg: float


@dataclass(frozen=True, slots=True, eq=False)
class Printer:
    """Bodies, with the positions of nozzle and accelerometer.

    Attributes
    ----------
    nozzle : ndarray, shape (2, coordinates)
        Position of the nozzle relative to the bed, in commanded X and Y.
    felt : ndarray, shape (2, coordinates)
        Body that carries the accelerometer in tests of X and of Y.
    """

    name: str
    kind: Literal["bed slinger", "corexy"]
    bodies: Bodies
    nozzle: Array
    felt: Array

    def prints(self, command_mm: Array, dt_s: float = STEP_S) -> Array:
        """Return where the nozzle is over the bed, shape (2, n), for a command of that shape."""
        return np.asarray(self.nozzle @ self.follow(command_mm, dt_s).position_mm)

    def follow(self, command_mm: Array, dt_s: float = STEP_S) -> Motion:
        """Return the motion of all bodies under a command (2, n)."""
        return self.bodies.follow(command_mm, dt_s)

    def frequency_response(self, f_hz: Array) -> NDArray[np.complex128]:
        """Return nozzle over command without friction, shape (f, 2, 2)."""
        return np.asarray(self.nozzle @ self.bodies.frequency_response(f_hz))


def bed_slinger(name: str, x: Axis, y: Axis, head: Mount, gantry: Mount, frame: Frame) -> Printer:
    """Return a cartesian machine whose bed moves in Y.

    Parameters
    ----------
    x, y : Axis
        Carriage (without the head), and bed with what lies on it.
    head : Mount
        On its carriage, in X.
    gantry : Mount
        What carries the nozzle, as it rocks in Y on the frame.
    """
    masses = {
        "rotor x": x.rotor_kg,
        "rotor y": y.rotor_kg,
        "carriage": x.belt.mass_kg,
        "head": head.mass_kg,
        "bed": y.belt.mass_kg,
        "gantry": gantry.mass_kg,
        "frame x": frame.mass_kg,
        "frame y": frame.mass_kg,
    }
    on_x, on_y = {"carriage": 1.0, "frame x": -1.0}, {"bed": 1.0, "frame y": -1.0}
    elements = (
        x.motor("rotor x", (1.0, 0.0)),
        y.motor("rotor y", (0.0, 1.0)),
        x.belt.element({**on_x, "rotor x": -1.0}),
        y.belt.element({**on_y, "rotor y": -1.0}),
        x.guide(on_x),
        y.guide(on_y),
        head.element({"head": 1.0, "carriage": -1.0}),
        gantry.element({"gantry": 1.0, "frame y": -1.0}),
        *_feet(frame),
    )
    frictions = (Friction(on_x, x.friction_n), Friction(on_y, y.friction_n))
    bodies = Bodies(masses, elements, frictions)
    # The bed lies on the frame in X; in Y the nozzle hangs on the gantry.
    nozzle = _rows(bodies, {"head": 1.0, "frame x": -1.0}, {"bed": 1.0, "gantry": -1.0})
    return Printer(name, "bed slinger", bodies, nozzle, _rows(bodies, {"head": 1.0}, {"bed": 1.0}))


def corexy(name: str, drive: CoreXY, head: Mount, frame: Frame) -> Printer:
    """Return a CoreXY machine; `head` hangs on the carriage alike in X and Y."""
    masses = {
        "rotor a": drive.a.rotor_kg,
        "rotor b": drive.b.rotor_kg,
        "carriage x": drive.carriage_kg,
        "carriage y": drive.carriage_kg + drive.beam_kg,
        "head x": head.mass_kg,
        "head y": head.mass_kg,
        "frame x": frame.mass_kg,
        "frame y": frame.mass_kg,
    }
    on_x = {"carriage x": 1.0, "frame x": -1.0}
    on_y = {"carriage y": 1.0, "frame y": -1.0}
    minus_y = {key: -value for key, value in on_y.items()}
    elements = (
        drive.a.motor("rotor a", (1.0, 1.0)),
        drive.b.motor("rotor b", (1.0, -1.0)),
        drive.a.belt.element({**on_x, **on_y, "rotor a": -1.0}),
        drive.b.belt.element({**on_x, **minus_y, "rotor b": -1.0}),
        drive.a.guide(on_x),
        drive.b.guide(on_y),
        head.element({"head x": 1.0, "carriage x": -1.0}),
        head.element({"head y": 1.0, "carriage y": -1.0}),
        *_feet(frame),
    )
    frictions = (Friction(on_x, drive.a.friction_n), Friction(on_y, drive.b.friction_n))
    bodies = Bodies(masses, elements, frictions)
    nozzle = _rows(bodies, {"head x": 1.0, "frame x": -1.0}, {"head y": 1.0, "frame y": -1.0})
    felt = _rows(bodies, {"head x": 1.0}, {"head y": 1.0})
    return Printer(name, "corexy", bodies, nozzle, felt)


def _feet(frame: Frame) -> tuple[Element, Element]:
    x, y = (Mount(frame.mass_kg, f_hz, frame.zeta) for f_hz in (frame.fx_hz, frame.fy_hz))
    return x.element({"frame x": 1.0}), y.element({"frame y": 1.0})


def _rows(bodies: Bodies, *along: dict[str, float]) -> Array:
    return np.array([[one.get(name, 0.0) for name in bodies.names] for one in along])
