"""Wait for a database or a storage that is away."""

from __future__ import annotations

import errno
import math
import time
from collections.abc import Callable
from typing import TypeVar

import structlog

from stillpath.service.storage.disk import DISK_FULL

__all__ = ["patiently"]

_PATIENCE_S = 180.0
"""Time for which storage and database may be unavailable before an attempt is given up. A request
to S3 alone may take a minute."""
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.2, 4.0

_Given = TypeVar("_Given")


def patiently(
    action: Callable[[], _Given],
    trouble: type[Exception],
    pause: Callable[[float], None] = time.sleep,
    *,
    for_ever: bool = False,
) -> _Given:
    """Repeat `action` while it raises `trouble`, up to a limit; do not wait for a full disk.

    Parameters
    ----------
    pause : callable
        Waits for so many seconds; may raise to give up.
    for_ever : bool
        Whether there is no limit.
    """
    deadline = math.inf if for_ever else time.monotonic() + _PATIENCE_S
    wait_s = _FIRST_PAUSE_S
    while True:
        try:
            return action()
        except trouble as error:
            full = isinstance(error, OSError) and error.errno in (*DISK_FULL, errno.EFBIG)
            if full or time.monotonic() > deadline:
                raise
            structlog.get_logger("worker").warning("trying again", error=str(error), in_s=wait_s)
        pause(wait_s)
        wait_s = min(2 * wait_s, _LONGEST_PAUSE_S)
