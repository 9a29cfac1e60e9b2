"""How long heartbeats could arrive without interruption."""

from __future__ import annotations

import time

__all__ = ["Steadiness"]

_CLOCK_SET_S = 1.0
"""Difference between two checks that shows that the clock was set."""


class Steadiness:
    """Counts for how long silence of a worker is its own.

    Heartbeats cannot arrive while the database is away, and their times cannot be compared with a
    clock that was set since.
    """

    def __init__(self) -> None:
        self._since_s = self._checked_s = time.monotonic()
        self._clock_offset_s = time.time() - time.monotonic()

    def interrupt(self) -> None:
        """Count from now on."""
        self._since_s = time.monotonic()

    def lasts_s(self, held_up_s: float) -> float:
        """Return how long nothing has interrupted heartbeats.

        Parameters
        ----------
        held_up_s : float
            Time between two calls from which something, such as a slow disk, has held us up, and
            heartbeats with us.
        """
        now_s, offset_s = time.monotonic(), time.time() - time.monotonic()
        was_set = abs(offset_s - self._clock_offset_s) > _CLOCK_SET_S
        if was_set or now_s - self._checked_s > held_up_s:
            self._since_s = now_s
        self._clock_offset_s, self._checked_s = offset_s, now_s
        return now_s - self._since_s
