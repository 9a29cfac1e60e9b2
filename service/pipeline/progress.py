"""How a job says where it is, and how it is told to stop."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

__all__ = ["Cancelled", "Progress", "ProgressCallback"]


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
