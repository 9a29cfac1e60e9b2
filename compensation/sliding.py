"""Targets that slide along the path, and matching weights of a plant set.

For a print, every member of a plant set must be ON the path, but not at an exact time. Each member
therefore gets its own target: the point of the path nearest to its response, moved slightly back
towards the planned time. The error across the path then counts in full and the error along it with
a small weight. Alternately moving the targets (the exact minimum over the slack along the path) and
filtering them (the exact minimum over the command) is the majorise-minimise iteration for that
weighted sum. The gains stay constant; X and Y are coupled only through the nearest point, and
corners need no special case.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from stillpath.compensation._sliding_kernels import contour_square, move_targets
from stillpath.compensation.ladder import Designs
from stillpath.compensation.lifted_window import lifted_window
from stillpath.compensation.preview_axis import WEIGHT_TRAVEL, AxisCommand, AxisTask, PreviewAxis
from stillpath.compensation.window_problem import Bounds
from stillpath.models.arrays import Array
from stillpath.models.plants import DiscretePlant
from stillpath.models.reference_motion import reference_motion

__all__ = ["balanced_weights", "member_response", "slide"]

Choice = tuple[int, frozenset[int]]

ROUNDS = 4
RELAXATION = 1.6
"""Over-relaxation towards the new targets; 2 would be the stability limit."""
REACH_S = 0.008
_BOUNDED_ROUNDS = 12
_WEIGHT_ROUNDS = 8
_WEIGHT_RUNG = 2
_LEAST_SHARE = 0.05
_NO_BOUNDS = Bounds(1e9, 1e9, -1e9, 1e9)


def slide(
    axes: Sequence[PreviewAxis],
    commands: list[AxisCommand],
    tasks: Sequence[AxisTask],
    chosen: Sequence[Choice],
    extruding: NDArray[np.bool_],
    along: float,
    dt_s: float,
) -> list[AxisCommand]:
    """Improve the commands of X and Y for all members by moving the members' targets.

    Parameters
    ----------
    axes : PreviewAxis of X and of Y
    commands, tasks : of the axes
        The commands for the path itself, and the axes' tasks.
    chosen : of the axes
        Rung of the ladder, and windows solved within bounds.
    extruding : ndarray of bool, shape (n,)
    along : float
        Weight of the error along the path against that across it.

    Returns
    -------
    list of AxisCommand
        From the last round that keeps the bounds.
    """
    path = np.stack([task.path_mm for task in tasks])
    members = max(axis.members for axis in axes)
    targets = np.repeat(path[None], members, axis=0)
    reach = _reach(dt_s)
    choice = list(chosen)
    for _ in range(ROUNDS):
        positions = [command.position_mm for command in commands]
        for j in range(members):
            response = member_response(axes, positions, j)
            move_targets(
                path, response, extruding, along, WEIGHT_TRAVEL, reach, RELAXATION, targets[j]
            )
        moved = []
        for i, (axis, task) in enumerate(zip(axes, tasks, strict=True)):
            wanted = targets[: axis.members, i]
            command, choice[i] = _within_bounds(axis, task, choice[i], wanted)
            if command is None:
                return commands
            moved.append(command)
        commands = moved
    return commands


def _within_bounds(
    axis: PreviewAxis, task: AxisTask, choice: Choice, targets_mm: Array
) -> tuple[AxisCommand | None, Choice]:
    """Return the command for the members' targets, on the same rung or a gentler one."""
    rung, bounded = choice
    for _ in range(_BOUNDED_ROUNDS):
        command = axis.command(rung, task, bounded, targets_mm)
        outside = axis.windows_outside(task.bounds, command.position_mm)
        if not outside:
            return command, (rung, bounded)
        if outside <= bounded:
            rung, bounded = min(rung + 1, axis.last_rung), frozenset()
        else:
            bounded |= outside
    return None, choice


@lru_cache(maxsize=32)
def balanced_weights(
    x: tuple[tuple[DiscretePlant, ...], tuple[float, ...]],
    y: tuple[tuple[DiscretePlant, ...], tuple[float, ...]],
    dt_s: float,
    window: int,
    update: int,
    basis: str,
    along: float,
    most: tuple[int, int] = (300, 300),
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return weights of the members that make their contour errors e_j more equal.

    They minimise sum_j p_j e_j^4 on the reference motion, p_j the given weights: a fixed point of
    l_j ~ p_j e_j^2. Least squares alone minimises sum_j p_j e_j^2, a true minimax the largest e_j
    at the expense of all others.

    Parameters
    ----------
    x, y : plants and given weights of either axis, equally many
    dt_s, window, update, basis, along
        Of the design that will use the weights.
    most : (int, int)
        Most functions per 300 samples, as in `compensation.ladder.functions_within`.
    """
    path, extruding = reference_motion(dt_s)
    n = path.shape[1]
    stops = np.array([[-1, 1], [n, n + window]], dtype=np.int64)
    tasks = [AxisTask(row, np.ones(n), stops, _NO_BOUNDS, np.inf) for row in path]
    given = [np.array(weights) for _, weights in (x, y)]
    found = [weights.copy() for weights in given]
    for _ in range(_WEIGHT_ROUNDS):
        axes = [
            PreviewAxis(name, Designs(lifted_window(plants, weights, window, update), basis, n))
            for name, (plants, _), weights, n in zip("xy", (x, y), found, most, strict=True)
        ]
        chosen: list[Choice] = [(min(_WEIGHT_RUNG, axis.last_rung), frozenset()) for axis in axes]
        commands = [
            axis.command(rung, task, frozenset())
            for axis, task, (rung, _) in zip(axes, tasks, chosen, strict=True)
        ]
        if along < 1.0:
            commands = slide(axes, commands, tasks, chosen, extruding, along, dt_s)
        positions = [command.position_mm for command in commands]
        responses = (member_response(axes, positions, j) for j in range(axes[0].members))
        reach = 2 * _reach(dt_s)
        squares = np.array([contour_square(path, y, extruding, reach, 3) for y in responses])
        for i, prior in enumerate(given):
            wanted = prior * squares
            # Geometric mean of old and new weights, as the errors depend on the weights.
            moved = np.sqrt(found[i] * wanted / wanted.sum())
            moved = np.maximum(moved / moved.sum(), _LEAST_SHARE * prior)
            found[i] = moved / moved.sum()
    return tuple(found[0].tolist()), tuple(found[1].tolist())


def member_response(
    axes: Sequence[PreviewAxis], commands_mm: Sequence[Array] | Array, j: int
) -> Array:
    """Return the response of member j of X and of Y, shape (2, n); the shorter set repeats."""
    pairs = zip(axes, commands_mm, strict=True)
    return np.stack([axis.response(j % axis.members, u) for axis, u in pairs])


def _reach(dt_s: float) -> int:
    return max(1, round(REACH_S / dt_s))
