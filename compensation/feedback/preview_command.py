"""Reference of a closed loop by filtered basis functions with limited preview.

The windows of `compensation.preview`, with the loop from its reference to its output as the plant:
no zero of it is cancelled or approximated, so it serves where ZPETC's gain error shows.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stillpath.compensation._preview_kernels import advance_window
from stillpath.compensation.feedback.zero_phase import reference_plant
from stillpath.compensation.lifted_window import lifted_window
from stillpath.compensation.preview import PreviewDesign
from stillpath.models.loops import Loop

__all__ = ["preview_command"]

Array = NDArray[np.float64]


def preview_command(
    loop: Loop, y_d: Array, *, window: int = 64, update: int = 16, functions: int = 40
) -> Array:
    """Return the reference for a desired position, shape (n,), that starts and ends at rest.

    Parameters
    ----------
    loop : Loop
    y_d : ndarray, shape (n,)
    window, update : int
        Samples that are looked at, and of them those that are committed.
    functions : int
        Of the window; functions/(2 window dt) is the cut-off frequency of the command.

    Raises
    ------
    DesignError
        If the windows' recursion is not stable, or the functions are nearly dependent.
    """
    lifted = lifted_window([reference_plant(loop)], [1.0], window, update)
    design = PreviewDesign(lifted, functions)
    windows = -(-len(y_d) // update)
    path = np.pad(y_d, (0, windows * update + window - len(y_d)), mode="edge")
    command = np.empty(windows * update)
    z = lifted.rest_state(float(y_d[0]))
    for first in range(0, windows * update, update):
        committed = design.command_gain @ z + design.path_gain @ path[first : first + window]
        command[first : first + update] = committed
        advance_window(lifted.advance, design.state_drive, z, committed)
    return command[: len(y_d)]
