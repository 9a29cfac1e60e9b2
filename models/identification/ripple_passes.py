"""A machine with its ripple from files of passes, and its refinement by later passes.

A pass is a table of text with a row per sample of the sensor:

    # homed
    time_s, position_mm, measured_mm        (or accel_mm_s2 in place of measured_mm)

`position_mm` is what the axis was told, in machine coordinates. The comment says that the machine
was homed before; without it the phase of a ripple means nothing, and learning refuses.

A motor of CoreXY is seen alone where the other stands: motor a (x + y) on moves along the diagonal
x = y, motor b (x - y) along the other. Both columns are then x + y, or x - y.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from scipy.linalg import block_diag

from stillpath.models.errors import ModelError
from stillpath.models.identification.readers.tables import as_table
from stillpath.models.identification.ripple import (
    PassLog,
    RippleLearning,
    WaveBasis,
    check_gain,
    learn_ripple,
    update_ripple,
)
from stillpath.models.machine import Machine
from stillpath.models.plants import DiscretePlant, discretise
from stillpath.models.ripple import RippleAxis

__all__ = ["learn_machine_ripple", "read_pass"]

_FEWEST_ROWS = 16
_LONGEST_S, _SLOWEST_S = 3600.0, 0.1
_DT_S = 0.25e-3
"""Fine against the ripple's waves, which the lines between samples would flatten."""


def read_pass(text: str, source: str) -> PassLog:
    """Read one pass; the command between the rows is taken as straight.

    Parameters
    ----------
    source : str
        The file's name, for messages.

    Raises
    ------
    ModelError
        For a column that is missing, rows that are no numbers, or times that do not rise.
    """
    table = as_table(text, source)
    kinds: dict[str, Literal["position", "acceleration"]] = {
        "measured_mm": "position",
        "accel_mm_s2": "acceleration",
    }
    column = next((name for name in kinds if name in table.names), None)
    if column is None:
        raise ModelError(
            f"{source}: neither measured_mm nor accel_mm_s2 among the columns "
            f"({', '.join(table.names) or 'none named'}); a pass has time_s, position_mm and one "
            "of them"
        )
    time_s, position_mm, measured = table.numbers(("time_s", "position_mm", column)).T
    if len(time_s) < _FEWEST_ROWS:
        raise ModelError(f"{source}: {len(time_s)} rows, at least {_FEWEST_ROWS} are needed")
    back = np.flatnonzero(np.diff(time_s) <= 0)
    if len(back):
        raise table.at(int(back[0]) + 1, "time_s does not rise; sort the rows, or cut the log")
    lasts_s, apart_s = float(time_s[-1] - time_s[0]), float(np.median(np.diff(time_s)))
    if lasts_s > _LONGEST_S or apart_s > _SLOWEST_S:
        raise ModelError(
            f"{source}: by its time it lasts {lasts_s:.6g} s and its rows are {apart_s:.4g} s "
            f"apart; up to {_LONGEST_S:g} s and {_SLOWEST_S:g} s are read: time_s must be in "
            "seconds; of a longer log hand in a part"
        )
    since = time_s - time_s[0]
    grid = np.arange(int(since[-1] / _DT_S) + 1) * _DT_S
    homed = any(c.strip("#; \t").lower() == "homed" for c in table.comments)
    return PassLog(
        np.interp(grid, since, position_mm), since, measured, kinds[column], homed, source
    )


def learn_machine_ripple(
    machine: Machine,
    axis: RippleAxis,
    passes: Sequence[PassLog],
    basis: Sequence[WaveBasis],
    *,
    gain: float = 0.5,
    remaining: bool = False,
    homing_repeatability_mm: float = 0.0,
) -> tuple[Machine, RippleLearning]:
    """Return the machine with the ripple of an axis as its passes show it.

    Where the axis has ripple already, the passes update it (`update_ripple`).

    Parameters
    ----------
    axis : str
        Input ripple of CoreXY belongs to its motors ``a`` and ``b``, all else to ``x`` and ``y``.
    passes, basis, homing_repeatability_mm
        See `learn_ripple`.
    gain, remaining
        See `update_ripple`.

    Raises
    ------
    ModelError
        See `learn_ripple`; or if the ripple cannot enter at `axis`.
    """
    check_gain(gain)
    _check_axis(machine, axis, basis)
    plant = _plant(machine, axis)
    learning = learn_ripple(passes, basis, plant, homing_repeatability_mm=homing_repeatability_mm)
    ripple = learning.ripple
    if axis in machine.ripple:
        ripple = update_ripple(machine.ripple[axis], ripple, gain=gain, remaining=remaining)
    changed = machine.model_copy(update={"ripple": {**machine.ripple, axis: ripple}})
    # A copy is not checked; the document is.
    return Machine.model_validate(changed.model_dump(mode="json")), learning


def _check_axis(machine: Machine, axis: RippleAxis, basis: Sequence[WaveBasis]) -> None:
    corexy = machine.kinematics == "corexy"
    for source in basis:
        motors = ("a", "b") if corexy and source.enters == "input" else ("x", "y")
        if axis in motors:
            continue
        remedy = (
            "two motors move each axis; drive along a diagonal, where one of them stands, and "
            "learn motor a (x + y) or b (x - y)"
            if corexy and source.enters == "input"
            else "learn it there"
        )
        raise ModelError(
            f"axis {axis}: {source.enters} ripple ({source.name}) of a {machine.kinematics} "
            f"machine belongs to {' or '.join(motors)}; {remedy}"
        )


def _plant(machine: Machine, axis: RippleAxis) -> DiscretePlant:
    """Return the plant of a motor's motion: along a diagonal the mean of both axes."""
    if axis in ("x", "y"):
        return discretise(machine.axes[axis].nominal, _DT_S)
    x, y = (discretise(machine.axes[name].nominal, _DT_S) for name in ("x", "y"))
    return DiscretePlant(
        np.asarray(block_diag(x.a, y.a)),
        np.concatenate([x.b, y.b]),
        0.5 * np.concatenate([x.c, y.c]),
        0.5 * (x.d + y.d),
        dt_s=_DT_S,
    )
