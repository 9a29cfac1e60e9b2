"""Design the reference of a closed loop by filtered basis functions with limited preview.

It uses the windows of `compensation.preview` with the loop from reference to output as the plant.
No zero is cancelled or approximated, so it helps where ZPETC's gain error shows.
"""

from __future__ import annotations

import numpy as np

from stillpath.compensation._preview_kernels import advance_window
from stillpath.compensation.feedback.zero_phase import reference_plant
from stillpath.compensation.lifted_window import lifted_window
from stillpath.compensation.preview import PreviewDesign
from stillpath.models.arrays import Array
from stillpath.models.loops import Loop

__all__ = ["preview_command"]

_WINDOW, _UPDATE = 64, 16
"""Samples in a window, and those committed per window."""
_FUNCTIONS = 40
"""Per window; functions/(2 window dt) is the cut-off frequency of the command."""


def preview_command(loop: Loop, y_d: Array) -> Array:
    """Return the reference for a desired position, shape (n,), that starts and ends at rest.

    Raises
    ------
    DesignError
        If the windows' recursion is not stable, or the functions are nearly dependent.
    """
    if len(y_d) == 0:
        return np.empty(0)
    lifted = lifted_window([reference_plant(loop)], [1.0], _WINDOW, _UPDATE)
    design = PreviewDesign(lifted, _FUNCTIONS)
    windows = -(-len(y_d) // _UPDATE)
    path = np.pad(y_d, (0, windows * _UPDATE + _WINDOW - len(y_d)), mode="edge")
    command = np.empty(windows * _UPDATE)
    z = lifted.rest_state(float(y_d[0]))
    for first in range(0, windows * _UPDATE, _UPDATE):
        committed = design.command_gain @ z + design.path_gain @ path[first : first + _WINDOW]
        command[first : first + _UPDATE] = committed
        advance_window(lifted.advance, design.state_drive, z, committed)
    return command[: len(y_d)]
