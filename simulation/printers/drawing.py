"""Printers drawn from stated ranges.

==================================  ===================  ===================  ===================
what                                bed slinger, X       bed slinger, Y       CoreXY
==================================  ===================  ===================  ===================
moving mass, kg                     .20 to .40           .5 to 1.1            .25 to .45
beam, kg                                                                      .3 to .6
frequency on the belt, Hz           38 to 75             26 to 55             45 to 110
damping of the belt                 .03 to .12           .04 to .15           .03 to .10
rotor as a mass at the belt, kg     .10 to .16           .10 to .16           .10 to .16
magnetic field, N/m                 1.5e5 to 5e5         1.5e5 to 5e5         1.5e5 to 5e5
viscous guides, of the belt's       0 to .4              0 to .4              0 to .4
dry friction, N                     .02 to .2            .03 to .3            .02 to .2
head: kg, Hz, damping               .10-.25, 70-190, .02-.08                  as X
gantry: kg, Hz, damping                                  1-2, 35-90, .03-.10
frame: kg, Hz, damping              4-9, 8-28, .08-.25   as X                 8-18, 8-28, .08-.25
==================================  ===================  ===================  ===================

Masses and inertias are those of common motors (54 to 80 g cm2, 20 teeth) and tool heads;
frequencies and dampings were set so that tables of drawn printers look like real ones. Friction is
that of greased rails: with the .3 to 1.5 N of wheels on extrusions, positions are uncertain by 10
to 20 um, and no command that is linear in the path does much about that.
"""

from __future__ import annotations

import numpy as np

from stillpath.simulation.printers.machines import (
    Axis,
    CoreXY,
    Frame,
    Mount,
    Printer,
    bed_slinger,
    corexy,
)

__all__ = ["KINDS", "draw"]

KINDS = ("bed slinger", "corexy")


def draw(kind: str, seed: int) -> Printer:
    """Draw a printer; the same seed, the same printer.

    Parameters
    ----------
    kind : str
        One of `KINDS`.
    """
    if kind not in KINDS:
        raise ValueError(f"no printer is a {kind!r}; there are {', '.join(KINDS)}")
    return _Draw(KINDS.index(kind), seed).printer()


class _Draw:
    def __init__(self, kind: int, seed: int) -> None:
        self._kind, self._seed = kind, seed
        self._rng = np.random.default_rng([kind, seed])

    def printer(self) -> Printer:
        name = f"{KINDS[self._kind].replace(' ', '-')}-{self._seed}"
        if self._kind == 0:
            x = self._axis((0.2, 0.4), (38.0, 75.0), (0.03, 0.12), (0.02, 0.2))
            y = self._axis((0.5, 1.1), (26.0, 55.0), (0.04, 0.15), (0.03, 0.3))
            gantry = self._mount((1.0, 2.0), (35.0, 90.0), (0.03, 0.10))
            return bed_slinger(name, x, y, self._head(), gantry, self._frame((4.0, 9.0)))
        carriage, beam = self._between(0.25, 0.45), self._between(0.3, 0.6)
        a = self._axis((carriage, carriage), (45.0, 110.0), (0.03, 0.10), (0.02, 0.2))
        # The other belt is tensioned as well as a hand can.
        unequal = self._between(0.93, 1.07)
        belt = Mount(a.belt.mass_kg, a.belt.f_hz * unequal, a.belt.zeta * self._between(0.8, 1.2))
        b = Axis(a.rotor_kg, a.field_n_m, a.field_zeta, belt, a.viscous, self._scaled(0.02, 0.2))
        drive = CoreXY(a, b, carriage, beam)
        return corexy(name, drive, self._head(), self._frame((8.0, 18.0)))

    def _axis(
        self,
        mass_kg: tuple[float, float],
        f_hz: tuple[float, float],
        zeta: tuple[float, float],
        friction_n: tuple[float, float],
    ) -> Axis:
        return Axis(
            rotor_kg=self._between(0.10, 0.16),
            field_n_m=self._scaled(1.5e5, 5e5),
            field_zeta=self._between(0.03, 0.15),
            belt=self._mount(mass_kg, f_hz, zeta),
            viscous=self._between(0.0, 0.4),
            friction_n=self._scaled(*friction_n),
        )

    def _head(self) -> Mount:
        return self._mount((0.10, 0.25), (70.0, 190.0), (0.02, 0.08))

    def _frame(self, mass_kg: tuple[float, float]) -> Frame:
        fx_hz = self._scaled(8.0, 28.0)
        return Frame(
            self._between(*mass_kg),
            fx_hz,
            fx_hz * self._between(0.8, 1.25),
            self._scaled(0.08, 0.25),
        )

    def _mount(
        self, mass_kg: tuple[float, float], f_hz: tuple[float, float], zeta: tuple[float, float]
    ) -> Mount:
        return Mount(self._between(*mass_kg), self._scaled(*f_hz), self._scaled(*zeta))

    def _between(self, low: float, high: float) -> float:
        return float(self._rng.uniform(low, high))

    def _scaled(self, low: float, high: float) -> float:
        """Uniform in the logarithm."""
        return float(np.exp(self._rng.uniform(np.log(low), np.log(high))))
