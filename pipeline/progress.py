"""Progress of a job, and how it is cancelled."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

__all__ = ["Cancelled", "Progress", "ProgressCallback", "ProgressReports", "progress_to"]


_SURE = 0.02
"""Share after which the time still needed can be told."""


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
    """Raised by a progress callback: stop the job and leave nothing after."""


ProgressCallback = Callable[[Progress], None]
"""Called now and then; may raise `Cancelled`."""


class ProgressReports:
    """Tells where a job is, and how long it may still take.

    Parameters
    ----------
    callback : callable, optional
    """

    def __init__(self, callback: ProgressCallback | None) -> None:
        self._callback = callback
        self._began = time.monotonic()

    def say(self, stage: str, fraction: float, print_s: float = 0.0) -> None:
        """Tell the stage, the share of all that is done, and the seconds of printing handled."""
        if self._callback is None:
            return
        elapsed_s = time.monotonic() - self._began
        eta_s = elapsed_s * (1.0 - fraction) / fraction if fraction > _SURE else None
        self._callback(Progress(stage, min(fraction, 1.0), print_s, elapsed_s, eta_s))


def progress_to(
    callback: ProgressCallback | None, stage: str, fraction: float
) -> Callable[[float], None]:
    """Return a callback for a stage before or after the work that `fraction` counts.

    What it is given, the share of the stage itself, only shows that work goes on.
    """
    began = time.monotonic()

    def tell(_: float) -> None:
        if callback is not None:
            callback(Progress(stage, fraction, 0.0, time.monotonic() - began, None))

    return tell
