"""Track the operating point along a file: mass of the print on its bed, and height."""

from __future__ import annotations

import math

import numpy as np

from stillpath.gcode.types import Moves
from stillpath.models.machine import Machine
from stillpath.models.operating import BLEND_STEP, OperatingGrid, machine_at, mass_schedules
from stillpath.models.schedule import EMPTY, MassSchedule, OperatingPoint, resonances_hz
from stillpath.simulation.machine_response import SIMULATION_STEP

__all__ = ["Operation"]

_ALL_KNOWN = 7
_LONGEST_RETRACTION_MM = 20.0
"""Filament pulled back further has left the hotend: a change of filament or tool, after which the
firmware may load by itself. Such a retraction is not offset against later extrusion."""
_HEAVY_KG = 0.15
"""From here on a print lowers the resonances of a bed of 0.8 kg by 8 %, which is more than
the plants of a set differ by."""


class Operation:
    """Follow the moves of a file, item by item.

    Attributes
    ----------
    printed_kg : float
        Filament on the bed. Feeding counts while X or Y moves, net of retraction; what is extruded
        while the nozzle stands is purged or wiped off.

    Notes
    -----
    Diameter and density are those of the machine document (`firmware`, `schedules`).
    """

    def __init__(self, machine: Machine) -> None:
        self._machine = machine
        masses = mass_schedules(machine)
        self._follows_mass = bool(masses)
        usual_g_cm3 = float(MassSchedule.model_fields["filament_density_g_cm3"].default)
        density_g_cm3 = masses[0].filament_density_g_cm3 if masses else usual_g_cm3
        area_mm2 = 0.25 * math.pi * machine.firmware.hotend.filament_diameter_mm**2
        self._kg_per_mm = 1e-6 * area_mm2 * density_g_cm3
        self.printed_kg = 0.0
        self._furthest_mm: float | None = None
        self._point = EMPTY
        self._grid = OperatingGrid(machine, step=SIMULATION_STEP, blend_step=BLEND_STEP)
        self._level: OperatingPoint | None = None
        self._used: dict[str, tuple[float, float]] = {}

    def at(self, moves: Moves) -> OperatingPoint:
        """Return the operating point of the next moves.

        The mass is that at half of their filament, the position that where they first print.
        """
        if not self._machine.schedules:
            return self._point
        known = np.flatnonzero((moves.known & _ALL_KNOWN) == _ALL_KNOWN)
        position = (self._point.x_mm, self._point.y_mm, self._point.z_mm)
        if len(known):
            x, y, z = moves.start_mm[known[np.argmax(moves.prints[known])], :3].tolist()
            position = (x, y, z)
        on_bed_kg = 0.0
        if self._follows_mass:
            on_bed_kg = self.printed_kg + 0.5 * self._kg_per_mm * self._laid(moves)[0]
        self._point = OperatingPoint(on_bed_kg, *position)
        self._note_range()
        return self._point

    def passed(self, moves: Moves) -> None:
        """Count the filament of completed moves."""
        laid_mm, self._furthest_mm = self._laid(moves)
        self.printed_kg += self._kg_per_mm * laid_mm

    def notes(self) -> list[str]:
        """Return notes on the masses and heights that the plants followed, or would have to."""
        notes = []
        if (
            self._machine.kinematics == "cartesian"
            and not self._follows_mass
            and self.printed_kg > _HEAVY_KG
        ):
            notes.append(
                f"The print weighs {1e3 * self.printed_kg:.0f} g (of PLA). If the bed moves in Y, "
                "Y's resonances fall as it grows, and Y rings more towards the end than is "
                "predicted here: let Stillpath follow the mass (docs/scheduling.md)."
            )
        for axis, schedule in self._machine.schedules.items():
            follows = []
            if schedule.mass is not None:
                follows.append(
                    f"the mass on the bed ({self.printed_kg:.3f} kg at the end, filament of "
                    f"{schedule.mass.filament_density_g_cm3:g} g/cm3)"
                )
            if schedule.grid is not None:
                measured = [a for a in ("x", "y", "z") if schedule.grid.coordinates_mm(a)]
                follows.append(f"the position in {', '.join(measured)}")
            text = f"The plant of axis {axis} follows {' and '.join(follows)}"
            if axis in self._used:
                low, high = self._used[axis]
                text += f": its lowest resonance was between {low:.1f} and {high:.1f} Hz"
            notes.append(f"{text}.")
        return notes

    def _laid(self, moves: Moves) -> tuple[float, float | None]:
        """Return the filament laid by the moves and the extruder's furthest position after them."""
        if len(moves) == 0:
            return 0.0, self._furthest_mm
        e_mm = moves.end_mm[:, 3]
        moving = np.any(moves.end_mm[:, :2] != moves.start_mm[:, :2], axis=1)
        furthest_mm = moves.start_mm[0, 3] if self._furthest_mm is None else self._furthest_mm
        laid_mm, first = 0.0, 0
        while first < len(moves):
            furthest = np.maximum.accumulate(np.append(furthest_mm, e_mm[first:]))
            unloaded = furthest[1:] - e_mm[first:] > _LONGEST_RETRACTION_MM
            count = int(np.argmax(unloaded)) + 1 if unloaded.any() else len(unloaded)
            last = first + count
            laid_mm += float(np.sum(np.diff(furthest)[:count][moving[first:last]]))
            furthest_mm = float(e_mm[last - 1] if unloaded.any() else furthest[count])
            first = last
        return laid_mm, furthest_mm

    def _note_range(self) -> None:
        level = self._grid.level(self._point)
        if level == self._level:
            return
        self._level = level
        for node in self._grid.at_level(level):
            axes = machine_at(self._machine, node).axes
            # An axis without a schedule need not have a resonance.
            for axis in self._machine.schedules:
                f_hz = float(resonances_hz(axes[axis].nominal)[0])
                low, high = self._used.get(axis, (f_hz, f_hz))
                self._used[axis] = (min(low, f_hz), max(high, f_hz))
