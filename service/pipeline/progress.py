"""How a job says where it is, and how it is told to stop."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

__all__ = ["Cancelled", "Progress", "ProgressCallback", "telling"]


@dataclass(frozen=True, slots=True)
class Progress:
    """Where a job is.

    Attributes
    ----------
    stage : str
        What is being done, for a person: `compensating`, `measuring`, ...
    fraction : float
        Done so far, 0 to 1.
    print_seconds : float
        Seconds of printing handled so far.
    elapsed_s : float
        Wall time since the job began.
    eta_s : float or None
        Wall time still needed; None while it is unknown.
    """

    stage: str
    fraction: float
    print_seconds: float
    elapsed_s: float
    eta_s: float | None


class Cancelled(Exception):
    """Raised by a progress callback: stop the job and leave nothing behind."""


ProgressCallback = Callable[[Progress], None]
"""Called now and then; may raise `Cancelled`."""


def telling(
    callback: ProgressCallback | None, stage: str, fraction: float
) -> Callable[[float], None]:
    """Return a callback for a stage before or behind the work that `fraction` counts.

    What it is given, the share of the stage itself, only shows that there is life.
    """
    began = time.monotonic()

    def tell(_: float) -> None:
        if callback is not None:
            callback(Progress(stage, fraction, 0.0, time.monotonic() - began, None))

    return tell
