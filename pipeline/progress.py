"""Progress reports of a job, and its cancellation."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

__all__ = ["Progress", "ProgressCallback", "ProgressReports", "StopWork", "progress_to", "within"]


_SURE = 0.02
"""Share after which the remaining time can be estimated."""


@dataclass(frozen=True, slots=True)
class Progress:
    """Progress of a job.

    Attributes
    ----------
    stage : str
        Current stage as shown to users: `compensating`, `measuring`, ...
    fraction : float
        Share done so far, 0 to 1.
    print_seconds : float
        Seconds of printing handled so far.
    elapsed_s : float
        Wall time since the job began.
    eta_s : float or None
        Estimated remaining wall time; None while unknown.
    """

    stage: str
    fraction: float
    print_seconds: float
    elapsed_s: float
    eta_s: float | None


class StopWork(Exception):
    """Raised by a progress callback: stop the job and leave nothing after."""


ProgressCallback = Callable[[Progress], None]
"""Called from time to time; may raise `StopWork`."""


class ProgressReports:
    """Reports the progress of a job, and estimates its remaining time.

    Parameters
    ----------
    callback : callable, optional
    """

    def __init__(self, callback: ProgressCallback | None) -> None:
        self._callback = callback
        self._began = time.monotonic()

    def say(self, stage: str, fraction: float, print_s: float = 0.0) -> None:
        """Report the stage, the overall share done, and the seconds of printing handled."""
        if self._callback is None:
            return
        elapsed_s = time.monotonic() - self._began
        eta_s = elapsed_s * (1.0 - fraction) / fraction if fraction > _SURE else None
        self._callback(Progress(stage, min(fraction, 1.0), print_s, elapsed_s, eta_s))


def progress_to(
    callback: ProgressCallback | None, stage: str, fraction: float
) -> Callable[[float], None]:
    """Return a callback for a stage before or after the work that `fraction` counts.

    Its argument, the share of the stage itself, is ignored: it only shows that work goes on.
    """
    began = time.monotonic()

    def tell(_: float) -> None:
        if callback is not None:
            callback(Progress(stage, fraction, 0.0, time.monotonic() - began, None))

    return tell


def within(callback: ProgressCallback | None, low: float, high: float) -> ProgressCallback | None:
    """Return a callback for a part of the work; its share done counts from `low` to `high`."""
    if callback is None:
        return None
    tell = callback

    def say(now: Progress) -> None:
        tell(replace(now, fraction=low + (high - low) * now.fraction, eta_s=None))

    return say
