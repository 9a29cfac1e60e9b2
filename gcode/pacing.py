"""Replan a piece with other accelerations and speeds, one class of moves after the other.

Geometry, filament and the order of the lines stay; so do extruding speeds, which reflect the
slicer's decisions on flow, cooling, overhangs and small perimeters. What changes are the
accelerations of X and Y, the speed at corners, and the speed of travel.

The first layer keeps all it has, and so do wipes (the extruder's own limits bind them), and moves
of Z or of the extruder alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stillpath.gcode.firmware.registry import adapter
from stillpath.gcode.pieces import Piece
from stillpath.gcode.plan import plan_moves
from stillpath.gcode.types import Moves
from stillpath.models.arrays import Mask
from stillpath.models.machine import CommandLimits, Machine

__all__ = [
    "AS_SLICED",
    "SAME",
    "TRAVEL",
    "FirstLayer",
    "Pace",
    "move_classes",
    "paced",
    "top_limits",
]

Ints = NDArray[np.int32]

TRAVEL, AS_SLICED = -2, -3
"""Classes beside the features, whose ids begin at -1 (unnamed)."""

_ACCEL_ROOM, _SPEED_ROOM = 0.7, 0.9
"""Shares of the command's limits for the plan: the command itself exceeds the plan."""
_SAME_Z_MM = 1e-3


@dataclass(frozen=True, slots=True)
class Pace:
    """Ratios, above 0, of a class's accelerations and speed to the file's."""

    accel: float = 1.0
    speed: float = 1.0
    """Of travel; the speed of what is extruded stays."""


SAME = Pace()


@dataclass(frozen=True, slots=True)
class FirstLayer:
    """The first layer, of all objects if they are printed one after another.

    Attributes
    ----------
    below : int
        Layers below this number belong to it; -1 if the file does not mark layers.
    z_mm : float
        Moves up to this height belong to it too, where no layer is marked only these; minus
        infinity if unknown.
    """

    below: int = 1
    z_mm: float = -np.inf

    def has(self, moves: Moves) -> Mask:
        """Mark the moves that belong to it, shape (n,)."""
        low = moves.end_mm[:, 2] <= self.z_mm + _SAME_Z_MM
        return np.asarray((moves.layer < self.below) | low)


def move_classes(moves: Moves, first_layer: FirstLayer = FirstLayer()) -> Ints:
    """Return the class of every move.

    Parameters
    ----------
    first_layer : FirstLayer
        Its moves stay as they are.

    Returns
    -------
    ndarray of int32, shape (n,)
        The feature's id for what extrudes, `TRAVEL`, or `AS_SLICED`.
    """
    way = moves.end_mm - moves.start_mm
    classes = np.where(way[:, 3] > 0.0, moves.feature, TRAVEL)
    kept = ~moves.moves_xy | (way[:, 3] < 0.0) | first_layer.has(moves)
    return np.where(kept, AS_SLICED, classes).astype(np.int32)


def top_limits(machine: Machine) -> CommandLimits:
    """Return the upper bounds of a plan's limits."""
    return machine.command.every_way.scaled(velocity=_SPEED_ROOM, accel=_ACCEL_ROOM)


def paced(piece: Piece, classes: Ints, paces: Mapping[int, Pace], machine: Machine) -> Piece:
    """Return a piece with the moves of each class at their pace, planned anew.

    Parameters
    ----------
    classes : ndarray of int32, shape (moves of the piece,)
        As `move_classes` gives them.
    paces : mapping
        Class to pace; classes not listed keep theirs.

    Returns
    -------
    Piece
        The same lines; `moves` have other speeds and limits, `limits` more rows, `phases` are the
        firmware's plan of that. The piece itself where nothing changes.

    Raises
    ------
    GcodeError
        For a move that the firmware refuses.
    """
    moves = piece.moves
    limits_id, speed = moves.limits_id.copy(), moves.speed_mm_s.copy()
    limits = list(piece.limits)
    firmware, most = adapter(machine), top_limits(machine)
    for one, pace in paces.items():
        rows = np.flatnonzero(classes == one)
        if len(rows) == 0 or pace == SAME:
            continue
        ratio = pace.speed if one == TRAVEL else 1.0
        speed[rows] = np.minimum(ratio * speed[rows], np.maximum(speed[rows], most.velocity_mm_s))
        for own in np.unique(moves.limits_id[rows]).tolist():
            made = firmware.paced(piece.limits[own], pace.accel, ratio, most)
            if made == piece.limits[own]:
                continue
            limits_id[rows[moves.limits_id[rows] == own]] = len(limits)
            limits.append(made)
    changed = replace(moves, limits_id=limits_id, speed_mm_s=speed)
    if len(limits) == len(piece.limits) and np.array_equal(speed, moves.speed_mm_s):
        return piece
    phases = plan_moves(changed, limits, machine)
    if len(phases) != len(moves):
        return piece
    return replace(piece, moves=changed, limits=limits, phases=phases)
