"""Plan moves from rest to rest by the rules of a machine's firmware."""

from __future__ import annotations

from collections.abc import Sequence

from stillpath.gcode.firmware.planning import check_moves_end
from stillpath.gcode.firmware.registry import adapter
from stillpath.gcode.types import Limits, Moves, Phases
from stillpath.models.machine import Machine

__all__ = ["plan_moves"]


def plan_moves(
    moves: Moves, limits: Sequence[Limits], machine: Machine, *, rests_apart: bool = False
) -> Phases:
    """Plan moves from rest to rest.

    Parameters
    ----------
    limits : sequence of Limits
        The table of `Moves.limits_id`.
    rests_apart : bool
        See `FirmwareAdapter.planner`.

    Raises
    ------
    GcodeError
        For a move that the firmware refuses, or that takes more than 20 minutes.
    """
    phases = adapter(machine).planner(rests_apart=rests_apart).plan_whole(moves, limits)
    check_moves_end(phases, lambda index: int(moves.line[index]))
    return phases
