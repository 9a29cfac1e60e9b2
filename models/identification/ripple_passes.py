"""From files of passes to a machine with its ripple, and from later passes to a better one.

A pass is a table of text with a row per sample of the sensor:

    # homed
    time_s, position_mm, measured_mm        (or accel_mm_s2 in place of measured_mm)

`position_mm` is what the axis was told, in machine coordinates. The comment says that the machine
was homed before; without it the phase of a ripple means nothing, and learning refuses.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from models.errors import ModelError
from models.identification.readers.tables import as_table
from models.identification.ripple import (
    PassLog,
    RippleLearning,
    WaveBasis,
    learn_ripple,
    update_ripple,
)
from models.machine import Machine
from models.plants import DiscretePlant, discretise

__all__ = ["learn_machine_ripple", "read_pass"]

_FEWEST_ROWS = 16
_DT_S = 0.25e-3
"""Fine against the ripple's waves, which the lines between samples would flatten."""


def read_pass(text: str, source: str, dt_s: float = _DT_S) -> PassLog:
    """Read one pass; the command between the rows is taken as straight.

    Parameters
    ----------
    text : str
    source : str
        The file's name, for messages.
    dt_s : float
        Sampling time of the plant it will be compared with.

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
    since = time_s - time_s[0]
    grid = np.arange(int(since[-1] / dt_s) + 1) * dt_s
    homed = any(c.strip("#; \t").lower() == "homed" for c in table.comments)
    return PassLog(
        np.interp(grid, since, position_mm), since, measured, kinds[column], homed, source
    )


def learn_machine_ripple(
    machine: Machine,
    axis: Literal["x", "y"],
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
    machine : Machine
    axis : str
    passes, basis, homing_repeatability_mm
        See `learn_ripple`.
    gain, remaining
        See `update_ripple`.

    Raises
    ------
    ModelError
        See `learn_ripple`; or if the axis's motors are not its own.
    """
    sides = {source.enters for source in basis}
    if machine.kinematics == "corexy" and "input" in sides:
        raise ModelError(
            f"axis {axis}: two motors move each axis of a corexy machine; their ripple cannot be "
            "told apart along x or y. Learn it as output ripple, which holds where it was measured"
        )
    plant: DiscretePlant = discretise(machine.axes[axis].nominal, _DT_S)
    learning = learn_ripple(passes, basis, plant, homing_repeatability_mm=homing_repeatability_mm)
    ripple = learning.ripple
    if axis in machine.ripple:
        ripple = update_ripple(machine.ripple[axis], ripple, gain=gain, remaining=remaining)
    changed = machine.model_copy(update={"ripple": {**machine.ripple, axis: ripple}})
    # A copy is not checked; the document is.
    return Machine.model_validate(changed.model_dump(mode="json")), learning
